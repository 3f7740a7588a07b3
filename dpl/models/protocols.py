"""Optional capabilities of networks, found with `isinstance`.

A network of another package has a capability if it defines the methods; it need not inherit.
"""

from typing import Protocol, runtime_checkable

from torch import Tensor

from dpl.fem import SubspaceNewton
from dpl.models.linear_base import Base
from dpl.models.reduced_samples import ReducedDataset
from dpl.scene import Sample


@runtime_checkable
class TrainsInCoordinates(Protocol):
    """A network between reduced coordinates of loads and displacements.

    `dpl.training.Surrogate` lets it fit its bases before training. If the loss is a function of
    squared errors, it trains the network on samples in reduced coordinates. With a base
    (`HasBase`) the forces of the samples are scaled linear solutions and their displacements what
    the network has to predict.
    """

    @property
    def is_fitted(self) -> bool:
        """True after `fit_bases`, or once a checkpoint with bases has been loaded."""
        ...

    @property
    def is_symmetric(self) -> bool:
        """True if `encode` adds the images of the samples under the symmetries of the body."""
        ...

    def fit_bases(self, samples: Sample) -> None:
        """Compute the bases from scaled training samples (S, N, D), float64."""
        ...

    def encode(self, samples: Sample, amplitude: Tensor | None = None) -> ReducedDataset:
        """Return scaled samples (S, N, D), float64, in reduced coordinates.

        Args:
            samples: The samples.
            amplitude: Amplitudes of the linear solutions, (S,); required with a linear base.
        """
        ...

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates of displacements (B, R) from coordinates of loads (B, M)."""
        ...


@runtime_checkable
class HasBase(Protocol):
    """A network that predicts the displacement, or the part that a base lacks.

    With `base = "linear"` it maps scaled linear solutions (B, N, D), and further inputs of
    `extra_inputs` such as "amplitude", to the scaled nonlinear displacement (B, N, D), see
    `LinearBase`. `dpl.training.Surrogate` computes the linear solutions, before the training once
    for all samples of a data set, and adds them. "none" is the same as no attribute.
    """

    base: Base


@runtime_checkable
class ClosedFormFit(Protocol):
    """A model without trained parameters, which is fitted to all samples at once.

    It takes dimensionless forces and returns displacements over L, both float64.
    `dpl.training.fit` fits it in place of a training by gradient descent.
    """

    def fit(self, samples: Sample, held_out: Sample) -> None:
        """Fit the model, also a fitted one to other samples.

        Args:
            samples: Dimensionless samples to fit to, (S, N, D).
            held_out: Samples by whose error options are chosen.
        """
        ...

    @property
    def is_fitted(self) -> bool:
        """True after `fit`, or once a checkpoint has been loaded."""
        ...


@runtime_checkable
class Correctable(Protocol):
    """A model whose predictions Newton iterations in its modes can correct."""

    def galerkin(self, states: Tensor, *, rank: int, tolerance: float) -> SubspaceNewton:
        """Return the solver in the first `rank` modes, whose `correct` improves a prediction.

        Args:
            states: Equilibrium displacements, (S, N, D) [-].
            rank: Number of modes.
            tolerance: Tolerance of the choice of cells, see `dpl.fem.rom.ecsw`.
        """
        ...


@runtime_checkable
class HasCorrection(Protocol):
    """A model whose fit includes Newton's method in its modes."""

    def correction(self) -> SubspaceNewton | None:
        """Return Newton's method in the modes; None before the fit."""
        ...
