"""Optional capabilities of networks.

A network of another package has a capability if it defines the methods; it need not inherit.
"""

from typing import Protocol

from torch import Tensor

from dpl.fem import SubspaceNewton
from dpl.scene import Sample


class HasBases(Protocol):
    """A network with constants that are computed from the training samples before the training.

    `dpl.training.Surrogate` calls `fit_bases` at the begin of a training if `is_fitted` is False.
    """

    @property
    def is_fitted(self) -> bool:
        """True after `fit_bases`, or once a checkpoint has been loaded."""
        ...

    def fit_bases(self, field: Tensor, output: Tensor) -> None:
        """Compute the constants from fields and outputs of the network, (S, N, D), float64."""
        ...


class ClosedFormFit(Protocol):
    """A model without trained parameters, which is fitted to all samples at once.

    `forward(force, parameters)` takes dimensionless forces (B, N, D) and the values of the ranges
    of the body (B, P) and returns displacements over L, (B, N, D), all float64.
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


class HasCorrection(Protocol):
    """A model whose fit includes Newton's method in its modes and estimates of its errors."""

    def forward_with_errors(
        self, force: Tensor, parameters: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return displacements over L (B, N, D) and their estimated relative errors (B, 2) [-].

        The second error is that which Newton's method leaves. Both are calibrated on held-out loads
        and valid in the range of the training only.
        """
        ...

    def correction(self) -> SubspaceNewton | None:
        """Return Newton's method in the modes; None before the fit."""
        ...
