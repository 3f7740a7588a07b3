"""Comparison of an ONNX graph with its surrogate: largest differences."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.export.onnx_graph import Array, ExportGraph, OnnxSession
from dpl.fem import Load
from dpl.scene import Scene

CHECK_STREAM = (0, 11)  # random stream of the loads of the comparison
IN_RANGE = "in range"
AMPLITUDES = {"small": 1e-3, "tiny": 1e-9, "large": 10.0}  # factors on loads in the training range
N_OUTSIDE = 4  # loads of each kind outside the training range


class CheckLoads(NamedTuple):
    """Loads on which graph and surrogate are compared.

    Attributes:
        kinds: Kind of each load, B entries.
        inputs: Inputs of the graph by name, B of each, see `Scene.si_inputs`.
    """

    kinds: list[str]
    inputs: dict[str, Tensor]

    def select(self, selection: slice | list[int]) -> dict[str, Tensor]:
        """Return the inputs of a selection of loads."""
        return {name: column[selection] for name, column in self.inputs.items()}


@dataclass(frozen=True)
class OutputDifference:
    """Differences between graph and surrogate for loads of one kind.

    Attributes:
        kind: Kind of the loads.
        n_loads: Number of loads.
        max_error: Largest relative difference ||a - b|| / ||b|| [-].
    """

    kind: str
    n_loads: int
    max_error: float


def sample_check_loads(scene: Scene, count: int) -> CheckLoads:
    """Return `count` loads in the training range, scaled and zero loads, nodal forces and noise."""
    loads = scene.loads
    some = loads.sample(CHECK_STREAM, range(N_OUTSIDE))
    parts = {IN_RANGE: loads.sample(CHECK_STREAM, range(count))}
    parts |= {kind: some._replace(force=a * some.force) for kind, a in AMPLITUDES.items()}
    parts |= {kind: some._replace(force=force) for kind, force in _foreign_forces(scene).items()}
    kinds = [kind for kind, load in parts.items() for _ in load.force]
    load = Load(*map(torch.cat, zip(*parts.values(), strict=True)))
    return CheckLoads(kinds, scene.si_inputs(load))


def _foreign_forces(scene: Scene) -> dict[str, Tensor]:
    """Return no forces, forces on single nodes, and white noise, (N_OUTSIDE, N, D) [-] each."""
    random = torch.Generator().manual_seed(11)
    nodes = scene.loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    zero = torch.zeros(N_OUTSIDE, *scene.problem.shape, dtype=torch.float64)
    nodal = zero.clone()
    for force in nodal:
        node = nodes[int(torch.randint(len(nodes), (1,), generator=random))]
        force[node] = torch.randn(force.shape[1], generator=random, dtype=torch.float64)
    noise = torch.randn(zero.shape, generator=random, dtype=torch.float64)
    size = 0.1 * scene.loads.largest_force
    nodal, noise = (f * size / f.flatten(1).norm(dim=1)[:, None, None] for f in (nodal, noise))
    return {"zero": zero, "on a node": nodal, "noise": noise}


def compare_outputs(
    graph: ExportGraph, session: OnnxSession, loads: CheckLoads
) -> list[OutputDifference]:
    """Return the differences between an ONNX file and its surrogate for each kind of load.

    All loads are evaluated at once, then the first three, then each load alone, to detect a graph
    with a fixed batch size.
    """
    count = len(loads.kinds)
    largest = np.zeros(count)
    for part in (slice(0, count), slice(0, 3), *(slice(k, k + 1) for k in range(count))):
        inputs = loads.select(part)
        with torch.inference_mode():
            expected = graph(**inputs).numpy()
        error = relative_differences(session(**inputs), expected)
        largest[part] = np.maximum(largest[part], error)
    rows = []
    for kind in dict.fromkeys(loads.kinds):
        own = largest[[one == kind for one in loads.kinds]]
        rows.append(OutputDifference(kind, len(own), float(own.max())))
    return rows


def relative_differences(found: Array, expected: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, N, D), (B,) [-]; 0 where both are zero."""
    difference, size = (np.sqrt((x**2).sum(axis=(1, 2))) for x in (found - expected, expected))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0, 0.0, difference / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)
