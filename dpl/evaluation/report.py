"""Errors, convergence and run times of solvers on the same test loads."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.evaluation.nodal_fields import nodal_fields
from dpl.evaluation.tables import (
    PREDICTION,
    TOLS,
    newton_row,
    percent,
    power,
    show_cells,
    simulator_row,
)
from dpl.evaluation.timing import Latency, latencies, percentiles, time_interleaved
from dpl.fem import (
    LinearSolver,
    Load,
    Newton,
    Problem,
    Solution,
    Solver,
    Status,
    estimate_error,
    write_mesh,
)
from dpl.inference import Answer, Corrected, Direct, Hybrid, Simulator
from dpl.scene import Sample, Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate, relative_errors
from dpl.training.metrics import errors_of
from dpl.visualization import plot_deformed

ERRORS = (1e-3,)  # estimated relative errors of the simulator [-]
LEAST_ERROR = 1e-12  # estimated error at which no step is made [-]
ONE_STEP = f"{PREDICTION}, 1 step"  # name of a row
SOLVED = 12  # test loads that the solvers to a tolerance answer


@dataclass(frozen=True)
class SolverResult:
    """Results of one solver for all loads."""

    solver: str  # name of the solver
    errors: dict[str, float]  # the metrics of `dpl.training.metrics`
    converged: int  # number of loads that meet the tolerance and have no inverted element
    loads: int  # number of loads
    iterations: float  # mean number of linear solves
    max_iterations: int  # maximum number of linear solves
    ms: float  # median wall time of one load, with its residual and min det F [ms]
    ms_p99: float  # 99th percentile of this time [ms]
    # median of the estimated relative error [-]: for predictions and the simulator that of
    # `Answer`, else that of `estimate_error`; infinite: not computed
    estimated_error: float = math.inf
    # latency of `sim(force)` and of the bare network; empty for other solvers
    latency: Mapping[str, Latency] = field(default_factory=dict)


def measure(
    solvers: Mapping[str, Solver], batch: Sample, problem: Problem
) -> tuple[list[SolverResult], dict[str, Tensor]]:
    """Return the results and the displacements (B, N, D) [-] of each solver.

    Loads are solved one at a time, see `dpl.evaluation.timing.time_interleaved`.
    """
    timed, rows = time_interleaved(solvers, batch.load), []
    for name, (solution, times) in timed.items():
        numbers = errors_of(problem, solution.displacement, batch)
        iterations = solution.iterations.double()
        counts = int(solution.converged.sum()), len(solution.converged)
        steps = float(iterations.mean()), int(iterations.max())
        rows.append(SolverResult(name, numbers, *counts, *steps, *percentiles(times)))
    return rows, {name: solution.displacement for name, (solution, _) in timed.items()}


def show(rows: Sequence[SolverResult], title: str) -> None:
    """Print the most important numbers of rows as a table of at most 100 columns."""
    columns = (
        "", "median [%]", "worst [%]", "e_mean", "e_max", "SNR [dB]", "esti- mated [%]", "residual",
        "con- verged", "linear solves", "ms p50", "ms p99",
    )  # fmt: skip
    cells = []
    for row in rows:
        e = row.errors
        cells.append([
            row.solver, percent(e["rel_L2_median"]), percent(e["rel_L2_worst"]),
            f"{e['e_mean']:.1e}", f"{e['e_max']:.1e}", f"{e['SNR_min']:.0f}",
            percent(row.estimated_error), f"{e['residual']:.1e}", f"{row.converged}/{row.loads}",
            f"{row.iterations:.1f}", *(f"{ms:.{int(ms < 100)}f}" for ms in (row.ms, row.ms_p99)),
        ])  # fmt: skip
    show_cells(title, columns, cells, space=1)


def evaluate(
    surrogate: TrainedSurrogate,
    test: Sample,
    folder: Path,
    *,
    tols: Sequence[float] = TOLS,
    errors: Sequence[float] = ERRORS,
) -> list[SolverResult]:
    """Evaluate a surrogate on test loads: print and save a table of solvers.

    The rows are the linear solution, the prediction, for a model that `HasCorrection` the
    prediction after one step of Newton's method in its modes, and, if the law is known, the paper's
    hybrid to the smallest tolerance, the simulator to each estimated error, and simulator and
    Newton's method to each tolerance. All solve one load at a time on one thread, the solvers to a
    tolerance only the first `SOLVED` loads. The latencies of `sim(force)` and of the bare network
    are measured as well. Writes `evaluation.json`, `shapes.png` and `worst.vtu`.

    Args:
        surrogate: A surrogate on the CPU.
        test: Loads with reference solutions.
        folder: Folder of the results.
        tols: Relative residuals of simulator and Newton [-].
        errors: Estimated relative errors of the simulator [-].
    """
    scene, simulator = surrogate.scene, Simulator(surrogate)
    tight, linear = min(tols), _own(scene).linear_solver
    simulated = {
        f"sim(force, error={power(error)})": _Simulated(simulator, {"error": error})
        for error in errors
    }
    simulated |= {simulator_row(tol): _Simulated(simulator, {"tol": tol}) for tol in tols}
    predictions: dict[str, Solver] = {
        "linear": replace(linear, tol=tight, parent=linear),  # with its factor
        PREDICTION: Direct(surrogate.predict, scene.problem, tight),
    }
    if (within := surrogate.predictor.correction()) is not None:
        one = replace(within, tol=tight, max_iter=1, error_tol=LEAST_ERROR)
        one.prepare()  # here, so that the first call is not slower
        predictions[ONE_STEP] = Corrected(surrogate.predict, one)
    paper = Hybrid(surrogate.predict, replace(_own(scene), tol=tight), "paper")
    solvers: dict[str, Solver] = {f"paper's hybrid to {power(tight)}": paper, **simulated}
    solvers |= {newton_row(tol): replace(_own(scene), tol=tol) for tol in tols}
    if not (is_known := scene.problem.material.is_known):
        solvers = {}  # predictions are compared with the given solutions alone
    few = Sample(*(column[:SOLVED] for column in test))
    with one_thread():
        rows, displacements = measure(predictions, test, scene.problem)
        solved = measure(solvers, few, scene.problem)
        rows, displacements = rows + solved[0], displacements | solved[1]
        estimates: dict[str, Callable[[Load, Tensor], float]]
        estimates = dict.fromkeys(displacements, lambda *a: estimate_error(scene.linear, *a).error)
        estimates |= {name: solver.error for name, solver in simulated.items()}
        estimates |= dict.fromkeys((PREDICTION, ONE_STEP), simulator.prediction_error)
        medians = {
            name: float(np.median(list(map(estimates[name], test.load.unbatch(), u.split(1)))))
            for name, u in displacements.items()
        }
    rows = [replace(row, estimated_error=medians[row.solver]) for row in rows]
    latency = latencies(simulator, test.load)
    rows = [replace(row, latency=latency) if row.solver == PREDICTION else row for row in rows]
    about = "one at a time, 1 thread; median, worst and estimated error are relative L2"
    unknown = "" if is_known else "\nthe law is unknown, and so are residual and estimated error"
    show(rows, f"{len(test.force)} test loads, {about}{unknown}")
    print(f"latency, 1 thread: {'; '.join(f'{name} {one}' for name, one in latency.items())}")
    content = json.dumps([asdict(row) for row in rows], indent=1)
    (folder / "evaluation.json").write_text(content + "\n")
    _draw(surrogate, test, displacements, folder)
    return rows


@dataclass(frozen=True)
class _Simulated:
    """The simulator with a tolerance, as a solver.

    A load has converged if it meets the tolerance, be it of the residual or of the estimated error.
    """

    simulator: Simulator
    tolerance: Mapping[str, float]  # `tol` or `error` of a call [-]

    def answer(self, load: Load) -> Answer:
        """Return the answer of the simulator."""
        scene = self.simulator.scene
        if scene.problem.material.parameter_ranges:  # each load has its own K(0) and factor
            scene.linear.forget_clones()
        arguments: dict[str, Any] = {**scene.si_inputs(load), **self.tolerance}
        return self.simulator(**arguments)

    def error(self, load: Load, displacement: Tensor) -> float:
        """Return the estimated relative error that the answer states [-]."""
        return float(self.answer(load).error)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the answer of the simulator."""
        scene, answer = self.simulator.scene, self.answer(load)
        met = answer.converged | (answer.error <= self.tolerance.get("error", -1.0))
        count = torch.zeros_like(answer.iterations)
        yield Solution(
            displacement=answer.displacement / scene.length,
            internal=torch.full_like(answer.displacement, math.nan),  # no part of an answer
            residual=answer.residual,
            volume_ratio=answer.volume_ratio,
            status=torch.where(met, int(Status.CONVERGED), int(Status.NOT_CONVERGED)),
            negative_pivots=answer.negative_pivots,
            iterations=answer.iterations,
            factorisations=count,
            load_factor=met.double(),
            seconds=answer.milliseconds / 1e3,
            from_guess=count.bool(),
        )


