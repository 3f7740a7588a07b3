"""POD network: a residual network from coordinates of the field to those of the displacement."""

from typing import cast

import torch
from torch import Tensor, nn

from dpl.fem.rom.pod import orthonormal_fields, pod
from dpl.models.interface import Inputs, full_precision
from dpl.models.linear_base import partial_whitening
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.memory import refuse_weights

MAX_BLOCKS = 1000


class Block(nn.Module):
    """Residual block x + B gelu(A x)."""

    def __init__(self, width: int) -> None:
        """Build a block that is close to the identity."""
        super().__init__()
        self.inner = nn.Linear(width, width)
        self.outer = nn.Linear(width, width)
        with torch.no_grad():
            self.outer.weight.mul_(0.1)
            self.outer.bias.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """Return (..., W) from (..., W)."""
        return cast(Tensor, x + self.outer(nn.functional.gelu(self.inner(x))))


class PODNet(nn.Module):
    """Residual network from POD coordinates of fields to POD coordinates of displacements.

    The bases are computed from the training samples (`HasBases`) and stored in buffers.
    `torch.autocast` applies to the layers of the network only; projections to and from the bases
    keep the precision of their fields.

    Source: Hesthaven, Ubbiali (2018), Non-intrusive reduced order modeling of nonlinear problems
    using neural networks, J. Comput. Phys. 363.

    Attributes:
        modes: Orthonormal modes of the displacement, 0 at fixed degrees of freedom, (R, N D).
        projection: Map from fields to inputs of the network: orthonormal modes of the field over
            `partial_whitening`, (N D, M).
        output_scale: Scale of each coordinate of the displacement, (R,).
    """

    modes: Tensor
    projection: Tensor
    output_scale: Tensor

    def __init__(
        self,
        scene: Scene,
        inputs: Inputs | None = None,
        *,
        rank: int = 100,
        coordinates: int = 60,
        width: int = 256,
        blocks: int = 4,
    ) -> None:
        """Build the network; its bases are zero until `fit_bases`.

        Args:
            scene: The scene to predict.
            inputs: Its inputs; None for scaled forces.
            rank: Number of modes of the displacement, R; at most the free degrees of freedom.
            coordinates: Number of modes of the field, M; at most the degrees of freedom at which
                it is not zero.
            width: Units of the hidden layers.
            blocks: Number of residual blocks, each of two layers.

        Raises:
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        check_range(1, rank=rank, coordinates=coordinates, width=width)
        check_range(0, MAX_BLOCKS, blocks=blocks)
        self.scene = scene
        inputs = inputs or Inputs.from_scene(scene)
        rank = min(rank, int(scene.problem.free.sum()))
        coordinates = min(coordinates, int(inputs.dofs.sum()))
        count = coordinates + inputs.scalars
        weights = width * (count + 1) + (width + 1) * rank + 2 * blocks * width * (width + 1)
        refuse_weights(weights, None, "take a smaller model.width or model.blocks")
        dofs = scene.problem.free.numel()
        self.register_buffer("modes", torch.zeros(rank, dofs))
        self.register_buffer("projection", torch.zeros(dofs, coordinates))
        self.register_buffer("output_scale", torch.zeros(rank))
        self.enter = nn.Linear(count, width)
        self.blocks = nn.Sequential(*(Block(width) for _ in range(blocks)))
        self.leave = nn.Linear(width, rank)

    def forward(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a field (B, N, D) and scalars (B, S)."""
        device = field.device.type
        with full_precision(device):
            coordinates = field.flatten(1) @ self.projection
        hidden = self.blocks(self.enter(torch.cat([coordinates, scalars], dim=1)))
        outputs = self.leave(nn.functional.gelu(hidden)).to(field.dtype)
        with full_precision(device):
            return ((self.output_scale * outputs) @ self.modes).view_as(field)

    @property
    def is_fitted(self) -> bool:
        """True after `fit_bases`, or once a checkpoint has been loaded."""
        return bool(self.modes.any())

    def fit_bases(self, field: Tensor, output: Tensor) -> None:
        """Compute the bases, see `HasBases`.

        Snapshots are divided by the root of the norm of their outputs, so that large displacements
        do not determine all modes.
        """
        field, output = field.flatten(1), output.flatten(1)
        size = output.norm(dim=1)
        weight = (size.clamp(min=1e-12) ** -0.5 * (size > 0))[:, None]
        modes = _modes(weight * output, len(self.modes))
        self.modes.copy_(modes.T)
        size = (output @ modes).square().mean(dim=0).sqrt()
        self.output_scale.copy_((size * size.max()).sqrt())
        modes = _modes(weight * field, self.projection.shape[1])
        size = (field @ modes).square().mean(dim=0).sqrt()
        self.projection.copy_(modes / partial_whitening(size))

    @property
    def vectors(self) -> Tensor:
        """Orthonormal modes of the displacement, the most important first, (N, D, R), float64."""
        modes, free = self.modes.cpu(), self.scene.problem.free.cpu()
        return orthonormal_fields(modes[modes.any(dim=1)][:, free.flatten()].T, free)

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line each."""
        rank, outputs = len(self.modes), int(self.scene.problem.free.sum())
        return [f"{rank} coordinates learnt instead of {outputs} displacements"]


def _modes(snapshots: Tensor, rank: int) -> Tensor:
    """Return POD modes (n, rank) of snapshots (S, n); columns that snapshots do not span are 0."""
    found = pod(snapshots, min(rank, *snapshots.shape))
    vectors, values = found.vectors, found.values[: found.vectors.shape[1]]
    modes = snapshots.new_zeros(snapshots.shape[1], rank)
    modes[:, : len(values)] = torch.where(values > 1e-7 * values.max(), vectors, 0.0)
    return torch.where(snapshots.any(dim=0)[:, None], modes, 0.0)  # without rounding errors
