"""Sources of the training samples of a data module: a data set on disk, or an endless stream."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

from dpl.data.dataset import DataSet, LoadSolver
from dpl.data.learning_curve import CurvePoint, in_words
from dpl.data.replay_buffer import ReplayBuffer
from dpl.data.solving.solve import Guess
from dpl.data.storage.store import SHARD_SIZE, Store
from dpl.data.stream import SampleStream
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.memory import machine, refuse_beyond
from dpl.system.threads import leave_cores, one_thread

MAX_COUNT = 10**9  # of batches, and of samples in a batch
HELD_OUT = 32  # smallest number of held-out loads of a fit, as far as there are as many
MIN_REST = 128  # training loads that are not solved for which a fit to the first ones saves time


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

    def count(self, store: Store) -> int:
        """Return the number of loads of a data set whose samples are training samples."""
        return self.train

    def loader(self, data: Any) -> Iterable[Any]:
        """Return the batches of an epoch of gradient descent for a `DataModule`."""
        return data.shuffled()

    def fits(self, dataset: DataSet, guess: Guess | None = None) -> Iterator[dict[str, int]]:
        """Yield the numbers of loads, by split, of each fit of a model in closed form.

        Args:
            dataset: The data set; its missing loads are solved.
            guess: Prediction of the last fit, from which loads are solved.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            KeyboardInterrupt: The solves were interrupted.
            ValueError: The source is no set of solved loads.
        """
        raise ValueError("a model in closed form is fitted to solved loads; set data=offline")

    def unseen(self, store: Store, loads: int) -> Sample | None:
        """Return samples that the fit to a number of training loads has not seen, if there are."""
        return None

    def record(self, loads: int, errors: Mapping[str, float]) -> str:
        """Record the held-out errors of a fit to a number of loads; return them in words."""
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

    def fits(self, dataset: DataSet, guess: Guess | None = None) -> Iterator[dict[str, int]]:
        """Yield the sizes of the data set; before, if many loads are missing, those of a first fit.

        The missing loads are then solved from its predictions, see `Source.fits`.
        """
        first = fit_sizes(SHARD_SIZE, dataset.val)
        if len(dataset.store.missing("train", dataset.train)) > MIN_REST:
            rest = {part: range(first.get(part, 0), n) for part, n in dataset.sizes.items()}
            loads = [*((part, range(n)) for part, n in first.items()), *rest.items()]
            self._solver = LoadSolver(dataset, loads, guess=guess, thread=dataset.workers > 0)
            self._solver.wait(first, show=True)
            with one_thread():  # the workers need the other cores
                yield first
            self._solver.wait(dataset.sizes, show=True)
            self.close()
        dataset.fill()
        yield dataset.sizes


@dataclass(eq=False)
class Stream(Source):
    """Samples that worker processes solve while the network trains, kept in a `ReplayBuffer`.

    Attributes:
        batches: Batches in an epoch.
        new_per_round: New samples after which batches are drawn again.
        reuse: Maximum number of uses of a sample.
        capacity: Number of samples that the replay buffer keeps.
    """

    _: KW_ONLY
    batches: int = 16
    new_per_round: int = 8
    reuse: int = 50
    capacity: int = 4096

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("batches", "new_per_round", "reuse")}
        check_range(1, MAX_COUNT, **counts)
        if self.capacity < self.new_per_round:
            raise ValueError(
                f"capacity = {self.capacity} must be at least new_per_round = {self.new_per_round}"
            )
        self._replay: ReplayBuffer | None = None
        self._first = 0  # number of loads of the run that this one resumes

    def check(self, scene: Scene, batch_size: int) -> None:
        """Check the buffer.

        Raises:
            ValueError: The buffer can never give a batch.
            MemoryError: The buffer exceeds the memory of the machine.
        """
        if self.capacity * self.reuse < batch_size:
            raise ValueError(
                f"capacity * reuse = {self.capacity} * {self.reuse} must be at least batch_size = "
                f"{batch_size}; take a larger data.train.capacity or data.train.reuse"
            )
        needed = self.capacity * 2 * 8 * scene.problem.points.numel() / 1e9
        remedy = "take a smaller data.train.capacity"
        refuse_beyond(needed, machine(), f"{self.capacity} samples", remedy)

    @property
    def rates(self) -> Mapping[str, float] | None:  # type: ignore[override]
        """Rates of the stream in the last epoch, see `ReplayBuffer`."""
        return self._replay.rates if self._replay is not None else None

    def loader(self, data: Any) -> ReplayBuffer:
        """Return the stream; training is limited to the cores that its workers leave."""
        leave_cores(data.workers)
        rank, world_size = data.rank_and_world_size
        self.close()  # the stream of an earlier training
        stream = SampleStream(
            data.scene,
            data.store.stream("train"),
            first=self._first,
            rank=rank,
            world_size=world_size,
            workers=data.workers,
            timeout=data.dataset.timeout,
        )
        self._replay = ReplayBuffer(
            stream,
            batch_size=data.batch_size,
            batches=self.batches,
            new_per_round=self.new_per_round,
            reuse=self.reuse,
            capacity=self.capacity,
            seed=data.shuffle_seed,
            group=data.group,
        )
        return self._replay

    def close(self) -> None:
        """Stop the workers."""
        if self._replay is not None:
            self._replay.stream.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the number of loads that all training processes have taken."""
        taken = self._first if self._replay is None else self._replay.taken
        return {"next_index": max(self._first, taken)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue a stream where it was left; no load is drawn twice."""
        self._first = state["next_index"]


def fit_sizes(train: int, val: int) -> dict[str, int]:
    """Return the numbers of held-out loads, of `val`, and of training loads of a fit, by split."""
    return {"val": min(val, max(HELD_OUT, train // 2)), "train": train}
