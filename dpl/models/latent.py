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
        self.linear_tol, self.rests = linear_tol, Rests(scene.linear)
        self.register_buffer("unit", torch.tensor(0.0, dtype=torch.float64))
        members = max(1, len(self.group))
        count = -(-PROBES // members) * members
        self.register_buffer("probes", torch.zeros(len(self.read), self.rests.count * count))
        inputs = self.scaled.shape[1]
        bent = inputs * (1 + self.turns.shape[1] - inputs)  # x, and x nu where nu is an input
        self.left = nn.Linear(inputs, width, bias=False)
        self.right = nn.Linear(bent, width, bias=False)
        self.product = nn.Linear(width, len(self.basis), bias=False)

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
        local = self._local(acting, linear, poisson)
        if not local.any():
            moved = (linear + learnt) @ self.basis
        else:
            moved = torch.where(local[:, None], learnt, linear + learnt) @ self.basis
            exact = _Respond.apply(acting[local].double(), self)
            exact = self.combined(exact, None if poisson is None else poisson[local])
            moved = moved.index_add(0, local.nonzero()[:, 0], exact.to(moved.dtype))
        return self.leaving(moved, force)

    def _local(self, acting: Tensor, linear: Tensor, poisson: Tensor | None) -> Tensor:
        """Return of which loads (B, inputs) the basis misses too much, (B,).

        Args:
            acting: The loads.
            linear: Coordinates of their linear answers, (B, R).
            poisson: Poisson's ratios, (B, P) [-].
        """
        probed = self.combined(acting @ self.probes.to(acting), poisson)
        missed = probed.square().mean(dim=1)
        return missed >= self.linear_tol**2 * (linear.square().sum(dim=1) + missed)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of the nonlinear part from inputs (B, M), without symmetry."""
        x, beside = inputs.tensor_split([self.scaled.shape[1]], dim=1)
        square = x.square().sum(dim=1, keepdim=True)
        bent = torch.cat([x, *(x * one[:, None] for one in beside.unbind(1))], dim=1)
        curved = self.spread * self.product(self.left(x) * self.right(bent))
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
        linear = self.linear(force, samples.poisson, rtol=1e-12)
        size = displacement.norm(dim=1)
        weight = torch.where(size > 0, size.clamp(min=1e-12) ** -0.5, 0.0)
        parts = [weight[:, None] * linear, weight[:, None] * (displacement - linear)]
        basis = self._modes(torch.cat(parts), self.moving, len(self.basis))
        # its coordinates in the order of what they have of the rests
        rests = parts[1] @ basis
        basis = basis @ torch.linalg.eigh(rests.T @ rests)[1].flip(1)
        self.basis.copy_(basis.T)
        acting = self.acting.cpu()[self.moving.cpu()]
        probes = self._probing(basis)
        for known, fields in {"read": basis.T, "probes": probes}.items():
            members = range(self.rests.count)
            responses = [self._respond_all(fields, k, rtol=1e-12)[:, acting] for k in members]
            getattr(self, known).copy_(torch.cat(responses).T)
        motions = self._motions(basis, self.moving)
        self._scale(linear @ basis, (displacement - linear) @ basis, weight, motions)
        self._turn(motions, motions)
        self.prepared.fill_(True)

    def _probing(self, basis: Tensor) -> Tensor:
        """Return random fields less what a basis (outputs, R) has of them, (P, outputs).

        Few fields and their images, so that a load and its images are told alike.
        """
        members = max(1, len(self.group))
        random = torch.Generator().manual_seed(0)
        count = self.probes.shape[1] // (members * self.rests.count)
        fields = torch.randn(count, len(basis), generator=random, dtype=torch.float64)
        every = torch.cat([self._image(fields, self.moving, k) for k in range(members)])
        return every - (every @ basis) @ basis.T

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

    def _split(
        self, force: Tensor, displacement: Tensor, poisson: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See `PODNet._split`; of the linear answer the basis has its part, unless it is exact."""
        basis, reading = self.basis.cpu().double(), self.read.cpu().double()
        linear, whole = self.combined(force @ reading, poisson), displacement @ basis.T
        missed = displacement.square().sum(dim=1) - whole.square().sum(dim=1)
        local = self._local(force, linear, poisson)
        if local.any():
            beyond = displacement[local] - self.linear(force[local], poisson[local])
            inside = beyond @ basis.T
            missed[local] = beyond.square().sum(dim=1) - inside.square().sum(dim=1)
        return linear, whole - linear, missed

    def linear(self, acting: Tensor, poisson: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return linear answers (S, outputs) of forces on the inputs (S, inputs), scaled."""
        parts = zip(acting.split(256), poisson.split(256), strict=True)
        return torch.cat([self.combined(self.respond(some, rtol), nu) for some, nu in parts])

    def respond(self, acting: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return K(0)^-1 f, scaled: (B, K outputs) of forces on the inputs (B, inputs), float64.

        At each of the K Poisson's ratios of `rests`; where the law has one, K = 1.
        """
        every = acting.new_zeros(len(acting), len(self.moving_places))
        every[:, self.acting[self.moving].to(acting.device)] = acting
        members = range(self.rests.count)
        return torch.cat([self._respond_all(every, k, rtol) for k in members], dim=1)

    def _respond_all(self, forces: Tensor, k: int, rtol: float = RESPONSE) -> Tensor:
        """Return K(0)^-1 f, scaled, (B, outputs) of forces on all that moves, (B, outputs).

        Args:
            forces: What acts.
            k: Which of the Poisson's ratios of `rests`.
            rtol: Residual ratio.
        """
        factor = self.rests.members[k].factor
        answers = [torch.from_numpy(factor.solve(one.numpy(), rtol)) for one in forces.cpu()]
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
