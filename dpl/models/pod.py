"""A network between few coordinates: those of the load, and those of the displacement in a basis.

The basis comes from the training samples (`fit_bases`) and is kept in the network's buffers.
"""

from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from dpl.fem import PODGalerkin, symmetries
from dpl.fem.rom.pod import LARGE, pod
from dpl.fem.symmetry import images
from dpl.models.poisson_interpolation import normalise_poisson
from dpl.models.reduced_samples import (
    ReducedDataset,
    ReducedOrderNet,
    ReducedSamples,
    partial_whitening,
    projection_error,
    root_mean_square,
)
from dpl.models.symmetric_fields import Orbits, turned, turned_back
from dpl.scene import Sample, Scene
from dpl.system.memory import refuse_weights

SNAPSHOTS = 16_000  # images of samples that make a basis, at most
CHUNK = 256  # samples that are worked on at a time
DEEPEST = 1000  # residual blocks
STATES = 256  # samples at which cells are chosen for corrections


def padded(basis: Tensor, rank: int) -> Tensor:
    """Return a basis (n, r) with columns of zeros behind, (n, rank)."""
    return nn.functional.pad(basis, (0, rank - basis.shape[1]))


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
        """Return (..., W) of (..., W)."""
        return cast(Tensor, x + self.outer(nn.functional.gelu(self.inner(x))))


class Reading(NamedTuple):
    """How loads are read.

    Attributes:
        coordinates: Of a load, C.
        times: How often it is read: once at each of K Poisson's ratios.
        own: Whether it is in a basis of its own, which images turn in, and not in that of the
            displacement.
    """

    coordinates: int
    times: int = 1
    own: bool = True


