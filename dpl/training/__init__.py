"""The LightningModule, its losses, metrics, optimisers and callbacks."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.training.callbacks.hparams import LearningRate, Session
    from dpl.training.callbacks.nonfinite_gradients import Diverged, Guard
    from dpl.training.callbacks.throughput import SampleRates
    from dpl.training.callbacks.training_time import TrainingTime
    from dpl.training.callbacks.worst_cases import WorstCases
    from dpl.training.checkpoints import BestWeights, WholeCheckpoints
    from dpl.training.losses.energy import Energy, Stiffness
    from dpl.training.losses.loss import Loss, Physics
    from dpl.training.losses.residual import LrPlus, LrStar
    from dpl.training.losses.schedule import Annealed
    from dpl.training.losses.supervised import MSE, MeanNorm
    from dpl.training.metrics import (
        MaxError,
        MeanError,
        MinSNR,
        MinVolumeRatio,
        RelativeL2,
        ResidualRatio,
    )
    from dpl.training.muon import Muon
    from dpl.training.schedules import warmup_cosine
    from dpl.training.surrogate import Surrogate
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
