"""The linear answer, and a network for what is nonlinear: the flagship."""

from functools import reduce
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.fem.symmetry import products
from dpl.models.pod import PODNet, Reading, padded
from dpl.models.poisson_interpolation import PoissonInterpolation
from dpl.models.reduced_samples import partial_whitening, projection_error, root_mean_square
from dpl.models.symmetric_fields import turned_back
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
        probers: From forces at the inlet to products with images of random fields, see `missed`,
            (n' D, K F G) with F fields at each of K Poisson's ratios.
        pairs: Which image of the load and of a field meet, (G, G).
    """

    unit: Tensor
    probers: Tensor
    pairs: Tensor

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
        self.linear_tol, self.rests = linear_tol, PoissonInterpolation(scene.linear)
        self.register_buffer("unit", torch.tensor(0.0, dtype=torch.float64))
        members = len(self.turns)
        columns = -(-PROBES // members) * members
        probers = torch.zeros(len(self.readers), self.rests.count * columns)
        self.register_buffer("probers", probers)
        pairs = products(self.group) * members + torch.arange(members)
        self.register_buffer("pairs", pairs, persistent=False)
        inputs = self.scaled.shape[1]
        bent = inputs * (1 + self.turns.shape[1] - inputs)  # x, and x nu where nu is an input
        self.left = nn.Linear(inputs, width, bias=False)
        self.right = nn.Linear(bent, width, bias=False)
        self.product = nn.Linear(width, len(self.modes), bias=False)

    def _weights(self, coordinates: int, rank: int, width: int) -> int:
        bent = coordinates * (1 + len(self.extra_inputs))
        return super()._weights(coordinates, rank, width) + width * (coordinates + bent + rank)

    def _reading(self, rank: int, coordinates: int) -> Reading:
        """Return how linear answers are read: in the basis of the displacement."""
        return Reading(rank, PoissonInterpolation(self.scene.linear).count, own=False)

    def forward(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """See `PODNet.forward`."""
        linear, learnt, local = self._parts(force, poisson)
        if not local.any():
            return self.field(linear + learnt, force)
        moved = self.field(torch.where(local[:, None], learnt, linear + learnt), force)
        exact = _Respond.apply(force[local][:, self.acting].double(), self)
        exact = self.rests.between(exact, None if poisson is None else poisson[local])
        return moved.index_add(0, local.nonzero()[:, 0], self._fields(exact, self.moving).to(moved))

    def within(self, force: Tensor, poisson: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return answers within the basis (B, N, D), and of which loads it misses too much, (B,).

        Where it does not, they are those of `forward`; where it does, a factor of K(0) is wanted.
        """
        linear, learnt, local = self._parts(force, poisson)
        return self.field(linear + learnt, force), local

    def _parts(self, force: Tensor, poisson: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return coordinates (B, R) of linear answer and rest, and which loads are local, (B,)."""
        seen = self.inlet.seen(force)
        linear = self.reading(seen, poisson)
        learnt = self.learnt(self.beside(linear @ self.scaled, poisson))
        return linear, learnt, self._local(seen, linear, poisson)

    def reading(self, seen: Tensor, poisson: Tensor | None) -> Tensor:
        """See `PODNet.reading`; coordinates of the linear answer."""
        read = (seen @ self.readers.to(seen)).unflatten(2, (self.rests.count, -1))
        returns = self.returns.to(seen)
        every = [turned_back(one, returns) for one in read.unbind(2)]
        return self.rests.between(torch.cat(every, dim=1), poisson)

    def missed(self, seen: Tensor, poisson: Tensor | None) -> Tensor:
        """Return about what squares the basis misses of linear answers, (B,).

        The mean square of the products of what it misses with random fields and all their images,
        so that a load and its images are told alike.

        Args:
            seen: Images of the loads at the inlet, (B, G, n' D).
            poisson: Poisson's ratios, (B, P) [-].
        """
        met = (seen @ self.probers.to(seen)).unflatten(2, (-1, len(self.pairs)))  # (B, G, K F, G)
        met = met.movedim(1, 2).flatten(2)[..., self.pairs].sum(dim=3)
        return self.rests.between(met.flatten(1), poisson).square().mean(dim=1)

    def _local(self, seen: Tensor, linear: Tensor, poisson: Tensor | None) -> Tensor:
        """Return of which loads the basis misses too much, (B,).

        Args:
            seen: Their images at the inlet, (B, G, n' D).
            linear: Coordinates of their linear answers, (B, R).
            poisson: Poisson's ratios, (B, P) [-].
        """
        missed = self.missed(seen, poisson)
        return missed >= self.linear_tol**2 * (linear.square().sum(dim=1) + missed)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (..., R) of the nonlinear part from inputs (..., M), see `PODNet`."""
        x, beside = inputs.tensor_split([self.scaled.shape[1]], dim=-1)
        square = x.square().sum(dim=-1, keepdim=True)
        bent = torch.cat([x, *(x * one[..., None] for one in beside.unbind(-1))], dim=-1)
        curved = self.spread * self.product(self.left(x) * self.right(bent))
        return curved / (1 + square) + (square / (1 + square)) ** 1.5 * super().network(inputs)

    def skipped_work(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        lines = super().skipped_work()
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

    def fit_bases(self, samples: Sample, unit: float) -> None:
        """Make the basis; see `PODNet.fit_bases`."""
        self.unit.fill_(unit)
        force, displacement = self._columns(samples)
        linear = self.linear(force, samples.poisson, rtol=1e-12)
        size = displacement.norm(dim=1)
        weight = torch.where(size > 0, size.clamp(min=1e-12) ** -0.5, 0.0)
        parts = [weight[:, None] * linear, weight[:, None] * (displacement - linear)]
        basis = self._modes(torch.cat(parts), self.moving, len(self.modes))
        # its coordinates in the order of what they have of the rests
        rests = parts[1] @ basis
        basis = basis @ torch.linalg.eigh(rests.T @ rests)[1].flip(1)
        motions = self._motions(basis, self.moving)
        self._scale(linear @ basis, (displacement - linear) @ basis, weight, motions)
        self._turn(motions, motions)
        basis = padded(basis, len(self.modes))
        self._set_modes(basis)
        members = range(self.rests.count)
        read = [self._read(self._reach(basis.T, k)) for k in members]
        self.readers.copy_(torch.cat(read).T)
        fields = self._probing(basis)
        probed = [self._fields(self._reach(fields, k).T, self.acting) for k in members]
        images = self.inlet.seen(torch.cat(probed).to(self.probers.device)) * self.inlet.share
        self.probers.copy_(images.flatten(0, 1).T)
        self.prepared.fill_(True)

    def _reach(self, fields: Tensor, k: int) -> Tensor:
        """Return K(0)^-1 of fields (S, outputs) where loads act, (inputs, S); see `respond`."""
        acting = self.acting.cpu()[self.moving.cpu()]
        return self._respond_all(fields, k, rtol=1e-12)[:, acting].T

    def _probing(self, basis: Tensor) -> Tensor:
        """Return random fields less what a basis (outputs, R) has of them, (F, outputs)."""
        random = torch.Generator().manual_seed(0)
        count = self.probers.shape[1] // (len(self.turns) * self.rests.count)
        fields = torch.randn(count, len(basis), generator=random, dtype=torch.float64)
        return fields - (fields @ basis) @ basis.T

    def _scale(self, read: Tensor, targets: Tensor, weight: Tensor, motions: Tensor) -> None:
        def spread(columns: Tensor) -> Tensor:
            """Return mean products of coordinates (S, C) over all images, (C, C)."""
            return (motions.mT @ (columns.T @ columns / len(columns)) @ motions).mean(dim=0)

        values, axes = (
            found.flip(-1) for found in torch.linalg.eigh(spread(weight[:, None] * read))
        )
        count = min(self.scaled.shape[1], len(values))
        gaps = -values.diff()
        while 0 < count < len(values) and gaps[count - 1] < SAME * values[count - 1]:
            count -= 1  # a cluster of eigenvalues is kept whole or not at all
        axes = padded(axes[:, :count], self.scaled.shape[1])
        size = ((axes.T @ spread(read)) * axes.T).sum(dim=1).clamp(min=0).sqrt()
        self.scaled.zero_()[: len(axes)] = (axes / partial_whitening(size)).to(self.scaled)
        size = root_mean_square(targets)
        self.spread.zero_()[: len(size)] = (size * size.max()).sqrt().to(self.spread)

    def _split(self, samples: Sample) -> tuple[Tensor, Tensor, Tensor]:
        """See `PODNet._split`; of the linear answer the basis has its part, unless it is exact."""
        seen = self.inlet.seen(samples.force)
        linear, whole = self.reading(seen, samples.poisson), self.coordinates(samples.displacement)
        missed = projection_error(samples.displacement, whole)
        local = self._local(seen, linear, samples.poisson)
        if local.any():
            acting = samples.force[local][:, self.acting]
            exact = self._fields(self.linear(acting, samples.poisson[local]), self.moving)
            beyond = samples.displacement[local] - exact
            missed[local] = projection_error(beyond, self.coordinates(beyond))
        return linear, whole - linear, missed

    def linear(self, acting: Tensor, poisson: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return linear answers (S, outputs) of forces on the inputs (S, inputs), scaled."""
        parts = zip(acting.split(256), poisson.split(256), strict=True)
        return torch.cat([self.rests.between(self.respond(some, rtol), nu) for some, nu in parts])

    def respond(self, acting: Tensor, rtol: float = RESPONSE) -> Tensor:
        """Return K(0)^-1 f, scaled: (B, K outputs) of forces on the inputs (B, inputs), float64.

        At each of the K Poisson's ratios of `rests`; where the law has one, K = 1.
        """
        every = acting.new_zeros(len(acting), int(self.moving.sum()))
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
