"""Lightning's door to the samples: from disk, or from workers that solve while it trains."""

import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dpl.data.dataset import DataSet
from dpl.data.replay_buffer import ReplayBuffer, StreamRates
from dpl.data.storage.writer import Writer
from dpl.data.stream import HardExamples, OnlineSamples
from dpl.fem import symmetries
from dpl.fem.symmetry import Symmetry, images
from dpl.scene import Sample, Scene
from dpl.system.files import DataSetError
from dpl.system.memory import machine, refuse_beyond

MANY = 10**9  # batches, and samples in one


class Samples(Dataset):
    """Samples in memory with their images under symmetries, fetched a batch at a time."""

    def __init__(self, samples: Sample, group: Sequence[Symmetry] = ()) -> None:
        """Keep the samples, (B, ...), and the symmetries of their body, identity first."""
        self.samples, self.group = samples, group

    def __len__(self) -> int:
        """Return B times the number of symmetries."""
        return len(self.samples.force) * max(1, len(self.group))

    def __getitems__(self, indices: list[int]) -> Sample:
        """Return a batch."""
        count = len(self.samples.force)
        batch = Sample(*(column[[i % count for i in indices]] for column in self.samples))
        if not self.group:
            return batch
        which = torch.tensor([i // count for i in indices])
        force, displacement = (images(field, self.group, which) for field in batch[:2])
        return batch._replace(force=force, displacement=displacement)


class OfflineData(L.LightningDataModule):
    """A data set on disk, generated where it is missing.

    Attributes:
        wanted: The data set.
        store: Where it is kept.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        folder: str | None = None,
        seed: int = 0,
        shuffle: int = 0,
        train: int = 1000,
        val: int = 100,
        test: int = 100,
        batch_size: int = 64,
        symmetry: bool = False,
        workers: int = 2,
        timeout: float | None = 600.0,
    ) -> None:
        """Nothing is read or solved before `prepare_data`.

        Args:
            scene: What is simulated.
            folder: Where the data set is; named after the scene's fingerprint if left out.
            seed: Names the loads.
            shuffle: Names the order of the batches.
            train: Loads to train on.
            val: Loads to validate on.
            test: Loads to test on.
            batch_size: Samples in a batch.
            symmetry: Train on the images of each sample under the symmetries of the body too.
            workers: Processes that solve; 0: this one.
            timeout: Longest time for one load [s]; None: no limit.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        spans = {"val": val, "test": test, "batch_size": batch_size}
        for name, number in spans.items():
            if not 1 <= number <= MANY:
                raise ValueError(f"{name} = {number} must be 1 or more and at most {MANY:,}")
        if not 0 <= shuffle < 2**32:
            raise ValueError(f"shuffle = {shuffle} must be 0 or more and below 2^32")
        self.wanted = DataSet(
            scene, folder, seed, train, val, test, workers=workers, timeout=timeout
        )
        self.scene, self.batch_size, self.workers = scene, batch_size, workers
        self.store, self.symmetry = self.wanted.store, symmetry
        self._shuffle = shuffle
        self._loaded: dict[str, Sample] = {}

    @cached_property
    def group(self) -> list[Symmetry]:
        """The symmetries that make images of the training samples; none if they are not wanted."""
        if not self.symmetry:
            return []
        always = self.scene.loads.constant_force
        return symmetries(self.scene.problem, also=[] if always is None else [always])

    def skipped_work(self) -> list[str]:
        """Return what of the data set need not be solved, a line each."""
        lines = self.wanted.skipped_work()
        if self.symmetry:
            lines.append(f"{len(self.group)} samples of each load solved: symmetries of the body")
        return lines

    def prepare_data(self) -> None:
        """Solve what is missing on disk."""
        self.wanted.fill()

    def samples(self, split: str) -> Sample:
        """Return a split, read once, (B, ...) in float64."""
        if split not in self._loaded:
            self._loaded[split] = self.store.load(split, self.wanted.sizes[split])
        return self._loaded[split]

    def snapshots(self) -> Sample:
        """Return samples to make a basis from, (B, ...): those of training, or of validation."""
        return self.samples("train" if self.wanted.sizes["train"] else "val")

    @property
    def place(self) -> tuple[int, int]:
        """Which training process this is, of how many."""
        trainer = self.trainer
        return (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)

    def train_dataloader(self) -> DataLoader | ReplayBuffer:
        """Return shuffled batches, in an order that (shuffle, epoch) decides: a run can resume.

        Batches of samples and their images, or of what the module encodes them as.
        """
        module = getattr(self.trainer, "lightning_module", None)
        encode = getattr(module, "encode", lambda samples, images: None)
        data = encode(self.samples("train"), images=len(self.group) > 1)
        if data is None:
            data = Samples(self.samples("train"), self.group)
        rank, processes = self.place
        sampler: DistributedSampler = DistributedSampler(
            data, num_replicas=processes, rank=rank, shuffle=True, seed=self._shuffle
        )
        return self._loader(data, sampler)

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches."""
        return self._loader(Samples(self.samples("val")))

    def test_dataloader(self) -> DataLoader:
        """Return the test batches."""
        return self._loader(Samples(self.samples("test")))

    def _loader(self, data: Dataset, sampler: DistributedSampler | None = None) -> DataLoader:
        # a generator of its own: a loader takes none of the training's random numbers
        return DataLoader(
            data,
            self.batch_size,
            sampler=sampler,
            collate_fn=_same,
            generator=torch.Generator(),
        )


class OnlineData(OfflineData):
    """Training samples solved while the network trains; validation and test from disk.

    Attributes:
        rates: How fast the samples of the last epoch were made and used; None before its end.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        batches: int = 16,
        fresh: int = 8,
        reuse: int = 50,
        capacity: int = 4096,
        worst: float = 0.0,
        save: bool = False,
        workers: int = 2,
        batch_size: int = 64,
        **kwargs: object,
    ) -> None:
        """See `OfflineData`; besides.

        Args:
            scene: What is simulated.
            batches: Batches in an epoch.
            fresh: New samples after which batches are drawn again.
            reuse: How often a sample is used at most.
            capacity: Samples kept.
            worst: Part of the new loads that are drawn near those on which the surrogate is worst.
            save: Keep what is solved in the data set, and read what it has instead of solving it.
            workers: Processes that solve; 0: this one, between the steps.
            batch_size: Samples in a batch.
            kwargs: folder, seed, val, test, symmetry, timeout of `OfflineData`.

        Raises:
            ValueError: A number is out of range, or options exclude each other.
            MemoryError: So many samples do not fit.
        """
        for name, number in (("batches", batches), ("fresh", fresh), ("reuse", reuse)):
            if not 1 <= number <= MANY:
                raise ValueError(f"{name} = {number} must be 1 or more and at most {MANY:,}")
        if capacity < fresh:
            raise ValueError(f"capacity = {capacity} must be fresh = {fresh} or more")
        needed = capacity * 2 * 8 * scene.problem.points.numel() / 1e9
        refuse_beyond(needed, machine(), f"{capacity} samples", "take a smaller data.capacity")
        if not 0 <= worst <= 1:
            raise ValueError(f"worst = {worst} must lie between 0 and 1")
        if save and worst:
            raise ValueError(
                "save = true keeps the loads that the seed names, and worst > 0 draws others; "
                "choose one of the two"
            )
        super().__init__(scene, train=0, workers=workers, batch_size=batch_size, **kwargs)  # type: ignore[arg-type]
        self._options = {"batches": batches, "fresh": fresh, "reuse": reuse, "capacity": capacity}
        self._save, self._worst = save, worst
        self.rates: StreamRates | None = None
        self._replay: ReplayBuffer | None = None
        self._produced = self._first = 0  # what earlier runs took that this one resumes

    def skipped_work(self) -> list[str]:
        """Return what need not be solved, a line each."""
        lines = super().skipped_work()
        known = sum(line["tried"] for line in self.store.shards() if line["split"] == "train")
        if self._save and known:
            lines.append(f"{known} loads of the stream not solved again: they are there")
        return lines

    def train_dataloader(self) -> ReplayBuffer:
        """Return the stream, an epoch at a time; training keeps to the cores that are left."""
        # threads of one operation wait for each other: none of them may wait for a solving worker
        left = max(1, cores() - self.workers)
        torch.set_num_threads(min(torch.get_num_threads(), left))
        rank, processes = self.place
        stream = OnlineSamples(
            self.scene,
            self.store.stream("train"),
            first=self._first,
            lane=rank,
            lanes=processes,
            store=self.store if self._save else None,
            worst=HardExamples(self.scene.loads.n_random) if self._worst else None,
            near=self._worst,
            timeout=self.wanted.timeout,
        )
        self._replay = ReplayBuffer(
            stream,
            workers=self.workers,
            batch_size=self.batch_size,
            group=self.group,
            errors=self._errors,
            report=self._report,
            **self._options,
        )
        return self._replay

    def _errors(self) -> Tensor | None:
        """Return the surrogate's errors on the last batch, (B,)."""
        module = self.trainer.lightning_module if self.trainer is not None else None
        return getattr(module, "batch_errors", None)

    def _report(self, rates: StreamRates) -> None:
        """Keep an epoch's rates; write what makes whole shards."""
        self.rates = rates
        if self._save and self.place[0] == 0:
            with suppress(DataSetError):  # another process writes there; shards can wait
                Writer(self.store).collect("train")

    def prepare_data(self) -> None:
        """Solve what is missing of validation and test."""
        super().prepare_data()
        if self._save:
            Writer(self.store).create()

    def teardown(self, stage: str) -> None:
        """Stop the workers."""
        if self._replay is not None:
            self._replay.close()

    def state_dict(self) -> dict[str, int]:
        """Return how far the stream has been used, the other training processes included.

        They have taken as many samples, but may have met more rejected loads: as far again as this
        one has come beyond what it took.
        """
        produced, following = self._produced, self._first
        if self._replay is not None:
            produced += self._replay.produced
            following = max(following, self._replay.following)
            lanes = self.place[1]
            if lanes > 1:
                beyond = following - self._first - lanes * self._replay.produced
                following += lanes * max(1, self.workers) + max(0, beyond)
        return {"produced": produced, "following": following}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Go on where a stream was left: no load is drawn twice."""
        self._produced, self._first = state_dict["produced"], state_dict["following"]


def cores() -> int:
    """Return how many cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _same(batch: Any) -> Any:
    return batch
