"""Solvers with a network in them: its answer alone, and as the start of Newton."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dpl.fem.newton import Newton
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, Solution, in_step, judge

Predict = Callable[[Load], Tensor]  # -> displacement (B, N, D) [-]


@dataclass(frozen=True, eq=False)
class Direct:
    """The prediction alone, judged.

    Attributes:
        predict: From a load to displacements over L.
        problem: The body.
        tol: Residual ratio below which the answer counts as converged [-].
    """

    predict: Predict
    problem: Problem
    tol: float = 1e-8

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction."""
        yield judge(self.problem, _prediction(self.predict, load), load, self.tol)


@dataclass(frozen=True, eq=False)
class Hybrid:
    """Network guess, Newton correction: the answer is as exact as Newton's.

    The prediction is the answer if it balances the load. Otherwise one classic Newton step is taken
    from zero, and Newton goes on from the prediction where its residual is smaller than that after
    the step, else from the step. A prediction that is not finite or inverts an element is never
    picked: what follows is the classic path, bit for bit.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, algorithm 2.

    Attributes:
        predict: From a load to displacements over L.
        newton: The corrector.
    """

    predict: Predict
    newton: Newton

    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the prediction, the state after the classic step, and what Newton makes of it.

        The classic step counts as an iteration also where it is discarded.
        """
        guesses = _prediction(self.predict, load)
        yield from in_step(
            [
                self._member(single, guess[None])
                for single, guess in zip(load.singles(), guesses, strict=True)
            ]
        )

    def _member(self, load: Load, guess: Tensor) -> Iterator[Solution]:
        """Yield the states under one load."""
        predicted = judge(self.newton.problem, guess, load, self.newton.tol)
        yield predicted
        if predicted.converged:
            return
        classic = self.newton.iterate(load)
        rest = next(classic)
        first = next(classic, rest)
        yield first
        if first.converged:
            return
        if not pick(predicted, first):
            yield from classic
            return
        for state in self.newton.iterate(load, guess=guess):
            yield state._replace(
                iterations=state.iterations + first.iterations,
                factorisations=state.factorisations + first.factorisations,
                seconds=state.seconds + first.seconds,
            )


def pick(predicted: Solution, first: Solution) -> bool:
    """Return whether Newton goes on from the prediction: ||R(u_p)|| < ||R(u_1)||, nothing inverted.

    Written so that a residual that is not a number never picks.
    """
    return bool(predicted.volume_ratio > 0) and bool(predicted.residual < first.residual)


def _prediction(predict: Predict, load: Load) -> Tensor:
    with torch.no_grad():
        return predict(load)
