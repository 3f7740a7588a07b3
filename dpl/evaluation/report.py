"""Errors, convergence and run times of solvers on the same test loads."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from dpl.evaluation.tables import show_cells
from dpl.evaluation.timing import Latency, describe, latencies, percentiles, time_interleaved
from dpl.fem import LinearSolver, Newton, Problem, Solver, write_mesh
from dpl.inference import Corrected, Direct, Hybrid, Simulator, default_hybrid
from dpl.models import HasCorrection
from dpl.scene import Sample
from dpl.system.threads import one_thread
from dpl.training import RelativeL2, Surrogate
from dpl.training.metrics import default_metrics, median
from dpl.visualization import plot_deformed

LEAST_ERROR = 1e-12  # estimated error at which no step is made [-]


@dataclass(frozen=True)
class SolverResult:
    """Results of one solver for all loads.

    Attributes:
        solver: Name of the solver.
        errors: The metrics of `dpl.training.metrics`.
        converged: Number of loads with a residual below the tolerance and no inverted element.
        loads: Number of loads.
        iterations: Mean number of linear solves.
        max_iterations: Maximum number of linear solves.
        ms: Median wall time of one load, with its residual and min det F [ms].
        ms_p99: 99th percentile of this time [ms].
        latency: Latency of `sim(force)` and of the bare network; empty for other solvers.
    """

    solver: str
    errors: dict[str, float]
    converged: int
    loads: int
    iterations: float
    max_iterations: int
    ms: float
    ms_p99: float
    latency: Mapping[str, Latency] = field(default_factory=dict)


def measure(
    solvers: Mapping[str, Solver], batch: Sample, problem: Problem
) -> tuple[list[SolverResult], dict[str, Tensor]]:
    """Return the results and the displacements (B, N, D) [-] of each solver.

    Loads are solved one at a time, see `dpl.evaluation.timing.time_interleaved`.
    """
    timed, rows = time_interleaved(solvers, batch.load), []
    for name, (solution, times) in timed.items():
        errors = default_metrics(problem)
        errors.update(solution.displacement, batch)
        numbers = {key: float(value) for key, value in errors.compute().items()}
        iterations = solution.iterations.double()
        counts = int(solution.converged.sum()), len(solution.converged)
        steps = float(iterations.mean()), int(iterations.max())
        rows.append(SolverResult(name, numbers, *counts, *steps, *percentiles(times)))
    return rows, {name: solution.displacement for name, (solution, _) in timed.items()}


def show(rows: Sequence[SolverResult], title: str) -> None:
    """Print rows as a table."""
    columns = (
        "solver", "e_mean", "e_max", "SNR min [dB]", "rel. L2 median", "max",
        "||R||/||f||", "min det F", "converged", "iterations", "max", "p50 [ms]", "p99 [ms]",
    )  # fmt: skip
    cells = []
    for row in rows:
        e = row.errors
        middle, worst = e["rel_L2_median"], e["rel_L2_worst"]
        cells.append([
            row.solver, f"{e['e_mean']:.1e}", f"{e['e_max']:.1e}", f"{e['SNR_min']:.1f}",
            f"{middle:.2%}" if middle > 1e-5 else f"{middle:.0e}",
            f"{worst:.1%}" if worst > 1e-4 else f"{worst:.0e}",
            f"{e['residual']:.1e}", f"{e['min_det_F']:.2f}", f"{row.converged}/{row.loads}",
            f"{row.iterations:.1f}", f"{row.max_iterations}", f"{row.ms:.1f}", f"{row.ms_p99:.1f}",
        ])  # fmt: skip
    show_cells(title, columns, cells)


def compare(folder: Path) -> None:
    """Print the errors of the network and the hybrid of all evaluated runs below a folder.

    Runs whose folder names differ only in `seed` form a group, for which medians are printed.

    Raises:
        FileNotFoundError: No run below the folder has been evaluated.
    """
    found = sorted(folder.rglob("evaluation.json"))
    if not found:
        raise FileNotFoundError(f"{folder} contains no evaluated run")
    names = ("e_mean", "e_max", "SNR_min", "rel_L2_median", "rel_L2_worst", "residual")
    runs: list[list[str]] = []
    groups: dict[str, list[list[float]]] = {}
    for path in found:
        rows = {row["solver"]: row for row in json.loads(path.read_text())}
        network, hybrid = rows["network"]["errors"], rows["hybrid Newton"]
        ratio = hybrid["ms"] / rows["Newton from zero"]["ms"]
        numbers = [*(network[name] for name in names), hybrid["iterations"], ratio]
        name = str(path.parent.relative_to(folder))
        runs.append([name, *(f"{number:.3g}" for number in numbers)])
        groups.setdefault(re.sub(r",?seed=\d+,?", "", name), []).append(numbers)
    medians = [
        [f"median of {len(members)}: {name}"]
        + [f"{number:.3g}" for number in median(torch.tensor(members)).tolist()]
        for name, members in groups.items()
    ]
    columns = ("run", *names, "hybrid iterations", "hybrid ms / Newton ms")
    show_cells(str(folder), columns, runs, medians)


def save(rows: Sequence[SolverResult], path: Path) -> None:
    """Write rows as JSON."""
    path.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


def evaluate(
    surrogate: Surrogate, test: Sample, folder: Path, *, tol: float = 1e-8
) -> list[SolverResult]:
    """Evaluate a surrogate on test loads: print and save a table of solvers.

    A model that `HasCorrection` has a row with one step of Newton's method in its modes.
    Hybrid Newton has the rule of the paper and the default one. All solve one load at a time on one
    thread. The latencies of `sim(force)` and of the bare network are measured as well. Writes
    `evaluation.json`, `shapes.png` and `worst.vtu`.

    Args:
        surrogate: A surrogate on the CPU.
        test: Loads with reference solutions.
        folder: Folder of the results.
        tol: Relative residual of Newton and the hybrid [-].
    """
    scene = surrogate.scene
    newton = replace(scene.newton, tol=tol)
    # with ranges of the law every load has its own K(0); no solver reuses another's
    shared = not scene.loads.parameter_ranges
    own = scene if shared else replace(scene, solver=_without_factors(scene.newton))
    plain = newton if shared else _without_factors(newton)
    solvers: dict[str, Solver] = {
        "linear": replace(newton.linear_solver, tol=tol),
        "network": Direct(surrogate.predict, scene.problem, tol),
        **_step_in_modes(surrogate, tol),
        "hybrid Newton": Hybrid(surrogate.predict, plain, "paper"),
        "hybrid, best rule": default_hybrid(surrogate.predict, own, tol),
        "Newton from zero": newton,
    }
    with one_thread():
        rows, displacements = measure(solvers, test, scene.problem)
    latency = latencies(Simulator(surrogate), test.load)
    rows = [replace(row, latency=latency) if row.solver == "network" else row for row in rows]
    show(rows, f"{len(test.force)} test loads, one at a time, 1 thread, tol {tol:g}")
    print(describe(latency))
    save(rows, folder / "evaluation.json")
    _draw(surrogate, test, displacements, folder)
    return rows


def _step_in_modes(surrogate: Surrogate, tol: float) -> dict[str, Solver]:
    """Return the surrogate with one Newton step in its modes, if it has such a method."""
    net = surrogate.net
    newton = net.correction() if isinstance(net, HasCorrection) else None
    if newton is None:
        return {}
    one = replace(newton, tol=tol, max_iter=1, error_tol=LEAST_ERROR)
    one.tangent  # noqa: B018  # built here, so that the first call is not slower
    return {"network, 1 step in modes": Corrected(surrogate.predict, one)}


def _without_factors(newton: Newton) -> Newton:
    """Return the solver with a linear solver of its own, which has no factor yet."""
    return replace(newton, linear_solver=LinearSolver(newton.problem, newton.tol, newton.linear))


def _draw(
    surrogate: Surrogate, test: Sample, displacements: Mapping[str, Tensor], folder: Path
) -> None:
    """Draw the loads with minimum, median and maximum error; write the last one as VTU."""
    scene, network = surrogate.scene, displacements["network"]
    error = RelativeL2().measure(network, test)
    order = error.argsort()
    chosen = order[[0, (len(order) - 1) // 2, -1]]  # of two middle loads the one with less error
    names = [
        f"{name} load: relative L2 {error[k]:.2%}"
        for name, k in zip(("best", "median", "worst"), chosen, strict=True)
    ]
    shown = [(name, displacements[name][chosen]) for name in ("network", "linear")]
    figure = plot_deformed(scene.problem, test.displacement[chosen], shown, names=names)
    figure.savefig(folder / "shapes.png", dpi=150)
    worst = int(order[-1])
    length, truth, found = scene.length, test.displacement[worst], network[worst]
    fields = {
        "displacement [m]": length * truth,
        "network [m]": length * found,
        "error [m]": length * (found - truth).norm(dim=1),
        "force [N]": scene.si_inputs(test.load)["force"][worst],
    }
    arrays = {name: field.numpy() for name, field in fields.items()}
    write_mesh(folder / "worst.vtu", scene.problem.mesh_in_metres, arrays)
