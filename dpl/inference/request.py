"""Tolerances and budget of a call of the simulator, and the solutions that they choose from."""

import math
import time
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

from torch import Tensor

from dpl.fem import Solution
from dpl.fem.solvers.error_estimate import PRODUCTS
from dpl.fem.solvers.solution import check_tol
from dpl.inference.arguments import as_number
from dpl.scene import Scene

T = TypeVar("T")
EXACT = 1e-12  # error of a motion that counts as met exactly [-]
SUFFICIENT = 2e-3  # estimated relative error above which predictions are corrected [-]
FINISH = "finish"  # stage between the last iteration of a call and its answer
RECENT = 20  # times of a stage from which the next one is forecast
PATIENCE = 1000  # calls that a forecast prevents a stage in, one after the other, until it is tried


class Guess(NamedTuple):
    """A displacement with its relative errors, calibrated on held-out loads; infinite: unknown."""

    displacement: Tensor  # (1, N, D) [-]
    error: float = math.inf  # [-]
    error_outside: float = math.inf  # that which steps in the modes leave [-]


class Candidate(NamedTuple):
    """A solution with its method and its errors."""

    method: str  # as of `Answer`
    state: Solution
    error: float | None = None  # estimated relative error [-]; None: not computed
    error_in_modes: float = 0.0  # relative correction in the modes of the model [-]; 0 without
    error_outside: float = math.inf  # relative error outside of the modes [-]; infinite: unknown
    correction: Tensor | None = None  # behind the estimated error, (1, N, D) [-]
    motion_error: float = 0.0  # largest distance of a held node from its prescribed place [-]
    force: Tensor | None = None  # of a gripper, (m,) [-]; None: balances the stresses
    forces_found: bool = False  # as of `GraspAnswer`

    @property
    def is_exact(self) -> bool:
        """True if the state has converged and meets the prescribed motion."""
        return bool(self.state.converged) and self.motion_error <= EXACT

    @property
    def known_error(self) -> float:
        """The estimated error; infinite if it was not computed."""
        return math.inf if self.error is None else self.error


class Durations:
    """Wall times of the stages of earlier calls, which forecast the next time of each stage.

    The forecast is the second largest of the last `RECENT` times, of two the largest: nine of ten
    further times are below it if they are drawn from the same distribution. A stage that does not
    fit is tried in one of `PATIENCE` calls, so that one slow call does not prevent it for ever.
    """

    def __init__(self) -> None:
        """Begin without times; the forecast of a stage that was never timed is 0."""
        self._recent: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=RECENT))
        self._prevented: dict[str, int] = defaultdict(int)  # since the last run of each stage

    def add(self, stage: str, seconds: float) -> None:
        """Add a time of a stage [s]."""
        self._recent[stage].append(seconds)
        self._prevented[stage] = 0

    def each(self, stage: str, items: Iterable[T]) -> Iterator[T]:
        """Yield items, and add the time from each one to the next."""
        clock = time.perf_counter()
        for item in items:
            now = time.perf_counter()
            self.add(stage, now - clock)
            clock = now
            yield item

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block."""
        begin = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - begin)

    def forecast(self, stage: str) -> float:
        """Return the time of the next run of a stage [s]."""
        times = sorted(self._recent[stage])
        return times[-2 if len(times) > 2 else -1] if times else 0.0

    def prevents(self, stages: Sequence[str], seconds: float) -> bool:
        """Return True if stages that follow each other take longer, and the first has to wait."""
        first, *others = map(self.forecast, stages)
        is_long = first + sum(others) > seconds
        self._prevented[stages[0]] += is_long
        is_tried = self._prevented[stages[0]] > PATIENCE
        return is_long and not (is_tried and sum(others) <= seconds)


@dataclass
class Request:
    """Tolerances and budget of a call."""

    tol: float | None = None  # relative residual of the result [-]; None: not requested
    budget_ms: float | None = None  # wall time of each load [ms]; None: no limit
    error: float | None = None  # estimated relative error of the result [-]; None: not requested
    durations: Durations = field(default_factory=Durations)  # of this call and of earlier ones
    warm: bool = False  # the last displacement is a guess too
    products: int = PRODUCTS  # most products with the tangent in an estimated error
    begin: float = field(default_factory=lambda: time.perf_counter())  # of the computation [s]
    spent: bool = False  # a computation ended because of the budget

    def __post_init__(self) -> None:
        self.tol, self.error = as_number("tol", self.tol), as_number("error", self.error)
        self.budget_ms = as_number("budget_ms", self.budget_ms)
        if self.tol is not None:
            check_tol(self.tol)
        if self.error is not None and not self.error > 0:
            raise ValueError(f"error = {self.error} must be above 0")
        if self.budget_ms is not None and not 0 < self.budget_ms < math.inf:
            raise ValueError(f"budget_ms = {self.budget_ms} must be a number above 0")

    @property
    def sufficient_error(self) -> float:
        """Estimated relative error up to which a prediction is not corrected [-]."""
        return SUFFICIENT if self.error is None else self.error

    @property
    def is_more_than_prediction(self) -> bool:
        """True if other methods may follow the prediction."""
        return (self.tol, self.budget_ms, self.error) != (None, None, None)

    def residual_tol(self, scene: Scene) -> float:
        """Return the residual below which a solution counts as converged [-]."""
        return scene.solver.tol if self.tol is None else self.tol

    def iteration_tol(self, scene: Scene) -> float:
        """Return the residual at which iterations end, whatever the estimated error [-]."""
        tol = self.residual_tol(scene)
        return tol if self.error is None else min(tol, scene.solver.tol)

    def is_met(self, candidate: Candidate) -> bool:
        """Return True if a solution meets all tolerances of the call, or is the best possible."""
        state = candidate.state
        if bool(state.converged):  # to `iteration_tol`, or rounding allows no smaller residual
            return True
        if self.tol is None and self.error is None:
            return False
        kept = self.tol is None or bool((state.residual < self.tol) & (state.volume_ratio > 0))
        return kept and (self.error is None or candidate.known_error <= self.error)

    def rank(self, candidate: Candidate) -> tuple[bool, bool, float]:
        """Return the key by which solutions are sorted; the smallest is best.

        The estimated error decides if it has a tolerance or nothing has, else the residual.
        """
        state = candidate.state
        by_error = self.error is not None or not self.is_more_than_prediction
        size = candidate.known_error if by_error else float(state.residual)
        valid = bool(state.volume_ratio > 0)
        return not bool(state.converged), not valid, size if size == size else math.inf

    @property
    def milliseconds(self) -> float:
        """Time since the computation began [ms]."""
        return 1e3 * (time.perf_counter() - self.begin)

    @property
    def seconds_left(self) -> float:
        """Time until the budget is spent [s]; infinite without one."""
        return math.inf if self.budget_ms is None else (self.budget_ms - self.milliseconds) / 1e3

    def over(self, *stages: str) -> bool:
        """Return True if the next stages and the end of the call exceed the budget.

        The caller then ends. Without stages the next one takes too little to be forecast.
        """
        if self.budget_ms is None:
            return False
        is_over = self.durations.prevents((*stages, FINISH), self.seconds_left)
        self.spent |= is_over
        return is_over
