"""The linear answer, and a network for what is nonlinear: the flagship."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.models.pod import PODNet, evened, root_mean_square
from dpl.scene import Sample, Scene

SAME = 1e-4  # eigenvalues closer than this, relatively, belong to one family
PROBES = 16  # random fields that tell how much of a linear answer the basis misses, at least
RESPONSE = 1e-6  # residual ratio of linear answers in a prediction


class Latent(PODNet):
    """K(0)^-1 f plus what a network learns of u - K(0)^-1 f, in one basis.

    Its error vanishes quadratically with the load: the linear part is the exact one, projected on
    the basis, and what is learnt is a quadratic form of the inputs x, coordinates of the linear
    answer, over 1 + |x|^2, and a network held to zero as |x|^3 where they are small. The basis
    holds linear answers and nonlinear rests of the training samples. Local loads, whose near field
    no global basis sees, take their linear part from the factor of K(0) itself: those of whose
    linear answer the basis misses too much. How much that is, a few random probes tell without a
    solve (Halko, Martinsson, Tropp, 2011, SIAM Rev. 53, section 4.3).

    Attributes:
        unit: What scaled linear answers are multiples of, ().
        probes: Each square of a force's product with one of these is, in the mean, that of what the
            basis misses of its linear answer, (inputs, P).
    """

    unit: Tensor
    probes: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        rank: int = 160,
        coordinates: int = 60,
        width: int = 256,
        blocks: int = 4,
        symmetry: bool = True,
        linear_tol: float = 5e-4,
    ) -> None:
        """Build the network; see `PODNet`, besides.

        Args:
            scene: What it is to answer.
            rank: Modes of the displacement, R.
            coordinates: Inputs of the network, M.
            width: Units in the hidden layers.
            blocks: Residual blocks of two layers.
            symmetry: Find the symmetries of the body and respect them.
            linear_tol: Part of its linear answer that the basis may miss; a load of which it
                misses more takes it from the factor of K(0). 0: all do; infinity: none.

        Raises:
            ValueError: A number is out of range.
        """
        if not linear_tol >= 0:
            raise ValueError(f"linear_tol = {linear_tol} must be 0 or more")
        super().__init__(
            scene,
            rank=rank,
            coordinates=coordinates,
            width=width,
            blocks=blocks,
            symmetry=symmetry,
        )
        self.linear_tol = linear_tol
        self.register_buffer("unit", torch.tensor(0.0, dtype=torch.float64))
        members = max(1, len(self.group))
        count = -(-PROBES // members) * members
        self.register_buffer("probes", torch.zeros(len(self.read), count))
        inputs = self.scaled.shape[1]
        self.left = nn.Linear(inputs, width, bias=False)
        self.right = nn.Linear(inputs, width, bias=False)
        self.product = nn.Linear(width, len(self.basis), bias=False)

    def _reading(self, rank: int, coordinates: int) -> int:
        return rank

    def forward(self, force: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32."""
        acting = self.entering(force)
        linear = acting @ self.read
        learnt = self.learnt(linear @ self.scaled)
        local = self._local(acting, linear)
        if not local.any():
            moved = (linear + learnt) @ self.basis
        else:
            moved = torch.where(local[:, None], learnt, linear + learnt) @ self.basis
            exact = _Respond.apply(acting[local].double(), self)
            moved = moved.index_add(0, local.nonzero()[:, 0], exact.to(moved.dtype))
        return self.leaving(moved, force)

    def _local(self, acting: Tensor, linear: Tensor) -> Tensor:
        """Return of which loads (B, inputs) the basis misses too much, (B,).

        Args:
            acting: The loads.
            linear: Coordinates of their linear answers, (B, R).
        """
        missed = (acting @ self.probes.to(acting.dtype)).square().mean(dim=1)
        return missed >= self.linear_tol**2 * (linear.square().sum(dim=1) + missed)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of the nonlinear part from inputs (B, M), without symmetry."""
        square = inputs.square().sum(dim=1, keepdim=True)
        curved = self.spread * self.product(self.left(inputs) * self.right(inputs))
        return curved / (1 + square) + (square / (1 + square)) ** 1.5 * super().network(inputs)

    def plan(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        lines = super().plan()
        lines.append("nothing linear learnt: K(0)^-1 f is exact to the rank of the basis")
        if self.linear_tol < torch.inf:
            lines.append(
                "no rank for near fields: loads of whose linear answer the basis misses more than "
                f"{self.linear_tol:.2g} are answered with the factor of K(0)"
            )
        return lines

    def prepare(self, samples: Sample, unit: float) -> None:
        """Make the basis; see `PODNet.prepare`."""
        self.unit.fill_(unit)
        force, displacement = self._columns(samples)
        linear = self.respond(force, rtol=1e-12)
        size = displacement.norm(dim=1)
        weight = torch.where(size > 0, size.clamp(min=1e-12) ** -0.5, 0.0)
        parts = [weight[:, None] * linear, weight[:, None] * (displacement - linear)]
        basis = self._modes(torch.cat(parts), self.moving, len(self.basis))
        # its coordinates in the order of what they have of the rests
        rests = parts[1] @ basis
        basis = basis @ torch.linalg.eigh(rests.T @ rests)[1].flip(1)
        self.basis.copy_(basis.T)
        acting = self.acting.cpu()[self.moving.cpu()]
        self.read.copy_(self._respond_all(basis.T, rtol=1e-12)[:, acting].T)
        self.probes.copy_(self._missed(basis)[:, acting].T)
        motions = self._motions(basis, self.moving)
        self._scale(linear @ basis, (displacement - linear) @ basis, weight, motions)
        self._turn(motions, motions)
        self.prepared.fill_(True)

    def _missed(self, basis: Tensor) -> Tensor:
        """Return K(0)^-1 of random fields less what a basis (outputs, R) has of them, (P, outputs).

        Of few fields and their images, so that a load and its images are told alike.
        """
        members = max(1, len(self.group))
        random = torch.Generator().manual_seed(0)
        count = self.probes.shape[1] // members
        fields = torch.randn(count, len(basis), generator=random, dtype=torch.float64)
        every = torch.cat([self._image(fields, self.moving, k) for k in range(members)])
        return self._respond_all(every - (every @ basis) @ basis.T, rtol=1e-12)

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

    def _split(self, force: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `PODNet._split`; of the linear answer the basis has its part, unless it is exact."""
        basis, reading = self.basis.cpu().double(), self.read.cpu().double()
        linear, whole = force @ reading, displacement @ basis.T
        missed = displacement.square().sum(dim=1) - whole.square().sum(dim=1)
        local = self._local(force, linear)
        if local.any():
            beyond = displacement[local] - self.respond(force[local])
            inside = beyond @ basis.T
            missed[local] = beyond.square().sum(dim=1) - inside.square().sum(dim=1)
        return linear, whole - linear, missed

    def respond(self, acting: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return K(0)^-1 f, scaled: (B, outputs) of forces on the inputs (B, inputs), float64."""
        every = acting.new_zeros(len(acting), len(self.moving_places))
        every[:, self.acting[self.moving].to(acting.device)] = acting
        return self._respond_all(every, rtol)

    def _respond_all(self, forces: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return K(0)^-1 f, scaled, (B, outputs) of forces on all that moves, (B, outputs)."""
        factor = self.scene.linear.factor
        answers = [torch.from_numpy(factor.solve(one.numpy(), rtol)) for one in forces.cpu()]
        return float(self.unit) * torch.stack(answers).to(forces.device)


class _Respond(torch.autograd.Function):
    """K(0)^-1 f, scaled; K is symmetric, so the slope is the same solve."""

    @staticmethod
    def forward(ctx: Any, acting: Tensor, net: Latent) -> Tensor:
        """Return (B, outputs) of (B, inputs)."""
        ctx.net = net
        return net.respond(acting)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        """Return the slope with respect to forces."""
        net = ctx.net
        return net._respond_all(slope)[:, net.acting[net.moving]], None
