"""The interface of models: inputs of networks, optional capabilities, checks of stored buffers.

A network of another package has a capability if it defines the methods; it need not inherit.
"""

from contextlib import AbstractContextManager, nullcontext
from typing import Any, Literal, NamedTuple, Protocol, Self

import torch
from torch import Tensor, nn

from dpl.fem import SubspaceNewton
from dpl.scene import Sample, Scene

Base = Literal["linear"]


class Inputs(NamedTuple):
    """Sizes of the inputs (field, scalars) of a network.

    Without a base the field is a nodal force over its usual size. With `base = "linear"` it is a
    whitened linear solution, see `OnLinearSolution`. The scalars are, in this order: Young's
    modulus if `young`, the amplitude of the linear solution with a base, and a column for each
    range of the body (`LoadFamily.parameter_ranges`). All are of order one.

    Attributes:
        dofs: Degrees of freedom at which the field is not zero, (N, D).
        scalars: Number of scalars.
        is_displacement: The field is a displacement, whose mean over a region has its size. The
            resultant of a region of nodal forces is their sum.
    """

    dofs: Tensor
    scalars: int
    is_displacement: bool

    @classmethod
    def from_scene(cls, scene: Scene, base: Base | None = None, *, young: bool = False) -> Self:
        """Return the inputs of the networks of a scene.

        Args:
            scene: The scene.
            base: "linear" for a network that adds to the linear solution; None for one that
                predicts the displacement from the force.
            young: Young's modulus is an input.

        Raises:
            ValueError: There is no such base, or it excludes `young`.
        """
        if base not in (None, "linear"):
            raise ValueError(f"base = {base} must be linear or null")
        if young and base is not None:
            raise ValueError(f"young = true requires base = null, not {base}")
        count = young + (base is not None) + len(scene.loads.parameter_ranges)
        dofs = scene.loads.loadable_dofs if base is None else scene.problem.free
        return cls(dofs, count, base is not None)


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
    """A model whose fit includes Newton's method in its modes and estimates of its errors.

    Attributes:
        largest_residual: Residual of a prediction up to which its estimated errors hold, () [-].
    """

    largest_residual: Tensor

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


class StoredBuffers(nn.Module):
    """Module that checks the values of its buffers after it has loaded them."""

    def check_buffers(self) -> None:
        """Raise ValueError if buffers do not fit together: compiled loops do not check indices."""
        raise NotImplementedError

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self.check_buffers()


def check_indices(count: int, **indices: Tensor) -> None:
    """Raise ValueError if an index, of the tensor that the keyword names, is not in [0, count)."""
    for name, values in indices.items():
        if wrong := values[(values < 0) | (values >= count)].tolist():
            raise ValueError(f"{name} contains {wrong[0]}; it must lie between 0 and {count - 1}")


def full_precision(device: str) -> AbstractContextManager[object]:
    """Return a context without `torch.autocast` on a type of devices, such as "cuda"."""
    if torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return nullcontext()
