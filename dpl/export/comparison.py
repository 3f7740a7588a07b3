"""Comparison of an ONNX graph with its surrogate: largest differences and latencies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.evaluation import latency
from dpl.export.onnx_graph import Array, ExportGraph, OnnxSession
from dpl.fem import Load
from dpl.scene import Scene

CHECK_STREAM = (0, 11)  # random stream of the loads of the comparison
IN_RANGE = "in range"
AMPLITUDES = {"small": 1e-3, "tiny": 1e-9, "large": 10.0}  # factors on loads in the training range
N_OUTSIDE = 4  # loads of each kind outside the training range
BATCH = 32  # batch size for which times are measured


class CheckLoads(NamedTuple):
    """Loads on which graph and surrogate are compared.

    Attributes:
        kinds: Kind of each load, B entries.
        force: (B, N, D) [N].
        young: (B,) [Pa].
        poisson: (B,) [-]; None if the law has a single Poisson's ratio.
    """

    kinds: list[str]
    force: Tensor
    young: Tensor
    poisson: Tensor | None

    def inputs(self, selection: slice | list[int] = slice(None)) -> tuple[Tensor, ...]:
        """Return the inputs of the graph for a selection of loads."""
        columns = (self.force, self.young, self.poisson)
        return tuple(column[selection] for column in columns if column is not None)


@dataclass(frozen=True)
class OutputDifference:
    """Differences between graph and surrogate for loads of one kind.

    Attributes:
        kind: Kind of the loads.
        n_loads: Number of loads.
        max_error: Largest relative difference ||a - b|| / ||b|| of loads that are not local [-].
        n_local: Number of loads that the graph marks as local.
        max_local_error: Largest relative difference of local loads, which the surrogate solves with
            the factor of K(0) and the graph does not [-]; NaN if there are none.
        median_local_error: Median of the same differences [-].
    """

    kind: str
    n_loads: int
    max_error: float
    n_local: int
    max_local_error: float
    median_local_error: float


@dataclass(frozen=True)
class BatchLatency:
    """Latency of the network without the checks of the simulator, see `dpl.evaluation.timing`.

    Attributes:
        batch: Loads per call.
        torch_p50: Median wall time of a call of the surrogate [ms].
        torch_p99: 99th percentile of the same [ms].
        onnxruntime_p50: Median wall time of a call of the graph [ms].
        onnxruntime_p99: 99th percentile of the same [ms].
    """

    batch: int
    torch_p50: float
    torch_p99: float
    onnxruntime_p50: float
    onnxruntime_p99: float


def sample_check_loads(scene: Scene, count: int) -> CheckLoads:
    """Return loads in the training range, scaled loads, zero loads, nodal forces and noise.

    Args:
        scene: The scene.
        count: Number of loads in the training range.
    """
    loads = scene.loads
    parts = [(IN_RANGE, loads.sample(CHECK_STREAM, range(count)))]
    for kind, amplitude in AMPLITUDES.items():
        parts.append((kind, loads.sample(CHECK_STREAM, range(N_OUTSIDE), amplitude=amplitude)))
    some = loads.sample(CHECK_STREAM, range(N_OUTSIDE))
    parts.append(("zero", some._replace(force=torch.zeros_like(some.force))))
    parts += [(kind, some._replace(force=force)) for kind, force in _foreign_forces(scene).items()]
    kinds = [kind for kind, load in parts for _ in load.force]
    load = Load(*(torch.cat(column) for column in zip(*(load for _, load in parts), strict=True)))
    force = load.force * (load.young * scene.force_unit)[:, None, None]
    poisson = load.poisson[:, 0] if load.poisson.shape[1] else None
    return CheckLoads(kinds, force, load.young, poisson)


def _foreign_forces(scene: Scene) -> dict[str, Tensor]:
    """Return forces on single nodes and white noise on all nodes, (N_OUTSIDE, N, D) [-] each."""
    random = torch.Generator().manual_seed(11)
    shape = (N_OUTSIDE, *scene.problem.shape)
    nodes = scene.loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    nodal = torch.zeros(shape, dtype=torch.float64)
    for k in range(N_OUTSIDE):
        node = nodes[int(torch.randint(len(nodes), (1,), generator=random))]
        nodal[k, node] = torch.randn(shape[2], generator=random, dtype=torch.float64)
    noise = torch.randn(shape, generator=random, dtype=torch.float64)
    size = 0.1 * scene.loads.largest_force
    return {
        kind: size * force / force.flatten(1).norm(dim=1)[:, None, None]
        for kind, force in (("on a node", nodal), ("noise", noise))
    }


def compare_outputs(
    graph: ExportGraph, session: OnnxSession, loads: CheckLoads
) -> list[OutputDifference]:
    """Return the differences between an ONNX file and its surrogate for each kind of load.

    All loads are evaluated at once, then the first three, then each load alone, to detect a graph
    with a fixed batch size. The outputs for local loads are compared with the representation in the
    basis. A load that only one of the two marks as local has an infinite difference.

    Args:
        graph: The graph, evaluated by torch.
        session: The ONNX file, evaluated by onnxruntime.
        loads: The loads.
    """
    count = len(loads.kinds)
    largest, local_error = np.zeros(count), np.zeros(count)
    local = np.zeros(count, dtype=bool)
    for part in (slice(0, count), slice(0, 3), *(slice(k, k + 1) for k in range(count))):
        inputs = loads.inputs(part)
        with torch.inference_mode():
            in_basis, *flags = graph(*inputs)
            surrogate = graph.surrogate(*inputs)
        found = session(*(column.numpy() for column in inputs))
        expected = flags[0].numpy() if flags else np.zeros(len(found.local), dtype=bool)
        error = relative_differences(found.displacement, in_basis.numpy())
        full_error = relative_differences(found.displacement, surrogate.numpy())
        error = np.where(found.local, error, np.maximum(error, full_error))
        error = np.where(found.local == expected, error, np.inf)
        largest[part] = np.maximum(largest[part], error)
        local_error[part] = np.where(found.local, np.maximum(local_error[part], full_error), np.nan)
        local[part] = found.local
    return [
        _summarise(
            kind, np.array([one == kind for one in loads.kinds]), largest, local, local_error
        )
        for kind in dict.fromkeys(loads.kinds)
    ]


def _summarise(
    kind: str,
    selected: NDArray[np.bool_],
    largest: Array,
    local: NDArray[np.bool_],
    local_error: Array,
) -> OutputDifference:
    """Return the row of one kind, whose loads are `selected`, (B,)."""
    marked = selected & local
    errors = local_error[marked] if marked.any() else np.array([np.nan])
    return OutputDifference(
        kind,
        int(selected.sum()),
        float(largest[selected].max()),
        int(marked.sum()),
        float(errors.max()),
        float(np.median(errors)),
    )


def relative_differences(found: Array, expected: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, N, D), (B,) [-]; 0 where both are zero."""
    difference = np.sqrt(((found - expected) ** 2).sum(axis=(1, 2)))
    size = np.sqrt((expected**2).sum(axis=(1, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0, 0.0, difference / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)


def measure_latency(
    graph: ExportGraph,
    session: OnnxSession,
    loads: CheckLoads,
    *,
    calls: int,
    batches: Sequence[int] = (1, BATCH),
) -> list[BatchLatency]:
    """Return the latencies of surrogate and graph on loads in the training range.

    Local loads are left out, because the graph does less for them. If all are local, all are used.

    Args:
        graph: The graph whose surrogate is timed.
        session: The ONNX file.
        loads: The loads.
        calls: Smallest number of calls of each.
        batches: Numbers of loads per call.
    """
    local = session(*(column.numpy() for column in loads.inputs())).local
    usual = [k for k, kind in enumerate(loads.kinds) if kind == IN_RANGE and not local[k]]
    usual = usual or list(range(len(local)))
    rows = []
    for batch in batches:
        size = min(batch, len(usual))
        starts = range(0, len(usual) - size + 1, size)
        inputs = [loads.inputs(usual[start : start + size]) for start in starts]
        arrays = [tuple(column.numpy() for column in part) for part in inputs]
        repeats = -(-calls // len(inputs))
        torch_time = latency(lambda part: graph.surrogate(*part), inputs, repeats=repeats)
        onnx_time = latency(lambda part: session(*part), arrays, repeats=repeats)
        times = (torch_time.p50, torch_time.p99, onnx_time.p50, onnx_time.p99)
        rows.append(BatchLatency(size, *(round(time, 4) for time in times)))
    return rows