def _own(scene: Scene) -> Newton:
    """Return Newton's method of a scene; with a factor of K(0) of its own if loads differ in it."""
    newton = scene.newton
    if not scene.problem.material.parameter_ranges:
        return newton
    return replace(newton, linear_solver=LinearSolver(newton.problem, newton.tol, newton.linear))


def _draw(
    surrogate: TrainedSurrogate, test: Sample, displacements: Mapping[str, Tensor], folder: Path
) -> None:
    """Draw the loads with minimum, median and maximum error; write the last one as VTU.

    The file has the fields of `nodal_fields`, with the test solution as the reference.
    """
    scene, network = surrogate.scene, displacements[PREDICTION]
    error = relative_errors(network, test)
    order = error.argsort()
    chosen = order[[0, (len(order) - 1) // 2, -1]]  # of two middle loads the one with less error
    names = [
        f"{name} load: relative L2 {error[k]:.2%}"
        for name, k in zip(("best", "median", "worst"), chosen, strict=True)
    ]
    shown = [(name, displacements[name][chosen]) for name in (PREDICTION, "linear")]
    figure = plot_deformed(scene.problem, test.displacement[chosen], shown, names=names)
    figure.savefig(folder / "shapes.png")
    worst = int(order[-1])
    load = test.load.unbatch()[worst]
    found = nodal_fields(scene, load, network[worst], test.displacement[worst])
    arrays = {name: field.numpy() for name, field in found.items()}
    write_mesh(folder / "worst.vtu", scene.problem.mesh_in_metres, arrays)
