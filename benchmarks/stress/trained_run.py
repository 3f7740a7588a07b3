"""A trained surrogate on loads from 1e-9 of its range to 25 times it: alone, corrected, hybrid."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import torch

from benchmarks.stress.auditor import Auditor
from benchmarks.stress.case import Case, LoadLevel, Outcome, classify
from benchmarks.stress.loads import rung
from benchmarks.verification.report import Row
from dpl import Scene
from dpl.fem import Load, Solution
from dpl.inference import Answer, Simulator, default_hybrid
from dpl.inference.simulator import SLACK
from dpl.training import Surrogate

LADDER = (1e-9, 1e-6, 1e-3, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 25.0)  # times the range
STREAM = (0, 11)  # of these loads
TOL = 1e-6  # asked of the simulator [-]
ERROR = 1e-3  # relative distance of two answers in range, balanced to TOL, that is one and the same


class Step(NamedTuple):
    """A load of the ladder, Newton's answer to it, and the smallest min det F on the way."""

    amplitude: float
    load: Load
    exact: Solution
    smallest: float


@dataclass(frozen=True, eq=False)
class Ladder:
    """Loads of growing amplitude for a surrogate, each with Newton's answer.

    Attributes:
        surrogate: Trained.
        count: Loads that are scaled.
        amplitudes: To these, times the range [-].
        watch: Over Newton's answers.
    """

    surrogate: Surrogate
    count: int = 2
    amplitudes: tuple[float, ...] = LADDER
    watch: Auditor = field(default_factory=Auditor)
    simulator: Simulator = field(init=False)

    def __post_init__(self) -> None:
        """Make the simulator."""
        object.__setattr__(self, "simulator", Simulator(self.surrogate))

    @property
    def scene(self) -> Scene:
        """What is simulated."""
        return self.surrogate.scene

    @cached_property
    def steps(self) -> list[Step]:
        """The loads with their answers, from the smallest amplitude."""
        loads, exact = self.scene.loads, self.scene.solver
        solver = self.watch.over(exact, self.scene.problem, exact.tol)
        drawn = loads.sample(STREAM, range(self.count))
        own = drawn.force if loads.constant_force is None else drawn.force - loads.constant_force
        places, _ = loads.project(drawn.force)
        found = []
        for amplitude in self.amplitudes:
            force = (amplitude / places)[:, None, None] * own
            force = force if loads.constant_force is None else force + loads.constant_force
            for load in drawn._replace(force=force).unbatch():
                states = list(solver.iterate(load))
                smallest = min(float(state.volume_ratio) for state in states)
                found.append(Step(amplitude, load, states[-1], smallest))
        return found

    def asked(self, step: Step, tol: float | None) -> Answer:
        """Return the simulator's answer to a load, newtons in and metres out."""
        load = step.load
        newtons = load.force[0] * load.young[0] * self.scene.force_unit
        poisson = load.poisson[0] if load.poisson.shape[-1] else None
        return self.simulator(newtons, young=load.young, poisson=poisson, tol=tol)


def simulated(ladder: Ladder, tol: float | None, watch: Auditor) -> Outcome:
    """Ask the simulator, without or with a tolerance, and hold its answers to what they say."""
    series = "network" if tol is None else f"simulator to {tol:g}"
    rows, fails, rungs, tiers = list[Row](), list[str](), list[LoadLevel](), list[str]()
    for step in ladder.steps:
        answer = ladder.asked(step, tol)
        u = answer.displacement[None] / ladder.scene.length
        error = _apart(u, step.exact)
        tiers.append(answer.method)
        rungs.append(
            LoadLevel(
                *(series, step.amplitude, answer.residual, answer.volume_ratio),
                *(answer.iterations, answer.summary, error),
            )
        )
        place = f"{step.amplitude:g}"
        rows += [
            Row(f"{place}: {what}", "1", float(so), 0)
            for what, so in _true(ladder, step, answer, u)
        ]
        if tol is not None and step.amplitude <= 1:
            if not answer.converged:
                fails.append(f"{place}: {answer.summary}")
            elif step.exact.stable.all():
                rows.append(Row(f"{place}: off Newton's answer", f"< {ERROR}", error))
    return classify(_told(rungs, tiers), rows, fails=fails, rungs=rungs)


