"""A network between few coordinates: those of the load, and those of the displacement in a basis.

The basis comes from the training samples (`prepare`) and is kept in the network's buffers.
"""

from typing import cast

import torch
from torch import Tensor, nn

from dpl.fem.pod import LARGE, pod
from dpl.fem.symmetry import images, symmetries
from dpl.models.coordinates import Coordinates, CoordinateSamples
from dpl.models.moduli import placed
from dpl.scene import Sample, Scene

SNAPSHOTS = 16_000  # images of samples that make a basis, at most


class Block(nn.Module):
    """x + B gelu(A x): a residual block."""

    def __init__(self, width: int) -> None:
        """Build it, close to the identity."""
        super().__init__()
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)
        with torch.no_grad():
            self.outer.weight.mul_(0.1)
            self.outer.bias.zero_()

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, W) of (B, W)."""
        return cast(Tensor, x + self.outer(nn.functional.gelu(self.inner(x))))


class PODNet(nn.Module):
    """POD basis of the displacements, a residual network from coordinates of the load to its own.

    The load is read in the POD basis of the training loads. Where the body has symmetries, both
    bases are invariant under them, and the answer to a load is the mean over its images, each
    turned back: it has the symmetries exactly.

    Source: Hesthaven, Ubbiali (2018), Non-intrusive reduced order modeling of nonlinear problems
    using neural networks, J. Comput. Phys. 363.

    Attributes:
        basis: Rows are the modes of the displacement, orthonormal, (R, outputs).
        read: From forces on the inputs to coordinates of the load, (inputs, C).
        scaled: From those to the inputs of the network, (C, M).
        spread: Size of each output of the network, (R,).
        prepared: Whether the bases are there, ().
    """

    acting: Tensor
    moving: Tensor
    acting_places: Tensor
    moving_places: Tensor
    basis: Tensor
    read: Tensor
    scaled: Tensor
    spread: Tensor
    turns: Tensor
    returns: Tensor
    prepared: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        rank: int = 100,
        coordinates: int = 60,
        width: int = 256,
        blocks: int = 4,
        symmetry: bool = True,
    ) -> None:
        """Build the network; its bases are zero until `prepare`.

        Args:
            scene: What it is to answer.
            rank: Modes of the displacement, R; fewer where the body moves in fewer ways.
            coordinates: Inputs of the network, M; fewer where loads act in fewer ways.
            width: Units in the hidden layers.
            blocks: Residual blocks of two layers.
            symmetry: Find the symmetries of the body and respect them.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        for name, number in {"rank": rank, "coordinates": coordinates, "width": width}.items():
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        if blocks < 0:
            raise ValueError(f"blocks = {blocks} must be 0 or more")
        self.scene = scene
        always = scene.loads.always
        also = [] if always is None else [always]
        self.group = symmetries(scene.problem, also=also) if symmetry else []
        self.register_buffer("acting", scene.loads.reach, persistent=False)
        self.register_buffer("moving", scene.problem.free, persistent=False)
        for name, where in {"acting": self.acting, "moving": self.moving}.items():
            places = where.flatten().nonzero()[:, 0]  # faster than a mask
            self.register_buffer(f"{name}_places", places, persistent=False)
        inputs, outputs = len(self.acting_places), len(self.moving_places)
        rank, coordinates = min(rank, outputs), min(coordinates, inputs)
        members = max(1, len(self.group))
        width_of_reading = self._reading(rank, coordinates)
        coordinates = min(coordinates, width_of_reading)
        self.poisson_range = scene.loads.poisson_range
        self.takes = () if self.poisson_range is None else ("poisson",)
        entering = coordinates + len(self.takes)
        for name, shape in {
            "basis": (rank, outputs),
            "read": (inputs, width_of_reading * self._readings(scene)),
            "scaled": (width_of_reading, coordinates),
            "spread": (rank,),
            "turns": (members, entering, entering),
            "returns": (members, rank, rank),
        }.items():
            self.register_buffer(name, torch.zeros(shape))
        self.register_buffer("prepared", torch.tensor(False))
        self.enter = nn.Linear(entering, width)
        self.blocks = nn.Sequential(*(Block(width) for _ in range(blocks)))
        self.leave = nn.Linear(width, rank)

    def _reading(self, rank: int, coordinates: int) -> int:
        """Return how many coordinates of a load are read, C."""
        return coordinates

    def _readings(self, scene: Scene) -> int:
        """Return of how many Poisson's ratios a load is read, see `combined`."""
        return 1

    def forward(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: What acts.
            poisson: Poisson's ratios, (B, 1) [-]; wanted where the law has a range of them.
        """
        read = self.combined(self.entering(force) @ self.read, poisson)
        inputs = self.beside(read @ self.scaled, poisson)
        return self.leaving(self.learnt(inputs) @ self.basis, force)

    def beside(self, inputs: Tensor, poisson: Tensor | None) -> Tensor:
        """Return inputs (B, M) with the place of Poisson's ratio, where there is a range."""
        if self.poisson_range is None:
            return inputs
        return torch.cat([inputs, placed(poisson, self.poisson_range, inputs)], dim=1)

    def combined(self, read: Tensor, poisson: Tensor | None) -> Tensor:
        """Return coordinates (B, C) of a load from those read at several Poisson's ratios."""
        return read

    def entering(self, force: Tensor) -> Tensor:
        """Return the forces on the inputs, (B, inputs), of (B, N, D)."""
        return force.flatten(1).index_select(1, self.acting_places)

    def leaving(self, moved: Tensor, force: Tensor) -> Tensor:
        """Return displacements (B, outputs) as a field like the force, (B, N, D)."""
        field = moved.new_zeros(len(force), force[0].numel())
        return field.index_copy(1, self.moving_places, moved).view_as(force)

    def learnt(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of the displacement from inputs (B, M).

        In evaluation the mean over the symmetries; in training the network alone, which meets
        images as samples.
        """
        if self.training or len(self.turns) == 1:
            return self.network(inputs)
        turned = torch.einsum("bm,gmk->bgk", inputs, self.turns)
        answers = self.network(turned.flatten(0, 1)).unflatten(0, turned.shape[:2])
        return answers.flatten(1) @ self.returns.flatten(0, 1) / len(self.turns)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) from inputs (B, M), without symmetry."""
        hidden = nn.functional.gelu(self.blocks(self.enter(inputs)))
        return cast(Tensor, self.spread * self.leave(hidden))

    def plan(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        rank, outputs = self.basis.shape
        lines = [f"{rank} coordinates learnt instead of {outputs} displacements"]
        if len(self.turns) > 1:
            lines.append(f"nothing learnt {len(self.turns)} times: the answer has the symmetries")
        return lines

    # ------------------------------------------------------------------ bases

    def prepare(self, samples: Sample, unit: float) -> None:
        """Make the bases.

        Args:
            samples: Scaled, (S, N, D), float64.
            unit: Scale of forces over that of displacements: K(0)^-1 f in scaled fields is this
                times that of dimensionless ones.
        """
        force, displacement = self._columns(samples)
        weight = displacement.norm(dim=1).clamp(min=1e-12) ** -0.5
        weight = weight * (displacement.norm(dim=1) > 0)
        basis = self._modes(weight[:, None] * displacement, self.moving, len(self.basis))
        loads = self._modes(weight[:, None] * force, self.acting, self.read.shape[1])
        self.basis.copy_(basis.T)
        self.read.copy_(loads)
        motions = self._motions(loads, self.acting)
        self._scale(force @ loads, displacement @ basis, weight, motions)
        self._turn(motions, self._motions(basis, self.moving))
        self.prepared.fill_(True)

    def _scale(self, read: Tensor, targets: Tensor, weight: Tensor, motions: Tensor) -> None:
        """Set sizes from the coordinates of all samples, (S, C) and (S, R), and their weights.

        Args:
            read: Coordinates of the loads.
            targets: Coordinates of the displacements.
            weight: Of the samples, (S,).
            motions: What symmetries do to coordinates of loads, (G, C, C).
        """
        size = root_mean_square(read)
        self.scaled.copy_(torch.diag(1 / evened(size)))
        size = root_mean_square(targets)
        self.spread.copy_((size * size.max()).sqrt())

    def _turn(self, loads: Tensor, basis: Tensor) -> None:
        """Set what symmetries do to inputs and outputs, from what they do to coordinates."""
        scaled = self.scaled.cpu().double()
        count = scaled.shape[1]
        self.turns.copy_(torch.eye(self.turns.shape[1]).expand_as(self.turns))
        self.turns[:, :count, :count] = (torch.linalg.pinv(scaled) @ loads @ scaled).to(self.turns)
        self.returns.copy_(basis.mT)

    def _columns(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return forces on the inputs (S, inputs) and displacements (S, outputs)."""
        return samples.force[:, self.acting.cpu()], samples.displacement[:, self.moving.cpu()]

    def _modes(self, snapshots: Tensor, where: Tensor, rank: int) -> Tensor:
        """Return POD modes (n, rank), zero beyond the rank of the snapshots (S, n).

        Images of the snapshots under the symmetries count as snapshots.
        """
        members = max(1, len(self.group))
        stride = -(-len(snapshots) * members // SNAPSHOTS)
        some = snapshots[::stride]
        some = some.float() if members * len(some) > LARGE else some
        every = torch.cat([self._image(some, where, k) for k in range(members)])
        found = self._invariant(pod(every, min(rank, *every.shape)).vectors.double(), where)
        seen = every @ found.to(every.dtype)
        found = found @ torch.linalg.eigh((seen.T @ seen).double())[1].flip(1)  # largest first
        return nn.functional.pad(found, (0, rank - found.shape[1]))

    def _invariant(self, modes: Tensor, where: Tensor) -> Tensor:
        """Return a basis (n, r) of what symmetries map onto itself of the span of modes (n, rank).

        Where the last modes are some of a family whose others were cut off, they go too.
        """
        members = len(self.group)
        if members < 2:
            return modes
        every = torch.cat([self._image(modes.T, where, k) for k in range(members)]).T
        q, r = torch.linalg.qr(every)
        shares, vectors = torch.linalg.eigh(r @ r.T / members)  # of images in each direction
        kept = vectors[:, shares > 3 / 4].flip(1)[:, : modes.shape[1]]
        if not kept.shape[1]:
            raise ValueError(
                f"{modes.shape[1]} modes end amid a family that the body's symmetries mix; take a "
                "larger rank and more coordinates, or symmetry=false"
            )
        return q @ kept

    def _image(self, columns: Tensor, where: Tensor, k: int) -> Tensor:
        """Return fields (S, n) on some degrees of freedom as their images under a symmetry."""
        if k == 0:
            return columns
        where = where.cpu()
        field = columns.new_zeros(len(columns), *where.shape)
        field[:, where] = columns
        return images(field, self.group, torch.full((len(field),), k))[:, where]

    def _motions(self, basis: Tensor, where: Tensor) -> Tensor:
        """Return what each symmetry does to coordinates in a basis (n, r): c -> c T, (G, r, r)."""
        members = range(max(1, len(self.group)))
        return torch.stack([self._image(basis.T, where, k) @ basis for k in members])

    def encode(self, samples: Sample) -> CoordinateSamples:
        """Return scaled samples (S, N, D), float64, in coordinates."""
        force, displacement = self._columns(samples)
        read, targets, missed = self._split(force, displacement, samples.poisson)
        coordinates = Coordinates(
            inputs=self.beside(read @ self.scaled.cpu().double(), samples.poisson).float(),
            targets=targets.float(),
            rest=missed.clamp(min=0),
            size=displacement.square().sum(1) / self.acting.numel(),
        )
        return CoordinateSamples(coordinates, self.turns.cpu(), self.returns.mT.cpu())

    def _split(
        self, force: Tensor, displacement: Tensor, poisson: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what of samples is read, to be learnt, and out of reach.

        Args:
            force: On the inputs, (S, inputs), float64.
            displacement: (S, outputs), float64.
            poisson: Poisson's ratios, (S, P) [-].

        Returns:
            Coordinates of the loads (S, C), of what the network is to answer (S, R), and squares of
            what the basis misses (S,).
        """
        basis, reading = self.basis.cpu().double(), self.read.cpu().double()
        targets = displacement @ basis.T
        missed = displacement.square().sum(dim=1) - targets.square().sum(dim=1)
        return self.combined(force @ reading, poisson), targets, missed


def evened(size: Tensor) -> Tensor:
    """Return what coordinates of sizes (n,) are divided by, (n,).

    Between whitened and as they are: small ones matter less, but not nothing, and rounding least.
    """
    largest = size.max().clamp(min=1e-30)
    return (size**0.6 * largest**0.4).clamp(min=1e-3 * float(largest))


def root_mean_square(columns: Tensor) -> Tensor:
    """Return the size of each column of (S, n), (n,)."""
    return columns.square().mean(dim=0).sqrt()
