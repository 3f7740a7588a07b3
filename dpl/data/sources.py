"""Sources of the training samples of a data module; `Stream` is in `dpl.data.stream`."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple

import numpy as np

from dpl.data.dataset import MAX_LOADS, DataSet, LoadSolver
from dpl.data.storage.store import SHARD_SIZE, Store
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.threads import leave_cores

MAX_COUNT = 10**9  # of batches, and of samples in a batch
HELD_OUT = 32  # smallest number of held-out loads of a fit, as far as there are as many
PATIENCE = 2  # fits without gain after which the growth ends
MIN_GAIN = 0.95  # ratio of errors from which a fit is one without gain
# ratio of the training loads of a fit to those of the one before
MIN_FACTOR = math.sqrt(2)
MAX_FACTOR = 4
FITTED = 4  # last points of a learning curve that the power law is fitted to
MIN_EXPONENT = 0.05  # slower decay predicts nothing


class CurvePoint(NamedTuple):
    """Held-out errors of a fit.

    Attributes:
        loads: Number of training loads.
        seconds: Wall time since the start of the training [s].
        median, worst: Median and maximum over held-out loads of the relative L2 error [-].
        e_mean: See `dpl.training.metrics.METRICS` [-].
    """

    loads: int
    seconds: float
    median: float
    worst: float
    e_mean: float


class Source:
    """Source of the training samples of a `DataModule`.

    Attributes:
        train: Number of training loads that are solved before a training.
        points: Learning curve of the fits so far of a model in closed form.
        rates: See `ReplayBuffer`; None for other sources.
    """

    train: int = 0
    points: Sequence[CurvePoint] = ()
    rates: Mapping[str, float] | None = None
    _solver: LoadSolver | None = None

    def check(self, scene: Scene, batch_size: int) -> None:
        """Raise an error if the source cannot serve this scene."""
        scene.problem.material.require_known("a data set other than data=files")

    def count(self, store: Store) -> int:
        """Return the number of loads of a data set whose samples are training samples."""
        return self.train

    def loader(self, data: Any) -> Iterable[Any]:
        """Return the batches of an epoch of gradient descent for a `DataModule`."""
        return data.shuffled()

    def fits(self, dataset: DataSet) -> Iterator[dict[str, int]]:
        """Yield the numbers of loads, by split, of each fit of a model in closed form.

        Missing loads of the data set are solved.
        """
        raise ValueError("a model in closed form is fitted to solved loads; set data=offline")

    def unseen(self, store: Store, loads: int) -> Sample | None:
        """Return samples that the fit to a number of training loads has not seen, if there are."""
        return None

    def record(self, loads: int, errors: Mapping[str, float]) -> str:
        """Record the errors of a fit to a number of loads, see `in_words`; return them in words."""
        return f"{loads} loads: {in_words(errors)}"

    def close(self) -> None:
        """Finish the solves in progress and end the worker processes."""
        if self._solver is not None:
            self._solver.close()
            self._solver = None

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed training needs, as plain data."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state."""


@dataclass(eq=False)
class Stored(Source):
    """The first loads of a data set on disk; missing ones are solved before the training."""

    train: int = 1000

    def fits(self, dataset: DataSet) -> Iterator[dict[str, int]]:
        """Solve the missing loads; yield the sizes of the data set."""
        dataset.fill()
        yield dataset.sizes


