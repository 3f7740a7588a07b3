"""Lightning callbacks."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.training.callbacks.hparams import LogHyperparameters, LogLearningRate
    from dpl.training.callbacks.nonfinite_gradients import Diverged, SkipNonFiniteGradients
    from dpl.training.callbacks.throughput import ThroughputMonitor
    from dpl.training.callbacks.training_time import TrainingTime
    from dpl.training.callbacks.worst_cases import WorstCasePlots
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
