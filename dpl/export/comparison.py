"""Comparison of an ONNX graph with its surrogate: largest differences."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpl.export.onnx_graph import Array, OnnxSession
from dpl.fem import Load
from dpl.scene import Scene
from dpl.training import TrainedSurrogate

CHECK_STREAM = (0, 11)  # random stream of the loads of the comparison
IN_RANGE = "in range"
AMPLITUDES = {"small": 1e-3, "tiny": 1e-9, "large": 10.0}  # factors on loads in the training range
N_OUTSIDE = 4  # loads of each kind outside the training range


@dataclass(frozen=True)
class OutputDifference:
    """Differences between graph and surrogate for loads of one kind."""

    kind: str
    n_loads: int
    max_error: float  # largest relative difference ||a - b|| / ||b|| [-]


def sample_check_loads(scene: Scene, count: int) -> tuple[list[str], dict[str, Tensor]]:
    """Return kinds (B entries) and inputs of the graph (B of each) of loads for the comparison.

    They are `count` loads in the training range, scaled and zero loads, forces on single nodes, and
    white noise.
    """
    loads, random = scene.loads, torch.Generator().manual_seed(11)
    some = loads.sample(CHECK_STREAM, range(N_OUTSIDE))
    zero, nodes = torch.zeros_like(some.force), loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    nodal = zero.clone()
    for force in nodal:
        node = nodes[int(torch.randint(len(nodes), (1,), generator=random))]
        force[node] = torch.randn(force.shape[1], generator=random, dtype=torch.float64)
    noise = torch.randn(zero.shape, generator=random, dtype=torch.float64)
    size = 0.1 * loads.largest_force
    nodal, noise = (f * size / f.flatten(1).norm(dim=1)[:, None, None] for f in (nodal, noise))
    forces = {kind: factor * some.force for kind, factor in AMPLITUDES.items()}
    forces |= {"zero": zero, "on a node": nodal, "noise": noise}
    parts = {IN_RANGE: loads.sample(CHECK_STREAM, range(count))}
    parts |= {kind: some._replace(force=force) for kind, force in forces.items()}
    kinds = [kind for kind, load in parts.items() for _ in load.force]
    return kinds, scene.si_inputs(Load(*map(torch.cat, zip(*parts.values(), strict=True))))


def compare_outputs(
    surrogate: TrainedSurrogate, session: OnnxSession, kinds: list[str], inputs: dict[str, Tensor]
) -> list[OutputDifference]:
    """Return the differences between an ONNX file and its surrogate for each kind of load.

    All loads are evaluated at once, then the first three, then each load alone, to detect a graph
    with a fixed batch size.
    """
    count = len(kinds)
    largest = np.zeros(count)
    for part in (slice(0, count), slice(0, 3), *(slice(k, k + 1) for k in range(count))):
        some = {name: column[part] for name, column in inputs.items()}
        with torch.inference_mode():
            expected = surrogate(**some).numpy()
        largest[part] = np.maximum(largest[part], relative_differences(session(**some), expected))
    rows = []
    for kind in dict.fromkeys(kinds):
        own = largest[[one == kind for one in kinds]]
        rows.append(OutputDifference(kind, len(own), float(own.max())))
    return rows


def relative_differences(found: Array, expected: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, N, D), (B,) [-]; 0 where both are zero."""
    difference, size = (np.linalg.norm(x, axis=(1, 2)) for x in (found - expected, expected))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0, 0.0, difference / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)
