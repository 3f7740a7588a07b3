"""Run time against error of all iterates of solvers on the same loads."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from benchmarks.study import method_colours, picture, place_labels
from dpl.evaluation.timing import WARM_UP, percentiles
from dpl.fem import Load, Solution, Solver, solve
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import relative_errors
from dpl.training.metrics import median

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORDS = {
    "": "prediction, or solution",
    "corrected": "one step in the modes",
    "hybrid": "hybrid: each iterate",
}
MARKERS = {"corrected": "D", "hybrid": "s"}  # of methods; "o" for others
LEAST = 1e-12  # errors below are drawn there [-]


@dataclass(frozen=True)
class Point:
    """One iterate of a solver, over all loads."""

    solver: str  # name of the solver
    iteration: int  # index of the iterate; a load with fewer iterates keeps its last one
    is_final: bool  # this is the last iterate of all loads
    threads: int  # threads of torch and BLAS
    device: str  # device of the other computations than the network's
    loads: int  # number of loads
    # median wall time up to this iterate, with its residual and min det F, one load at a time [ms]
    ms: float
    ms_p99: float  # 99th percentile of this time [ms]
    error: float  # median relative L2 error against the converged solution on the same mesh [-]
    max_error: float  # maximum of this error [-]
    residual: float  # median relative residual ||R|| / ||f|| [-]


def points(
    solvers: Mapping[str, Solver],
    batch: Sample,
    *,
    threads: int = 1,
    tick: Callable[[], None] = lambda: None,
) -> list[Point]:
    """Return run times and errors of all iterates of solvers, one load at a time.

    Each solver is warmed up, then solves all loads in a row; `tick` is called after each. With one
    thread of torch BLAS has one too, otherwise its default.
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
                iterates = [states[min(k, len(states) - 1)] for states in paths]
                times = torch.tensor([ms for ms, _ in iterates], dtype=torch.float64)
                displacement = torch.cat([state.displacement for _, state in iterates])
                error = relative_errors(displacement, batch)
                residual = torch.cat([state.residual for _, state in iterates])
                record = name, k, k == count - 1, threads, "cpu", len(singles)
                errors = float(median(error)), float(error.max()), float(median(residual))
                found.append(Point(*record, *percentiles(times), *errors))
            tick()
    return found


def time_iterates(solver: Solver, load: Load) -> list[tuple[float, Solution]]:
    """Return all iterates of a solver, each with the wall time up to it [ms]."""
    start = time.perf_counter()
    return [(1e3 * (time.perf_counter() - start), state) for state in solver.iterate(load)]


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with one_thread() if count == 1 else nullcontext():
            yield
    finally:
        torch.set_num_threads(before)


def draw(rows: Sequence[Point], path: Path) -> None:
    """Draw run time against error of the iterates of solvers, with the first number of threads.

    Each method has one colour: a dot for its prediction, a line through the iterates.
    """
    from matplotlib.ticker import LogLocator

    rows = [row for row in rows if row.threads == rows[0].threads]
    solvers = list(dict.fromkeys(row.solver for row in rows))
    families = {name: _family(name) for name in solvers}
    with picture(path, 4.4) as figure:
        ax = figure.subplots()
        labels = []
        for family, colour in method_colours(dict.fromkeys(families.values())).items():
            lines = [
                [row for row in rows if row.solver == name]
                for name in solvers
                if families[name] == family
            ]
            if family == "Newton":  # one line through the solutions to all tolerances
                lines = [sorted((line[-1] for line in lines), key=lambda row: row.ms)]
            starts = [at for line in lines if (at := _draw_line(ax, line, colour))]
            if starts:
                label = ax.annotate(family, min(starts), (0, 0), textcoords="offset points")
                label.set(color=colour, weight="bold", ha="center", va="center")
                labels.append(label)
        used = {name.partition(", ")[2] for name in solvers}
        for method, words in WORDS.items():
            if method in used:
                ax.plot([], [], color="0.5", ls="", marker=MARKERS.get(method, "o"), label=words)
        ax.set_xlabel("time of one load [ms], median")
        ax.set_ylabel("relative error, median of the loads")
        ax.set_ylim(top=10)
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
        ax.grid(visible=True)
        ax.legend(loc="lower left")
        place_labels(ax, labels)


def _draw_line(ax: "Axes", line: Sequence[Point], colour: str) -> tuple[float, float] | None:
    """Draw the iterates of a solver, the last one larger; return the place of the first."""
    shown = [row for row in line if row.error < 1]
    if not shown:
        return None
    style = {"color": colour, "marker": MARKERS.get(shown[-1].solver.partition(", ")[2], "o")}
    x, y = [row.ms for row in shown], [max(row.error, LEAST) for row in shown]
    ax.loglog(x, y, lw=1.2, ms=3, **style)
    ax.loglog(x[-1:], y[-1:], ms=7, **style)
    return x[0], y[0]


def _family(name: str) -> str:
    """Return the method of a solver without its variant and tolerance."""
    return name.partition(", ")[0].partition(" to ")[0]
