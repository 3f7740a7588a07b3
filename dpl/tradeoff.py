"""Run time against error: every solver and every iterate of it; meshes; and growth with size."""

import math
import multiprocessing
import os
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpl.fem.forces import Traction
from dpl.fem.linear import chosen
from dpl.fem.materials import Material, NeoHookeanLn, SaintVenantKirchhoff
from dpl.fem.mesh import Plane, box
from dpl.fem.modes import ModalLoads
from dpl.fem.newton import Linear, Newton
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, Solver, one_thread, solve
from dpl.losses import MSE
from dpl.metrics import RelativeL2
from dpl.models.fcnn import FCNN
from dpl.models.latent import Latent
from dpl.module import Surrogate
from dpl.scene import Sample, Scene

WARM_UP = 5  # loads asked before the clock starts


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
        ms: Median wall time until it is there, batch 1 [ms].
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


def clocked(solver: Solver, load: Load) -> list[tuple[float, Solution]]:
    """Return every iterate with the time at which it was there [s]."""
    path = []
    start = time.perf_counter()
    for state in solver.iterate(load):
        path.append((time.perf_counter() - start, state))
    return path


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
    singles = batch.load.singles()
    found = []
    with _threads(threads), torch.inference_mode():
        for name, solver in solvers.items():
            for load in singles[:WARM_UP]:
                solve(solver, load)
            paths = [clocked(solver, load) for load in singles]
            count = max(len(path) for path in paths)
            for k in range(count):
                now = [path[min(k, len(path) - 1)] for path in paths]
                taken = torch.tensor([1e3 * seconds for seconds, _ in now]).double()
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
                        float(taken.median()),
                        float(taken.quantile(0.99)),
                        float(error.median()),
                        float(error.max()),
                        float(residual.median()),
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


@dataclass(frozen=True)
class Discretisation:
    """A mesh of the paper's beam under a load on its end face.

    Attributes:
        cells: Along the edges.
        degree: Of the elements.
        dofs: Degrees of freedom, held ones included.
        ms: Median wall time of Newton to 1e-6 [ms].
        tip: Displacement of a corner of the end face across the beam [m].
        error: Of the tip, over the limit [-].
    """

    cells: tuple[int, int, int]
    degree: int
    dofs: int
    ms: float
    tip: float
    error: float


BEAM = (100.0, 25.0, 25.0)  # [m]
YOUNG = 4500.0  # [Pa]
LOAD = 20.0  # traction on the end face, against z [Pa]
LINEAR = ((4, 1, 1), (8, 2, 2), (16, 4, 4), (26, 6, 6), (39, 9, 9), (60, 14, 14))
QUADRATIC = ((4, 1, 1), (8, 2, 2), (16, 4, 4))


def discretisations(
    *,
    law: Material | None = None,
    linear: Sequence[tuple[int, int, int]] = LINEAR,
    quadratic: Sequence[tuple[int, int, int]] = QUADRATIC,
    repeats: int = 5,
) -> list[Discretisation]:
    """Return meshes of linear and quadratic hexahedra, and how far each is from the limit.

    The limit is Richardson's of the last three quadratic meshes, each twice as fine as the one
    before (Roache 1998, Verification and Validation in Computational Science, section 5.4).

    Args:
        law: Saint Venant-Kirchhoff with a Poisson's ratio of 0.3 if left out.
        linear: Cells of the linear meshes.
        quadratic: Of the quadratic ones.
        repeats: Timed solves.
    """
    law = law or SaintVenantKirchhoff(0.3)
    found = []
    for degree, meshes in ((1, linear), (2, quadratic)):
        for cells in meshes:
            mesh = box(BEAM, [n + 1 for n in cells])
            problem = Problem.build(mesh, law, fixed=Plane(0, "min"), degree=degree)
            force = Traction(Plane(0, "max"), [0.0, 0.0, -LOAD / YOUNG]).on(problem)
            load = Load(force[None], torch.tensor([YOUNG], dtype=torch.float64))
            newton = Newton(problem, tol=1e-6)
            answer = solve(newton, load)
            corner = (problem.points - problem.points.amax(dim=0)).norm(dim=1).argmin()
            tip = BEAM[0] * float(answer.displacement[0, corner, 2])
            times = [float(solve(newton, load).seconds) for _ in range(repeats)]
            ms = 1e3 * statistics.median(times)
            found.append((cells, degree, problem.free.numel(), ms, tip))
    last = [tip for _, degree, _, _, tip in found if degree == 2][-3:]
    end = limit(*last)
    return [Discretisation(*row, abs(row[-1] / end - 1)) for row in found]


