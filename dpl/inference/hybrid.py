"""Solvers with a network: the prediction alone, and Newton started from the prediction."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dpl.fem import (
    AndersonSolver,
    Load,
    Newton,
    Problem,
    Solution,
    SubspaceNewton,
    evaluate_solution,
)
from dpl.fem.problem import Evaluation
from dpl.fem.solvers.solution import check_tol, run_lockstep
from dpl.scene import Scene

Predict = Callable[[Load], Tensor]  # -> displacement (B, N, D) [-]
RULES = ("natural_monotonicity", "paper")
SECOND_CORRECTION = 0.1  # norm, over that of the displacement, that is always allowed [-]


@dataclass(frozen=True, eq=False)
class Direct:
    """The prediction of a network with its residual and min det F.

    Attributes:
        predict: Function from a load to displacements, (B, N, D) [-].
        problem: The body.
        tol: Relative residual below which the prediction counts as converged [-].
    """

    predict: Predict
    problem: Problem
    tol: float = 1e-8

    def __post_init__(self) -> None:
        check_tol(self.tol)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction."""
        prediction = _prediction(self.predict, load)
        yield evaluate_solution(self.problem, prediction, load, self.tol, from_guess=True)


@dataclass(frozen=True, eq=False)
class Corrected:
    """The prediction of a network, corrected by the steps of `newton` in its modes."""

    predict: Predict
    newton: SubspaceNewton

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction and the state after each step."""
        yield from self.newton.iterate(load, guess=_prediction(self.predict, load))


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Newton started from the prediction of a network; solutions are as accurate as Newton's.

    A prediction whose residual is below the tolerance is returned. If the prediction is not finite
    or inverts an element, Newton starts from zero; the iterates are then the same bit for bit as
    without a network.

    `rule="paper"`: one Newton iteration is made from zero. Newton continues from the prediction if
    its residual is smaller than that after this iteration, else from this iteration.

    `rule="natural_monotonicity"`: Newton continues from the prediction while its corrections du
    contract. The first one must satisfy ||du|| < ||u + du|| / 2 (from zero, ||du|| = ||u + du||).
    Each later one must be less than half of the one before. The second one may
    also be a tenth of the displacement, because the first one removes the error in stiff directions
    and only then the error in soft directions enters the corrections. Otherwise Newton starts again
    from zero. Unlike residuals, corrections do not depend on the stiffness of the body against an
    error.

    With `steps`, Anderson iterations are made first; Newton continues from the best of them unless
    `is_over()` returns True.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 2; Deuflhard (2011), Newton
    Methods for Nonlinear Problems, section 3.2 (natural monotonicity).

    Attributes:
        predict: Function from a load to displacements, (B, N, D) [-].
        newton: Newton's method.
        rule: Criterion by which Newton continues from the prediction, one of `RULES`.
        steps: Iterations without tangents that precede Newton; None: no such iterations.
        is_over: Called between these iterations and Newton; True: the iteration ends.
        evaluation: Internal force and min det F at the prediction of one load, if known; needed by
            `steps`.
    """

    predict: Predict
    newton: Newton
    rule: str = "natural_monotonicity"
    steps: AndersonSolver | None = None
    is_over: Callable[[], bool] = bool  # which returns False
    evaluation: Evaluation | None = None

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise ValueError(f"rule = {self.rule!r} must be {' or '.join(RULES)}")

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the initial state and the state after each iteration.

        The initial state is the prediction, or zero if the prediction is not finite or inverts an
        element. By the rule of the paper it is the prediction in any case, followed by the state
        after one iteration from zero. Discarded iterations are included in the counts.
        """
        guesses = _prediction(self.predict, load)
        member = self._by_paper if self.rule == "paper" else self._by_corrections
        pairs = zip(load.unbatch(), guesses.split(1), strict=True)
        yield from run_lockstep([member(single, guess) for single, guess in pairs])

    def _by_paper(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield the states under one load by the rule of the paper."""
        predicted = evaluate_solution(
            self.newton.problem, guess, load, self.newton.tol, from_guess=True
        )
        yield predicted
        if predicted.converged:
            return
        classic = self.newton.iterate(load)
        rest = next(classic)
        first = next(classic, rest)
        yield first
        if first.converged:
            return
        if not prefer_prediction(predicted, first):
            yield from classic
            return
        yield from _after(first, self.newton.iterate(load, guess=guess))

    def _by_corrections(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield the states under one load by natural monotonicity, after `steps`."""
        if self.steps is None or not self.newton.problem.acting(load.force).any():
            yield from self._corrected(load, guess)
            return
        least = None
        for state in self.steps.iterate(load, guess=guess, evaluation=self.evaluation):
            if not state.volume_ratio > 0:
                break
            yield state
            least = state if least is None or state.residual < least.residual else least
        if state.converged or self.is_over():
            return
        states = self._corrected(load, guess if least is None else least.displacement)
        if least is not None:
            next(states)  # this state has been yielded
        yield from _after(state, states)

    def _corrected(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield Newton's states from a guess while its corrections contract, else from zero."""
        states = self.newton.iterate(load, guess=guess)
        last = next(states)
        yield last
        before = float("inf")
        for k, state in enumerate(states):
            size = float((state.displacement - last.displacement).norm())
            whole = float(state.displacement.norm())
            allowed = max(0.5 * min(before, whole), SECOND_CORRECTION * whole if k == 1 else 0.0)
            contracts = bool(state.from_guess) and size < allowed
            if last.from_guess and not (contracts or state.converged):
                classic = self.newton.iterate(load)
                next(classic)
                yield from _after(state, classic)
                return
            yield state
            last, before = state, size


def default_hybrid(predict: Predict, scene: Scene, tol: float | None = None) -> Hybrid:
    """Return the hybrid solver of a scene, whose tolerance it has if `tol` is None.

    Anderson iterations precede Newton if the corotated factor of K(0) is a good preconditioner, see
    `Scene.is_compact`.
    """
    newton = scene.corrector if tol is None else replace(scene.corrector, tol=tol)
    return Hybrid(predict, newton, steps=AndersonSolver(newton) if scene.is_compact else None)


def prefer_prediction(predicted: Solution, first: Solution) -> bool:
    """Return True if ||R(u_p)|| < ||R(u_1)|| and the prediction u_p inverts no element.

    `predicted` is u_p of one load, `first` u_1 after one iteration from zero. The result is False
    for a residual that is NaN.
    """
    return bool(predicted.volume_ratio > 0) and bool(predicted.residual < first.residual)


def _after(spent: Solution, states: Iterator[Solution]) -> Iterator[Solution]:
    """Yield states with the iterations, factorisations and time of an earlier state added."""
    for state in states:
        yield state._replace(
            iterations=state.iterations + spent.iterations,
            factorisations=state.factorisations + spent.factorisations,
            seconds=state.seconds + spent.seconds,
        )


def _prediction(predict: Predict, load: Load) -> Tensor:
    with torch.no_grad():
        return predict(load)