def _true(
    ladder: Ladder, step: Step, answer: Answer, u: torch.Tensor
) -> Iterator[tuple[str, bool]]:
    """Yield what an answer says of itself, and whether it is so."""
    problem = ladder.scene.problem.at(step.load.poisson)
    internal, volume = problem.internal_force(u), float(problem.volume_ratio(u))
    ratio = float(problem.relative_residual_of(internal, step.load.force))
    near = abs(answer.residual - ratio) <= 1e-3 * ratio + 1e-12
    yield "the residual is as said", near or not (ratio == ratio and ratio < float("inf"))
    yield "nothing is inverted where that is said", (answer.volume_ratio > 0) == (volume > 0)
    tol = TOL if answer.iterations else ladder.scene.solver.tol
    sound = volume > 0 and (
        ratio < 1.01 * max(tol, TOL)
        or bool(problem.is_equilibrium(u, internal, step.load.force, TOL))
    )
    yield "it converged where that is said", sound or not answer.converged
    words = answer.summary
    yield (
        "an estimate is called one",
        answer.converged or words.startswith(("NOT VALID", "an estimate")),
    )
    outside = step.amplitude > 1 + SLACK
    yield (
        "outside is said",
        bool(answer.out_of_distribution) == outside or answer.out_of_span > 1e-3,
    )
    if outside and answer.out_of_span <= 1e-3:
        yield "by how much is said", "times the training's largest" in words


def hybrid(ladder: Ladder, watch: Auditor) -> Outcome:
    """Start Newton from the network's predictions, by the rule that suits the scene."""
    scene = ladder.scene
    solver = watch.over(
        default_hybrid(ladder.surrogate.predict, scene), scene.problem, scene.solver.tol
    )
    rows, fails, rungs = list[Row](), list[str](), list[LoadLevel]()
    for step in ladder.steps:
        with torch.inference_mode():
            states = list(solver.iterate(step.load))
        last = states[-1]
        error = _apart(last.displacement, step.exact)
        smallest = min(float(s.volume_ratio) for s in states if s.iterations > 0 or s is last)
        rungs.append(rung("hybrid", step.amplitude, last, smallest, error))
        if step.amplitude > 1:
            continue
        if not last.converged.all():
            fails.append(f"{step.amplitude:g}: {rungs[-1].status}")
        elif step.exact.stable.all():
            rows.append(Row(f"{step.amplitude:g}: off Newton's answer", f"< {ERROR}", error))
    picked = f"{sum(r.status == 'converged' for r in rungs)} of {len(rungs)} converged"
    most = max(r.iterations for r in rungs)
    return classify(f"{picked}, at most {most} iterations", rows, fails=fails, rungs=rungs)


def newton(ladder: Ladder, watch: Auditor) -> Outcome:
    """Solve the same loads from rest, for comparison."""
    rungs, fails = list[LoadLevel](), list[str]()
    for step in ladder.steps:
        rungs.append(rung("Newton", step.amplitude, step.exact, step.smallest, 0.0))
        if step.amplitude <= 1 and not step.exact.converged.all():
            fails.append(f"{step.amplitude:g}: {rungs[-1].status}")
    watch.take(ladder.watch)
    done = sum(r.status in ("converged", "unstable") for r in rungs)
    most = max(r.iterations for r in rungs)
    return classify(
        f"{done} of {len(rungs)} answered, at most {most} iterations", fails=fails, rungs=rungs
    )


def _apart(u: torch.Tensor, exact: Solution) -> float:
    """Return ||u - u*|| / ||u*||; NaN where there is no u*."""
    if not exact.converged.all():
        return float("nan")
    return float((u - exact.displacement).norm() / exact.displacement.norm())


def _told(rungs: list[LoadLevel], tiers: list[str]) -> str:
    """Return errors by amplitude, and who answered."""
    errors: dict[float, list[float]] = {}
    for step in rungs:
        errors.setdefault(step.amplitude, []).append(step.error)
    shown = ", ".join(f"{a:g}: {max(e):.1e}" for a, e in errors.items())
    who = ", ".join(f"{tiers.count(tier)} {tier}" for tier in dict.fromkeys(tiers))
    return f"largest error at amplitude {shown}; answered by {who}"


def cases(surrogate: Surrogate, *, count: int = 2) -> list[Case]:
    """Return the cases of a trained surrogate.

    Args:
        surrogate: On the CPU.
        count: Loads of each amplitude.
    """
    ladder = Ladder(surrogate.eval(), count)
    span = f"{count} loads, {LADDER[0]:g} to {LADDER[-1]:g} times the range"
    return [
        Case(
            *("run", f"Newton from rest, {span}"),
            *("answers in range; beyond, an answer or a status", partial(newton, ladder)),
        ),
        Case(
            *("run", f"network alone, {span}"),
            *("residual, det F and range are as said; an estimate is called one",),
            partial(simulated, ladder, None),
        ),
        Case(
            *("run", f"simulator to {TOL:g}, {span}"),
            *("Newton's answers in range; beyond, an answer or a verdict",),
            partial(simulated, ladder, TOL),
        ),
        Case(
            *("run", f"hybrid, {span}"),
            *("Newton's answers in range; beyond, an answer or a status",),
            partial(hybrid, ladder),
        ),
    ]