def limit(coarse: float, middle: float, fine: float) -> float:
    """Return where values on three meshes, each twice as fine as the one before, tend to."""
    return fine + (fine - middle) ** 2 / ((middle - coarse) - (fine - middle))


@dataclass(frozen=True)
class Size:
    """What something costs on a beam of some size.

    Attributes:
        what: It.
        dofs: Degrees of freedom, held ones included.
        ms: Median wall time, one thread [ms].
        parameters: Of the network.
        memory: What it keeps, weights or factors [MB]; None: not measured.
        peak: Largest memory of the process that measured everything of this size [MB].
    """

    what: str
    dofs: int
    ms: float
    parameters: int | None = None
    memory: float | None = None
    peak: float | None = None


def sizes(
    across: Sequence[int], *, memory_limit: float = 4.0, loads: int = 5
) -> Iterator[list[Size]]:
    """Yield what solvers and networks cost, beam by beam, each measured in a process of its own.

    Args:
        across: Cells across each beam; four times as many along it.
        memory_limit: Weights of a fully connected network beyond which it is not built [GB].
        loads: Timed loads.
    """
    context = multiprocessing.get_context("spawn")
    for cells in across:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            yield pool.submit(_size, cells, memory_limit, loads).result()


def _size(cells: int, memory_limit: float, loads: int) -> list[Size]:
    with one_thread(), torch.inference_mode():
        rows = list(_costs(cells, memory_limit, loads))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [Size(r.what, r.dofs, r.ms, r.parameters, r.memory, peak) for r in rows]


def _costs(cells: int, memory_limit: float, loads: int) -> Iterator[Size]:
    """Yield the rows of one beam; weights are random, for they take as long as trained ones."""
    mesh = box(BEAM, [4 * cells + 1, cells + 1, cells + 1])
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"))
    newton = Newton(problem, tol=1e-6)
    scene = Scene(problem, ModalLoads(newton.rest, deflection=0.4, young=YOUNG), newton)
    dofs = problem.free.numel()
    batch = scene.loads.sample((0, 2), range(max(loads, 3)))
    singles = batch.singles()[:loads]

    def row(what: str, call: Callable[[Load], object], **more: float | int) -> Size:
        call(singles[0])
        taken = []
        for load in singles:
            start = time.perf_counter()
            call(load)
            taken.append(1e3 * (time.perf_counter() - start))
        return Size(what, dofs, statistics.median(taken), **more)  # type: ignore[arg-type]

    start = time.perf_counter()
    Linear(problem).factor  # noqa: B018
    first = 1e3 * (time.perf_counter() - start)
    name = chosen("auto", problem.pattern, problem.rigid_motions()[0][problem.free].numpy())
    yield Size(f"factor of K(0), analysis included ({name})", dofs, first)
    yield row("linear answer", lambda load: newton.rest.respond(load.force[0]))
    answers = {float(load.force.norm()): solve(newton, load).displacement for load in singles}
    yield row("Newton", lambda load: solve(newton, load))
    turned = newton.but(turned=True)

    def hybrid(load: Load) -> None:
        guess = 1.001 * answers[float(load.force.norm())]
        for _ in turned.iterate(load, guess=guess):
            pass

    yield row("Newton from an answer a thousandth off, K(0) turned", hybrid)
    net = Latent(scene)
    surrogate = Surrogate(net, MSE(), scene).eval()
    drawn = scene.loads.sample((0, 0), range(64))
    linear = torch.stack([newton.rest.respond(force) for force in drawn.force])
    bent = linear + linear * linear.norm(dim=-1, keepdim=True)
    surrogate.prepare(Sample(drawn.force, bent, drawn.young))
    kept = sum(t.nbytes for t in surrogate.state_dict().values()) / 1e6
    count = sum(p.numel() for p in net.parameters())
    yield row("latent", surrogate.predict, parameters=count, memory=kept)
    weights = 4 * dofs**2 + 7 * dofs
    if 4e-9 * weights < memory_limit:
        whole = Surrogate(FCNN(scene, all_dofs=True, memory_limit=1e9), MSE(), scene).eval()
        count = sum(p.numel() for p in whole.net.parameters())
        yield row("fcnn, as in the paper", whole.predict, parameters=count, memory=4e-6 * count)


