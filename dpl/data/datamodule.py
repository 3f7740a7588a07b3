"""Lightning data module of a data set and a source of training samples."""

from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset
from torch.utils.data.distributed import DistributedSampler

from dpl.data.dataset import DataSet
from dpl.data.samples import Samples
from dpl.data.sources import MAX_COUNT, Source, Stored
from dpl.fem import symmetries
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class DataModule(L.LightningDataModule):
    """Validation and test samples of a data set on disk, and training samples of a source.

    Loads of the data set that are missing are solved by `prepare_data`.

    Attributes:
        dataset: The data set.
        store: Its files.
        source: Source of the training samples.
        sizes: Number of loads of each split that are read from the data set.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        train: int | Source = 1000,
        val: int = 100,
        test: int = 100,
        folder: str | None = None,
        seed: int = 0,
        shuffle_seed: int = 0,
        batch_size: int = 64,
        symmetry: bool = False,
        workers: int = 2,
        timeout: float | None = 600.0,
    ) -> None:
        """Check the arguments; nothing is read or solved.

        Args:
            scene, val, test, folder, seed, workers, timeout: See `DataSet`.
            train: Source of the training samples; a number stands for `Stored`.
            shuffle_seed: Seed of the choice and the order of the samples for the batches.
            batch_size: Samples in a batch.
            symmetry: Train also on the images of each sample under the symmetries of the body.
        """
        super().__init__()
        check_range(1, MAX_COUNT, val=val, test=test, batch_size=batch_size)
        check_range(0, 2**32 - 1, shuffle_seed=shuffle_seed)
        self.source = train if isinstance(train, Source) else Stored(train)
        self.source.check(scene, batch_size)
        self.dataset = DataSet(scene, folder, seed, self.source.train, val, test, workers, timeout)
        self.sizes = dict(self.dataset.sizes)
        self.store = self.dataset.store
        self.scene = scene
        self.batch_size = batch_size
        self.workers = workers
        self.symmetry = symmetry
        self.shuffle_seed = shuffle_seed
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

    def figure(self) -> "Figure | None":
        """Return a figure of the data for the folder of a run, if there is one."""
        return None

    def skipped_work(self) -> list[str]:
        """Return one line for each kind of work that is not needed."""
        lines = self.dataset.skipped_work()
        if self.symmetry:
            images = f"{len(self.group)} samples of each load solved, in gradient descent only"
            lines.append(f"{images}: symmetries of the body")
        return lines

    def prepare_data(self) -> None:
        """Solve the missing loads."""
        self.sizes["train"] = self.source.count(self.store)
        self.dataset.fill()

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

    def train_dataloader(self) -> Iterable[Any]:
        """Return the batches of an epoch from the source."""
        return self.source.loader(self)

    def shuffled(self) -> DataLoader:
        """Return shuffled batches of stored samples and their images, or of their encoding.

        The order is a function of `shuffle_seed` and epoch, so that a run can be resumed. The
        module that is trained may encode the samples.
        """
        module, samples = getattr(self.trainer, "lightning_module", None), self.samples("train")
        data: Dataset = getattr(module, "encode", Samples)(samples, self.group)
        rank, world_size = self.rank_and_world_size
        seed = self.shuffle_seed
        sampler: DistributedSampler = DistributedSampler(data, world_size, rank, seed=seed)
        return self._loader(data, sampler)

    def val_dataloader(self) -> DataLoader:
        """Return the validation batches."""
        return self._loader(Samples(self.samples("val")))

    def test_dataloader(self) -> DataLoader:
        """Return the test batches."""
        return self._loader(Samples(self.samples("test")))

    def teardown(self, stage: str) -> None:
        """End the workers of the source."""
        self.source.close()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the source."""
        return self.source.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Let the source continue from the state of an interrupted training."""
        self.source.load_state_dict(state_dict)

    def _loader(self, data: Dataset, sampler: DistributedSampler | None = None) -> DataLoader:
        return DataLoader(
            data,
            self.batch_size,
            sampler=sampler,
            collate_fn=lambda batch: batch,
            generator=torch.Generator(),  # the random numbers of the training stay untouched
        )
