"""Solvers with a network in them: its answer alone, and as the start of Newton."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from dpl.fem import AndersonSolver, Load, Problem, Solution, evaluate_solution
from dpl.fem.solvers import check_tol, run_lockstep
from dpl.scene import Scene

Predict = Callable[[Load], Tensor]  # -> displacement (B, N, D) [-]
RULES = ("natural_monotonicity", "paper")
SECOND = 0.1  # part of the displacement that the second correction may be in any case


class Corrector(Protocol):
    """A Newton method that can start from a guess."""

    @property
    def problem(self) -> Problem:
        """The body."""
        ...

    @property
    def tol(self) -> float:
        """Residual ratio below which an answer counts as converged [-]."""
        ...

    def iterate(self, load: Load, *, guess: Tensor | None = None) -> Iterator[Solution]:
        """Yield the start and the state after each iteration."""
        ...


@dataclass(frozen=True, eq=False)
class Direct:
    """The prediction alone, judged.

    Attributes:
        predict: From a load to displacements over L.
        problem: The body.
        tol: Residual ratio below which the answer counts as converged [-]; at least 1e-15, below 1.
    """

    predict: Predict
    problem: Problem
    tol: float = 1e-8

    def __post_init__(self) -> None:
        """Check the tolerance.

        Raises:
            ValueError: It is out of range.
        """
        check_tol(self.tol)

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction."""
        prediction = _prediction(self.predict, load)
        yield evaluate_solution(self.problem, prediction, load, self.tol, from_guess=True)


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Network guess, Newton correction: the answer is as exact as Newton's.

    The prediction is the answer if it balances the load. One that is not finite or inverts an
    element is never picked: what follows is the classic path from rest, bit for bit.

    `rule="paper"`: one classic step is taken from rest, and Newton goes on from the prediction
    where its residual is smaller than that after the step, else from the step.

    `rule="natural_monotonicity"`: Newton goes on from the prediction as long as its corrections
    contract. The first must be less than half of the displacement that it leads to, ||du|| < ||u +
    du|| / 2, where from rest the two are equal; each that follows, less than half of the one
    before. The second may also be a tenth of the displacement: the first removes what stiff
    directions resist and shows only then what soft ones lack. If not, Newton starts again from
    rest. Corrections, unlike residuals, do not depend on how stiff the body is against an error.

    With `steps`, those are tried first from a prediction, and Newton goes on from the best of them.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 2; Deuflhard (2011), Newton
    Methods for Nonlinear Problems, section 3.2 (natural monotonicity).

    Attributes:
        predict: From a load to displacements over L.
        newton: The corrector.
        rule: How a prediction is picked.
        steps: Cheaper ones that a good prediction is improved by; None: Newton at once.
    """

    predict: Predict
    newton: Corrector
    rule: str = "natural_monotonicity"
    steps: AndersonSolver | None = None

    def __post_init__(self) -> None:
        """Check the rule.

        Raises:
            ValueError: There is no such rule.
        """
        if self.rule not in RULES:
            raise ValueError(f"rule = {self.rule!r} must be {' or '.join(RULES)}")

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction, or rest where it is useless, and what Newton makes of it.

        By the paper's rule the prediction comes first in any case, then the state after the classic
        step. What is discarded counts: the classic step, or corrections of the prediction.
        """
        guesses = _prediction(self.predict, load)
        member = self._by_paper if self.rule == "paper" else self._by_corrections
        yield from run_lockstep(
            [
                member(single, guess[None])
                for single, guess in zip(load.unbatch(), guesses, strict=True)
            ]
        )

    def _by_paper(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield the states under one load."""
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
        """Yield the states under one load."""
        if self.steps is None or not self.newton.problem.acting(load.force).any():
            yield from self._corrected(load, guess)
            return
        least = None
        for state in self.steps.iterate(load, guess=guess):
            if not state.volume_ratio > 0:
                break
            yield state
            least = state if least is None or state.residual < least.residual else least
        if state.converged:
            return
        states = self._corrected(load, guess if least is None else least.displacement)
        if least is not None:
            next(states)  # it has been yielded
        yield from _after(state, states)

    def _corrected(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield Newton's states from a guess while its corrections contract, else from rest."""
        states = self.newton.iterate(load, guess=guess)
        last = next(states)
        yield last
        before = float("inf")
        for k, state in enumerate(states):
            size = float((state.displacement - last.displacement).norm())
            whole = float(state.displacement.norm())
            allowed = max(0.5 * min(before, whole), SECOND * whole if k == 1 else 0.0)
            contracts = bool(state.from_guess) and size < allowed
            if last.from_guess and not (contracts or state.converged):
                classic = self.newton.iterate(load)
                next(classic)
                yield from _after(state, classic)
                return
            yield state
            last, before = state, size


def default_hybrid(predict: Predict, scene: Scene, tol: float | None = None) -> Hybrid:
    """Return the hybrid that suits a scene.

    Where K(0)'s factor, turned, stands for those of tangents, steps without tangents come first.

    Args:
        predict: From a load to displacements over L.
        scene: What is simulated.
        tol: Residual ratio [-]; the scene's if left out.
    """
    newton = scene.corrector if tol is None else replace(scene.corrector, tol=tol)
    return Hybrid(predict, newton, steps=AndersonSolver(newton) if newton.corotational else None)


def prefer_prediction(predicted: Solution, first: Solution) -> bool:
    """Return whether Newton goes on from the prediction: ||R(u_p)|| < ||R(u_1)||, nothing inverted.

    Written so that a residual that is not a number never picks.
    """
    return bool(predicted.volume_ratio > 0) and bool(predicted.residual < first.residual)


def _after(spent: Solution, states: Iterator[Solution]) -> Iterator[Solution]:
    """Yield states with what was spent before them added."""
    for state in states:
        yield state._replace(
            iterations=state.iterations + spent.iterations,
            factorisations=state.factorisations + spent.factorisations,
            seconds=state.seconds + spent.seconds,
        )


def _prediction(predict: Predict, load: Load) -> Tensor:
    with torch.no_grad():
        return predict(load)
