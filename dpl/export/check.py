"""A graph against the surrogate that it was made of: how far apart, and how fast."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.evaluation import latency
from dpl.export.onnx_graph import Array, Graph, Session
from dpl.fem import Load
from dpl.scene import Scene

TRIED = (0, 11)  # the stream of the loads that graphs are checked on
IN_RANGE = "in range"
SIZES = {"small": 1e-3, "tiny": 1e-9, "large": 10.0}  # times loads of the training's range
FEW = 4  # loads of each kind besides those of the training's range
BATCH = 32  # loads at once, where batches are timed


class Trial(NamedTuple):
    """Loads on which graph and surrogate are compared.

    Attributes:
        kinds: What each is, B of them.
        force: (B, N, D) [N].
        young: (B,) [Pa].
        poisson: (B,) [-]; None where the law has one Poisson's ratio.
    """

    kinds: list[str]
    force: Tensor
    young: Tensor
    poisson: Tensor | None

    def part(self, where: slice | list[int]) -> tuple[Tensor, ...]:
        """Return what goes into a graph, of some of the loads."""
        columns = (self.force, self.young, self.poisson)
        return tuple(column[where] for column in columns if column is not None)


@dataclass(frozen=True)
class Row:
    """Loads of one kind.

    Attributes:
        kind: Which.
        loads: How many.
        error: Largest relative difference of graph and surrogate, over loads that are not local,
            ||a - b|| / ||b|| [-].
        local: How many the graph says are local.
        local_error: Largest relative difference over those: what the factor of K(0) would have
            added, and the graph cannot [-]; NaN where there are none.
        local_median: Median of the same [-].
    """

    kind: str
    loads: int
    error: float
    local: int
    local_error: float
    local_median: float


@dataclass(frozen=True)
class Times:
    """Latency of the bare network, see `dpl.evaluation.timing`.

    Attributes:
        batch: Loads in a call.
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


def trial(scene: Scene, count: int) -> Trial:
    """Return loads of every kind: of the training's range, far smaller, larger, local, strange.

    Args:
        scene: What is answered.
        count: Loads of the training's range.
    """
    loads, dim = scene.loads, scene.problem.shape[1]
    parts = [(IN_RANGE, loads.sample(TRIED, range(count)))]
    for kind, size in SIZES.items():
        parts.append((kind, loads.sample(TRIED, range(FEW), amplitude=size)))
    some = loads.sample(TRIED, range(FEW))
    parts.append(("zero", some._replace(force=torch.zeros_like(some.force))))
    random = torch.Generator().manual_seed(11)
    places = loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    point = torch.zeros_like(some.force)
    for k in range(FEW):
        node = places[int(torch.randint(len(places), (1,), generator=random))]
        point[k, node] = torch.randn(dim, generator=random, dtype=torch.float64)
    noise = torch.randn(some.force.shape, generator=random, dtype=torch.float64)
    for kind, field in (("on a node", point), ("noise", noise)):
        size = 0.1 * loads.largest_force / field.flatten(1).norm(dim=1)
        parts.append((kind, some._replace(force=size[:, None, None] * field)))
    kinds = [kind for kind, load in parts for _ in load.force]
    load = Load(*(torch.cat(column) for column in zip(*(load for _, load in parts), strict=True)))
    force = load.force * (load.young * scene.force_unit)[:, None, None]
    own = load.poisson[:, 0] if load.poisson.shape[1] else None
    return Trial(kinds, force, load.young, own)


def compare(graph: Graph, session: Session, tried: Trial) -> list[Row]:
    """Return how far a graph is from its surrogate, a row for each kind of load.

    All loads at once, then the first few alone and in threes, since a graph may have kept a batch.
    Where a load is local the graph is held to the surrogate's answer within its basis.

    Args:
        graph: As torch computes it.
        session: As onnxruntime does.
        tried: The loads.
    """
    whole = len(tried.kinds)
    worst, apart = np.zeros(whole), np.zeros(whole)
    local = np.zeros(whole, dtype=bool)
    parts = [slice(0, whole), slice(0, 3), *(slice(k, k + 1) for k in range(whole))]
    for part in parts:
        given = tried.part(part)
        with torch.inference_mode():
            within, *flags = graph(*given)
            answer = graph.surrogate(*given)
        found = session(*(column.numpy() for column in given))
        flagged = flags[0].numpy() if flags else np.zeros(len(found.local), dtype=bool)
        error = distance(found.displacement, within.numpy())
        beyond = distance(found.displacement, answer.numpy())
        error = np.where(found.local, error, np.maximum(error, beyond))
        error = np.where(found.local == flagged, error, np.inf)
        worst[part] = np.maximum(worst[part], error)
        apart[part] = np.where(found.local, np.maximum(apart[part], beyond), np.nan)
        local[part] = found.local
    rows = []
    for kind in dict.fromkeys(tried.kinds):
        here = np.array([one == kind for one in tried.kinds])
        near = here & local
        off = apart[near] if near.any() else np.array([np.nan])
        told = int(near.sum()), float(off.max()), float(np.median(off))
        rows.append(Row(kind, int(here.sum()), float(worst[here].max()), *told))
    return rows


def distance(answer: Array, truth: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, N, D), (B,) [-]: 0 where both are zero."""
    apart = np.sqrt(((answer - truth) ** 2).sum(axis=(1, 2)))
    size = np.sqrt((truth**2).sum(axis=(1, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(apart == 0, 0.0, apart / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)


def clock(
    graph: Graph, session: Session, tried: Trial, *, calls: int, batches: Sequence[int] = (1, BATCH)
) -> list[Times]:
    """Return the times of surrogate and graph on loads of the training's range, none of them local.

    Where all of these are local, the times are those of all loads.

    Args:
        graph: Of whose surrogate.
        session: Of the graph.
        tried: The loads.
        calls: How often each is called at least.
        batches: Loads in a call.
    """
    local = session(*(column.numpy() for column in tried.part(slice(None)))).local
    usual = [k for k, kind in enumerate(tried.kinds) if kind == IN_RANGE and not local[k]]
    usual = usual or list(range(len(local)))
    rows = []
    for batch in batches:
        size = min(batch, len(usual))
        starts = range(0, len(usual) - size + 1, size)
        given = [tried.part(usual[start : start + size]) for start in starts]
        arrays = [tuple(column.numpy() for column in part) for part in given]
        repeats = -(-calls // len(given))
        ours = latency(lambda part: graph.surrogate(*part), given, repeats=repeats)
        theirs = latency(lambda part: session(*part), arrays, repeats=repeats)
        numbers = (ours.p50, ours.p99, theirs.p50, theirs.p99)
        rows.append(Times(size, *(round(number, 4) for number in numbers)))
    return rows
