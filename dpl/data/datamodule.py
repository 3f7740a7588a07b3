"""Lightning data module of a data set on disk."""

from functools import cached_property
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.trainer.states import TrainerFn
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dpl.data.dataset import DataSet
from dpl.data.growth import Growth
from dpl.data.replay_buffer import ReplayBuffer, transform
from dpl.fem import symmetries
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.threads import leave_cores

MAX_COUNT = 10**9  # of batches, and of samples in a batch


class Samples(Dataset):
    """Samples in memory and their images under symmetries, read a batch at a time."""

    def __init__(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> None:
        """Store the samples, (B, ...), and the symmetries of their body, identity first."""
        self.samples = samples
        self.group = group

    def __len__(self) -> int:
        """Return B times the number of symmetries."""
        return len(self.samples.force) * max(1, len(self.group))

    def __getitems__(self, indices: list[int]) -> Sample:
        """Return a batch."""
        count = len(self.samples.force)
        batch = Sample(*(column[[i % count for i in indices]] for column in self.samples))
        if not self.group:
            return batch
        return transform(batch, self.group, torch.tensor([i // count for i in indices]))


class OfflineData(L.LightningDataModule):
    """A data set on disk; loads that are missing are solved first.

    With `train="auto"` training loads are solved while a model is fitted, see `Growth`; each epoch
    has more of them.

    Attributes:
        dataset: The data set; without training loads if their number is chosen by `growth`.
        store: Its files.
        growth: Choice of the number of training loads; None if that is given.
        sizes: Present number of loads of each split.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        folder: str | None = None,
        seed: int = 0,
        shuffle_seed: int = 0,
        train: int | Literal["auto"] = 1000,
        val: int = 100,
        test: int = 100,
        batch_size: int = 64,
        symmetry: bool = False,
        workers: int = 2,
        timeout: float | None = 600.0,
        error: float = 1e-3,
        minutes: float | None = None,
        max_train: int = 10_000,
    ) -> None:
        """Check the arguments, those of `DataSet` and `Growth` and the following.

        Nothing is read or solved before `prepare_data`.

        Args:
            train: Number of loads to train on; "auto": the growth of the data set chooses it.
            shuffle_seed: Seed of the order of the batches.
            batch_size: Samples in a batch.
            symmetry: Train also on the images of each sample under the symmetries of the body.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        check_range(1, MAX_COUNT, val=val, test=test, batch_size=batch_size)
        check_range(0, 2**32 - 1, shuffle_seed=shuffle_seed)
        count = 0 if train == "auto" else train
        self.dataset = DataSet(scene, folder, seed, count, val, test, workers, timeout)
        growth = Growth(self.dataset, error=error, minutes=minutes, max_train=max_train)
        self.growth = growth if train == "auto" else None
        self.sizes = dict(self.dataset.sizes)
        self.store = self.dataset.store
        self.scene = scene
        self.batch_size = batch_size
        self.workers = workers
        self.symmetry = symmetry
        self._shuffle_seed = shuffle_seed
        self._loaded: dict[str, tuple[int, Sample]] = {}  # with the number of loads tried

    @cached_property
    def group(self) -> SymmetryGroup:
        """Symmetries whose images are training samples; empty without `symmetry`."""
        if not self.symmetry:
            return NO_SYMMETRIES
        constant = self.scene.loads.constant_force
        return symmetries(self.scene.problem, also=[] if constant is None else [constant])

    def describe(self) -> list[tuple[str, str]]:
        """Return the numbers of loads, and how many of them have to be solved."""
        return self.dataset.describe()

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        lines = self.dataset.skipped_work()
        if self.symmetry:
            images = f"{len(self.group)} samples of each load solved, in gradient descent only"
            lines.append(f"{images}: symmetries of the body")
        return lines

    def prepare_data(self) -> None:
        """Solve the missing loads; those of a growing data set are solved during the training."""
        if self.growth is not None:
            if self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING:
                return
            self.sizes["train"] = len(self.store.tried("train"))
        self.dataset.fill()

    def setup(self, stage: str) -> None:
        """Let the loaders of a growing data set be made again in each epoch."""
        if self.growth is not None and stage == "fit" and self.trainer is not None:
            self.trainer.reload_dataloaders_every_n_epochs = 1

    def samples(self, split: str) -> Sample:
        """Return a split, (B, ...) in float64; each load is read once."""
        size = self.sizes[split]
        done, loaded = self._loaded.get(split, (0, None))
        if loaded is None or size < done:
            loaded = self.store.load(split, size)
        elif size > done:
            more = self.store.load(split, size, first=done)
            loaded = Sample(*(torch.cat(pair) for pair in zip(loaded, more, strict=True)))
        self._loaded[split] = size, loaded
        return loaded

    def snapshots(self) -> Sample:
        """Return the samples that bases are made from: training, or else validation, (B, ...)."""
        return self.samples("train" if self.sizes["train"] else "val")

    @property
    def rank_and_world_size(self) -> tuple[int, int]:
        """Index of this training process, and number of training processes."""
        trainer = self.trainer
        return (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)

    def train_dataloader(self) -> DataLoader | ReplayBuffer:
        """Return shuffled batches of samples and their images, or of the module's encoding of them.

        The order is a function of `shuffle_seed` and epoch, so that a run can be resumed. A growing
        data set waits for the loads of the epoch.
        """
        if self.growth is not None:
            leave_cores(self.workers)
            self.sizes |= self.growth.next_sizes()
        module, samples = getattr(self.trainer, "lightning_module", None), self.samples("train")
        encode = getattr(module, "encode", lambda samples, group: None)
        data = encode(samples, self.group)
        if data is None:
            data = Samples(samples, self.group)
        rank, world_size = self.rank_and_world_size
        seed = self._shuffle_seed
        sampler: DistributedSampler = DistributedSampler(data, world_size, rank, seed=seed)
        return self._loader(data, sampler)

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches."""
        return self._loader(Samples(self.samples("val")))

    def test_dataloader(self) -> DataLoader:
        """Return the test batches."""
        return self._loader(Samples(self.samples("test")))

    def teardown(self, stage: str) -> None:
        """End the workers of a growing data set."""
        if self.growth is not None:
            self.growth.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the growth."""
        return {} if self.growth is None else self.growth.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue the growth of an interrupted training."""
        if self.growth is not None:
            self.growth.load_state_dict(state_dict)
            if self.growth.is_finished and self.trainer is not None:
                self.trainer.should_stop = True

    def _loader(self, data: Dataset, sampler: DistributedSampler | None = None) -> DataLoader:
        return DataLoader(
            data,
            self.batch_size,
            sampler=sampler,
            collate_fn=_identity,
            generator=torch.Generator(),  # the random numbers of the training stay untouched
        )


def _identity(batch: Any) -> Any:
    return batch
