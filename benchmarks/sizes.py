"""What solvers and networks cost as a beam gets more degrees of freedom: time, memory, weights."""

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

from benchmarks.discretisation import BEAM, YOUNG
from dpl import Sample, Scene
from dpl.evaluation import latency
from dpl.fem import LinearSolver, Load, ModalLoads, NeoHookeanLn, Newton, Plane, Problem, box, solve
from dpl.fem.linear import select_backend
from dpl.models import FCNN, Latent
from dpl.system.threads import one_thread
from dpl.training import MSE, Surrogate


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
    scene = Scene(problem, ModalLoads(newton.linear_solver, deflection=0.4, young=YOUNG), newton)
    dofs = problem.free.numel()
    batch = scene.loads.sample((0, 2), range(max(loads, 3)))
    singles = batch.unbatch()[:loads]

    def row(what: str, call: Callable[[Load], object], **more: float | int) -> Size:
        return Size(what, dofs, latency(call, singles).p50, **more)  # type: ignore[arg-type]

    start = time.perf_counter()
    LinearSolver(problem).factor  # noqa: B018
    first = 1e3 * (time.perf_counter() - start)
    name = select_backend("auto", problem.pattern, problem.near_null, many_rhs=True)
    yield Size(f"factor of K(0), analysis included ({name})", dofs, first)
    yield row("linear answer", lambda load: newton.linear_solver.solve(load.force[0]))
    answers = {float(load.force.norm()): solve(newton, load).displacement for load in singles}
    yield row("Newton", lambda load: solve(newton, load))
    turned = replace(newton, corotational=True)

    def hybrid(load: Load) -> None:
        guess = 1.001 * answers[float(load.force.norm())]
        for _ in turned.iterate(load, guess=guess):
            pass

    yield row("Newton from an answer a thousandth off, K(0) turned", hybrid)
    net = Latent(scene)
    surrogate = Surrogate(net, MSE(), scene).eval()
    drawn = scene.loads.sample((0, 0), range(64))
    linear = torch.stack([newton.linear_solver.solve(force) for force in drawn.force])
    bent = linear + linear * linear.norm(dim=-1, keepdim=True)
    surrogate.fit_bases(Sample(drawn.force, bent, drawn.young))
    kept = sum(t.nbytes for t in surrogate.state_dict().values()) / 1e6
    count = sum(p.numel() for p in net.parameters())
    yield row("latent", surrogate.predict, parameters=count, memory=kept)
    weights = 4 * dofs**2 + 7 * dofs
    if 4e-9 * weights < memory_limit:
        whole = Surrogate(FCNN(scene, all_dofs=True, memory_limit=1e9), MSE(), scene).eval()
        count = sum(p.numel() for p in whole.net.parameters())
        yield row("fcnn, as in the paper", whole.predict, parameters=count, memory=4e-6 * count)


def exponent(dofs: Sequence[float], costs: Sequence[float]) -> float:
    """Return p of cost ~ DOFs^p, fitted by least squares to logarithms; NaN for fewer than two."""
    if len(dofs) < 2:
        return math.nan
    return float(np.polyfit(np.log(dofs), np.log(costs), 1)[0])


def draw(rows: Sequence[Size], path: Path) -> None:
    """Draw time, parameters and memory against degrees of freedom, with the exponents of fits."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 4.4), layout="constrained")
    panels = figure.subplots(1, 3)
    families: dict[str, list[Size]] = {}
    for row in rows:
        families.setdefault(row.what.partition(" (")[0], []).append(row)
    one_a_size = list({row.dofs: row for row in rows}.values())
    families["the whole process, at its peak"] = one_a_size
    for ax, name in zip(panels, ("ms", "parameters", "memory"), strict=True):
        for number, (what, family) in enumerate(families.items()):
            field = "peak" if family is one_a_size and name == "memory" else name
            known = [(row.dofs, value) for row in family if (value := getattr(row, field))]
            if not known or (family is one_a_size and field != "peak"):
                continue
            x, y = zip(*known, strict=True)
            label = f"{what}: DOFs^{exponent(x, y):.2f}" if len(x) > 1 else what
            ax.loglog(x, y, marker="o", ms=4, color=f"C{number}", label=label)
        ax.set_xlabel("degrees of freedom")
        ax.grid(alpha=0.3)
        low, high = ax.get_ylim()
        ax.set_ylim(low, high * (high / low) ** 0.5)  # room for the legend
        ax.legend(fontsize=7, loc="upper left")
    for ax, name in zip(
        panels, ("time of one load [ms]", "parameters", "memory [MB]"), strict=True
    ):
        ax.set_ylabel(name)
    figure.savefig(path, dpi=130)
