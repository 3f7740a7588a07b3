"""Time, memory and parameters of solvers and networks against degrees of freedom."""

import math
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.devices import samples_of
from benchmarks.discretisation import BEAM, YOUNG
from benchmarks.study import METHOD_COLOURS, OTHER_COLOURS, picture
from dpl import Scene
from dpl.evaluation import latency
from dpl.fem import LinearSolver, Load, ModalLoads, NeoHookeanLn, Newton, Plane, Problem, box, solve
from dpl.fem.linear import select_backend
from dpl.models import FCNN, Unrolled
from dpl.system.threads import one_thread
from dpl.training import MSE, Surrogate


@dataclass(frozen=True)
class Size:
    """Cost of a method on a beam."""

    case: str  # name of the method
    dofs: int  # degrees of freedom, fixed ones included
    ms: float  # median wall time on one thread [ms]
    parameters: int | None = None  # number of parameters of the network
    memory_mb: float | None = None  # memory of weights or factors [MB]; None if not measured
    peak_memory_mb: float | None = None  # peak memory of the process that measured this beam [MB]


def sizes(
    cells_across: Sequence[int], *, memory_limit: float = 4.0, loads: int = 5
) -> Iterator[list[Size]]:
    """Yield the costs of solvers and networks for each beam, measured in a separate process.

    A beam has four times as many cells along it as across. Fully connected networks above the
    memory limit [GB] are not built.
    """
    context = multiprocessing.get_context("spawn")
    for cells in cells_across:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            yield pool.submit(_size, cells, memory_limit, loads).result()


def _size(cells: int, memory_limit: float, loads: int) -> list[Size]:
    with one_thread(), torch.inference_mode():
        rows = list(_costs(cells, memory_limit, loads))
    peak_memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [replace(row, peak_memory_mb=peak_memory_mb) for row in rows]


def _costs(cells: int, memory_limit: float, loads: int) -> Iterator[Size]:
    """Yield the rows of one beam; the maps of `unrolled` are fitted to artificial samples."""
    mesh = box(BEAM, [4 * cells + 1, cells + 1, cells + 1])
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"))
    newton = Newton(problem, tol=1e-6)
    scene = Scene(problem, ModalLoads(newton.linear_solver, deflection=0.4, young=YOUNG), newton)
    dofs = problem.free.numel()
    batch = scene.loads.sample((0, 2), range(max(loads, 3)))
    singles = batch.unbatch()[:loads]

    def row(case: str, call: Callable[[Load], object], **more: float | int) -> Size:
        return Size(case, dofs, latency(call, singles).p50, **more)  # type: ignore[arg-type]

    start = time.perf_counter()
    LinearSolver(problem).factor  # noqa: B018
    first = 1e3 * (time.perf_counter() - start)
    name = select_backend("auto", problem.pattern, problem.near_null, many_rhs=True)
    yield Size(f"factor of K(0), analysis included ({name})", dofs, first)
    yield row("linear solution", lambda load: newton.linear_solver.solve(load.force[0]))
    answers = {float(load.force.norm()): solve(newton, load).displacement for load in singles}
    yield row("Newton", lambda load: solve(newton, load))
    corotational = replace(newton, corotational=True)

    def hybrid(load: Load) -> None:
        guess = 1.001 * answers[float(load.force.norm())]
        for _ in corotational.iterate(load, guess=guess):
            pass

    yield row("Newton, corotational, from a guess with a relative error of 1e-3", hybrid)
    net = Unrolled(scene)
    surrogate = Surrogate(net, MSE(), scene).eval()
    samples = samples_of(scene, 64)
    net.fit(samples, samples)
    kept = sum(t.nbytes for t in surrogate.state_dict().values()) + net.linear.blocks.values.nbytes
    yield row("unrolled", surrogate.predict, memory_mb=kept / 1e6)
    weights = 4 * dofs**2 + 7 * dofs
    if 4e-9 * weights < memory_limit:
        whole = Surrogate(FCNN(scene, all_dofs=True, memory_limit=1e9), MSE(), scene).eval()
        count = sum(p.numel() for p in whole.net.parameters())
        yield row("fcnn, as in the paper", whole.predict, parameters=count, memory_mb=4e-6 * count)


def exponent(dofs: Sequence[float], costs: Sequence[float]) -> float:
    """Return p of cost ~ DOFs^p, fitted by least squares to logarithms; NaN for fewer than two."""
    if len(dofs) < 2:
        return math.nan
    return float(np.polyfit(np.log(dofs), np.log(costs), 1)[0])


LINES = {  # start of a case: its short name, and its colour
    "factor of K(0)": ("factor of K(0)", OTHER_COLOURS[0]),
    "process": ("whole process, peak", OTHER_COLOURS[1]),
    "linear solution": ("linear", METHOD_COLOURS["linear"]),
    "Newton, corotational": ("Newton from a prediction", OTHER_COLOURS[2]),
    "Newton": ("Newton", METHOD_COLOURS["Newton"]),
    "unrolled": ("unrolled", METHOD_COLOURS["unrolled"]),
    "fcnn": ("fcnn", METHOD_COLOURS["fcnn"]),
}
PANELS = (  # label, field, drawn lines; each panel has at most four of them
    ("time of one solution [ms]", "ms", ("factor", "linear", "Newton")),
    ("time of one prediction [ms]", "ms", ("unrolled", "fcnn")),
    ("parameters", "parameters", ("fcnn",)),
    ("memory [MB]", "memory_mb", ("unrolled", "fcnn", "process")),
)


def draw(rows: Sequence[Size], path: Path) -> None:
    """Draw times, parameters and memory against degrees of freedom, with the exponents of fits."""
    whole = [replace(row, case="process", memory_mb=row.peak_memory_mb) for row in rows]
    families: dict[str, dict[int, Size]] = {}
    for row in [*rows, *whole]:
        start = next(start for start in LINES if row.case.startswith(start))
        families.setdefault(start, {})[row.dofs] = row
    with picture(path, 5.6) as figure:
        axes = figure.subplots(2, 2, sharex=True).flat
        for ax, (label, field, starts) in zip(axes, PANELS, strict=True):
            for start in (start for start in families if start.startswith(starts)):
                family = families[start].values()
                known = [(row.dofs, value) for row in family if (value := getattr(row, field))]
                if known:
                    name, colour = LINES[start]
                    power = exponent(*zip(*known, strict=True))
                    words = f"{name}: power {power:.1f}" if power == power else name
                    ax.loglog(
                        *zip(*known, strict=True), "o-", ms=3.5, lw=1.2, color=colour, label=words
                    )
            ax.set_ylabel(label)
            if ax.get_subplotspec().is_last_row():
                ax.set_xlabel("degrees of freedom")
            low, high = np.log10(ax.get_ylim())
            ax.set_ylim(top=10 ** (high + 0.12 * len(ax.lines) * (high - low)))  # of the legend
            ax.grid(visible=True)
            ax.legend(loc="upper left")
