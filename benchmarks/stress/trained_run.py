"""A trained surrogate on loads from 1e-9 to 25 times its range: alone, corrected and hybrid."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import torch

from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, LoadLevel, Outcome, classify
from benchmarks.stress.loads import level
from benchmarks.verification.report import Row
from dpl import Scene
from dpl.fem import Load, Solution
from dpl.inference import Answer, Simulator, default_hybrid
from dpl.inference.answer import ROUNDOFF
from dpl.training import TrainedSurrogate

AMPLITUDES = (1e-9, 1e-6, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 25.0)  # over the training range
STREAM = (0, 11)  # random stream of these loads
TOL = 1e-6  # tolerance of the simulator [-]
ERROR = (
    1e-3  # largest relative difference of two solutions in range, both with a residual below TOL
)


class Step(NamedTuple):
    """A load of the sweep, Newton's solution and the smallest min det F of its states."""

    amplitude: float
    load: Load
    exact: Solution
    min_detF: float


@dataclass(frozen=True, eq=False)
class AmplitudeSweep:
    """Loads of growing amplitude for a surrogate, each with Newton's solution.

    Attributes:
        surrogate: A trained surrogate.
        count: Number of loads that are scaled.
        amplitudes: Amplitudes over the training range [-].
        auditor: Checks Newton's states.
    """

    surrogate: TrainedSurrogate
    count: int = 2
    amplitudes: tuple[float, ...] = AMPLITUDES
    auditor: Auditor = field(default_factory=Auditor)
    simulator: Simulator = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "simulator", Simulator(self.surrogate))

    @property
    def scene(self) -> Scene:
        """The scene of the surrogate."""
        return self.surrogate.scene

    @cached_property
    def steps(self) -> list[Step]:
        """Loads with their solutions, in the order of amplitudes."""
        loads, exact = self.scene.loads, self.scene.solver
        solver = self.auditor.wrap(exact, self.scene.problem, exact.tol)
        drawn = loads.sample(STREAM, range(self.count))
        own = drawn.force if loads.constant_force is None else drawn.force - loads.constant_force
        places, _ = loads.project(drawn.force)
        found = []
        for amplitude in self.amplitudes:
            force = (amplitude / places)[:, None, None] * own
            force = force if loads.constant_force is None else force + loads.constant_force
            for load in drawn._replace(force=force).unbatch():
                states = list(solver.iterate(load))
                min_detF = min(float(state.volume_ratio) for state in states)
                found.append(Step(amplitude, load, states[-1], min_detF))
        return found

    def ask(self, step: Step, tol: float | None) -> Answer:
        """Return the answer of the simulator to a load, [N] to [m]."""
        load = step.load
        newtons = load.force[0] * load.young[0] * self.scene.force_unit
        parameters = load.parameters
        return self.simulator(newtons, young=load.young, parameters=parameters, tol=tol)


def simulator_answers(sweep: AmplitudeSweep, tol: float | None, auditor: Auditor) -> Outcome:
    """Check the answers of the simulator, without or with a tolerance."""
    series = "network" if tol is None else f"simulator to {tol:g}"
    rows, failures, levels, methods = list[Row](), list[str](), list[LoadLevel](), list[str]()
    for step in sweep.steps:
        answer = sweep.ask(step, tol)
        u = answer.displacement[None] / sweep.scene.length
        error = _relative_error(u, step.exact)
        methods.append(answer.method)
        levels.append(
            LoadLevel(
                *(series, step.amplitude, answer.residual, answer.volume_ratio),
                *(answer.iterations, answer.summary, error),
            )
        )
        place = f"{step.amplitude:g}"
        rows += [
            Row(f"{place}: {description}", "1", float(so), 0)
            for description, so in _checks(sweep, step, answer, u)
        ]
        if tol is not None and step.amplitude <= 1:
            if not answer.converged:
                failures.append(f"{place}: {answer.summary}")
            elif step.exact.stable.all():
                rows.append(Row(f"{place}: off Newton's answer", f"< {ERROR}", error))
    return classify(_summary(levels, methods), rows, failures=failures, levels=levels)


