"""Simulator: from forces [N] to displacements [m] with a report of their quality."""

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dpl.fem import Load, Newton, Solution, Status, SubspaceNewton, evaluate_solution
from dpl.fem.assembly.equilibrium import FAINT
from dpl.fem.solvers import check_tol, concatenate
from dpl.inference.answer import MAX_OUT_OF_SPAN, ROUNDOFF, Answer, answer_like, summarise
from dpl.inference.arguments import as_number, as_numbers, named_columns, per_load
from dpl.inference.hybrid import default_hybrid
from dpl.models import Correctable, HasCorrection
from dpl.models.newton_choice import MAX_STEPS
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import Surrogate

ERROR = 1e-3  # estimated relative error above which they are made [-]
MAX_LINEAR_AMPLITUDE = 0.05  # amplitude below which the linear solution is evaluated [-]


class Simulator:
    """Simulator of a scene with a trained surrogate and the solvers of the scene.

    Called with a force alone, it returns the prediction with its residual. If the model comes with
    Newton's method in its modes, it also estimates the error, and makes steps of this method while
    the estimate is too large. With a tolerance, it tries network, linear solution, hybrid and
    Newton in this order until the tolerance is met; with a budget, while there is time. It keeps
    the last displacement as an initial guess of the next call (`warm`).

    Attributes:
        surrogate: The surrogate.
        newton: Newton's method in the modes of the model; None: predictions are not corrected.
        steps: Largest number of its steps.
    """

    def __init__(
        self, surrogate: Surrogate, *, newton: SubspaceNewton | None = None, steps: int = MAX_STEPS
    ) -> None:
        """Store the surrogate and build the corrector of its scene.

        Args:
            surrogate: A trained surrogate on the CPU.
            newton: Newton's method in the modes of the model; None: that of a model which
                `HasCorrection`.
            steps: Largest number of its steps; 0: predictions are not corrected.

        Raises:
            ValueError: `steps` is negative.
        """
        if steps < 0:
            raise ValueError(f"steps = {steps} must be 0 or more")
        if newton is None and isinstance(surrogate.net, HasCorrection):
            newton = surrogate.net.correction()
        self.surrogate, self.newton, self.steps = surrogate.eval(), newton, steps
        if newton is not None:
            newton.tangent  # noqa: B018  # built here, so that the first call is not slower
        self._before: tuple[Tensor, Tensor] | None = None  # parameters, displacement
        self._pace = 0.0  # time of an iteration [s]
        self.scene.corrector  # noqa: B018  # built here, so that the first call is not slower

    @classmethod
    def corrected(
        cls, surrogate: Surrogate, states: Tensor, *, rank: int = 60, tolerance: float = 1e-2
    ) -> Self:
        """Return a simulator that corrects predictions by equilibrium in the modes of the network.

        Args:
            surrogate: A trained surrogate on the CPU whose network is `Correctable`.
            states: Displacements of training samples, (S, N, D) [-].
            rank: Number of modes of the correction.
            tolerance: Tolerance of the hyper-reduction, see `dpl.fem.rom.cubature`.

        Raises:
            ValueError: The network has no modes, or a number is out of range.
        """
        net = surrogate.net
        if not isinstance(net, Correctable):
            raise ValueError(f"corrected: {type(net).__name__} has no modes to correct in")
        solver = net.galerkin(states, rank=rank, tolerance=tolerance)
        return cls(surrogate, newton=solver)

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
            tol: Relative residual of the result [-], at least 1e-15 and below 1.
            budget_ms: Wall time of each load [ms]. An iteration is not started if the time of the
                last iteration exceeds the rest of the budget.
            error: Estimated relative error within the modes of the model [-] above which steps of
                Newton's method in them follow, at most `steps` of them; 1e-3 if left out.
            warm: Start from the last displacement if it is nearer to equilibrium than the
                prediction.
            stability: Factorise the tangent at the result to determine its stability.

        Raises:
            ValueError: An argument has a wrong shape, contains values that are no real numbers
                (booleans, text, complex numbers, masked entries) or not finite, or is out of range.
        """
        begin = time.perf_counter()
        given = as_numbers("force", force)
        load = self._load(given, young, parameters)
        tol, budget_ms = as_number("tol", tol), as_number("budget_ms", budget_ms)
        wanted = self.scene.solver.tol if tol is None else tol
        check_tol(wanted)
        error = as_number("error", error)
        if error is not None and not error > 0:
            raise ValueError(f"error = {error} must be above 0")
        if budget_ms is not None and not 0 < budget_ms < math.inf:
            raise ValueError(f"budget_ms = {budget_ms} must be a number above 0")
        count = len(load.force)
        with one_thread(), torch.inference_mode():
            predictions = self.surrogate.predict(load)
            amplitude, out_of_span = self.scene.loads.project(load.force)
            shared = (time.perf_counter() - begin) / count
            found = []
            for k, single in enumerate(load.unbatch()):
                begin = time.perf_counter() - shared
                request = _Request(tol, budget_ms, error or ERROR, warm, begin)
                method, state, estimate = self._solve(
                    single, predictions[k : k + 1], float(amplitude[k]), request
                )
                if stability:
                    state = self._with_stability(single, state)
                self._before = single.parameters, state.displacement
                taken = 1e3 * (time.perf_counter() - request.begin)
                found.append((method, state, estimate, taken))
        methods, states, estimates, times = zip(*found, strict=True)
        state = concatenate(states)
        kept = state.converged & (state.residual < wanted)
        outside = (
            (amplitude > 1 + ROUNDOFF)
            | (out_of_span > MAX_OUT_OF_SPAN)
            | self._outside_modulus_range(load)
        )
        words = [
            "no load: at rest"
            if method == "rest"
            else summarise(one, bool(ok), estimate, float(a), float(s), bool(out))
            for method, one, ok, estimate, a, s, out in zip(
                *(methods, states, kept, estimates, amplitude, out_of_span, outside), strict=True
            )
        ]
        answer = {
            "displacement": self.scene.length * state.displacement,
            "residual": state.residual,
            "error": torch.tensor(estimates, dtype=torch.float64),
            "volume_ratio": state.volume_ratio,
            "converged": kept,
            "negative_pivots": state.negative_pivots,
            "amplitude": amplitude,
            "out_of_span": out_of_span,
            "out_of_distribution": outside,
            "method": list(methods),
            "iterations": state.iterations,
            "milliseconds": torch.tensor(times, dtype=torch.float64),
            "summary": words,
        }
        return answer_like(answer, numpy=not isinstance(force, Tensor), single=given.ndim == 2)

    def _load(self, force: Tensor, young: Any, parameters: Any) -> Load:
        """Return the arguments of a call as a dimensionless load."""
        shape, scene = self.scene.problem.shape, self.scene
        if force.shape[-2:] != shape or force.ndim not in (2, 3) or not force.numel():
            words = f"({shape[0]}, {shape[1]}) or (B, {shape[0]}, {shape[1]})"
            raise ValueError(f"force: its shape is {tuple(force.shape)} and must be {words}")
        force = force.reshape(-1, *shape)
        if not force.isfinite().all():
            raise ValueError("force: a number is not finite")
        force = scene.problem.acting(force)
        low, high = scene.loads.young_range
        if young is None and low < high:
            raise ValueError(f"young: the scene has a range, {low:g} to {high:g} Pa; say which")
        moduli = per_load("young", low if young is None else young, len(force))
        if not (moduli > 0).all():
            raise ValueError("young: a modulus is not above 0 Pa")
        for modulus in moduli.tolist():
            scene.problem.check_foundation_modulus(modulus)
        ranges = scene.loads.parameter_ranges
        values = named_columns("parameters", parameters, list(ranges), len(force))
        scene.problem.material.with_parameters(values)  # refuses values that it does not allow
        load = scene.load_of(force, moduli, values)
        sizes = load.force.abs().amax(dim=(1, 2))
        lost = (sizes < FAINT) & force.any(dim=2).any(dim=1)
        if bool(lost.any()) or not sizes.isfinite().all():
            unit = "E L^2" if shape[1] == 3 else "E L"
            raise ValueError(
                f"force: its largest entry over {unit} must be 0, or a number from {FAINT:g} that "
                "float64 holds; check the units of force and young"
            )
        return load

    def _outside_modulus_range(self, load: Load) -> Tensor:
        """Return True for loads with an input modulus of the network out of range, (B,)."""
        loads, takes = self.scene.loads, getattr(self.surrogate.net, "extra_inputs", ())
        pairs = list(zip(load.parameters.T, loads.parameter_ranges.values(), strict=True))
        if "young" in takes:
            pairs.append((load.young, loads.young_range))
        outside = torch.zeros(len(load.force), dtype=torch.bool)
        for values, (low, high) in pairs:
            outside |= (values < low) | (values > high)
        return outside

    def _solve(
        self, load: Load, prediction: Tensor, amplitude: float, request: "_Request"
    ) -> tuple[str, Solution, float]:
        """Return the first solution that meets the tolerance, else the best one.

        It comes with its method and its estimated relative error, NaN if unknown.
        """
        scene = self.scene
        tol = scene.solver.tol if request.tol is None else request.tol
        if not load.force.any() and not scene.problem.moved_supports:
            rest = evaluate_solution(scene.problem, torch.zeros_like(prediction), load, tol)
            return "rest", rest, 0.0
        found: tuple[str, Solution, float] | None = None
        for method, last, error in self._candidates(load, prediction, amplitude, tol, request):
            if found is None or _rank(last) <= _rank(found[1]):
                found = method, last, error
            # converged also if rounding allows no smaller residual
            if last.converged or request.over(self._pace):
                break
        assert found is not None
        method, state, error = found
        return method, state._replace(status=last.status, load_factor=last.load_factor), error

    def _candidates(
        self, load: Load, prediction: Tensor, amplitude: float, tol: float, request: "_Request"
    ) -> Iterator[tuple[str, Solution, float]]:
        """Yield the solutions of the methods, the cheapest first, with names and errors."""
        problem = self.scene.problem
        state, error = self._corrected(load, prediction, tol, request)
        yield "corrected" if int(state.iterations) else "network", state, error
        if request.tol is None and request.budget_ms is None:
            return
        if amplitude < MAX_LINEAR_AMPLITUDE:
            answer = self.scene.linear.with_parameters(load.parameters).solve(load.force[0])[None]
            yield "linear", evaluate_solution(problem, answer, load, tol), math.nan
        guess = state.displacement
        newton = replace(self.scene.corrector, tol=tol)
        guesses = [guess]
        if (
            request.warm
            and self._before is not None
            and torch.equal(self._before[0], load.parameters)
        ):
            guesses.append(self._before[1])
        start = guess if len(guesses) == 1 else nearest(newton, load, guesses)
        clock = time.perf_counter()
        for state in default_hybrid(lambda load: start, self.scene, tol).iterate(load):
            if int(state.iterations):
                now = time.perf_counter()
                self._pace, clock = now - clock, now
            elif not state.converged:  # the initial state, which has been evaluated
                continue
            yield "hybrid" if state.from_guess else "full Newton", state, math.nan

    def _corrected(
        self, load: Load, prediction: Tensor, tol: float, request: "_Request"
    ) -> tuple[Solution, float]:
        """Return the prediction, corrected by Newton's steps in the modes, and its error."""
        problem = self.scene.problem
        if self.newton is None or not bool(prediction.isfinite().all()):
            return evaluate_solution(problem, prediction, load, tol, from_guess=True), math.nan
        wanted = request.error if request.tol is None else min(request.error, self.newton.error_tol)
        states = self.newton.states(load, guess=prediction, error_tol=wanted, max_iter=self.steps)
        state = next(states)
        while not request.over(0.0) and (following := next(states, None)) is not None:
            state = following
        solution = evaluate_solution(
            problem, state.displacement, load, tol,
            iterations=state.iterations, from_guess=True, evaluation=state.evaluation,
        )  # fmt: skip
        return solution, state.error + self.newton.outside_error

    def _with_stability(self, load: Load, state: Solution) -> Solution:
        """Return a solution with the number of negative eigenvalues of its tangent."""
        if not state.converged or int(state.negative_pivots) >= 0:
            return state
        stability = self.scene.newton.with_parameters(load.parameters).stability(state.displacement)
        pivots = stability.negative_pivots
        status = Status.UNSTABLE if stability.least else Status.CONVERGED
        return state._replace(
            negative_pivots=torch.full_like(state.negative_pivots, pivots),
            status=torch.full_like(state.status, int(status)),
        )


