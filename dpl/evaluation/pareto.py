"""Run time against error: every solver and every iterate of it on the same loads."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dpl.evaluation.timing import WARM_UP, percentiles, time_iterates
from dpl.fem import Load, Solver, solve
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import RelativeL2, Surrogate
from dpl.training.metrics import median

Cells = tuple[int, ...]
COLOURS = [f"C{k}" for k in range(10) if k != 7]  # grey is for what is beside


@dataclass(frozen=True)
class Discretisation:
    """A mesh under a load that all meshes of its body have.

    Attributes:
        cells: Along the edges of the beam, or as `dpl.fem.propeller` counts them.
        degree: Of the elements.
        dofs: Degrees of freedom, held ones included.
        ms: Median wall time of Newton to 1e-6 [ms].
        value: What is read off the answer: the beam's displacement across itself at a corner of the
            end face [m], the propeller's mean displacement along its shaft over L [-].
        error: Of the value, over the limit [-].
    """

    cells: Cells
    degree: int
    dofs: int
    ms: float
    value: float
    error: float


@dataclass(frozen=True)
class Point:
    """One iterate of a solver, over all loads.

    Attributes:
        solver: Its name.
        iterate: Which one; a load that has ended before stays with its end.
        last: Whether all loads have ended.
        threads: Threads of torch and BLAS.
        device: Where the network runs.
        loads: How many.
        ms: Median wall time until it is there, one load at a time, its residual and min det F
            included [ms].
        ms_p99: 99th percentile of the same [ms].
        error: Median relative L2 error against the mesh's exact answer [-].
        worst: Largest of the same [-].
        residual: Median ||R|| / ||f|| [-].
    """

    solver: str
    iterate: int
    last: bool
    threads: int
    device: str
    loads: int
    ms: float
    ms_p99: float
    error: float
    worst: float
    residual: float


def points(
    solvers: Mapping[str, Solver],
    batch: Sample,
    *,
    threads: int = 1,
    device: str = "cpu",
    tick: Callable[[], None] = lambda: None,
) -> list[Point]:
    """Return the iterates of solvers; each has all loads in a row, one at a time, after a warm-up.

    Args:
        solvers: Named.
        batch: Loads with the truth.
        threads: Of torch and BLAS; more than one lets BLAS have what it takes.
        device: Where networks run, for the record.
        tick: Called after each solver.
    """
    singles = batch.load.unbatch()
    found = []
    with _threads(threads), torch.inference_mode():
        for name, solver in solvers.items():
            for load in singles[:WARM_UP]:
                solve(solver, load)
            paths = [time_iterates(solver, load) for load in singles]
            count = max(map(len, paths))
            for k in range(count):
                now = [states[min(k, len(states) - 1)] for states in paths]
                taken = torch.tensor([ms for ms, _ in now], dtype=torch.float64)
                answers = torch.cat([state.displacement for _, state in now])
                error = RelativeL2().measure(answers, batch)
                residual = torch.cat([state.residual for _, state in now])
                found.append(
                    Point(
                        name,
                        k,
                        k == count - 1,
                        threads,
                        device,
                        len(singles),
                        *percentiles(taken),
                        float(median(error)),
                        float(error.max()),
                        float(median(residual)),
                    )
                )
            tick()
    return found


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with one_thread() if count == 1 else nullcontext():
            yield
    finally:
        torch.set_num_threads(before)


def all_threads() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_gpu(surrogate: Surrogate) -> Callable[[Load], Tensor]:
    """Return a surrogate's predictions made on the GPU, copies there and back included."""
    device = torch.device("cuda")
    there = surrogate.to(device)

    def predict(load: Load) -> Tensor:
        return there.predict(Load(*(column.to(device) for column in load))).cpu()

    return predict


def draw(
    rows: Sequence[Point],
    meshes: Sequence[Discretisation],
    floor: float | None,
    file: Path,
) -> None:
    """Draw run time against error: a line for each solver that iterates, a dot for the others.

    Args:
        rows: Iterates of solvers, one setting of threads.
        meshes: Finite elements on other meshes, against the limit.
        floor: Discretisation error of the mesh that all solvers have [-]; None: not known.
        file: Of the picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 5.2), layout="constrained")
    ax = figure.subplots()
    named: set[str] = set()
    families = list(dict.fromkeys(_family(row.solver) for row in rows))
    for name in dict.fromkeys(row.solver for row in rows):
        path_of = [row for row in rows if row.solver == name and row.error < 1]
        x, y = [row.ms for row in path_of], [max(row.error, 1e-12) for row in path_of]
        tier = name.partition(", ")[2]
        colour = "0.1" if _family(name) == "Newton" else COLOURS[families.index(_family(name)) % 9]
        marker = {"corrected": "D", "hybrid": "s", "GPU": "*"}.get(tier, "o")
        shown = not tier or tier == "GPU"  # other marks are explained below
        label = name.partition(" to ")[0] if shown and _family(name) not in named else None
        named.add(_family(name))
        ax.loglog(x, y, color=colour, lw=1.2, marker=marker, ms=4, label=label)
        ax.loglog(x[-1:], y[-1:], color=colour, marker=marker, ms=8)
    for marker, tier in (("D", "corrected"), ("s", "hybrid: each iterate")):
        ax.plot([], [], color="0.5", ls="", marker=marker, label=f"the same, {tier}")
    for degree, marker, name in ((1, "s", "linear"), (2, "D", "quadratic")):
        family = [mesh for mesh in meshes if mesh.degree == degree]
        if not family:
            continue
        ax.loglog(
            [mesh.ms for mesh in family],
            [mesh.error for mesh in family],
            color="0.55", ls=":", marker=marker, ms=5, mfc="none",
            label=f"Newton, {name} meshes, against\nthe limit (degrees of freedom)",
        )  # fmt: skip
        away = 4, 4 if degree == 1 else -10
        for mesh in family:
            ax.annotate(
                f"{mesh.dofs:,}", (mesh.ms, mesh.error), fontsize=7, color="0.4",
                textcoords="offset points", xytext=away,
            )  # fmt: skip
    if floor is not None:
        ax.axhline(floor, color="0.3", ls="--", lw=1)
        ax.annotate(
            "what the mesh itself is off",
            (0.01, floor),
            xycoords=("axes fraction", "data"),
            fontsize=8,
            va="top",
            xytext=(0, -2),
            textcoords="offset points",
        )
    ax.set_xlabel("time of one load, its residual and min det F included, p50 [ms]")
    ax.set_ylabel("relative error, median of the loads")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(file, dpi=130)


def _family(solver: str) -> str:
    """Return what solvers of one colour have in common."""
    return solver.partition(", ")[0].partition(" to ")[0]
