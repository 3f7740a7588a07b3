"""Losses of displacements: supervised, residual-based and energy-based."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.training.losses.energy import EnergyNormLoss, PotentialEnergyLoss
    from dpl.training.losses.loss import BlendedLoss, Loss, LossContext, clamp_scale, squared_error
    from dpl.training.losses.residual import LrPlus, LrStar, residual_norm
    from dpl.training.losses.supervised import MSE, RMSELoss
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
