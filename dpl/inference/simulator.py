"""What an engineer holds: a force goes in; out come a displacement and what it is worth."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from numbers import Real
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dpl.fem import Load, Newton, Solution, Status, evaluate_solution
from dpl.fem.problem import FAINT
from dpl.fem.solvers import check_tol, concatenate
from dpl.inference.hybrid import default_hybrid
from dpl.models import Correctable
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import Surrogate

Correct = Callable[[Tensor, Tensor], Tensor]  # force (N, D), displacement (N, D) -> displacement
SMALL = 0.05  # amplitude below which the linear answer is worth a look
STRANGE = 1e-3  # part of a force, not made of the training's modes, that counts as none
SLACK = 1e-9  # rounding in amplitudes


@dataclass(frozen=True)
class Answer:
    """A displacement and what it is worth; for several loads each field is an array, (B, ...).

    Attributes:
        displacement: (N, D) [m]; of the kind that the force was, NumPy or torch.
        residual: ||R_free|| / ||f||, evaluated at the displacement [-], see
            `Problem.relative_residual_of`.
        volume_ratio: min det F there [-]; at 0 or below an element is inverted.
        converged: Whether the residual is below the tolerance that was asked for (without one, the
            scene's) and nothing is inverted. False too where rounding does not allow it.
        negative_pivots: Negative eigenvalues of the tangent there; -1: not examined.
        amplitude: Largest modal load over the largest of the training [-], see
            `ModalLoads.project`.
        out_of_span: Part of the force that is not made of the training's modes [-].
        out_of_distribution: Whether the load lies outside the range of the training.
        method: What computed the result: "rest", "linear", "network", "corrected", "hybrid" or
            "full Newton".
        iterations: Linear solves with a tangent.
        milliseconds: Wall time [ms]; of several loads, the share of each.
        summary: The fields above in words.
    """

    displacement: Any
    residual: Any
    volume_ratio: Any
    converged: Any
    negative_pivots: Any
    amplitude: Any
    out_of_span: Any
    out_of_distribution: Any
    method: Any
    iterations: Any
    milliseconds: Any
    summary: Any


class Simulator:
    """A trained surrogate with the mechanics behind it: as exact as is asked for, and says so.

    Called with a force alone it answers with the network and how far that is out of balance. With a
    tolerance it goes on, tier by tier, until the answer keeps it; with a budget, while there is
    time. The answer before is remembered, for the next call may be near it.

    Attributes:
        surrogate: The network.
        correct: What improves a prediction without a solve of full size; None: nothing.
    """

    def __init__(self, surrogate: Surrogate, *, correct: Correct | None = None) -> None:
        """Take a surrogate on the CPU.

        Args:
            surrogate: Trained.
            correct: From a force (N, D) [-] and a displacement (N, D) [-] to a better one.
        """
        self.surrogate, self.correct = surrogate.eval(), correct
        self._before: tuple[Tensor, Tensor] | None = None  # Poisson's ratios, displacement
        self._pace = 0.0  # time of an iteration [s]
        self.scene.corrector  # noqa: B018  # made here, not on the first answer's time

    @classmethod
    def corrected(
        cls, surrogate: Surrogate, states: Tensor, *, rank: int = 60, tolerance: float = 1e-2
    ) -> Self:
        """Return the simulator that corrects predictions by equilibrium in the network's modes.

        Args:
            surrogate: On the CPU, with a network between coordinates.
            states: Displacements of training samples, (S, N, D) [-].
            rank: Modes in which to correct.
            tolerance: Of the choice of cells, see `dpl.fem.rom.cubature`.

        Raises:
            ValueError: The network has no modes, or a number is out of range.
        """
        net = surrogate.net
        if not isinstance(net, Correctable):
            raise ValueError(f"corrected: {type(net).__name__} has no modes to correct in")
        solver = net.galerkin(states, rank=rank, tolerance=tolerance)
        return cls(surrogate, correct=solver.correct)

    @property
    def scene(self) -> Scene:
        """What it answers for."""
        return self.surrogate.scene

    def __call__(
        self,
        force: ArrayLike | Tensor,
        *,
        young: float | ArrayLike | Tensor | None = None,
        poisson: float | ArrayLike | Tensor | None = None,
        tol: float | None = None,
        budget_ms: float | None = None,
        warm: bool = False,
        stability: bool = False,
    ) -> Answer:
        """Return the displacement under nodal forces, with what it is worth.

        Args:
            force: (N, D) or, several, (B, N, D) [N] (2D: [N/m]); what acts on held degrees of
                freedom does nothing. Integers and floating-point numbers of any width are taken,
                in NumPy arrays, nested lists or dense tensors on any device; the answer has no
                gradient with respect to them.
            young: E, one number or (B,) [Pa]; may be left out where the scene has one.
            poisson: Poisson's ratios, alike [-]; only where the law has a range of them.
            tol: Residual ratio that the answer is to keep [-], at least 1e-15 and below 1.
            budget_ms: Wall time that each load may take [ms]: no iteration is begun that would,
                by those before, go beyond it.
            warm: Start from the last answer where that is nearer than the network's.
            stability: Factorise the tangent at the answer, which tells whether it is stable.

        Raises:
            ValueError: Something has another shape, holds no real numbers (booleans, text, complex
                and masked entries are none), is not finite or out of range.
        """
        begin = time.perf_counter()
        given = _numbers("force", force)
        load = self._load(given, young, poisson)
        tol, budget_ms = _number("tol", tol), _number("budget_ms", budget_ms)
        wanted = self.scene.solver.tol if tol is None else tol
        check_tol(wanted)
        if budget_ms is not None and not 0 < budget_ms < math.inf:
            raise ValueError(f"budget_ms = {budget_ms} must be a number above 0")
        count = len(load.force)
        with one_thread(), torch.inference_mode():
            predictions = self.surrogate.predict(load)
            amplitude, strange = self.scene.loads.project(load.force)
            shared = (time.perf_counter() - begin) / count
            found = []
            for k, single in enumerate(load.unbatch()):
                ask = _Ask(tol, budget_ms, warm, time.perf_counter() - shared)
                tier, state = self._best(single, predictions[k : k + 1], float(amplitude[k]), ask)
                if stability:
                    state = self._examined(single, state)
                self._before = single.poisson, state.displacement
                found.append((tier, state, 1e3 * (time.perf_counter() - ask.begin)))
        tiers, states, times = zip(*found, strict=True)
        state = concatenate(states)
        kept = state.converged & (state.residual < wanted)
        outside = (amplitude > 1 + SLACK) | (strange > STRANGE) | self._elsewhere(load)
        words = [
            "no load: at rest"
            if tier == "rest"
            else _verdict(one, bool(ok), float(a), float(s), bool(out))
            for tier, one, ok, a, s, out in zip(
                *(tiers, states, kept, amplitude, strange, outside), strict=True
            )
        ]
        answer = {
            "displacement": self.scene.length * state.displacement,
            "residual": state.residual,
            "volume_ratio": state.volume_ratio,
            "converged": kept,
            "negative_pivots": state.negative_pivots,
            "amplitude": amplitude,
            "out_of_span": strange,
            "out_of_distribution": outside,
            "method": list(tiers),
            "iterations": state.iterations,
            "milliseconds": torch.tensor(times, dtype=torch.float64),
            "summary": words,
        }
        return _like(answer, numpy=not isinstance(force, Tensor), single=given.ndim == 2)

    def _load(self, force: Tensor, young: Any, poisson: Any) -> Load:
        """Return what was asked as a dimensionless load."""
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
        moduli = _column("young", low if young is None else young, len(force))
        if not (moduli > 0).all():
            raise ValueError("young: a modulus is not above 0 Pa")
        span = scene.loads.poisson_range
        if (span is None) != (poisson is None):
            words = (
                "its own, and needs none" if span is None else f"a range, {list(span)}: say which"
            )
            raise ValueError(f"poisson: the law has {words}")
        ratios = None if poisson is None else _column("poisson", poisson, len(force))
        if ratios is not None and not ((ratios > -1) & (ratios < 0.5)).all():
            raise ValueError("poisson: a ratio is not between -1 and 0.5")
        load = scene.load_of(force, moduli, ratios)
        sizes = load.force.abs().amax(dim=(1, 2))
        lost = (sizes < FAINT) & force.any(dim=2).any(dim=1)
        if bool(lost.any()) or not sizes.isfinite().all():
            unit = "E L^2" if shape[1] == 3 else "E L"
            raise ValueError(
                f"force: its largest entry over {unit} must be 0, or a number from {FAINT:g} that "
                "float64 holds; check the units of force and young"
            )
        return load

    def _elsewhere(self, load: Load) -> Tensor:
        """Return for which loads a modulus that the network takes lies outside its range, (B,)."""
        loads, takes = self.scene.loads, getattr(self.surrogate.net, "extra_inputs", ())
        spans = {"young": loads.young_range, "poisson": loads.poisson_range}
        outside = torch.zeros(len(load.force), dtype=torch.bool)
        for name in takes:
            low, high = spans[name] or (-math.inf, math.inf)
            values = getattr(load, name).reshape(len(outside), -1)
            outside |= ((values < low) | (values > high)).any(dim=1)
        return outside

    def _best(
        self, load: Load, prediction: Tensor, amplitude: float, ask: "_Ask"
    ) -> tuple[str, Solution]:
        """Return the first answer that does, else the best that there was."""
        scene = self.scene
        tol = scene.solver.tol if ask.tol is None else ask.tol
        if not load.force.any() and not scene.problem.moved_supports:
            return "rest", evaluate_solution(scene.problem, torch.zeros_like(prediction), load, tol)
        found: tuple[str, Solution] | None = None
        for tier, last in self._tiers(load, prediction, amplitude, tol, ask):
            if found is None or _rank(last) <= _rank(found[1]):
                found = tier, last
            if last.converged or ask.over(self._pace):  # a residual that rounding ends, too
                break
        assert found is not None
        tier, state = found
        return tier, state._replace(status=last.status, load_factor=last.load_factor)

    def _tiers(
        self, load: Load, prediction: Tensor, amplitude: float, tol: float, ask: "_Ask"
    ) -> Iterator[tuple[str, Solution]]:
        """Yield ever better answers, each with who gave it."""
        problem = self.scene.problem
        yield "network", evaluate_solution(problem, prediction, load, tol, from_guess=True)
        if ask.tol is None and ask.budget_ms is None:
            return
        if amplitude < SMALL:
            answer = self.scene.linear.at(load.poisson).solve(load.force[0])[None]
            yield "linear", evaluate_solution(problem, answer, load, tol)
        guess = prediction
        if self.correct is not None and bool(guess.isfinite().all()):
            guess = self.correct(load.force[0], guess[0])[None]
            yield "corrected", evaluate_solution(problem, guess, load, tol, from_guess=True)
        newton = replace(self.scene.corrector, tol=tol)
        guesses = [guess] if guess is prediction else [guess, prediction]
        if ask.warm and self._before is not None and torch.equal(self._before[0], load.poisson):
            guesses.append(self._before[1])
        start = guess if len(guesses) == 1 else nearest(newton, load, guesses)
        clock = time.perf_counter()
        for state in default_hybrid(lambda load: start, self.scene, tol).iterate(load):
            if int(state.iterations):
                now = time.perf_counter()
                self._pace, clock = now - clock, now
            elif not state.converged:  # where it starts, judged before
                continue
            yield "hybrid" if state.from_guess else "full Newton", state

    def _examined(self, load: Load, state: Solution) -> Solution:
        """Return an answer with the negative eigenvalues of its tangent."""
        if not state.converged or int(state.negative_pivots) >= 0:
            return state
        stability = self.scene.newton.at(load.poisson).stability(state.displacement)
        pivots = stability.negative_pivots
        status = Status.UNSTABLE if stability.least else Status.CONVERGED
        return state._replace(
            negative_pivots=torch.full_like(state.negative_pivots, pivots),
            status=torch.full_like(state.status, int(status)),
        )


class _Ask(NamedTuple):
    """What is asked of an answer, and since when."""

    tol: float | None
    budget_ms: float | None
    warm: bool
    begin: float

    def over(self, ahead: float) -> bool:
        """Return whether the budget does not hold for so long [s]."""
        if self.budget_ms is None:
            return False
        return 1e3 * (time.perf_counter() - self.begin + ahead) > self.budget_ms


def nearest(newton: Newton, load: Load, guesses: list[Tensor]) -> Tensor:
    """Return the guess (1, N, D) that equilibrium is nearest to, as far as K(0) can tell.

    The smallest ||M R(u)||, with M the inverse of K(0), turned as the body is: about a Newton
    correction, and not how stiff the body is against an error. One that inverts an element or is
    not finite is not taken unless all are like that.
    """
    turning = newton.at(load.poisson).linear_solver.corotational

    def distance(guess: Tensor) -> float:
        internal, volume = turning.problem.evaluate(guess)
        if not bool(volume > 0):
            return math.inf
        right = turning.problem.restrict((load.force - internal)[0])
        return float(np.linalg.norm(turning.at(guess).apply(right)))

    return min(guesses, key=distance)


def _rank(state: Solution) -> tuple[bool, bool, float]:
    """Return what answers are ordered by: converged, not inverted, balanced."""
    residual = float(state.residual)
    upright = bool(state.volume_ratio > 0)
    return not bool(state.converged), not upright, residual if residual == residual else math.inf


def _verdict(state: Solution, kept: bool, amplitude: float, strange: float, outside: bool) -> str:
    """Return what one answer is worth, in words; `kept`: whether it keeps the tolerance."""
    residual = float(state.residual)
    if kept:
        words = f"in balance to {residual:.1e} of the load, nothing inverted"
    elif not float(state.volume_ratio) > 0:
        words = "NOT VALID: an element is inverted"
    else:
        words = f"an estimate, out of balance by {residual:.1e} of the load"
        words += ", the least that rounding allows" if state.converged else ""
    if bool(state.converged):
        pivots = int(state.negative_pivots)
        if pivots > 0:
            words += f", UNSTABLE ({pivots} negative eigenvalues)"
        else:
            words += ", stable" if pivots == 0 else ", stability not examined"
    if int(state.status) == Status.NO_VALID_EQUILIBRIUM:
        words += f"; no equilibrium found beyond {float(state.load_factor):.2f} of the load"
    if not outside:
        return words
    if strange > STRANGE:
        return words + f"; {strange:.0%} of the load is unlike the training's"
    if amplitude > 1 + SLACK:
        return words + f"; the load is {amplitude:.2g} times the training's largest"
    return words + "; a modulus lies outside the training's range"


def _numbers(name: str, value: Any) -> Tensor:
    """Return what was given as a tensor in float64 on the processor, a copy.

    Raises:
        ValueError: It holds something else than real numbers.
    """
    refused = f"{name} must be real numbers"
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_meta or value.is_quantized:
            raise ValueError(f"{refused}; this tensor has no dense values")
        if value.is_complex() or value.dtype == torch.bool:
            raise ValueError(f"{refused}, not {value.dtype}")
        return value.detach().to("cpu", torch.float64, copy=True)
    try:
        array = np.asarray(value)
        real = array.dtype.kind in "iuf" or (
            array.dtype.kind == "O" and all(map(_real, array.flat))
        )
        numbers = np.array(array, np.float64, order="C", subok=False) if real else None
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        told = str(error).partition("\n")[0]
        raise ValueError(f"{refused}; {told}") from error
    if numbers is None:
        raise ValueError(f"{refused}, not {array.dtype}")
    if np.ma.is_masked(value):
        raise ValueError(f"{refused}; masked entries have no value, fill them")
    return torch.from_numpy(numbers)


def _real(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _number(name: str, value: Any) -> float | None:
    """Return one number that was given, None for None.

    Raises:
        ValueError: It is something else.
    """
    if value is None:
        return None
    number = _numbers(name, value)
    if number.ndim:
        raise ValueError(f"{name} must be one number; its shape is {tuple(number.shape)}")
    return float(number)


def _column(name: str, value: Any, count: int) -> Tensor:
    """Return one number, or one for each load, as (B,)."""
    column = _numbers(name, value)
    if column.numel() not in (1, count) or column.ndim > 1:
        given = f"{column.numel()} numbers for {count} loads, of shape {tuple(column.shape)}"
        raise ValueError(f"{name}: {given}; give one number, or one for each load")
    if not column.isfinite().all():
        raise ValueError(f"{name}: a number is not finite")
    return column.reshape(-1).expand(count).clone()


def _like(answer: dict[str, Any], *, numpy: bool, single: bool) -> Answer:
    """Return the fields as what was given: NumPy or torch, one load or several."""
    for field in fields(Answer):
        value = answer[field.name]
        if single:
            value = value[0]
            if isinstance(value, Tensor) and value.ndim == 0:
                value = value.item()
        if isinstance(value, Tensor):
            value = value.clone()  # an ordinary tensor, not one of inference
            value = value.numpy() if numpy else value
        elif numpy and isinstance(value, list):
            value = np.array(value)
        answer[field.name] = value
    return Answer(**answer)
