"""Comparison of an ONNX graph with its surrogate: largest differences and latencies."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.evaluation import latency
from dpl.export.onnx_graph import Array, ExportGraph, OnnxSession
from dpl.fem import Load
from dpl.models import FlagsLocalLoads
from dpl.scene import Scene

CHECK_STREAM = (0, 11)  # random stream of the loads of the comparison
IN_RANGE = "in range"
AMPLITUDES = {"small": 1e-3, "tiny": 1e-9, "large": 10.0}  # factors on loads in the training range
N_OUTSIDE = 4  # loads of each kind outside the training range
ESTIMATE_FACTOR = 3.0  # largest ratio of a missing part to its estimate [-]
BATCHES = (1, 32)  # batch sizes for which times are measured


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
        max_error: Largest relative difference ||a - b|| / ||b|| from the torch operations of the
            graph, or from the surrogate where that is not explained by the basis [-].
        max_basis_error: Largest relative difference from the surrogate of loads that are not local
            [-]. It exceeds `max_error` where the surrogate applies a factor of K(0) to every load.
        n_local: Number of loads that the graph marks as local.
        max_local_error: Largest relative difference of local loads, which the surrogate solves with
            the factor of K(0) and the graph does not [-]; NaN if there are none.
        median_local_error: Median of the same differences [-].
    """

    kind: str
    n_loads: int
    max_error: float
    max_basis_error: float
    n_local: int
    max_local_error: float
    median_local_error: float


@dataclass(frozen=True)
class BatchLatency:
    """Latency of the network without the checks of the simulator, see `dpl.evaluation.timing`.

    Attributes:
        batch: Loads per call.
        torch_p50, torch_p99: Percentiles of the wall time of a call of the surrogate [ms].
        onnxruntime_p50, onnxruntime_p99: The same of the graph [ms].
    """

    batch: int
    torch_p50: float
    torch_p99: float
    onnxruntime_p50: float
    onnxruntime_p99: float


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
    with a fixed batch size. A load that only one of the two marks as local has an infinite
    difference. The difference of other loads from the surrogate counts too, beyond the part that
    the basis may miss where the surrogate solves every load.
    """
    count = len(loads.kinds)
    largest, distance = np.zeros(count), np.zeros(count)
    local = np.zeros(count, dtype=bool)
    net = graph.surrogate.net
    solves = isinstance(net, FlagsLocalLoads) and net.solves_every_load()
    allowed = ESTIMATE_FACTOR * net.linear_tol if solves else 0.0
    for part in (slice(0, count), slice(0, 3), *(slice(k, k + 1) for k in range(count))):
        inputs = loads.select(part)
        with torch.inference_mode():
            in_basis, *flags = (output.numpy() for output in graph(**inputs))
            surrogate = graph.surrogate(**inputs).numpy()
        found = session(**inputs)
        error = relative_differences(found.displacement, in_basis)
        full_error = relative_differences(found.displacement, surrogate)
        counts = ~found.local & (full_error > allowed)
        error = np.where(counts, np.maximum(error, full_error), error)
        error[found.local != (flags[0] if flags else False)] = np.inf
        largest[part] = np.maximum(largest[part], error)
        distance[part] = np.maximum(distance[part], full_error)
        local[part] = found.local
    rows = []
    for kind in dict.fromkeys(loads.kinds):
        own = np.array([one == kind for one in loads.kinds])
        marked = distance[own & local]
        worst, middle = (marked.max(), np.median(marked)) if len(marked) else (np.nan, np.nan)
        others = float(distance[own & ~local].max(initial=0))
        numbers = int(own.sum()), float(largest[own].max()), others, len(marked)
        rows.append(OutputDifference(kind, *numbers, float(worst), float(middle)))
    return rows


def relative_differences(found: Array, expected: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, N, D), (B,) [-]; 0 where both are zero."""
    difference, size = (np.sqrt((x**2).sum(axis=(1, 2))) for x in (found - expected, expected))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0, 0.0, difference / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)


def measure_latency(
    graph: ExportGraph, session: OnnxSession, loads: CheckLoads, *, calls: int
) -> list[BatchLatency]:
    """Return latencies of surrogate and graph on loads in the training range, `calls` or more.

    Local loads are left out, because the graph does less for them. If all are local, all are used.
    """
    local = session(**loads.inputs).local
    usual = [k for k, kind in enumerate(loads.kinds) if kind == IN_RANGE and not local[k]]
    usual = usual or list(range(len(local)))
    rows = []
    for batch in BATCHES:
        size = min(batch, len(usual))
        starts = range(0, len(usual) - size + 1, size)
        inputs = [loads.select(usual[start : start + size]) for start in starts]
        arrays = [{name: column.numpy() for name, column in part.items()} for part in inputs]
        repeats = -(-calls // len(inputs))
        surrogate = latency(lambda part: graph.surrogate(**part), inputs, repeats=repeats)
        onnx = latency(lambda part: session(**part), arrays, repeats=repeats)
        times = (surrogate.p50, surrogate.p99, onnx.p50, onnx.p99)
        rows.append(BatchLatency(size, *(round(time, 4) for time in times)))
    return rows
