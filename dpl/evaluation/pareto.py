"""Run time against error of all iterates of solvers on the same loads."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dpl.evaluation.timing import WARM_UP, percentiles, time_iterates
from dpl.fem import Load, Solver, solve
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import RelativeL2, Surrogate
from dpl.training.metrics import median

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Cells = tuple[int, ...]
MARKERS = {"corrected": "D", "hybrid": "s", "GPU": "*"}  # of methods; "o" for others
COLOURS = [f"C{k}" for k in range(10) if k != 7]  # without grey, the colour of references


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
                error = RelativeL2().measure(displacement, batch)
                residual = torch.cat([state.residual for _, state in iterates])
                record = name, k, k == count - 1, threads, "cpu", len(singles)
                errors = float(median(error)), float(error.max()), float(median(residual))
                found.append(Point(*record, *percentiles(times), *errors))
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


def on_gpu(surrogate: Surrogate) -> Callable[[Load], Tensor]:
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
    `floor` [-], are relative to the limit under refinement.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 5.2), layout="constrained")
    ax = figure.subplots()
    colours: dict[str, str] = {}
    for name in dict.fromkeys(row.solver for row in rows):
        own = [row for row in rows if row.solver == name and row.error < 1]
        x, y = [row.ms for row in own], [max(row.error, 1e-12) for row in own]
        family, _, method = name.partition(", ")
        family = family.partition(" to ")[0]
        label = None if family in colours else family
        free = "0.1" if family == "Newton" else COLOURS[len(colours) % len(COLOURS)]
        style = {"color": colours.setdefault(family, free), "marker": MARKERS.get(method, "o")}
        ax.loglog(x, y, lw=1.2, ms=4, label=label, **style)
        ax.loglog(x[-1:], y[-1:], ms=8, **style)
    for marker, method in (("D", "corrected"), ("s", "hybrid: each iterate")):
        ax.plot([], [], color="0.5", ls="", marker=marker, label=f"the same, {method}")
    _draw_meshes(ax, meshes)
    if floor is not None:
        ax.axhline(floor, color="0.3", ls="--", lw=1)
        ax.annotate(
            "discretisation error of the mesh", (0.01, floor), xycoords=("axes fraction", "data"),
            fontsize=8, va="top", xytext=(0, -2), textcoords="offset points",
        )  # fmt: skip
    ax.set_xlabel("time of one load, its residual and min det F included, p50 [ms]")
    ax.set_ylabel("relative error, median of the loads")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(file, dpi=130)


def _draw_meshes(ax: "Axes", meshes: Sequence[Discretisation]) -> None:
    """Draw the errors of Newton on other meshes, one line per polynomial degree."""
    for degree, marker, name in ((1, "s", "linear"), (2, "D", "quadratic")):
        family = [mesh for mesh in meshes if mesh.degree == degree]
        if not family:
            continue
        label = f"Newton, {name} meshes, against\nthe limit (degrees of freedom)"
        style = {"color": "0.55", "ls": ":", "marker": marker, "ms": 5, "mfc": "none"}
        ax.loglog([m.ms for m in family], [m.error for m in family], label=label, **style)
        away = 4, 4 if degree == 1 else -10
        for mesh in family:
            ax.annotate(
                f"{mesh.dofs:,}", (mesh.ms, mesh.error), fontsize=7, color="0.4",
                textcoords="offset points", xytext=away,
            )  # fmt: skip