def exponent(rows: Sequence[Size]) -> float:
    """Return p of cost ~ DOFs^p, fitted by least squares to logarithms; NaN for fewer than two."""
    if len(rows) < 2:
        return math.nan
    x, y = np.log([row.dofs for row in rows]), np.log([row.ms for row in rows])
    return float(np.polyfit(x, y, 1)[0])


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


def draw_points(
    rows: Sequence[Point], meshes: Sequence[Discretisation], floor: float, path: Path
) -> None:
    """Draw run time against error: a line for each solver that iterates, a dot for the others.

    Args:
        rows: Iterates of solvers, one setting of threads.
        meshes: Finite elements on other meshes, against the limit.
        floor: Discretisation error of the mesh that all solvers have [-].
        path: Of the picture.
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
        colour = "0.1" if _family(name) == "Newton" else f"C{families.index(_family(name)) % 10}"
        marker = {"corrected": "D", "hybrid": "s", "GPU": "*"}.get(tier, "o")
        shown = not tier or tier == "GPU"  # other marks are explained below
        label = name.partition(" to ")[0] if shown and _family(name) not in named else None
        named.add(_family(name))
        ax.loglog(x, y, color=colour, lw=1.2, marker=marker, ms=4, label=label)
        ax.loglog(x[-1:], y[-1:], color=colour, marker=marker, ms=8)
    for marker, tier in (("D", "corrected"), ("s", "hybrid: each Newton iterate")):
        ax.plot([], [], color="0.5", ls="", marker=marker, label=f"the same, {tier}")
    for degree, marker, name in ((1, "s", "linear"), (2, "D", "quadratic")):
        family = [mesh for mesh in meshes if mesh.degree == degree]
        ax.loglog(
            [mesh.ms for mesh in family],
            [mesh.error for mesh in family],
            color="0.55", ls=":", marker=marker, ms=5, mfc="none",
            label=f"Newton, {name} meshes, against the limit",
        )  # fmt: skip
        for mesh in family:
            ax.annotate(f"{mesh.dofs:,}", (mesh.ms, mesh.error), fontsize=6, color="0.4")
    ax.axhline(floor, color="0.3", ls="--", lw=1)
    ax.annotate(
        "discretisation error of this mesh", (0.01, floor), xycoords=("axes fraction", "data"),
        fontsize=8, va="top",
    )  # fmt: skip
    ax.set_xlabel("time of one load [ms]")
    ax.set_ylabel("relative error, median")
    ax.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=130)


def _family(solver: str) -> str:
    """Return what solvers of one colour have in common."""
    return solver.partition(", ")[0].partition(" to ")[0]


def draw_sizes(rows: Sequence[Size], path: Path) -> None:
    """Draw time and parameters against degrees of freedom, with the exponents of the fits."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, what in enumerate(dict.fromkeys(row.what.partition(" (")[0] for row in rows)):
        family = [row for row in rows if row.what.partition(" (")[0] == what]
        x = [row.dofs for row in family]
        label = f"{what}: DOFs^{exponent(family):.2f}" if len(family) > 1 else what
        left.loglog(
            x, [row.ms for row in family], marker="o", ms=4, color=f"C{number}", label=label
        )
        if family[0].parameters:
            right.loglog(
                x, [row.parameters for row in family], marker="o", ms=4, color=f"C{number}",
                label=f"{what}: parameters",
            )  # fmt: skip
            right.loglog(
                x, [row.memory for row in family], marker="s", ms=4, ls="--", color=f"C{number}",
                label=f"{what}: memory [MB]",
            )  # fmt: skip
    every = sorted({(row.dofs, row.peak or math.nan) for row in rows})
    right.loglog(*zip(*every, strict=True), color="0.5", ls=":", label="peak of the process [MB]")
    for ax, name in ((left, "time of one load [ms]"), (right, "")):
        ax.set_xlabel("degrees of freedom")
        ax.set_ylabel(name)
        ax.grid(alpha=0.3)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.5)  # room for the legend
        ax.legend(fontsize=7, loc="upper left")
    figure.savefig(path, dpi=130)
