"""The linear answer, and a network for what is nonlinear: the flagship."""

from functools import reduce
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.models.moduli import Rests
from dpl.models.pod import PODNet, evened, root_mean_square
from dpl.scene import Sample, Scene

SAME = 1e-4  # eigenvalues closer than this, relatively, belong to one family


class Latent(PODNet):
    """K(0)^-1 f plus what a network learns of u - K(0)^-1 f, in one basis.

    Its error vanishes quadratically with the load: the linear part is the exact one, projected on
    the basis, and the network's output is held to zero as |x|^2 where its inputs x, coordinates of
    the linear answer, are small. The basis holds linear answers and nonlinear rests of the training
    samples. Loads on few degrees of freedom, whose near field no global basis sees, take their
    linear part from the factor of K(0) itself.

    Attributes:
        unit: What scaled linear answers are multiples of, ().
    """

    unit: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        rank: int = 160,
        coordinates: int = 60,
        width: int = 256,
        blocks: int = 4,
        symmetry: bool = True,
        near: int = 300,
    ) -> None:
        """Build the network; see `PODNet`, besides.

        Args:
            scene: What it is to answer.
            rank: Modes of the displacement, R.
            coordinates: Inputs of the network, M.
            width: Units in the hidden layers.
            blocks: Residual blocks of two layers.
            symmetry: Find the symmetries of the body and respect them.
            near: Loads on no more degrees of freedom than this are answered with the factor of
                K(0); 0: none.

        Raises:
            ValueError: A number is out of range.
        """
        if near < 0:
            raise ValueError(f"near = {near} must be 0 or more")
        super().__init__(
            scene,
            rank=rank,
            coordinates=coordinates,
            width=width,
            blocks=blocks,
            symmetry=symmetry,
        )
        self.near, self.rests = near, Rests(scene.linear)
        self.register_buffer("unit", torch.tensor(0.0, dtype=torch.float64))

    def _reading(self, rank: int, coordinates: int) -> int:
        return rank

    def _readings(self, scene: Scene) -> int:
        return Rests(scene.linear).count

    def combined(self, read: Tensor, poisson: Tensor | None) -> Tensor:
        """See `PODNet.combined`."""
        return self.rests.between(read, poisson)

    def forward(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """See `PODNet.forward`."""
        acting = self.entering(force)
        linear = self.combined(acting @ self.read, poisson)
        learnt = self.learnt(self.beside(linear @ self.scaled, poisson))
        few = (acting != 0).sum(dim=1) <= self.near
        if not few.any():
            moved = (linear + learnt) @ self.basis
        else:
            moved = torch.where(few[:, None], learnt, linear + learnt) @ self.basis
            exact = _Respond.apply(acting[few].double(), self)
            exact = self.combined(exact, None if poisson is None else poisson[few])
            moved = moved.index_add(0, few.nonzero()[:, 0], exact.to(moved.dtype))
        return self.leaving(moved, force)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of the nonlinear part from inputs (B, M), without symmetry."""
        square = inputs[:, : self.scaled.shape[1]].square().sum(dim=1, keepdim=True)
        return square / (1 + square) * super().network(inputs)

    def plan(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        lines = super().plan()
        lines.append("nothing linear learnt: K(0)^-1 f is exact to the rank of the basis")
        if self.near:
            lines.append(
                f"no rank for near fields: forces on up to {self.near} degrees of freedom are "
                "answered with the factor of K(0)"
            )
        if self.rests.count > 1:
            lines.append(
                f"no K(0) for every Poisson's ratio: that of {self.rests.count} of them, and a "
                "polynomial between"
            )
        return lines

    def prepare(self, samples: Sample, unit: float) -> None:
        """Make the basis; see `PODNet.prepare`."""
        self.unit.fill_(unit)
        force, displacement = self._columns(samples)
        linear = self.linear(force, samples.poisson)
        size = displacement.norm(dim=1)
        weight = torch.where(size > 0, size.clamp(min=1e-12) ** -0.5, 0.0)
        parts = [weight[:, None] * linear, weight[:, None] * (displacement - linear)]
        basis = self._modes(torch.cat(parts), self.moving, len(self.basis))
        # its coordinates in the order of what they have of the rests
        rests = parts[1] @ basis
        basis = basis @ torch.linalg.eigh(rests.T @ rests)[1].flip(1)
        self.basis.copy_(basis.T)
        responses = [self._respond_all(basis.T, k) for k in range(self.rests.count)]
        self.read.copy_(torch.cat(responses)[:, self.acting.cpu()[self.moving.cpu()]].T)
        motions = self._motions(basis, self.moving)
        self._scale(linear @ basis, (displacement - linear) @ basis, weight, motions)
        self._turn(motions, motions)
        self.prepared.fill_(True)

    def _scale(self, read: Tensor, targets: Tensor, weight: Tensor, motions: Tensor) -> None:
        def spread(columns: Tensor) -> Tensor:
            """Return mean products of coordinates (S, C) over all images, (C, C)."""
            return (motions.mT @ (columns.T @ columns / len(columns)) @ motions).mean(dim=0)

        values, axes = (
            found.flip(-1) for found in torch.linalg.eigh(spread(weight[:, None] * read))
        )
        count = self.scaled.shape[1]
        gaps = -values.diff()
        while 0 < count < len(values) and gaps[count - 1] < SAME * values[count - 1]:
            count -= 1  # a family is kept whole or not at all
        axes = nn.functional.pad(axes[:, :count], (0, self.scaled.shape[1] - count))
        size = ((axes.T @ spread(read)) * axes.T).sum(dim=1).clamp(min=0).sqrt()
        self.scaled.copy_(axes / evened(size))
        size = root_mean_square(targets)
        self.spread.copy_((size * size.max()).sqrt())

    def _known(self, force: Tensor, poisson: Tensor) -> Tensor:
        """Return linear answers (S, outputs) of forces on the inputs (S, inputs), scaled.

        Those that the basis has of them for all but forces on few degrees of freedom.
        """
        linear, basis = self.linear(force, poisson), self.basis.cpu().double()
        few = (force != 0).sum(dim=1) <= self.near
        return torch.where(few[:, None], linear, (linear @ basis.T) @ basis)

    def linear(self, acting: Tensor, poisson: Tensor) -> Tensor:
        """Return linear answers (S, outputs) of forces on the inputs (S, inputs), scaled."""
        parts = zip(acting.split(256), poisson.split(256), strict=True)
        return torch.cat([self.combined(self.respond(some), nu) for some, nu in parts])

    def respond(self, acting: Tensor) -> Tensor:
        """Return K(0)^-1 f, scaled: (B, K outputs) of forces on the inputs (B, inputs), float64.

        At each of the K Poisson's ratios of `rests`; where the law has one, K = 1.
        """
        every = acting.new_zeros(len(acting), len(self.moving_places))
        every[:, self.acting[self.moving].to(acting.device)] = acting
        return torch.cat([self._respond_all(every, k) for k in range(self.rests.count)], dim=1)

    def _respond_all(self, forces: Tensor, k: int) -> Tensor:
        """Return K(0)^-1 f, scaled, (B, outputs) of forces on all that moves, (B, outputs).

        Args:
            forces: What acts.
            k: Which of the Poisson's ratios of `rests`.
        """
        factor = self.rests.members[k].factor
        answers = [torch.from_numpy(factor.solve(one.numpy())) for one in forces.cpu()]
        return float(self.unit) * torch.stack(answers).to(forces.device)


class _Respond(torch.autograd.Function):
    """K(0)^-1 f, scaled; K is symmetric, so the slope is the same solve."""

    @staticmethod
    def forward(ctx: Any, acting: Tensor, net: Latent) -> Tensor:
        """Return (B, K outputs) of (B, inputs)."""
        ctx.net = net
        return net.respond(acting)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        """Return the slope with respect to forces."""
        net = ctx.net
        parts = slope.chunk(net.rests.count, dim=1)
        solved = reduce(torch.add, (net._respond_all(part, k) for k, part in enumerate(parts)))
        return solved[:, net.acting[net.moving]], None
