"""Lightning's door to the samples: from disk, or from workers that solve while it trains."""

import os
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dpl.data.online import OnlineSamples, Replay
from dpl.data.store import generate, store_of
from dpl.scene import Sample, Scene


class Samples(Dataset):
    """Samples in memory, fetched a batch at a time."""

    def __init__(self, samples: Sample) -> None:
        """Keep the samples, (B, ...)."""
        self.samples = samples

    def __len__(self) -> int:
        """Return B."""
        return len(self.samples.force)

    def __getitems__(self, indices: list[int]) -> Sample:
        """Return a batch."""
        return Sample(*(column[indices] for column in self.samples))


class OfflineData(L.LightningDataModule):
    """A data set on disk, generated where it is missing.

    Attributes:
        store: The data set.
        sizes: Loads tried in each split: train, val, test.
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
        workers: int = 2,
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
            workers: Processes that solve; 0: this one.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        self.sizes = {"train": train, "val": val, "test": test}
        for name, number in {"val": val, "test": test, "batch_size": batch_size}.items():
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        for name, number in {"train": train, "seed": seed, "workers": workers}.items():
            if number < 0:
                raise ValueError(f"{name} = {number} must be 0 or more")
        self.scene, self.batch_size, self.workers = scene, batch_size, workers
        self.store = store_of(scene, folder, seed)
        self._shuffle = shuffle
        self._loaded: dict[str, Sample] = {}

    def plan(self) -> list[str]:
        """Return what of the data set is there already, a line."""
        wanted = sum(self.sizes.values())
        there = wanted - sum(len(self.store.missing(*split)) for split in self.sizes.items())
        where = self.store.folder
        return [f"{there} of {wanted} loads not solved again: they are in {where}"] if there else []

    def prepare_data(self) -> None:
        """Solve what is missing on disk."""
        folder, seed = str(self.store.folder), self.store.seed
        generate(self.scene, folder=folder, seed=seed, workers=self.workers, **self.sizes)

    def samples(self, split: str) -> Sample:
        """Return a split, read once, (B, ...) in float64."""
        if split not in self._loaded:
            self._loaded[split] = self.store.load(split, self.sizes[split])
        return self._loaded[split]

    def train_dataloader(self) -> DataLoader | Replay:
        """Return shuffled batches, in an order that (shuffle, epoch) decides: a run can resume."""
        data = Samples(self.samples("train"))
        sampler: DistributedSampler = DistributedSampler(
            data, num_replicas=1, rank=0, shuffle=True, seed=self._shuffle
        )
        return DataLoader(data, self.batch_size, sampler=sampler, collate_fn=_same)

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches."""
        return DataLoader(Samples(self.samples("val")), self.batch_size, collate_fn=_same)

    def test_dataloader(self) -> DataLoader:
        """Return the test batches."""
        return DataLoader(Samples(self.samples("test")), self.batch_size, collate_fn=_same)


class OnlineData(OfflineData):
    """Training samples solved while the network trains; validation and test from disk."""

    def __init__(
        self,
        scene: Scene,
        *,
        batches: int = 16,
        fresh: int = 8,
        reuse: int = 50,
        capacity: int = 4096,
        workers: int = 2,
        batch_size: int = 64,
        **kwargs: object,
    ) -> None:
        """See `OfflineData`; besides.

        Args:
            scene: What is simulated.
            batches: Batches in an epoch.
            fresh: New samples after which batches are drawn again.
            reuse: How often a sample is used on average.
            capacity: Samples kept.
            workers: Processes that solve; 0: this one, between the steps.
            batch_size: Samples in a batch.
            kwargs: folder, seed, val, test of `OfflineData`.

        Raises:
            ValueError: A number is out of range.
        """
        for name, number in (("batches", batches), ("fresh", fresh), ("reuse", reuse)):
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        if capacity < fresh:
            raise ValueError(f"capacity = {capacity} must be fresh = {fresh} or more")
        super().__init__(scene, train=0, workers=workers, batch_size=batch_size, **kwargs)  # type: ignore[arg-type]
        self._options = {"batches": batches, "fresh": fresh, "reuse": reuse, "capacity": capacity}
        self._replay: Replay | None = None
        self._produced = self._first = 0  # what earlier runs took that this one resumes

    def train_dataloader(self) -> Replay:
        """Return the stream, an epoch at a time; training keeps to the cores that are left."""
        # threads of one operation wait for each other: none of them may wait for a solving worker
        torch.set_num_threads(max(1, (os.cpu_count() or 1) - self.workers))
        stream = OnlineSamples(self.scene, self.store.stream("train"), first=self._first)
        self._replay = Replay(
            stream, workers=self.workers, batch_size=self.batch_size, **self._options
        )
        return self._replay

    def teardown(self, stage: str) -> None:
        """Stop the workers."""
        if self._replay is not None:
            self._replay.close()

    def state_dict(self) -> dict[str, int]:
        """Return how far the stream has been used."""
        produced, following = self._produced, self._first
        if self._replay is not None:
            produced += self._replay.produced
            following = max(following, self._replay.following)
        return {"produced": produced, "following": following}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Go on where a stream was left: no load is drawn twice."""
        self._produced, self._first = state_dict["produced"], state_dict["following"]


def _same(batch: Any) -> Any:
    return batch
