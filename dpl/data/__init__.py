"""Data sets of solved loads: generated, stored, streamed, fed to training."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.data.datamodule import OfflineData, Samples
    from dpl.data.dataset import DataSet
    from dpl.data.online import OnlineData
    from dpl.data.replay_buffer import ReplayBuffer
    from dpl.data.storage.store import Store
    from dpl.data.stream import OnlineSamples
    from dpl.system.files import DataSetError
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