@dataclass(eq=False)
class Growing(Source):
    """Training loads that are solved in the background while a model is fitted to the first ones.

    After the first `SHARD_SIZE` training loads the model is fitted and its error on held-out loads
    recorded. The next fit takes `MIN_FACTOR` times as many loads, or more if they are solved
    already, but not more than the learning curve predicts for the error wanted. The errors of a fit
    are those of the next training loads: held-out loads that have chosen its ridges and modes give
    smaller ones.

    The loads are those of the data set of the same seed, in the same order.

    Attributes:
        error: Median over held-out loads of the relative L2 error at which the growth ends [-].
        minutes: Time after which the growth ends [min]; None: no limit.
        max_train: Largest number of training loads.
    """

    _: KW_ONLY
    error: float = 1e-3
    minutes: float | None = None
    max_train: int = 10_000

    def __post_init__(self) -> None:
        if not 0 < self.error < math.inf:
            raise ValueError(f"error = {self.error} must be above 0")
        if self.minutes is not None and not self.minutes > 0:
            raise ValueError(f"minutes = {self.minutes} must be above 0 [min], or null")
        check_range(1, MAX_LOADS, max_train=self.max_train)
        self.points: list[CurvePoint] = []
        self._start = self._fit_start = time.monotonic()
        self._fit_seconds = 0.0  # duration of the last fit

    def count(self, store: Store) -> int:
        """Return the number of training loads of the last fit, or of those that are there."""
        return self.points[-1].loads if self.points else len(store.tried("train"))

    def fits(self, dataset: DataSet) -> Iterator[dict[str, int]]:
        """Solve loads in the background; yield the numbers of training and held-out loads of fits.

        The errors of each fit have to be recorded before the next one. The loads of validation and
        test that the data set wants are solved at the end.
        """
        if self.is_finished:
            return
        leave_cores(dataset.workers)
        self._start = time.monotonic() - (self.points[-1].seconds if self.points else 0.0)
        val, loads, thread = dataset.val, self._loads(dataset), dataset.workers > 0
        self._solver = solver = LoadSolver(dataset, loads, thread=thread)
        while not self.is_finished:
            least, most = self._limits()
            solver.wait(fit_sizes(least, val), until=self._deadline(), show=not self.points)
            self._fit_start = time.monotonic()
            available = solver.count("train")
            while available and solver.count("val") < fit_sizes(available, val)["val"]:
                available = max(0, available - SHARD_SIZE)
            size = max(least, min(most, available // SHARD_SIZE * SHARD_SIZE))
            if available < least:  # the time is over
                size = max(available, self.points[-1].loads if self.points else 1)
            yield fit_sizes(size, val)
        solver.wait({"val": val, "test": dataset.test}, show=True)

    def _loads(self, dataset: DataSet) -> Iterator[tuple[str, range]]:
        """Yield splits and loads in the order of the solves; the rest once the growth has ended."""
        val = 0
        for train in range(0, self.max_train, SHARD_SIZE):
            if self.is_finished:
                break
            end = min(train + SHARD_SIZE, self.max_train)
            held_out = fit_sizes(end, dataset.val)["val"]
            yield "val", range(val, held_out)
            yield "train", range(train, end)
            val = held_out
        yield "val", range(val, dataset.val)
        yield "test", range(dataset.test)

    def _limits(self) -> tuple[int, int]:
        """Return the smallest and the largest number of training loads of the next fit."""
        if not self.points:
            first = min(SHARD_SIZE, self.max_train)
            return first, first
        last = self.points[-1].loads
        needed = loads_for(self.points, self.error) or MAX_LOADS
        limits = MIN_FACTOR * last, min(MAX_FACTOR * last, needed)
        shards = (math.ceil(loads / SHARD_SIZE) for loads in limits)
        least, most = (min(self.max_train, count * SHARD_SIZE) for count in shards)
        return least, max(least, most)

    def _deadline(self) -> float | None:
        """Return the time at which a fit has to start to end in time [s]; None: no limit."""
        if self.minutes is None or not self.points:
            return None
        return self._start + 60 * self.minutes - self._fit_seconds

    def unseen(self, store: Store, loads: int) -> Sample | None:
        """Return the training samples that follow those of a fit, None after the last ones."""
        assert self._solver is not None  # there are fits while it solves
        self._solver.wait({"train": loads + SHARD_SIZE}, until=self._deadline())
        end = min(self._solver.count("train"), loads + SHARD_SIZE)
        return store.load("train", end, first=loads) if end > loads else None

    def record(self, loads: int, errors: Mapping[str, float]) -> str:
        """Record the errors of a fit, also with the number of loads that the target may need."""
        now = time.monotonic()
        self._fit_seconds = now - self._fit_start
        self.points.append(CurvePoint(loads, now - self._start, **errors))
        line = describe(self.points, self.error)
        reason = self._limit_reached
        return f"{line}; {reason}" if reason else line

    @property
    def is_finished(self) -> bool:
        """True if the last fit meets the error wanted or a limit is reached."""
        met = self.points and self.points[-1].median <= self.error
        return bool(met or self._limit_reached)

    @property
    def _limit_reached(self) -> str:
        """Limit that the last fit has reached, in words; empty if there is none."""
        if not self.points or (last := self.points[-1]).median <= self.error:
            return ""
        if last.loads >= self.max_train:
            return f"data.train.max_train = {self.max_train} reached"
        medians = [point.median for point in self.points]
        before, recent = medians[:-PATIENCE], medians[-PATIENCE:]
        if before and min(recent) > MIN_GAIN * min(before):
            return f"{PATIENCE} fits without gain: more loads no longer reduce the error"
        # the next fit would take at least as long as the last one
        if self.minutes is not None and last.seconds + self._fit_seconds >= 60 * self.minutes:
            return f"data.train.minutes = {self.minutes:g} reached"
        return ""

    def state_dict(self) -> dict[str, Any]:
        """Return the learning curve as plain data."""
        return {"points": [list(point) for point in self.points]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue a learning curve."""
        self.points = [CurvePoint(int(n), *map(float, rest)) for n, *rest in state["points"]]


def fit_sizes(train: int, val: int) -> dict[str, int]:
    """Return the numbers of held-out loads, of `val`, and of training loads of a fit, by split."""
    return {"val": min(val, max(HELD_OUT, train // 2)), "train": train}


def loads_for(points: Sequence[CurvePoint], error: float) -> int | None:
    """Return the number of loads at which a median error is expected; None above `MAX_LOADS`.

    A power law, error = a loads^-b, is fitted to the last points by least squares of logarithms.
    """
    last = [point for point in points[-FITTED:] if point.median > 0]
    if len(last) < 2 or not all(math.isfinite(point.median) for point in last):
        return None
    loads = np.log([point.loads for point in last])
    if np.ptp(loads) == 0:
        return None
    slope, offset = np.polyfit(loads, np.log([point.median for point in last]), 1)
    if slope > -MIN_EXPONENT:
        return None
    exponent = (math.log(error) - offset) / slope
    return math.ceil(math.exp(exponent)) if exponent < math.log(MAX_LOADS) else None


def describe(points: Sequence[CurvePoint], error: float) -> str:
    """Return the last point in words, and the number of loads that an error is expected to need."""
    last = points[-1]
    line = f"{last.loads} loads, {last.seconds:.0f} s: {in_words(last._asdict())}"
    if last.median <= error:
        return f"{line}; target of {_percent(error)} reached"
    if (needed := loads_for(points, error)) is None:
        return line
    needed = round(float(f"{max(needed, last.loads + 1):.2g}"))
    return f"{line}; about {needed} loads for {_percent(error)}"


def in_words(errors: Mapping[str, float]) -> str:
    """Return the `median`, `worst` and `e_mean` of a fit in words."""
    median, worst = _percent(errors["median"]), _percent(errors["worst"])
    return f"median {median}, worst {worst}, e_mean {errors['e_mean']:.1e}"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.2g} %"