class _Request(NamedTuple):
    """Options of a call and the time of its start [s]."""

    tol: float | None
    budget_ms: float | None
    error: float
    warm: bool
    begin: float

    def over(self, ahead: float) -> bool:
        """Return True if this time from now [s] exceeds the budget."""
        if self.budget_ms is None:
            return False
        return 1e3 * (time.perf_counter() - self.begin + ahead) > self.budget_ms


def nearest(newton: Newton, load: Load, guesses: list[Tensor]) -> Tensor:
    """Return the guess (1, N, D) with the smallest estimated distance from equilibrium.

    The distance is ||M R(u)|| with the corotated inverse M of K(0), an approximate Newton
    correction, which unlike the residual does not depend on the stiffness against an error. It is
    infinite for a guess that inverts an element or is not finite.
    """
    preconditioner = newton.with_parameters(load.parameters).linear_solver.corotational

    def distance(guess: Tensor) -> float:
        internal, volume = preconditioner.problem.evaluate(guess)
        if not bool(volume > 0):
            return math.inf
        right = preconditioner.problem.restrict((load.force - internal)[0])
        return float(np.linalg.norm(preconditioner.at(guess).apply(right)))

    return min(guesses, key=distance)


def _rank(state: Solution) -> tuple[bool, bool, float]:
    """Return the key by which solutions are sorted: converged, not inverted, residual."""
    residual = float(state.residual)
    valid = bool(state.volume_ratio > 0)
    return not bool(state.converged), not valid, residual if residual == residual else math.inf
