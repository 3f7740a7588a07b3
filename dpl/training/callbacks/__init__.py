"""Lightning callbacks."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.training.callbacks.hparams import LearningRate, Session
    from dpl.training.callbacks.nonfinite_gradients import Diverged, Guard
    from dpl.training.callbacks.throughput import SampleRates
    from dpl.training.callbacks.training_time import TrainingTime
    from dpl.training.callbacks.worst_cases import WorstCases
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
