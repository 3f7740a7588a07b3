"""POD network: a residual network from coordinates of the load to those of the displacement.

The bases are fitted to the training samples (`fit_bases`) and stored in buffers of the network.
"""

from typing import cast

import torch
from torch import Tensor, nn

from dpl.fem import SubspaceNewton, symmetries
from dpl.models.invariant_basis import (
    group_actions,
    invariant_pod,
    orthonormal_fields,
    pad_columns,
    scatter_fields,
)
from dpl.models.linear_base import Base
from dpl.models.precision import full_precision
from dpl.models.reduced_samples import (
    ReducedDataset,
    ReducedSamples,
    squared_projection_error,
)
from dpl.models.scalar_inputs import ScalarInputs
from dpl.models.symmetric_fields import Orbits, coordinates_of_images, sum_over_images
from dpl.models.whitening import partial_whitening, root_mean_square
from dpl.scene import Sample, Scene
from dpl.system.memory import refuse_weights

CHUNK = 256  # samples that are encoded at a time
MAX_BLOCKS = 1000
CELL_STATES = 256  # states at which the cells of hyper-reduction are chosen


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
    """Residual network from POD coordinates of loads to POD coordinates of displacements.

    The bases are those of the training loads and displacements, or with a linear base of linear
    solutions and of what has to be added to them. If the body has symmetries, both bases are
    invariant under them, and the prediction is the mean over all images of the load, each
    transformed back. It then has the symmetries exactly. Training in coordinates takes the output
    of the network alone, since `encode` adds the images as samples of their own.

    `torch.autocast` applies to the layers of the network only. Projections to and from the bases
    keep the precision of their fields.

    Source: Hesthaven, Ubbiali (2018), Non-intrusive reduced order modeling of nonlinear problems
    using neural networks, J. Comput. Phys. 363.

    Attributes:
        group: The symmetries, identity first; empty without symmetry.
        modes: Orthonormal modes of the displacement at the representatives of `Orbits`, (R, n D).
        load_basis: Map from forces at the representatives to coordinates of loads, (n' D, M).
        inverse_load_actions: T_g^-1 of coordinates of loads, see `Orbits`, (G, M, M).
        input_map: Map from coordinates of loads to inputs of the network, (M, M).
        output_scale: Scale of each output of the network, (R,).
        input_actions: T_g of inputs, (G, M, M).
        inverse_output_actions: T_g^-1 of coordinates of displacements, (G, R, R).
        fitted: True after `fit_bases`, ().
    """

    load_dofs: Tensor
    free_dofs: Tensor
    modes: Tensor
    load_basis: Tensor
    inverse_load_actions: Tensor
    input_map: Tensor
    output_scale: Tensor
    input_actions: Tensor
    inverse_output_actions: Tensor
    fitted: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        rank: int = 100,
        coordinates: int = 60,
        width: int = 256,
        blocks: int = 4,
        symmetry: bool = True,
        base: Base = "none",
    ) -> None:
        """Build the network; its bases are zero until `fit_bases`.

        Args:
            scene: The scene to predict.
            rank: Number of modes of the displacement, R; at most the free degrees of freedom.
            coordinates: Number of inputs of the network, M; at most the loaded degrees of freedom.
            width: Units of the hidden layers.
            blocks: Number of residual blocks, each of two layers.
            symmetry: Find the symmetries of the body and build them into the network.
            base: "linear" for the nonlinear displacement as output, see `LinearBase`.

        Raises:
            ValueError: A number is out of range, or there is no such base.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        for name, number in {"rank": rank, "coordinates": coordinates, "width": width}.items():
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        if not 0 <= blocks <= MAX_BLOCKS:
            raise ValueError(f"blocks = {blocks} must be 0 or more and at most {MAX_BLOCKS}")
        self.scene, self.base = scene, base
        self.scalars = ScalarInputs(scene, base)
        self.extra_inputs = self.scalars.names
        constant = scene.loads.constant_force
        also = [] if constant is None else [constant]
        self.group = symmetries(scene.problem, also=also) if symmetry else []
        read = scene.problem.free if base == "linear" else scene.loads.loadable_dofs
        self.register_buffer("load_dofs", read, persistent=False)
        self.register_buffer("free_dofs", scene.problem.free, persistent=False)
        self.input_orbits = Orbits(self.group, self.load_dofs)
        self.output_orbits = Orbits(self.group, self.free_dofs)
        rank = min(rank, int(self.free_dofs.sum()))
        coordinates = min(coordinates, int(self.load_dofs.sum()))
        inputs = coordinates + self.scalars.count
        weights = width * (inputs + 1) + (width + 1) * rank + 2 * blocks * width * (width + 1)
        refuse_weights(weights, None, "take a smaller model.width or model.blocks")
        self._register_bases(rank, coordinates)
        self.enter = nn.Linear(self.input_actions.shape[1], width)
        self.blocks = nn.Sequential(*(Block(width) for _ in range(blocks)))
        self.leave = nn.Linear(width, rank)

    def _register_bases(self, rank: int, coordinates: int) -> None:
        """Register the buffers of the bases, filled with zeros."""
        members, inputs = max(1, len(self.group)), coordinates + self.scalars.count
        for name, shape in {
            "modes": (rank, len(self.output_orbits.weights)),
            "load_basis": (len(self.input_orbits.weights), coordinates),
            "inverse_load_actions": (members, coordinates, coordinates),
            "input_map": (coordinates, coordinates),
            "output_scale": (rank,),
            "input_actions": (members, inputs, inputs),
            "inverse_output_actions": (members, rank, rank),
        }.items():
            self.register_buffer(name, torch.zeros(shape))
        self.register_buffer("fitted", torch.tensor(False))

    @property
    def is_fitted(self) -> bool:
        """See `TrainsInCoordinates`."""
        return bool(self.fitted)

    @property
    def is_symmetric(self) -> bool:
        """See `TrainsInCoordinates`."""
        return bool(self.group)

    def forward(
        self, force: Tensor, parameters: Tensor | None = None, amplitude: Tensor | None = None
    ) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: Scaled nodal forces, or scaled linear solutions with a linear base.
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.
            amplitude: Amplitudes of the linear solutions, (B,); required with a linear base.
        """
        with full_precision(force.device.type):
            encoded = self.encode_loads(self.input_orbits.images(force))
            inputs = self.append_scalars(encoded @ self.input_map, parameters, amplitude)
        return self.field(self.symmetrised_output(inputs), force)

    def encode_loads(self, images: Tensor) -> Tensor:
        """Return coordinates (B, M) of loads from their images, (B, G, n' D)."""
        read = images @ self.load_basis.to(images)
        return sum_over_images(read, self.inverse_load_actions.to(images))

    def append_scalars(
        self, inputs: Tensor, parameters: Tensor | None, amplitude: Tensor | None
    ) -> Tensor:
        """Return inputs (B, M) with the numbers of `ScalarInputs`, if there are any."""
        if not self.scalars.count:
            return inputs
        return torch.cat([inputs, self.scalars(inputs, amplitude, parameters)], dim=1)

    def field(self, coordinates: Tensor, like: Tensor) -> Tensor:
        """Return displacements (B, N, D), shaped like `like`, of coordinates (B, R)."""
        with full_precision(coordinates.device.type):
            every = coordinates_of_images(coordinates, self.inverse_output_actions.to(coordinates))
            return self.output_orbits.field(every @ self.modes.to(coordinates), like)

    def coordinates(self, displacement: Tensor) -> Tensor:
        """Return the coordinates (B, R) of displacements (B, N, D)."""
        modes = (self.modes * self.output_orbits.weights).to(displacement)
        projected = self.output_orbits.images(displacement) @ modes.T
        return sum_over_images(projected, self.inverse_output_actions.to(displacement))

    def symmetrised_output(self, inputs: Tensor) -> Tensor:
        """Return the mean over the images of the load of the coordinates (B, R), from (B, M)."""
        if len(self.input_actions) == 1:
            return self.network(inputs)
        with full_precision(inputs.device.type):
            images = (inputs @ self.input_actions).movedim(0, 1)
        outputs = self.network(images)
        with full_precision(inputs.device.type):
            return sum_over_images(outputs, self.inverse_output_actions) / len(self.input_actions)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (..., R) from inputs (..., M), without symmetrisation."""
        hidden = nn.functional.gelu(self.blocks(self.enter(inputs)))
        return cast(Tensor, self.output_scale * self.leave(hidden))

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line each."""
        rank, outputs, members = len(self.modes), int(self.free_dofs.sum()), len(self.input_actions)
        lines = [f"{rank} coordinates learnt instead of {outputs} displacements"]
        if members > 1:
            lines.append(f"no learning of {members} symmetries: they are built into the network")
        return lines

    # ------------------------------------------------------------------ bases

    def fit_bases(self, samples: Sample) -> None:
        """Compute the bases; see `TrainsInCoordinates`."""
        force, displacement = self._columns(samples)
        size = displacement.norm(dim=1)
        weight = size.clamp(min=1e-12) ** -0.5 * (size > 0)
        snapshots = weight[:, None] * displacement
        modes = invariant_pod(snapshots, self.free_dofs, self.group, len(self.modes))
        count = self.load_basis.shape[1]
        loads = invariant_pod(weight[:, None] * force, self.load_dofs, self.group, count)
        modes = pad_columns(modes, len(self.modes))
        loads = pad_columns(loads, count)
        self._set_modes(modes)
        self.load_basis.copy_(self._load_functionals(loads).T)
        actions = group_actions(loads, self.load_dofs, self.group)
        self._set_scales(force @ loads, displacement @ modes)
        self.inverse_load_actions.copy_(actions.mT)
        self._set_actions(actions, group_actions(modes, self.free_dofs, self.group))
        self.fitted.fill_(True)

    def _set_modes(self, modes: Tensor) -> None:
        """Store modes (outputs, R)."""
        fields = scatter_fields(modes.T, self.free_dofs).to(self.modes.device)
        self.modes.copy_(self.output_orbits.at_representatives(fields))

    def _load_functionals(self, columns: Tensor) -> Tensor:
        """Return functionals of forces at the representatives, (M, n' D), from (inputs, M)."""
        fields = scatter_fields(columns.T, self.load_dofs).to(self.load_basis.device)
        weights = self.input_orbits.weights.to(fields)
        return self.input_orbits.at_representatives(fields) * weights

    @property
    def basis(self) -> Tensor:
        """The modes of the displacement at all free degrees of freedom, (R, outputs)."""
        like = self.modes.new_zeros(len(self.modes), *self.free_dofs.shape)
        fields = self.field(torch.eye(len(self.modes)).to(self.modes), like)
        return fields[:, self.free_dofs]

    def galerkin(self, states: Tensor, *, rank: int, tolerance: float) -> SubspaceNewton:
        """Return Newton's method in the first modes; see `Correctable`.

        Args:
            states: Equilibrium displacements, (S, N, D) [-]; cells are chosen at the first 256.
            rank: Number of modes.
            tolerance: Tolerance of the choice of cells, see `dpl.fem.rom.ecsw`.

        Raises:
            ValueError: A number is out of range.
        """
        problem = self.scene.problem
        vectors = orthonormal_fields(self.basis[:rank].T, problem.free)
        return SubspaceNewton.within(problem, vectors, states[:CELL_STATES], tolerance=tolerance)

    def _set_scales(self, encoded: Tensor, targets: Tensor) -> None:
        """Set the input map and the output scale.

        Args:
            encoded: Coordinates of the training loads, (S, M).
            targets: Coordinates of the training displacements, (S, R).
        """
        self.input_map.copy_(torch.diag(1 / partial_whitening(root_mean_square(encoded))))
        size = root_mean_square(targets)
        self.output_scale.copy_((size * size.max()).sqrt())

    def _set_actions(self, loads: Tensor, modes: Tensor) -> None:
        """Set the actions on inputs and outputs from those on coordinates of loads and modes."""
        input_map = self.input_map[: loads.shape[1]].cpu().double()
        count, rank = input_map.shape[1], modes.shape[1]
        actions = torch.linalg.pinv(input_map) @ loads @ input_map
        self.input_actions.copy_(
            torch.eye(self.input_actions.shape[1]).expand_as(self.input_actions)
        )
        self.input_actions[:, :count, :count] = actions.to(self.input_actions)
        self.inverse_output_actions.zero_()[:, :rank, :rank] = modes.mT.to(self.modes)

    def _columns(self, samples: Sample) -> tuple[Tensor, Tensor]:
        """Return forces (S, inputs) and displacements (S, outputs) of samples."""
        force = samples.force[:, self.load_dofs.cpu()]
        return force, samples.displacement[:, self.free_dofs.cpu()]

    # ------------------------------------------------------------------ reduced samples

    def encode(self, samples: Sample, amplitude: Tensor | None = None) -> ReducedDataset:
        """See `TrainsInCoordinates`."""
        displacement = torch.where(self.free_dofs.cpu(), samples.displacement, 0.0)
        samples = samples._replace(displacement=displacement)
        columns = [*samples, torch.ones_like(samples.young) if amplitude is None else amplitude]
        device = self.output_scale.device
        chunks = zip(*(column.split(CHUNK) for column in columns), strict=True)
        encoded = [self._encode_chunk(*(column.to(device) for column in one)) for one in chunks]
        whole = ReducedSamples(*map(torch.cat, zip(*encoded, strict=True)))
        return ReducedDataset(whole, self.input_actions.cpu(), self.inverse_output_actions.mT.cpu())

    def _encode_chunk(self, *columns: Tensor) -> ReducedSamples:
        """Return the reduced samples of the columns of samples and their amplitudes."""
        samples, amplitude = Sample(*columns[:-1]), columns[-1]
        targets = self.coordinates(samples.displacement)
        error = squared_projection_error(samples.displacement, targets)
        read = self.encode_loads(self.input_orbits.images(samples.force))
        inputs = self.append_scalars(read @ self.input_map.to(read), samples.parameters, amplitude)
        square = samples.displacement.flatten(1).square().sum(1)
        encoded = ReducedSamples(
            inputs=inputs.float(),
            targets=targets.float(),
            squared_error=error.clamp(min=0),
            mean_square=square / self.free_dofs.numel(),
            factor=torch.ones_like(square),
        )
        return ReducedSamples(*(column.cpu() for column in encoded))
