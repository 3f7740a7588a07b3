"""What is wrong with a data set, as far as its scene can tell."""

from collections.abc import Mapping

import torch
from torch import Tensor

from dpl.fem.modes import Modes
from dpl.scene import Scene


def flaw_of_modes(scene: Scene, kept: Modes) -> str:
    """Return what is wrong with stored modes, their signs and bases included; empty if nothing."""
    near = [
        (a.shape, a.dtype) == (b.shape, b.dtype) and torch.allclose(a, b, rtol=1e-6, atol=1e-6)
        for a, b in zip(kept, scene.loads.modes, strict=True)
    ]
    return "" if all(near) else "holds other modes than this scene has"


def flaw_of_shard(scene: Scene, stream: tuple[int, int], shard: Mapping[str, Tensor]) -> str:
    """Return what is wrong with a shard; empty if nothing is.

    Args:
        scene: What it was made for.
        stream: Seed of its loads.
        shard: What it holds.
    """
    problem, loads = scene.problem, scene.loads
    if not len(shard["index"]):
        return ""
    points = loads.points(stream, shard["index"].tolist())
    if not torch.allclose(shard["point"], points, rtol=0, atol=1e-12):
        return "holds other loads than its seed draws"
    rounding = 1e-9 * loads.largest_force
    if not torch.allclose(shard["force"], loads.at(points).force, rtol=1e-6, atol=rounding):
        return "holds loads that this scene does not draw"
    poisson = loads.poisson_at(points)
    if not torch.allclose(shard["poisson"], poisson, rtol=0, atol=1e-12):
        return "holds other Poisson's ratios than its seed draws"
    for k, (u, force) in enumerate(zip(shard["displacement"], shard["force"], strict=True)):
        body = problem.at(shard["poisson"][k, None])
        internal, volume = body.evaluate(u[None])
        balanced = body.balanced(u[None], internal, force[None], scene.solver.tol)
        if not (bool(volume > 0) and bool(balanced)):
            return f"holds an answer out of balance: load {int(shard['index'][k])}"
    return ""
