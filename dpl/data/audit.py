"""What is wrong with a data set, as far as its scene can tell, and making it sound again."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from dpl.data.durable import DataSetError, sole_writer, sync_folder, write_file
from dpl.data.manifest import lines_of
from dpl.data.store import MODES, Store
from dpl.data.writer import rewrite
from dpl.fem.modes import Modes
from dpl.scene import Scene

MACHINE = ("timed out", "its worker died")  # reasons that lie with the machine: `repair` retries


def verify(store: Store) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield each shard's line with what is wrong with it; empty if nothing is.

    A shard is sound if its bytes are those that were written, its loads those that the scene
    draws, and each displacement balances its load to the tolerance, evaluated again, with
    nothing inverted.

    Raises:
        DataSetError: There is none.
    """
    if not (store.folder / "scene.json").exists():
        raise DataSetError(f"{store.folder} holds no data set yet; generate it first")
    try:
        flaw = flaw_of_modes(store.scene, store.modes())
    except DataSetError as error:
        flaw = f"is damaged: {error}"
    yield {"file": MODES, "rejected": []}, flaw
    for line in store.shards():
        try:
            shard = store.sound(line)
            yield line, flaw_of_shard(store.scene, store.stream(line["split"]), shard)
        except ValueError as error:
            yield line, str(error)


def repair(store: Store) -> dict[str, dict[str, Any]]:
    """Forget damaged shards, and those with loads that the machine lost; return their lines.

    Their loads count as missing from then on. Files that no manifest names are removed.

    Raises:
        DataSetError: Another process writes there.
    """
    if not (store.folder / "scene.json").exists():
        return {}
    with sole_writer(store.folder):
        poor = {
            line["file"]: line
            for line, flaw in verify(store)
            if flaw or any(one["reason"].startswith(MACHINE) for one in line["rejected"])
        }
        if poor.pop(MODES, None):
            write_file(store.folder / MODES, save(store.scene.loads.modes._asdict()))
        named = {MODES}
        for manifest in store.manifests():
            lines = [line for line in lines_of(manifest) if line["file"] not in poor]
            named |= {line["file"] for line in lines}
            rewrite(manifest, lines)
        for path in [*store.folder.glob("*.safetensors"), *store.folder.rglob(".*.part")]:
            if path.name not in named and (path.is_symlink() or not path.is_dir()):
                path.unlink()
        for path in store.spool.files().values():
            if store.spool.get(path).reason.startswith(MACHINE):
                path.unlink()
        sync_folder(store.folder)
    return poor


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
