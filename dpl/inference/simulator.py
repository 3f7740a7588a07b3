"""Simulator: from forces [N] to displacements [m] with a report of their quality."""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dpl.fem import (
    Load,
    Status,
    SubspaceNewton,
    estimate_error,
    evaluate_solution,
)
from dpl.fem.problem import Evaluation
from dpl.fem.solvers.error_estimate import MANY_PRODUCTS, PRODUCTS
from dpl.inference.answer import Answer, RangeCheck, answer_of, stacked
from dpl.inference.arguments import as_load, as_numbers
from dpl.inference.grasp import Gripper
from dpl.inference.hybrid import default_hybrid
from dpl.inference.request import FINISH, Candidate, Durations, Guess, Request
from dpl.models.unrolled.correction import MAX_STEPS
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

ERROR = 1e-3  # estimated relative error in the modes at which steps end, and are not begun [-]
FAR = 0.1  # estimated relative error above which the hybrid may start elsewhere [-]
WORTH = 1 / 3  # known error after steps over that before, below which they are made [-]
MAX_LINEAR_AMPLITUDE = 0.05  # amplitude below which the linear solution is evaluated [-]


class Simulator:
    """Simulator of a scene with a trained surrogate and the solvers of the scene.

    Called with a force alone, it returns the prediction with its residual and its estimated error.
    If that is too large and the model comes with Newton's method in its modes, it makes steps of
    this method while the error in the modes is too large, and a correction of the whole and further
    steps if the estimated error is too large then. With a tolerance for the residual or the
    estimated error, it tries network, linear solution, hybrid and Newton in this order until the
    tolerance is met; with a budget, while there is time. It keeps the last displacement as an
    initial guess of the next call (`warm`).

    Attributes:
        surrogate: The surrogate.
        scene: Its scene.
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
        """Store a surrogate on the CPU and build the corrector of its scene.

        Without `newton` it is that with which the model comes (`HasCorrection`). With `steps=0`
        predictions are not corrected.
        """
        if steps < 0:
            raise ValueError(f"steps = {steps} must be 0 or more")
        newton = surrogate.predictor.correction() if newton is None else newton
        self.surrogate, self.newton, self.steps = surrogate.eval(), newton, steps
        self.scene: Scene = surrogate.scene
        if newton is not None:
            newton.prepare()  # here, so that the first call is not slower
        self._before: tuple[Tensor, Tensor] | None = None  # parameters, displacement
        self._durations = Durations()
        self.scene.corrector  # noqa: B018  # built here, so that the first call is not slower
        self.scene.is_compact, self.scene.is_softened  # noqa: B018
        self.scene.linear.reference.corotational  # noqa: B018  # so is the factor of the estimate

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
            budget_ms: Wall time of each load [ms]. An iteration is not started if its forecast by
                `Durations` exceeds the rest of the budget.
            error: Estimated relative error of the result [-]. The prediction of a model with modes
                is corrected first, by at most `steps` steps, while its error is above `error`, or
                above 2e-3 if `error` is left out.
            warm: Start from the last displacement if it is nearer to equilibrium than the
                prediction.
            stability: Factorise the tangent at the result to determine its stability.
        """
        request = Request(tol, budget_ms, error, self._durations, warm)
        if request.is_more_than_prediction or stability:
            self.scene.problem.material.require_known("tol, error, budget_ms or stability")
        given = as_numbers("force", force)
        load = as_load(self.scene, given, young, parameters)
        with one_thread(), torch.inference_mode():
            places = RangeCheck.of(self.surrogate, load)
            guesses = self._guesses(load, places)
            shared = (time.perf_counter() - request.begin) / len(load.force)
            answers = []
            for single, guess, place in zip(load.unbatch(), guesses, places, strict=True):
                begin = time.perf_counter() - shared
                own = copy(request)  # `replace` would check the tolerances again
                own.begin, own.products = begin, self._products(place, request)
                best = self._solve(single, guess, place, own)
                best = self._with_error(single, best, own)
                with own.durations.timed(FINISH):
                    state = best.state
                    if stability and state.converged and int(state.negative_pivots) < 0:
                        newton = self.scene.newton.with_parameters(single.parameters)
                        pivots = newton.stability(state.displacement)
                        status = int(Status.UNSTABLE if pivots > 0 else Status.CONVERGED)
                        counted = state._replace(
                            negative_pivots=torch.tensor([pivots]), status=torch.tensor([status])
                        )
                        best = best._replace(state=counted)
                    self._before = single.parameters, state.displacement
                    answers.append(answer_of(best, place, own, self.scene))
        numpy = not isinstance(force, Tensor)
        if given.ndim == 3:
            return stacked(answers, numpy=numpy)
        u = answers[0].displacement  # a tensor of inference mode, which an ordinary one replaces
        return replace(answers[0], displacement=u.numpy() if numpy else u.clone())

    def prediction_error(self, load: Load, prediction: Tensor) -> float:
        """Return the estimated relative error that a call states for a prediction (1, N, D) [-].

        `load` has B = 1. The prediction may contain steps in the modes.
        """
        (place,) = RangeCheck.of(self.surrogate, load)
        request = Request()
        request.products = self._products(place, request)
        with torch.inference_mode():
            (guess,) = self._guesses(load, [place])
            if not torch.equal(guess.displacement, prediction):
                guess = Guess(prediction, error_outside=guess.error_outside)
            candidate = self._in_modes(load, guess, request, taken=self.steps)
            return self._with_error(load, candidate, request).known_error

    @cached_property
    def grasp(self) -> Gripper:
        """The gripper of the body, called as `sim.grasp(region, translation, rotation)`.

        `dataclasses.replace(sim.grasp, warm=True)` is a moving hand, `sliding=True` a flat plate.
        """
        return Gripper(self.surrogate, steps=self.steps)

    def _guesses(self, load: Load, places: Sequence[RangeCheck]) -> list[Guess]:
        """Return the predictions; their estimated errors are known in range only."""
        predictions, errors = self.surrogate.predict_with_errors(load)
        rows = zip(predictions.split(1), errors.tolist(), places, strict=True)
        return [Guess(u, *own) if place.inside else Guess(u) for u, own, place in rows]

    def _solve(self, load: Load, guess: Guess, place: RangeCheck, request: Request) -> Candidate:
        """Return the first solution that meets the tolerances, else the best one.

        Its error is estimated if that decides.
        """
        scene, tol = self.scene, request.residual_tol(self.scene)
        if not load.force.numpy().any() and not scene.problem.is_loaded_at_rest:
            rest = evaluate_solution(scene.problem, torch.zeros_like(load.force), load, tol)
            return Candidate("rest", rest, 0.0)
        best: Candidate | None = None
        last: Candidate | None = None
        for last, stages in self._candidates(load, guess, place, request):
            if request.error is not None:
                last = self._with_error(load, last, request)
            if best is None or request.rank(last) <= request.rank(best):
                best = last
            if request.is_met(last) or request.over(*stages):
                break
        assert best is not None
        assert last is not None
        ended, state = last.state, best.state
        kept = (state.residual < tol) & (state.volume_ratio > 0) & ~ended.converged
        status = torch.where(kept, int(Status.CONVERGED), ended.status)
        return best._replace(state=state._replace(status=status, load_factor=ended.load_factor))

    def _products(self, place: RangeCheck, request: Request) -> int:
        """Return the products with the tangent in an estimate, which softening needs.

        In a range without softening, compact bodies need them for a tolerance of the error only.
        Predictions of thin ones have none, since many products would take longer than the
        prediction.
        """
        is_compact = self.scene.is_compact
        is_usual = place.inside and not self.scene.is_softened
        is_decisive = request.error is not None
        if is_usual and not (is_decisive if is_compact else request.is_more_than_prediction):
            return 0
        return PRODUCTS if is_compact else MANY_PRODUCTS

    def _with_error(self, load: Load, candidate: Candidate, request: Request) -> Candidate:
        """Return a solution with its estimated error.

        It is the error in the modes plus the known one outside of them if this sum is sufficient,
        or there is no time for another one, else the larger one of the error in the modes and of
        `estimate_error`.
        """
        if candidate.error is not None:
            return candidate
        known = candidate.error_in_modes + candidate.error_outside
        is_known = math.isfinite(known) and request.over("estimate")
        if known <= request.sufficient_error or is_known:
            return candidate._replace(error=known)
        state = candidate.state
        with request.durations.timed("estimate"):
            found = estimate_error(
                self.scene.linear, load, state.displacement, state.evaluation,
                products=request.products,
            )  # fmt: skip
        if found.is_indefinite:
            state = state.unstable()
        error = max(found.error, candidate.error_in_modes)  # in this order: NaN stays NaN
        return candidate._replace(state=state, error=error, correction=found.correction)

    def _candidates(
        self, load: Load, guess: Guess, place: RangeCheck, request: Request
    ) -> Iterator[tuple[Candidate, Sequence[str]]]:
        """Yield the solutions of the methods, the cheapest first, and the stages that would follow.

        The hybrid continues from the prediction, or with `warm` from the last displacement, if that
        is near equilibrium. Otherwise Newton's method starts from rest, since its iterates from far
        seldom lead to a solution.
        """
        for first in self._predictions(load, guess, request):
            known = first.error_in_modes + first.error_outside
            is_known = first.error is not None or math.isfinite(known)
            following = ["start"] if is_known else ["start with estimate", "estimate"]
            yield first, following  # the last one is the best
        if not request.is_more_than_prediction:
            return
        starts, durations = [first], request.durations
        with durations.timed(following[0]):
            if request.warm and self._before and torch.equal(self._before[0], load.parameters):
                starts.append(self._evaluated("last", self._before[1], load, request))
            # a rough estimate suffices up to `FAR`
            rough = Request(error=FAR, products=0 if self.scene.is_compact else MANY_PRODUCTS)
            distances = [self._with_error(load, one, rough).known_error for one in starts]
        nearest = starts[distances.index(min(distances))].state
        start = nearest.displacement if min(distances) <= FAR else None
        is_slow = start is None or not self.scene.is_compact
        following = ["Newton" if is_slow else "iteration", "estimate"]  # the last of the result
        if place.amplitude < MAX_LINEAR_AMPLITUDE:
            linear = self.scene.linear.with_parameters(load.parameters).solve(load.force[0])[None]
            yield self._evaluated("linear", linear, load, request), following
        elif request.over(*following):
            return

        def newton_is_over() -> bool:  # called after the iterations without tangents
            following[0] = "Newton"
            return request.over(*following)

        tol = request.iteration_tol(self.scene)
        if start is None:
            states = replace(self.scene.corrector, tol=tol).iterate(load)
        else:
            hybrid = default_hybrid(lambda load: start, self.scene, tol)
            hybrid = replace(hybrid, is_over=newton_is_over, evaluation=nearest.evaluation)
            states = hybrid.iterate(load)
        clock = time.perf_counter()
        for state in states:
            if int(state.iterations):
                now = time.perf_counter()
                durations.add(following[0], now - clock)
                clock = now
            elif not state.converged:  # the initial state, which has been evaluated
                continue
            method = "hybrid" if state.from_guess else "full Newton"
            yield Candidate(method, state), following

    def _predictions(self, load: Load, guess: Guess, request: Request) -> Iterator[Candidate]:
        """Yield the prediction after steps in the modes, then corrections of it where they help.

        A correction is that of `estimate_error`, which reduces the error outside the modes, then
        steps in the modes, which reduce the error that it adds there. Corrections follow while the
        estimated error is too large and decreases.
        """
        last = self._in_modes(load, guess, request)
        is_corrected = self.newton is not None
        if request.error is not None or (is_corrected and not request.is_more_than_prediction):
            last = self._with_error(load, last, request)
        yield last
        if not is_corrected:
            return
        while last.correction is not None and last.known_error > request.sufficient_error:
            taken = int(last.state.iterations) + 1
            if taken > self.steps or request.over("correction"):
                return
            u = last.state.displacement + last.correction
            corrected = Guess(u, error_outside=guess.error_outside)
            with request.durations.timed("correction"):
                following = self._in_modes(load, corrected, request, taken=taken)
                following = self._with_error(load, following, request)
            if not following.known_error < last.known_error:
                return
            yield (last := following)

    def _in_modes(self, load: Load, guess: Guess, request: Request, *, taken: int = 0) -> Candidate:
        """Return a displacement after Newton's steps in the modes; `taken` steps precede them.

        No step is made where the known error is sufficient, unless a prediction is wanted alone and
        steps are known to reduce its error much, or if none is left.
        """
        method = "corrected" if taken else "prediction"
        first = self._evaluated(method, guess.displacement, load, request, taken)
        if self.newton is None or not first.state.residual.isfinite():
            return first
        limit = self.surrogate.largest_residual
        in_range = bool((first.state.volume_ratio > 0) & (first.state.residual <= limit))
        enough = request.sufficient_error if taken < self.steps else FAR
        pays = guess.error > ERROR and guess.error_outside < WORTH * guess.error
        pays &= not request.is_more_than_prediction
        if in_range and guess.error <= enough and not pays:
            return first._replace(error=guess.error)
        default = guess.error_outside if pays else ERROR
        wanted = default if request.error is None else request.error
        following = ["step"] if math.isfinite(guess.error_outside) else ["step", "estimate"]
        begin = time.perf_counter()
        *_, state = self.newton.states(
            load, guess=guess.displacement, evaluation=first.state.evaluation, error_tol=wanted,
            max_iter=self.steps - taken, is_over=lambda: request.over(*following),
        )  # fmt: skip
        request.durations.add("step", (time.perf_counter() - begin) / (1 + state.iterations))
        if state.iterations:
            u, taken = state.displacement, taken + state.iterations
            first = self._evaluated("corrected", u, load, request, taken, state.evaluation)
        outside = guess.error_outside if first.state.residual <= limit else math.inf
        return first._replace(error_in_modes=state.error, error_outside=outside)

    def _evaluated(
        self,
        method: str,
        displacement: Tensor,
        load: Load,
        request: Request,
        iterations: int = 0,
        evaluation: Evaluation | None = None,
    ) -> Candidate:
        """Return a displacement as a solution; it is evaluated unless the evaluation is given."""
        state = evaluate_solution(
            self.scene.problem, displacement, load, request.iteration_tol(self.scene),
            iterations=iterations, from_guess=method in ("prediction", "corrected"),
            evaluation=evaluation,
        )  # fmt: skip
        return Candidate(method, state)
