"""Run time against error of all iterates of solvers on the same loads."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from benchmarks.study import method_colours, picture
from dpl.evaluation.timing import WARM_UP, percentiles
from dpl.fem import Load, Solution, Solver, solve
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate, relative_errors
from dpl.training.metrics import median

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

Cells = tuple[int, ...]
WORDS = {
    "": "prediction, or solution",
    "corrected": "one step in the modes",
    "hybrid": "hybrid: each iterate",
}
MARKERS = {"corrected": "D", "hybrid": "s", "GPU": "*"}  # of methods; "o" for others
MARKER_SIZE, LABEL_OFFSET = 7.0, 7.0  # of predictions and their labels [points]
LEAST = 1e-12  # errors below are drawn there [-]


@dataclass(frozen=True)
class Discretisation:
    """A mesh of a refinement study, all under the same load.

    Attributes:
        cells: Cells along the edges of the beam, or as `dpl.fem.propeller` counts them.
        degree: Polynomial degree of the elements.
        dofs: Degrees of freedom with fixed ones.
        ms: Median wall time of Newton to a relative residual of 1e-6 [ms].
        value: Quantity of interest: transverse displacement at a corner of the end face of the beam
            [m], or mean displacement of the propeller along its shaft over L [-].
        error: Error of the value relative to its limit under refinement [-].
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
        solver: Name of the solver.
        iteration: Index of the iterate; a load with fewer iterates keeps its last one.
        is_final: This is the last iterate of all loads.
        threads: Threads of torch and BLAS.
        device: Device of the other computations than the network's.
        loads: Number of loads.
        ms: Median wall time up to this iterate, with its residual and min det F, one load at a time
            [ms].
        ms_p99: 99th percentile of this time [ms].
        error: Median relative L2 error against the converged solution on the same mesh [-].
        max_error: Maximum of this error [-].
        residual: Median relative residual ||R|| / ||f|| [-].
    """

    solver: str
    iteration: int
    is_final: bool
    threads: int
    device: str
    loads: int
    ms: float
    ms_p99: float
    error: float
    max_error: float
    residual: float


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


def on_gpu(surrogate: TrainedSurrogate) -> Callable[[Load], Tensor]:
    """Return the prediction of a surrogate on the GPU, with copies from and to the CPU."""
    device = torch.device("cuda")
    on_device = surrogate.to(device)

    def predict(load: Load) -> Tensor:
        return on_device.predict(Load(*(column.to(device) for column in load))).cpu()

    return predict


def draw(
    rows: Sequence[Point], meshes: Sequence[Discretisation], floor: float | None, file: Path
) -> None:
    """Draw run time against error of the iterates of solvers: a line or dot for each solver.

    Errors of Newton on other meshes and the discretisation error of the mesh of the solvers,
    `floor` [-], are relative to the limit under refinement; they have a panel of their own.
    """
    from matplotlib.ticker import LogLocator

    count = 2 if meshes else 1
    with picture(file, 4.0 * count + 1.0, 4.2) as figure:
        ratios = [1.6, 1.0][:count]
        axes = figure.subplots(1, count, squeeze=False, width_ratios=ratios)[0]
        labels = _draw_methods(axes[0], rows)
        if meshes:
            _draw_meshes(axes[1], meshes)
        if floor is not None:
            axes[0].axhline(floor, color="0.6", ls="--", lw=0.8, zorder=0)
            axes[0].annotate(
                "discretisation error of the mesh", (0.99, floor), ha="right", va="bottom",
                xycoords=("axes fraction", "data"), color="0.35", fontsize=7.5,
            )  # fmt: skip
        for ax in axes:
            ax.set_xlabel("time of one load [ms], median")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("")
            ax.grid(visible=True)
        axes[0].xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes[0].set_ylabel("relative error, median of the loads")
        _separate(figure, labels)


def _draw_methods(ax: "Axes", rows: Sequence[Point]) -> list["Annotation"]:
    """Draw each family of solvers in one colour: dots of predictions, lines of iterates.

    Returns:
        The labels with the names of the families.
    """
    from matplotlib.patheffects import withStroke

    labels = []
    families = {name: _family(name) for name in dict.fromkeys(row.solver for row in rows)}
    colours = method_colours(dict.fromkeys(families.values()))
    final = {name: [row for row in rows if row.solver == name][-1] for name in families}
    for family, colour in colours.items():
        names = [name for name, own in families.items() if own == family]
        if family == "Newton":  # one line through the solutions to all tolerances
            lines = [sorted((final[name] for name in names), key=lambda row: row.ms)]
        else:
            lines = [[row for row in rows if row.solver == name] for name in names]
        ends = []
        for line in lines:
            shown = [row for row in line if row.error < 1]
            if not shown:
                continue
            method = shown[-1].solver.partition(", ")[2]
            x, y = [row.ms for row in shown], [max(row.error, LEAST) for row in shown]
            ax.loglog(x, y, color=colour, lw=1.2, ms=3, marker=MARKERS.get(method, "o"))
            ax.loglog(x[-1:], y[-1:], color=colour, ms=MARKER_SIZE, marker=MARKERS.get(method, "o"))
            ends.append((x[0], y[0]))
        if ends:
            label = ax.annotate(
                family, min(ends), color=colour, weight="bold", ha="center", va="bottom",
                xytext=(0, LABEL_OFFSET), textcoords="offset points", fontsize=8.5,
                path_effects=[withStroke(linewidth=3, foreground="white")],
            )  # fmt: skip
            labels.append(label)
    ax.set_ylim(top=10)
    used = {name.partition(", ")[2] for name in families}
    for method, words in WORDS.items():
        if method in used:
            ax.plot([], [], color="0.5", ls="", marker=MARKERS.get(method, "o"), label=words)
    ax.legend(loc="lower left")
    return labels


def _separate(figure: "Figure", labels: Sequence["Annotation"]) -> None:
    """Place labels where none overlaps another one or a point, from the lowest to the highest.

    A label stands above or below its point, or else higher than that.
    """
    from matplotlib.transforms import Bbox

    figure.draw_without_rendering()
    half = MARKER_SIZE / 144 * figure.dpi
    spots = [figure.axes[0].transData.transform(label.xy) for label in labels]
    taken = [Bbox([spot - half, spot + half]) for spot in spots]
    for label in sorted(labels, key=lambda label: label.get_window_extent().y0):
        height = label.get_window_extent().height * 72 / figure.dpi
        for offset in (LABEL_OFFSET, -LABEL_OFFSET - height, *range(9, 60, 2)):
            label.set_position((0, offset))
            if not any(label.get_window_extent().overlaps(other) for other in taken):
                break
        taken.append(label.get_window_extent())


def _family(name: str) -> str:
    """Return the method of a solver without its variant and tolerance."""
    return name.partition(", ")[0].partition(" to ")[0]


def _draw_meshes(ax: "Axes", meshes: Sequence[Discretisation]) -> None:
    """Draw the errors of Newton on other meshes, one line per polynomial degree."""
    for degree, marker, name in ((1, "s", "linear"), (2, "D", "quadratic")):
        family = [mesh for mesh in meshes if mesh.degree == degree]
        if not family:
            continue
        style = {"color": "0.1", "ls": ":", "marker": marker, "ms": 5, "mfc": "none"}
        ax.loglog([m.ms for m in family], [m.error for m in family], label=name, **style)
        away = (5, 4) if degree == 1 else (-2, -12)
        for mesh in family:
            ax.annotate(
                f"{mesh.dofs:,}", (mesh.ms, mesh.error), fontsize=7, color="0.4",
                textcoords="offset points", xytext=away,
            )  # fmt: skip
    ax.set_title("Newton on other meshes (degrees of freedom)")
    ax.set_ylabel("relative error against the limit of fine meshes")
    ax.legend(loc="lower left", title="elements")
    ax.margins(x=0.15)