class PODNet(ReducedOrderNet):
    """POD basis of the displacements, a residual network from coordinates of the load to its own.

    The load is read in the POD basis of the training loads. Where the body has symmetries, both
    bases are invariant under them, and the answer to a load is the mean over its images, each
    turned back: it has the symmetries exactly.

    Source: Hesthaven, Ubbiali (2018), Non-intrusive reduced order modeling of nonlinear problems
    using neural networks, J. Comput. Phys. 363.

    Attributes:
        modes: Of the displacement, orthonormal, at one node of each orbit, (R, n D); see `Orbits`.
        readers: From forces there to coordinates of the load, (n' D, C).
        read_returns: What turns coordinates of an image of a load back, (G, C, C).
        scaled: From them to the inputs of the network, (C, M).
        spread: Size of each output of the network, (R,).
        turns: What symmetries do to inputs, x -> x T, (G, M, M).
        returns: What turns coordinates of the displacement of an image back, (G, R, R).
        prepared: Whether the bases are there, ().
    """

    acting: Tensor
    moving: Tensor
    modes: Tensor
    readers: Tensor
    read_returns: Tensor
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
        """Build the network; its bases are zero until `fit_bases`.

        Args:
            scene: What it is to answer.
            rank: Modes of the displacement, R; fewer where the body moves in fewer ways.
            coordinates: Inputs of the network, M; fewer where loads act in fewer ways.
            width: Units in the hidden layers.
            blocks: Residual blocks of two layers.
            symmetry: Find the symmetries of the body and respect them.

        Raises:
            ValueError: A number is out of range.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        for name, number in {"rank": rank, "coordinates": coordinates, "width": width}.items():
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        if not 0 <= blocks <= DEEPEST:
            raise ValueError(f"blocks = {blocks} must be 0 or more and at most {DEEPEST}")
        self.scene = scene
        always = scene.loads.constant_force
        also = [] if always is None else [always]
        self.group = symmetries(scene.problem, also=also) if symmetry else []
        self.register_buffer("acting", scene.loads.loadable_dofs, persistent=False)
        self.register_buffer("moving", scene.problem.free, persistent=False)
        self.inlet, self.outlet = (Orbits(self.group, w) for w in (self.acting, self.moving))
        inputs, outputs = int(self.acting.sum()), int(self.moving.sum())
        rank, coordinates = min(rank, outputs), min(coordinates, inputs)
        members = max(1, len(self.group))
        reading = self._reading(rank, coordinates)
        read = reading.coordinates
        coordinates = min(coordinates, read)
        self.poisson_range = scene.loads.poisson_range
        self.extra_inputs = () if self.poisson_range is None else ("poisson",)
        entering = coordinates + len(self.extra_inputs)
        weights = self._weights(coordinates, rank, width) + 2 * blocks * width * (width + 1)
        refuse_weights(weights, None, "take a smaller model.width or model.blocks")
        for name, shape in {
            "modes": (rank, len(self.outlet.share)),
            "readers": (len(self.inlet.share), read * reading.times),
            "scaled": (read, coordinates),
            "spread": (rank,),
            "turns": (members, entering, entering),
            "returns": (members, rank, rank),
            **({"read_returns": (members, read, read)} if reading.own else {}),
        }.items():
            self.register_buffer(name, torch.zeros(shape))
        self.register_buffer("prepared", torch.tensor(False))
        self.enter = nn.Linear(entering, width)
        self.blocks = nn.Sequential(*(Block(width) for _ in range(blocks)))
        self.leave = nn.Linear(width, rank)

    def _weights(self, coordinates: int, rank: int, width: int) -> int:
        """Return the parameters outside the residual blocks."""
        return width * (coordinates + len(self.extra_inputs) + 1) + (width + 1) * rank

    def _reading(self, rank: int, coordinates: int) -> Reading:
        """Return how loads are read, for R modes and so many inputs."""
        return Reading(coordinates)

    def forward(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: What acts.
            poisson: Poisson's ratios, (B, 1) [-]; wanted where the law has a range of them.
        """
        read = self.reading(self.inlet.seen(force), poisson)
        inputs = self.beside(read @ self.scaled, poisson)
        return self.field(self.learnt(inputs), force)

    def reading(self, seen: Tensor, poisson: Tensor | None) -> Tensor:
        """Return the coordinates (B, C) of loads, of their images at the inlet (B, G, n' D)."""
        return turned_back(seen @ self.readers.to(seen), self.read_returns.to(seen))

    def beside(self, inputs: Tensor, poisson: Tensor | None) -> Tensor:
        """Return inputs (B, M) with the place of Poisson's ratio, where there is a range."""
        if self.poisson_range is None:
            return inputs
        return torch.cat([inputs, normalise_poisson(poisson, self.poisson_range, inputs)], dim=1)

    def field(self, coordinates: Tensor, like: Tensor) -> Tensor:
        """Return displacements (B, N, D), shaped like forces, of coordinates (B, R)."""
        images = turned(coordinates, self.returns.to(coordinates)) @ self.modes.to(coordinates)
        return self.outlet.whole(images, like)

    def coordinates(self, displacement: Tensor) -> Tensor:
        """Return the coordinates (B, R) of displacements (B, N, D)."""
        modes = (self.modes * self.outlet.share).to(displacement)
        return turned_back(self.outlet.seen(displacement) @ modes.T, self.returns.to(displacement))

    def learnt(self, inputs: Tensor) -> Tensor:
        """Return coordinates (B, R) of the displacement from inputs (B, M).

        In evaluation the mean over the symmetries; in training the network alone, which meets
        images as samples.
        """
        if self.training or len(self.turns) == 1:
            return self.network(inputs)
        answers = self.network((inputs @ self.turns).movedim(0, 1))
        return turned_back(answers, self.returns) / len(self.turns)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (..., R) from inputs (..., M), without symmetry."""
        hidden = nn.functional.gelu(self.blocks(self.enter(inputs)))
        return cast(Tensor, self.spread * self.leave(hidden))

    def skipped_work(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        rank, outputs = len(self.modes), int(self.moving.sum())
        lines = [f"{rank} coordinates learnt instead of {outputs} displacements"]
        if len(self.turns) > 1:
            lines.append(f"nothing learnt {len(self.turns)} times: the answer has the symmetries")
        return lines

    # ------------------------------------------------------------------ bases

    def fit_bases(self, samples: Sample, unit: float) -> None:
        """Make the bases.

        Args:
            samples: Scaled, (S, N, D), float64.
            unit: Scale of forces over that of displacements: K(0)^-1 f in scaled fields is this
                times that of dimensionless ones.
        """
        force, displacement = self._columns(samples)
        weight = displacement.norm(dim=1).clamp(min=1e-12) ** -0.5
        weight = weight * (displacement.norm(dim=1) > 0)
        basis = self._modes(weight[:, None] * displacement, self.moving, len(self.modes))
        loads = self._modes(weight[:, None] * force, self.acting, self.readers.shape[1])
        basis = padded(basis, len(self.modes))
        loads = padded(loads, self.readers.shape[1])
        self._set_modes(basis)
        self.readers.copy_(self._read(loads).T)
        motions = self._motions(loads, self.acting)
        self._scale(force @ loads, displacement @ basis, weight, motions)
        self.read_returns.copy_(motions.mT)
        self._turn(motions, self._motions(basis, self.moving))
        self.prepared.fill_(True)

    def _set_modes(self, basis: Tensor) -> None:
        """Take up the modes, (outputs, R)."""
        fields = self._fields(basis.T, self.moving).to(self.modes.device)
        self.modes.copy_(self.outlet.first(fields))

    def _read(self, columns: Tensor) -> Tensor:
        """Return what reads coordinates of loads at the inlet, (C, n' D), from (inputs, C)."""
        fields = self._fields(columns.T, self.acting).to(self.readers.device)
        return self.inlet.first(fields) * self.inlet.share.to(fields)

    @property
    def basis(self) -> Tensor:
        """The modes of the displacement, whole, (R, outputs)."""
        like = self.modes.new_zeros(len(self.modes), *self.moving.shape)
        fields = self.field(torch.eye(len(self.modes)).to(self.modes), like)
        return fields[:, self.moving]

    def galerkin(self, states: Tensor, *, rank: int, tolerance: float) -> PODGalerkin:
        """Return equilibrium in the first modes, which corrects what the network predicts.

        Args:
            states: Displacements in equilibrium, (S, N, D) [-]; cells are chosen at the first 256.
            rank: Modes.
            tolerance: Of the choice of cells, see `dpl.fem.rom.cubature`.

        Raises:
            ValueError: A number is out of range.
        """
        problem = self.scene.problem
        vectors = torch.zeros(*problem.shape, min(rank, len(self.modes)), dtype=torch.float64)
        vectors[problem.free] = torch.linalg.qr(self.basis[:rank].double().cpu().T)[0]
        return PODGalerkin.within(
            problem, vectors, states[:STATES], tolerance=tolerance, reduced_tol=1e-3
        )

    @staticmethod
    def _fields(columns: Tensor, where: Tensor) -> Tensor:
        """Return fields (S, N, D) of what they are on some degrees of freedom, (S, n)."""
        where = where.to(columns.device)
        fields = columns.new_zeros(len(columns), *where.shape)
        fields[:, where] = columns
        return fields

    def _scale(self, read: Tensor, targets: Tensor, weight: Tensor, motions: Tensor) -> None:
        """Set sizes from the coordinates of all samples, (S, C) and (S, R), and their weights.

        Args:
            read: Coordinates of the loads.
            targets: Coordinates of the displacements.
            weight: Of the samples, (S,).
            motions: What symmetries do to coordinates of loads, (G, C, C).
        """
        size = root_mean_square(read)
        self.scaled.copy_(torch.diag(1 / partial_whitening(size)))
        size = root_mean_square(targets)
        self.spread.copy_((size * size.max()).sqrt())

    def _turn(self, loads: Tensor, basis: Tensor) -> None:
        """Set what symmetries do to inputs and outputs, from what they do to coordinates."""
        scaled = self.scaled[: loads.shape[1]].cpu().double()
        count = scaled.shape[1]
        self.turns.copy_(torch.eye(self.turns.shape[1]).expand_as(self.turns))
        self.turns[:, :count, :count] = (torch.linalg.pinv(scaled) @ loads @ scaled).to(self.turns)
        rank = basis.shape[1]
        self.returns.zero_()[:, :rank, :rank] = basis.mT.to(self.returns)

    def _columns(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return forces on the inputs (S, inputs) and displacements (S, outputs)."""
        return samples.force[:, self.acting.cpu()], samples.displacement[:, self.moving.cpu()]

    def _modes(self, snapshots: Tensor, where: Tensor, rank: int) -> Tensor:
        """Return POD modes (n, r) of snapshots (S, n), r at most `rank` and their number.

        Images of the snapshots under the symmetries count as snapshots.
        """
        members = max(1, len(self.group))
        stride = -(-len(snapshots) * members // SNAPSHOTS)
        some = snapshots[::stride]
        some = some.float() if members * len(some) > LARGE else some
        every = torch.cat([self._image(some, where, k) for k in range(members)])
        found = self._invariant(pod(every, min(rank, *every.shape)).vectors.double(), where)
        seen = every @ found.to(every.dtype)
        return found @ torch.linalg.eigh((seen.T @ seen).double())[1].flip(1)  # largest first

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
        fields = self._fields(columns, where)
        which = torch.full((len(fields),), k)
        return images(fields, self.group, which)[:, where.to(columns.device)]

    def _motions(self, basis: Tensor, where: Tensor) -> Tensor:
        """Return what each symmetry does to coordinates in a basis (n, r): c -> c T, (G, r, r)."""
        members = range(max(1, len(self.group)))
        return torch.stack([self._image(basis.T, where, k) @ basis for k in members])

    def encode(self, samples: Sample) -> ReducedDataset:
        """Return scaled samples (S, N, D), float64, in coordinates."""
        samples = samples._replace(
            displacement=torch.where(self.moving.cpu(), samples.displacement, 0.0)
        )
        device = self.spread.device
        parts = zip(*(column.split(CHUNK) for column in samples), strict=True)
        encoded = [self._encoded(Sample(*(one.to(device) for one in part))) for part in parts]
        whole = ReducedSamples(*map(torch.cat, zip(*encoded, strict=True)))
        return ReducedDataset(whole, self.turns.cpu(), self.returns.mT.cpu())

    def _encoded(self, samples: Sample) -> ReducedSamples:
        read, targets, missed = self._split(samples)
        encoded = ReducedSamples(
            inputs=self.beside(read @ self.scaled.to(read), samples.poisson).float(),
            targets=targets.float(),
            rest=missed.clamp(min=0),
            size=samples.displacement.flatten(1).square().sum(1) / self.acting.numel(),
        )
        return ReducedSamples(*(column.cpu() for column in encoded))

    def _split(self, samples: Sample) -> tuple[Tensor, Tensor, Tensor]:
        """Return what of samples (S, N, D) is read, to be learnt, and out of reach.

        Returns:
            Coordinates of the loads (S, C), of what the network is to answer (S, R), and squares of
            what the basis misses (S,).
        """
        targets = self.coordinates(samples.displacement)
        read = self.reading(self.inlet.seen(samples.force), samples.poisson)
        return read, targets, projection_error(samples.displacement, targets)
