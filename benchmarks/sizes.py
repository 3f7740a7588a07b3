"""Time, memory and parameters of solvers and networks against degrees of freedom."""

import math
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.discretisation import BEAM, YOUNG
from benchmarks.study import method_colours, picture
from dpl import Sample, Scene
from dpl.evaluation import latency
from dpl.fem import LinearSolver, Load, ModalLoads, NeoHookeanLn, Newton, Plane, Problem, box, solve
from dpl.fem.linear import select_backend
from dpl.models import FCNN, Unrolled
from dpl.system.threads import one_thread
from dpl.training import MSE, Surrogate


@dataclass(frozen=True)
class Size:
    """Cost of a method on a beam.

    Attributes:
        case: Name of the method.
        dofs: Degrees of freedom, fixed ones included.
        ms: Median wall time on one thread [ms].
        parameters: Number of parameters of the network.
        memory_mb: Memory of weights or factors [MB]; None if not measured.
        peak_memory_mb: Peak memory of the process that measured this beam [MB].
    """

    case: str
    dofs: int
    ms: float
    parameters: int | None = None
    memory_mb: float | None = None
    peak_memory_mb: float | None = None


def sizes(
    cells_across: Sequence[int], *, memory_limit: float = 4.0, loads: int = 5
) -> Iterator[list[Size]]:
    """Yield the costs of solvers and networks for each beam, measured in a separate process.

    Args:
        cells_across: Cells across each beam; there are four times as many along it.
        memory_limit: Largest fully connected network that is built [GB].
        loads: Number of timed loads.
    """
    context = multiprocessing.get_context("spawn")
    for cells in cells_across:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            yield pool.submit(_size, cells, memory_limit, loads).result()


def _size(cells: int, memory_limit: float, loads: int) -> list[Size]:
    with one_thread(), torch.inference_mode():
        rows = list(_costs(cells, memory_limit, loads))
    peak_memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [Size(r.case, r.dofs, r.ms, r.parameters, r.memory_mb, peak_memory_mb) for r in rows]


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
    drawn = scene.loads.sample((0, 0), range(64))
    linear = torch.stack([newton.linear_solver.solve(force) for force in drawn.force])
    bent = linear + linear * linear.norm(dim=-1, keepdim=True)
    samples = Sample(drawn.force, bent, drawn.young, drawn.parameters)
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


LINES = {  # start of a case: its short name and its method, which determines the colour
    "factor of K(0)": ("factor of K(0)", "factor of K(0)"),
    "process": ("whole process, peak", "process"),
    "linear solution": ("linear", "linear"),
    "Newton, corotational": ("Newton from a prediction", "corotational"),
    "Newton": ("Newton", "Newton"),
    "unrolled": ("unrolled", "unrolled"),
    "fcnn": ("fcnn", "fcnn"),
}
LABEL_SPACE = 0.15  # part of the axis to the right of the last point, for labels of lines
PANELS = (  # label, field, drawn lines; each panel has at most four of them
    ("time of one solution [ms]", "ms", ("factor", "linear", "Newton")),
    ("time of one prediction [ms]", "ms", ("unrolled", "fcnn")),
    ("parameters", "parameters", ("fcnn",)),
    ("memory [MB]", "memory_mb", ("unrolled", "fcnn", "process")),
)


def draw(rows: Sequence[Size], path: Path) -> None:
    """Draw times, parameters and memory against degrees of freedom, with the exponents of fits."""
    colours = method_colours([method for _, method in LINES.values()])
    whole = [replace(row, case="process", memory_mb=row.peak_memory_mb) for row in rows]
    families: dict[str, dict[int, Size]] = {}
    for row in [*rows, *whole]:
        start = next(start for start in LINES if row.case.startswith(start))
        families.setdefault(start, {})[row.dofs] = row
    with picture(path, 8.4, 6.2) as figure:
        for ax, (label, field, starts) in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
            for start in (start for start in families if start.startswith(starts)):
                family = families[start].values()
                known = [(row.dofs, value) for row in family if (value := getattr(row, field))]
                if known:
                    name, method = LINES[start]
                    _draw_line(ax, known, name, colours[method])
            ax.set(xscale="log", yscale="log", xlabel="degrees of freedom", ylabel=label)
            least, most = min(row.dofs for row in rows), max(row.dofs for row in rows)
            ax.set_xlim(least / 1.3, most * (most / least) ** LABEL_SPACE)
            ax.grid(visible=True)


def _draw_line(ax: Any, known: Sequence[tuple[int, float]], name: str, colour: str) -> None:
    x, y = zip(*known, strict=True)
    label = f"{name} $\\sim$ DOFs$^{{{exponent(x, y):.2f}}}$" if len(x) > 1 else name
    ax.plot(x, y, "o-", ms=3.5, lw=1.2, color=colour)
    place = {"xytext": (6, 0), "textcoords": "offset points", "va": "center", "fontsize": 7.5}
    ax.annotate(label, (x[-1], y[-1]), color=colour, **place)