def _checks(
    sweep: AmplitudeSweep, step: Step, answer: Answer, u: torch.Tensor
) -> Iterator[tuple[str, bool]]:
    """Yield statements of an answer and True where they hold."""
    problem = sweep.scene.problem.with_parameters(step.load.parameters)
    internal, volume = problem.internal_force(u), float(problem.volume_ratio(u))
    ratio = float(problem.relative_residual_of(internal, step.load.force))
    near = abs(answer.residual - ratio) <= 1e-3 * ratio + 1e-12
    yield "the reported residual is right", near or not (ratio == ratio and ratio < float("inf"))
    yield "the reported sign of min det F is right", (answer.volume_ratio > 0) == (volume > 0)
    tol = TOL if answer.iterations else sweep.scene.solver.tol
    sound = volume > 0 and (
        ratio < 1.01 * max(tol, TOL)
        or bool(problem.is_equilibrium(u, internal, step.load.force, TOL))
    )
    yield "reported convergence is right", sound or not answer.converged
    words = answer.summary
    yield (
        "no summary claims convergence without it",
        answer.converged or "(converged)" not in words,
    )
    outside = step.amplitude > 1 + ROUNDOFF
    yield (
        "a load out of range is reported",
        bool(answer.out_of_distribution) == outside or answer.out_of_span > 1e-3,
    )
    if outside and answer.out_of_span <= 1e-3:
        yield "its amplitude is reported", "times the training's largest" in words


def hybrid(sweep: AmplitudeSweep, auditor: Auditor) -> Outcome:
    """Start Newton from the predictions of the network by the default rule of the scene."""
    scene = sweep.scene
    solver = auditor.wrap(
        default_hybrid(sweep.surrogate.predict, scene), scene.problem, scene.solver.tol
    )
    rows, failures, levels = list[Row](), list[str](), list[LoadLevel]()
    for step in sweep.steps:
        with torch.inference_mode():
            states = list(solver.iterate(step.load))
        last = states[-1]
        error = _relative_error(last.displacement, step.exact)
        min_detF = min(float(s.volume_ratio) for s in states if s.iterations > 0 or s is last)
        levels.append(level("hybrid", step.amplitude, last, min_detF, error))
        if step.amplitude > 1:
            continue
        if not last.converged.all():
            failures.append(f"{step.amplitude:g}: {levels[-1].status}")
        elif step.exact.stable.all():
            rows.append(Row(f"{step.amplitude:g}: off Newton's answer", f"< {ERROR}", error))
    converged = f"{sum(r.status == 'converged' for r in levels)} of {len(levels)} converged"
    most = max(r.iterations for r in levels)
    return classify(
        f"{converged}, at most {most} iterations", rows, failures=failures, levels=levels
    )


def newton(sweep: AmplitudeSweep, auditor: Auditor) -> Outcome:
    """Solve the same loads from rest, for comparison."""
    levels, failures = list[LoadLevel](), list[str]()
    for step in sweep.steps:
        levels.append(level("Newton", step.amplitude, step.exact, step.min_detF, 0.0))
        if step.amplitude <= 1 and not step.exact.converged.all():
            failures.append(f"{step.amplitude:g}: {levels[-1].status}")
    auditor.merge(sweep.auditor)
    done = sum(r.status in ("converged", "unstable") for r in levels)
    most = max(r.iterations for r in levels)
    return classify(
        f"{done} of {len(levels)} answered, at most {most} iterations",
        failures=failures,
        levels=levels,
    )


def _relative_error(u: torch.Tensor, exact: Solution) -> float:
    """Return ||u - u*|| / ||u*||; NaN where there is no u*."""
    if not exact.converged.all():
        return float("nan")
    return float((u - exact.displacement).norm() / exact.displacement.norm())


def _summary(levels: list[LoadLevel], methods: list[str]) -> str:
    """Return the largest error of each amplitude and the methods that answered as text."""
    errors: dict[float, list[float]] = {}
    for step in levels:
        errors.setdefault(step.amplitude, []).append(step.error)
    shown = ", ".join(f"{a:g}: {max(e):.1e}" for a, e in errors.items())
    used = ", ".join(f"{methods.count(method)} {method}" for method in dict.fromkeys(methods))
    return f"largest error at amplitude {shown}; answered by {used}"


def cases(surrogate: TrainedSurrogate, *, count: int = 2) -> list[Case]:
    """Return the cases of a trained surrogate.

    Args:
        surrogate: A surrogate on the CPU.
        count: Number of loads of each amplitude.
    """
    sweep = AmplitudeSweep(surrogate.eval(), count)
    span = f"{count} loads, {AMPLITUDES[0]:g} to {AMPLITUDES[-1]:g} times the range"
    return [
        Case(
            *("run", f"Newton from rest, {span}"),
            *("answers in range; beyond, an answer or a status", partial(newton, sweep)),
        ),
        Case(
            *("run", f"network alone, {span}"),
            *("reported residual, det F and range are right; none claims to have converged",),
            partial(simulator_answers, sweep, None),
        ),
        Case(
            *("run", f"simulator to {TOL:g}, {span}"),
            *("Newton's answers in range; beyond, an answer or a verdict",),
            partial(simulator_answers, sweep, TOL),
        ),
        Case(
            *("run", f"hybrid, {span}"),
            *("Newton's answers in range; beyond, an answer or a status",),
            partial(hybrid, sweep),
        ),
    ]
