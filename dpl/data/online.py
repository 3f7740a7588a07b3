"""Lightning data module of samples that are solved while the network trains."""

from contextlib import suppress
from typing import Any

from torch import Tensor

from dpl.data.datamodule import MAX_COUNT, OfflineData
from dpl.data.replay_buffer import ReplayBuffer, StreamRates
from dpl.data.stream import HardExamples, OnlineSamples
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.files import DataSetError
from dpl.system.memory import machine, refuse_beyond
from dpl.system.threads import leave_cores


class OnlineData(OfflineData):
    """Training samples that are solved while the network trains; validation and test from disk.

    Attributes:
        rates: Rates of the stream in the last epoch; None before its end.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        folder: str | None = None,
        seed: int = 0,
        shuffle_seed: int = 0,
        val: int = 100,
        test: int = 100,
        symmetry: bool = False,
        timeout: float | None = 600.0,
        batches: int = 16,
        new_per_round: int = 8,
        reuse: int = 50,
        capacity: int = 4096,
        hard_example_fraction: float = 0.0,
        cache: bool = False,
        workers: int = 2,
        batch_size: int = 64,
    ) -> None:
        """Check the arguments; those of `OfflineData` and the following.

        Args:
            scene: Scene of the loads.
            shuffle_seed: Seed of the choice of samples, and of their images, for the batches.
            batches: Batches in an epoch.
            new_per_round: New samples after which batches are drawn again.
            reuse: Maximum number of uses of a sample.
            capacity: Number of samples that the replay buffer keeps.
            hard_example_fraction: Fraction of the new loads that are drawn near those with the
                largest errors of the surrogate.
            cache: Write solved loads to the data set, and read those that it has.
            workers: Number of processes that solve; 0: solve in this process, between the steps.
            batch_size: Samples in a batch.

        Raises:
            ValueError: A number is out of range, or options exclude each other.
            MemoryError: The buffer exceeds the memory of the machine.
        """
        check_range(1, MAX_COUNT, batches=batches, new_per_round=new_per_round, reuse=reuse)
        if capacity < new_per_round:
            raise ValueError(
                f"capacity = {capacity} must be at least new_per_round = {new_per_round}"
            )
        if capacity * reuse < batch_size:
            raise ValueError(
                f"capacity * reuse = {capacity} * {reuse} must be at least batch_size = "
                f"{batch_size}; take a larger data.capacity or data.reuse"
            )
        needed = capacity * 2 * 8 * scene.problem.points.numel() / 1e9
        refuse_beyond(needed, machine(), f"{capacity} samples", "take a smaller data.capacity")
        check_range(0, 1, hard_example_fraction=hard_example_fraction)
        if cache and hard_example_fraction:
            raise ValueError(
                "cache = true requires hard_example_fraction = 0, because a data set holds the "
                "loads of its seed only; choose one of the two"
            )
        super().__init__(
            scene,
            folder=folder,
            seed=seed,
            shuffle_seed=shuffle_seed,
            train=0,
            val=val,
            test=test,
            batch_size=batch_size,
            symmetry=symmetry,
            workers=workers,
            timeout=timeout,
        )
        self._buffer_options = {
            "batches": batches,
            "new_per_round": new_per_round,
            "reuse": reuse,
            "capacity": capacity,
        }
        self._cache = cache
        self._hard_example_fraction = hard_example_fraction
        self.rates: StreamRates | None = None
        self._replay: ReplayBuffer | None = None
        self._first = 0  # number of loads of the run that this one resumes

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        lines = super().skipped_work()
        known = sum(line["tried"] for line in self.store.shards() if line["split"] == "train")
        if self._cache and known:
            lines.append(f"{known} loads of the stream not solved again: they are there")
        return lines

    def train_dataloader(self) -> ReplayBuffer:
        """Return the stream; training is limited to the cores that its workers leave."""
        leave_cores(self.workers)
        rank, world_size = self.rank_and_world_size
        fraction = self._hard_example_fraction
        stream = OnlineSamples(
            self.scene,
            self.store.stream("train"),
            first=self._first,
            rank=rank,
            world_size=world_size,
            store=self.store if self._cache else None,
            hard_examples=HardExamples(self.scene.loads.n_random) if fraction else None,
            hard_example_fraction=fraction,
            timeout=self.dataset.timeout,
        )
        self._replay = ReplayBuffer(
            stream,
            workers=self.workers,
            batch_size=self.batch_size,
            seed=self._shuffle_seed,
            group=self.group,
            errors=self._errors,
            report=self._report,
            **self._buffer_options,
        )
        return self._replay

    def _errors(self) -> Tensor | None:
        """Return the surrogate's errors on the last batch, (B,)."""
        module = self.trainer.lightning_module if self.trainer is not None else None
        return getattr(module, "batch_errors", None)

    def _report(self, rates: StreamRates) -> None:
        """Store the rates of an epoch; write the shards that are complete."""
        self.rates = rates
        if self._cache and self.rank_and_world_size[0] == 0:
            with suppress(DataSetError):  # another process writes: wait for the next epoch
                self.dataset.collect("train")

    def prepare_data(self) -> None:
        """Solve the missing loads of validation and test."""
        super().prepare_data()
        if self._cache:
            self.dataset.create()

    def teardown(self, stage: str) -> None:
        """Stop the workers."""
        if self._replay is not None:
            self._replay.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the number of loads that all training processes have taken.

        Other processes have taken as many samples, but may have met more rejected loads. The number
        of loads that this process has taken beyond its samples is therefore added once more.
        """
        next_index = self._first
        if self._replay is not None:
            next_index = max(next_index, self._replay.next_index)
            world_size = self.rank_and_world_size[1]
            if world_size > 1:
                beyond = next_index - self._first - world_size * self._replay.produced
                next_index += world_size * max(1, self.workers) + max(0, beyond)
        return {"next_index": next_index}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue a stream where it was left; no load is drawn twice."""
        self._first = state_dict["next_index"]
