"""Simulator: from forces [N] to displacements [m] with a report of their quality."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dpl.fem import (
    Load,
    Problem,
    Solution,
    Status,
    SubspaceNewton,
    estimate_error,
    evaluate_solution,
)
from dpl.fem.solvers import concatenate
from dpl.fem.solvers.error_estimate import MANY_PRODUCTS, PRODUCTS
from dpl.inference.answer import Answer, answer_like, summarise
from dpl.inference.arguments import as_load, as_numbers
from dpl.inference.grasp import Gripper
from dpl.inference.hybrid import default_hybrid
from dpl.inference.request import Candidate, Request
from dpl.inference.training_range import RangeCheck
from dpl.models.unrolled.correction import MAX_STEPS
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

SUFFICIENT = 2e-3  # steps leave an error of 1e-3 in the modes, and about as much outside [-]
ERROR = 1e-3  # estimated relative error above which they are made [-]
POOR_STREAM = 9_003  # of the loads by which the predictions are judged
PACE_DECAY = 0.9  # of a time from call to call
FAR = 0.1  # estimated relative error above which the hybrid may start elsewhere [-]
MAX_RESIDUAL = 1.0  # above it the error outside of the modes is not that of the training [-]
MAX_LINEAR_AMPLITUDE = 0.05  # amplitude below which the linear solution is evaluated [-]


class Simulator:
    """Simulator of a scene with a trained surrogate and the solvers of the scene.

    Called with a force alone, it returns the prediction with its residual and its estimated error.
    If the model comes with Newton's method in its modes, it makes steps of this method while the
    error in the modes is too large, and a correction of the whole and further steps if the
    estimated error is too large then. With a tolerance for the residual or the estimated error, it
    tries network, linear solution, hybrid and Newton in this order until the tolerance is met; with
    a budget, while there is time. It keeps the last displacement as an initial guess of the next
    call (`warm`).

    Attributes:
        surrogate: The surrogate.
        newton: Newton's method in the modes of the model; None: predictions are not corrected.
        steps: Largest number of its steps and of corrections of the whole together.
    """

    def __init__(
        self,
        surrogate: TrainedSurrogate,
        *,
        newton: SubspaceNewton | None = None,
        steps: int = MAX_STEPS,
    ) -> None:
        """Store the surrogate and build the corrector of its scene.

        Args:
            surrogate: A trained surrogate on the CPU.
            newton: Newton's method in the modes of the model; None: that with which the model comes
                (`HasCorrection`).
            steps: Largest number of steps, see the attributes; 0: predictions are not corrected.

        Raises:
            ValueError: `steps` is negative.
        """
        if steps < 0:
            raise ValueError(f"steps = {steps} must be 0 or more")
        newton = surrogate.predictor.correction() if newton is None else newton
        self.surrogate, self.newton, self.steps = surrogate.eval(), newton, steps
        if newton is not None:
            newton.tangent  # noqa: B018  # built here, so that the first call is not slower
        self._before: tuple[Tensor, Tensor] | None = None  # parameters, displacement
        self._pace = 0.0  # time of the next iteration, as of the last one [s]
        self._first_pace = 0.0  # time of the start of the hybrid and its first iteration [s]
        self._estimate_time = 0.0  # time of an estimate of the error [s]
        self.scene.corrector  # noqa: B018  # built here, so that the first call is not slower
        self.scene.is_compact, self.scene.is_softened  # noqa: B018
        self.scene.linear.reference.corotational  # noqa: B018  # so is the factor of the estimate

    @property
    def scene(self) -> Scene:
        """The scene of the surrogate."""
        return self.surrogate.scene

    def __call__(
        self,
        force: ArrayLike | Tensor,
        *,
        young: float | ArrayLike | Tensor | None = None,
        parameters: Mapping[str, float | ArrayLike | Tensor] | ArrayLike | Tensor | None = None,
        tol: float | None = None,
        budget_ms: float | None = None,
        error: float | None = None,
        warm: bool = False,
        stability: bool = False,
    ) -> Answer:
        """Return the displacement under nodal forces with its quality.

        Args:
            force: Nodal forces, (N, D) or, for several loads, (B, N, D) [N] (2D: [N/m]); forces on
                fixed degrees of freedom have no effect. Integers and floating-point numbers of any
                width are accepted, in NumPy arrays, nested lists or dense tensors on any device;
                the result has no gradient with respect to them.
            young: Young's modulus, one number or (B,) [Pa]; optional if the scene has only one.
            parameters: A value for each range of the law, one number or (B,), by its name such as
                `{"poisson": 0.4}`; or all as an array (B, P).
            tol: Relative residual of the result [-], at least 1e-15 and below 1; with `error`, both
                are met.
            budget_ms: Wall time of each load [ms]. An iteration is not started if the time of the
                last iteration exceeds the rest of the budget.
            error: Estimated relative error of the result [-]. The prediction of a model with modes
                is corrected first, by at most `steps` steps, while its error is above `error`; it
                also is if `error` is left out, with 1e-3 in the modes and 2e-3 in the whole.
            warm: Start from the last displacement if it is nearer to equilibrium than the
                prediction.
            stability: Factorise the tangent at the result to determine its stability.

        Raises:
            ValueError: An argument has a wrong shape, contains values that are no real numbers
                (booleans, text, complex numbers, masked entries) or not finite, or is out of range.
        """
        begin = time.perf_counter()
        given = as_numbers("force", force)
        load = as_load(self.scene, given, young, parameters)
        request = Request.checked(tol, budget_ms, error, warm=warm)
        with one_thread(), torch.inference_mode():
            skipped = request.skips_poor_predictions and self._is_poor
            predictions = [None] * len(load.force)
            if not skipped:
                predictions = self.surrogate.predict(load).split(1)
            places = RangeCheck.of(self.surrogate, load)
            shared = (time.perf_counter() - begin) / len(load.force)
            found = []
            members = load.unbatch(), predictions, places.split()
            for single, prediction, place in zip(*members, strict=True):
                begin = time.perf_counter() - shared
                own = replace(request, begin=begin, products=self._products(place, request))
                best = self._solve(single, prediction, place, own)
                if stability:
                    best = best._replace(state=self._with_stability(single, best.state))
                self._before = single.parameters, best.state.displacement
                found.append((best, 1e3 * (time.perf_counter() - begin)))
            answer = self._reported(found, places, request)
        return answer_like(answer, numpy=not isinstance(force, Tensor), single=given.ndim == 2)

    def prediction_error(self, load: Load, prediction: Tensor) -> float:
        """Return the estimated relative error that a call states for a prediction (1, N, D) [-].

        `load` has B = 1. The prediction may contain steps in the modes.
        """
        place, request = RangeCheck.of(self.surrogate, load), Request(None, None, None, warm=False)
        own = replace(request, products=self._products(place, request))
        candidate = self._in_modes(load, prediction, place, own, taken=self.steps)
        return self._with_error(load, candidate, own).known_error

    @cached_property
    def grasp(self) -> Gripper:
        """The gripper of the body, called as `sim.grasp(region, translation, rotation)`."""
        return Gripper(self.surrogate, steps=self.steps)

    def _reported(
        self,
        found: Sequence[tuple[Candidate, float]],
        places: RangeCheck,
        request: Request,
    ) -> dict[str, Any]:
        """Return the fields of `Answer` for solutions with their times [ms]."""
        state = concatenate([best.state for best, _ in found])
        wanted = request.residual_tol(self.scene)
        kept = state.converged & (state.residual < wanted)
        errors = [best.known_error for best, _ in found]
        numbers = zip(kept.tolist(), errors, *(column.tolist() for column in places), strict=True)
        words = [
            "no load: at rest" if best.method == "rest" else summarise(best.state, *own)
            for (best, _), own in zip(found, numbers, strict=True)
        ]
        return {
            "displacement": self.scene.length * state.displacement,
            "residual": state.residual,
            "error": torch.tensor(errors, dtype=torch.float64),
            "volume_ratio": state.volume_ratio,
            "converged": kept,
            "negative_pivots": state.negative_pivots,
            "amplitude": places.amplitude,
            "out_of_span": places.out_of_span,
            "out_of_distribution": places.outside,
            "method": [best.method for best, _ in found],
            "iterations": state.iterations,
            "milliseconds": torch.tensor([taken for _, taken in found], dtype=torch.float64),
            "summary": words,
        }

    def _solve(
        self, load: Load, prediction: Tensor | None, place: RangeCheck, request: Request
    ) -> Candidate:
        """Return the first solution that meets the tolerances, else the best one.

        Args:
            load: The load, B = 1.
            prediction: The prediction of the network, (1, N, D) [-]; None if it is not tried.
            place: Position of the load relative to the training range.
            request: Options of the call.
        """
        scene, tol = self.scene, request.residual_tol(self.scene)
        if not load.force.any() and not scene.problem.is_loaded_at_rest:
            rest = evaluate_solution(scene.problem, torch.zeros_like(load.force), load, tol)
            return Candidate("rest", rest, 0.0)
        best: Candidate | None = None
        last: Candidate | None = None
        for last in self._candidates(load, prediction, place, request):
            if request.error is not None:
                last = self._with_error(load, last, request)
            if best is None or request.rank(last) <= request.rank(best):
                best = last
            if request.is_met(last) or request.over(self._pace + self._estimate_time):
                break
        assert best is not None
        assert last is not None
        ended, state = last.state, best.state
        kept = (state.residual < tol) & (state.volume_ratio > 0) & ~ended.converged
        status = torch.where(kept, int(Status.CONVERGED), ended.status)
        state = state._replace(status=status, load_factor=ended.load_factor)
        return self._with_error(load, best._replace(state=state), request)

    def _products(self, place: RangeCheck, request: Request) -> int:
        """Return the products with the tangent in an estimate, which softening needs.

        Displacements of a compact body in a range without softening are estimated without products,
        and predictions of a thin one, since many products would take longer than the prediction.
        """
        is_compact = self.scene.is_compact
        is_usual = place.inside and not self.scene.is_softened
        if is_usual and (is_compact or not request.is_more_than_prediction):
            return 0
        return PRODUCTS if is_compact else MANY_PRODUCTS

    def _with_error(self, load: Load, candidate: Candidate, request: Request) -> Candidate:
        """Return a solution with its estimated error.

        The error in the modes and the known one outside of them are the estimate if their sum is at
        most the requested one, or `SUFFICIENT`. Otherwise it is the larger one of the error in the
        modes and of `estimate_error`.
        """
        if candidate.error is not None:
            return candidate
        known = candidate.error_in_modes + candidate.error_outside
        if known <= (SUFFICIENT if request.error is None else request.error):
            return candidate._replace(error=known)
        begin, state = time.perf_counter(), candidate.state
        found = estimate_error(
            self.scene.linear, load, state.displacement, candidate.evaluation,
            products=request.products,
        )  # fmt: skip
        self._estimate_time = time.perf_counter() - begin
        if found.is_indefinite:
            state = state.unstable()
        error = max(candidate.error_in_modes, found.error)
        return candidate._replace(state=state, error=error, correction=found.correction)

    def _candidates(
        self, load: Load, prediction: Tensor | None, place: RangeCheck, request: Request
    ) -> Iterator[Candidate]:
        """Yield the solutions of the methods, the cheapest first; see `_solve`.

        The hybrid continues from the prediction, or with `warm` from the last displacement, if that
        is near equilibrium. Otherwise Newton's method starts from rest, since its iterates from far
        seldom lead to a solution.
        """
        problem, tol = self.scene.problem, request.iteration_tol(self.scene)
        self._pace = self._first_pace
        starts = []
        if prediction is not None:
            for first in self._predictions(load, prediction, place, request):
                yield first  # the last one is the best
            if not request.is_more_than_prediction:
                return
            starts.append(first)
        clock = time.perf_counter()
        if request.warm and self._before and torch.equal(self._before[0], load.parameters):
            starts.append(_evaluated("last", problem, self._before[1], load, tol))
        distances = [self._distance(load, one) for one in starts]
        if place.amplitude < MAX_LINEAR_AMPLITUDE:
            linear = self.scene.linear.with_parameters(load.parameters).solve(load.force[0])[None]
            yield _evaluated("linear", problem, linear, load, tol)
        start = None
        if (least := min(distances, default=math.inf)) <= FAR:
            start = starts[distances.index(least)].state.displacement
        for state in self._iterates(load, start, tol):
            if int(state.iterations):
                now = time.perf_counter()
                self._pace, clock = now - clock, now
                if int(state.iterations) == 1:
                    self._first_pace = max(self._pace, PACE_DECAY * self._first_pace)
            elif not state.converged:  # the initial state, which has been evaluated
                continue
            yield Candidate("hybrid" if state.from_guess else "full Newton", state)

    def _iterates(self, load: Load, start: Tensor | None, tol: float) -> Iterator[Solution]:
        """Return the iterates of the hybrid from a start, of Newton's method without one."""
        if start is None:
            return replace(self.scene.corrector, tol=tol).iterate(load)
        return default_hybrid(lambda load: start, self.scene, tol).iterate(load)

    @cached_property
    def _is_poor(self) -> bool:
        """True if predictions of a few random loads are far from equilibrium.

        Newton's method from rest is faster than it is to try such predictions.
        """
        problem, tol = self.scene.problem, self.scene.solver.tol
        return all(
            not self._distance(
                load, _evaluated("prediction", problem, self.surrogate.predict(load), load, tol)
            )
            <= FAR
            for load in self.scene.loads.sample((0, POOR_STREAM), range(3)).unbatch()
        )

    def _distance(self, load: Load, candidate: Candidate) -> float:
        """Return the estimated relative error of a start [-].

        A known error of up to `FAR` in and outside of the modes needs no further estimate.
        """
        if candidate.error is not None:
            return candidate.error
        known = candidate.error_in_modes + candidate.error_outside
        if known <= FAR:
            return known
        products = 0 if self.scene.is_compact else MANY_PRODUCTS
        return estimate_error(
            self.scene.linear, load, candidate.state.displacement, candidate.evaluation,
            products=products,
        ).error  # fmt: skip

    def _predictions(
        self, load: Load, prediction: Tensor, place: RangeCheck, request: Request
    ) -> Iterator[Candidate]:
        """Yield the prediction after steps in the modes, then corrections of it where they help.

        A correction is that of `estimate_error`, which reduces the error outside the modes, then
        steps in the modes, which reduce the error that it adds there. Corrections follow while the
        estimated error is too large and decreases.
        """
        last = self._in_modes(load, prediction, place, request)
        if request.error is not None or (self.newton is not None and request.is_for_error):
            last = self._with_error(load, last, request)
        yield last
        if self.newton is None:
            return
        sufficient = SUFFICIENT if request.error is None else request.error
        while last.correction is not None and last.known_error > sufficient:
            taken = int(last.state.iterations) + 1
            if taken > self.steps or request.over(2 * self._estimate_time):
                return
            guess = last.state.displacement + last.correction
            following = self._in_modes(load, guess, place, request, taken=taken)
            following = self._with_error(load, following, request)
            if not following.known_error < last.known_error:
                return
            yield (last := following)

    def _in_modes(
        self, load: Load, guess: Tensor, place: RangeCheck, request: Request, *, taken: int = 0
    ) -> Candidate:
        """Return a displacement after Newton's steps in the modes; `taken` steps precede them."""
        problem, tol = self.scene.problem, request.iteration_tol(self.scene)
        if self.newton is None or not guess.abs().amax().isfinite():
            return _evaluated("prediction", problem, guess, load, tol)
        wanted = ERROR if request.error is None else request.error
        begin, pace = time.perf_counter(), 0.0
        states = self.newton.states(
            load, guess=guess, error_tol=wanted, max_iter=self.steps - taken,
            is_over=lambda: request.over(pace + self._estimate_time),
        )  # fmt: skip
        first = next(states)
        pace = time.perf_counter() - begin  # each step evaluates and corrects like this
        *_, state = first, *states
        solution = evaluate_solution(
            problem, state.displacement, load, tol,
            iterations=taken + state.iterations, from_guess=True, evaluation=state.evaluation,
        )  # fmt: skip
        outside = self.newton.outside_error  # 0 if it is not known
        in_range = bool(place.inside & (solution.residual < MAX_RESIDUAL))
        return Candidate(
            "corrected" if taken + state.iterations else "prediction",
            solution,
            error_in_modes=state.error,
            error_outside=outside if outside > 0 and in_range else math.inf,
            evaluation=state.evaluation,
        )

    def _with_stability(self, load: Load, state: Solution) -> Solution:
        """Return a solution with the number of negative eigenvalues of its tangent."""
        if not state.converged or int(state.negative_pivots) >= 0:
            return state
        newton = self.scene.newton.with_parameters(load.parameters)
        pivots = newton.stability(state.displacement)
        status = Status.UNSTABLE if pivots > 0 else Status.CONVERGED
        return state._replace(
            negative_pivots=torch.full_like(state.negative_pivots, pivots),
            status=torch.full_like(state.status, int(status)),
        )


def _evaluated(
    method: str, problem: Problem, displacement: Tensor, load: Load, tol: float
) -> Candidate:
    """Return a displacement as a solution, with its evaluation."""
    evaluation = problem.with_parameters(load.parameters).evaluate(displacement)
    state = evaluate_solution(
        problem, displacement, load, tol, from_guess=method == "prediction", evaluation=evaluation
    )
    return Candidate(method, state, evaluation=evaluation)
