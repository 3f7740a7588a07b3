"""Growth of a training set, with a fit after each step, until a held-out error is met."""

import math
import time
from collections.abc import Iterator, Mapping
from typing import Any

from dpl.data.dataset import MAX_LOADS, DataSet, LoadSolver
from dpl.data.learning_curve import CurvePoint, describe, loads_for
from dpl.data.solving.solve import Guess
from dpl.data.sources import Source, fit_sizes
from dpl.data.storage.store import SHARD_SIZE, Store
from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.system.threads import leave_cores

PATIENCE = 2  # fits without gain after which the growth ends
MIN_GAIN = 0.95  # ratio of errors from which a fit is one without gain
# ratio of the training loads of a fit to those of the one before
MIN_FACTOR = math.sqrt(2)
MAX_FACTOR = 4


class Growing(Source):
    """Training loads that are solved in the background while a model is fitted to the first ones.

    After the first `SHARD_SIZE` training loads the model is fitted and its error on held-out loads
    recorded. The next fit takes `MIN_FACTOR` times as many loads, or more if they are solved
    already, but not more than the learning curve predicts for the error wanted. The errors of a fit
    are those of the next training loads: held-out loads that have chosen its ridges and modes give
    smaller ones.

    The loads are those of the data set of the same seed, in the same order.

    Attributes:
        points: The learning curve.
    """

    def __init__(
        self, *, error: float = 1e-3, minutes: float | None = None, max_train: int = 10_000
    ) -> None:
        """Check the arguments.

        Args:
            error: Median over held-out loads of the relative L2 error at which the growth ends [-].
            minutes: Time after which the growth ends [min]; None: no limit.
            max_train: Largest number of training loads.
        """
        if not 0 < error < math.inf:
            raise ValueError(f"error = {error} must be above 0")
        if minutes is not None and not minutes > 0:
            raise ValueError(f"minutes = {minutes} must be above 0 [min], or null")
        check_range(1, MAX_LOADS, max_train=max_train)
        self.points: list[CurvePoint] = []
        self._error, self._minutes, self._max_train = error, minutes, max_train
        self._start = self._fit_start = time.monotonic()
        self._fit_seconds = 0.0  # duration of the last fit

    # ------------------------------------------------------------------ sizes

    def count(self, store: Store) -> int:
        """Return the number of training loads of the last fit, or of those that are there."""
        return self.points[-1].loads if self.points else len(store.tried("train"))

    def fits(self, dataset: DataSet, guess: Guess | None = None) -> Iterator[dict[str, int]]:
        """Solve loads in the background; yield the numbers of training and held-out loads of fits.

        The errors of each fit have to be recorded before the next one. The loads of validation and
        test are solved at the end.

        Args:
            dataset: The data set; its numbers of validation and test loads are those wanted.
            guess: See `Source.fits`.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            RuntimeError: Workers die repeatedly.
        """
        if self.is_finished:
            return
        leave_cores(dataset.workers)
        self._start = time.monotonic() - (self.points[-1].seconds if self.points else 0.0)
        loads, thread = self._loads(dataset), dataset.workers > 0
        self._solver = LoadSolver(dataset, loads, guess=guess, thread=thread)
        while not self.is_finished:
            yield self._next_sizes(self._solver, dataset.val)
        self._solver.wait({"val": dataset.val, "test": dataset.test}, show=True)

    def _loads(self, dataset: DataSet) -> Iterator[tuple[str, range]]:
        """Yield splits and loads in the order of the solves; the rest once the growth has ended."""
        val = 0
        for train in range(0, self._max_train, SHARD_SIZE):
            if self.is_finished:
                break
            end = min(train + SHARD_SIZE, self._max_train)
            held_out = fit_sizes(end, dataset.val)["val"]
            yield "val", range(val, held_out)
            yield "train", range(train, end)
            val = held_out
        yield "val", range(val, dataset.val)
        yield "test", range(dataset.test)

    def _next_sizes(self, solver: LoadSolver, val: int) -> dict[str, int]:
        """Wait for the loads of the next fit; return the numbers of training and held-out loads."""
        least, most = self._limits()
        solver.wait(fit_sizes(least, val), until=self._deadline(), show=not self.points)
        self._fit_start = time.monotonic()
        available = solver.count("train")
        while available and solver.count("val") < fit_sizes(available, val)["val"]:
            available = max(0, available - SHARD_SIZE)
        if available < least:  # the time is over
            return fit_sizes(max(available, self.points[-1].loads if self.points else 1), val)
        return fit_sizes(max(least, min(most, available // SHARD_SIZE * SHARD_SIZE)), val)

    def _limits(self) -> tuple[int, int]:
        """Return the smallest and the largest number of training loads of the next fit."""
        if not self.points:
            first = min(SHARD_SIZE, self._max_train)
            return first, first
        last = self.points[-1].loads
        needed = loads_for(self.points, self._error) or MAX_LOADS
        least = self._whole_shards(MIN_FACTOR * last)
        most = self._whole_shards(min(MAX_FACTOR * last, needed))
        return least, max(least, most)

    def _whole_shards(self, loads: float) -> int:
        return min(self._max_train, math.ceil(loads / SHARD_SIZE) * SHARD_SIZE)

    def _deadline(self) -> float | None:
        """Return the time at which a fit has to start to end in time [s]; None: no limit."""
        if self._minutes is None or not self.points:
            return None
        return self._start + 60 * self._minutes - self._fit_seconds

    # ------------------------------------------------------------------ errors

    def unseen(self, store: Store, loads: int) -> Sample | None:
        """Return the training samples that follow those of a fit, None after the last ones."""
        assert self._solver is not None  # there are fits while it solves
        self._solver.wait({"train": loads + SHARD_SIZE}, until=self._deadline())
        end = min(self._solver.count("train"), loads + SHARD_SIZE)
        return store.load("train", end, first=loads) if end > loads else None

    def record(self, loads: int, errors: Mapping[str, float]) -> str:
        """Record the held-out errors of a fit.

        Args:
            loads: Number of training loads.
            errors: `median`, `worst` and `e_mean`, see `CurvePoint`.

        Returns:
            The errors and the number of loads that the target is expected to need, in words.
        """
        now = time.monotonic()
        self._fit_seconds = now - self._fit_start
        self.points.append(CurvePoint(loads, now - self._start, **errors))
        line = describe(self.points, self._error)
        reason = self._limit_reached
        return f"{line}; {reason}" if reason else line

    @property
    def is_finished(self) -> bool:
        """True if the last fit meets the error wanted or a limit is reached."""
        if not self.points:
            return False
        return self.points[-1].median <= self._error or bool(self._limit_reached)

    @property
    def _limit_reached(self) -> str:
        """Limit that the last fit has reached, in words; empty if there is none."""
        last = self.points[-1]
        if last.median <= self._error:
            return ""
        if last.loads >= self._max_train:
            return f"data.train.max_train = {self._max_train} reached"
        medians = [point.median for point in self.points]
        before, recent = medians[:-PATIENCE], medians[-PATIENCE:]
        if before and min(recent) > MIN_GAIN * min(before):
            return f"{PATIENCE} fits without gain: more loads no longer reduce the error"
        # the next fit would take at least as long as the last one
        if self._minutes is not None and last.seconds + self._fit_seconds >= 60 * self._minutes:
            return f"data.train.minutes = {self._minutes:g} reached"
        return ""

    def state_dict(self) -> dict[str, Any]:
        """Return the learning curve as plain data."""
        return {"points": [list(point) for point in self.points]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue a learning curve."""
        self.points = [CurvePoint(int(n), *map(float, rest)) for n, *rest in state["points"]]
