"""The LightningModule with its losses, metrics, optimisers and callbacks."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.training.callbacks.averaged_weights import AveragedWeights
    from dpl.training.callbacks.checkpointing import (
        AtomicCheckpointIO,
        BestWeights,
        writes_loadable,
    )
    from dpl.training.callbacks.nonfinite_gradients import Diverged, SkipNonFiniteGradients
    from dpl.training.callbacks.tensorboard import LogHyperparameters, LogLearningRate
    from dpl.training.callbacks.throughput import ThroughputMonitor, TrainingTime
    from dpl.training.callbacks.worst_cases import WorstCasePlots
    from dpl.training.closed_form import fit
    from dpl.training.losses import (
        MSE,
        BlendedLoss,
        EnergyNormLoss,
        Loss,
        LossContext,
        LrPlus,
        LrStar,
        PotentialEnergyLoss,
        RMSELoss,
    )
    from dpl.training.metrics import ErrorMetrics, relative_errors
    from dpl.training.muon import Muon
    from dpl.training.predictors import Fitted, OnLinearSolution, Predictor, Scaled
    from dpl.training.schedules import warmup_cosine
    from dpl.training.surrogate import Surrogate
    from dpl.training.trained import TrainedSurrogate
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
