"""Data sets of solved loads: generated, stored, streamed, fed to training."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.data.datamodule import DataModule
    from dpl.data.dataset import DataSet
    from dpl.data.pairs import PairData, Pairs
    from dpl.data.samples import Samples
    from dpl.data.sources import Growing, Source, Stored
    from dpl.data.storage.store import Store
    from dpl.data.stream import Stream
    from dpl.system.files import DataSetError
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
