"""Linear solution plus a network for the nonlinear part of the displacement."""

import copy
from functools import reduce
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.fem.symmetry import products
from dpl.models.invariant_basis import (
    group_actions,
    invariant_pod,
    pad_columns,
    scatter_fields,
)
from dpl.models.pod import LoadEncoding, PODNet
from dpl.models.poisson_interpolation import PoissonInterpolation
from dpl.models.reduced_samples import (
    partial_whitening,
    root_mean_square,
    squared_projection_error,
)
from dpl.models.symmetric_fields import sum_over_images
from dpl.scene import Sample, Scene

EIGENVALUE_TOL = 1e-4  # relative gap below which eigenvalues belong to one family
MIN_PROBES = 16  # random fields that estimate the projection residual of a linear solution
LINEAR_RTOL = 1e-6  # relative residual of linear solutions in a prediction


class Latent(PODNet):
    """K(0)^-1 f plus a network for u - K(0)^-1 f, in one basis.

    The error decreases quadratically with the load. The linear part is the projection of the exact
    linear solution onto the basis. The learnt part is a quadratic form of the inputs x, coordinates
    of the linear solution, divided by 1 + |x|^2, plus a network whose output is damped like |x|^3
    for small x. The basis is fitted to the linear solutions and the nonlinear parts of the training
    samples.

    A global basis cannot represent the near field of local loads. If the projection residual of the
    linear solution is too large, the linear part is solved with the factor of K(0). A few random
    fields estimate this residual without a solve (Halko, Martinsson, Tropp, 2011, SIAM Rev. 53,
    section 4.3).

    Attributes:
        linear_tol: Relative projection residual of the linear solution above which a load is local.
        linear_unit: K(0)^-1 f of scaled fields over K(0)^-1 f of dimensionless fields, ().
        probe_matrix: Map from forces at the representatives to products of the projection residual
            with all images of F random fields, at each of K Poisson's ratios, (n' D, K F G).
        group_products: Index of the product of each two symmetries, (G, G).
    """

    linear_unit: Tensor
    probe_matrix: Tensor
    group_products: Tensor

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
        """Build the network.

        Args:
            scene: The scene to predict.
            rank: Number of modes of the displacement, R.
            coordinates: Number of inputs of the network, M.
            width: Units of the hidden layers.
            blocks: Number of residual blocks, each of two layers.
            symmetry: Find the symmetries of the body and build them into the network.
            linear_tol: Relative projection residual of the linear solution above which the linear
                part is solved with the factor of K(0). 0: for all loads; infinity: for none.

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
        self.interpolation = PoissonInterpolation(scene.linear)
        self.register_buffer("linear_unit", torch.tensor(0.0, dtype=torch.float64))
        members = len(self.input_actions)
        columns = self.interpolation.count * -(-MIN_PROBES // members) * members
        self.register_buffer("probe_matrix", torch.zeros(len(self.load_basis), columns))
        group_products = products(self.group) * members + torch.arange(members)
        self.register_buffer("group_products", group_products, persistent=False)
        inputs = self.input_map.shape[1]
        # x, and x nu where nu is an input
        augmented = inputs * (1 + self.input_actions.shape[1] - inputs)
        self.left = nn.Linear(inputs, width, bias=False)
        self.right = nn.Linear(augmented, width, bias=False)
        self.product = nn.Linear(width, len(self.modes), bias=False)

    def _count_parameters(self, coordinates: int, rank: int, width: int) -> int:
        augmented = coordinates * (1 + len(self.extra_inputs))
        bilinear = width * (coordinates + augmented + rank)
        return super()._count_parameters(coordinates, rank, width) + bilinear

    def _load_encoding(self, rank: int, coordinates: int) -> LoadEncoding:
        """Return the sizes of linear solutions in the basis of the displacement."""
        return LoadEncoding(rank, PoissonInterpolation(self.scene.linear).count, own_basis=False)

    def forward(self, force: Tensor, parameters: Tensor | None = None) -> Tensor:
        """See `PODNet.forward`."""
        linear, learnt, local = self._parts(force, parameters)
        if not local.any():
            return self.field(linear + learnt, force)
        predicted = self.field(torch.where(local[:, None], learnt, linear + learnt), force)
        exact = _LinearSolve.apply(force[local][:, self.load_dofs].double(), self)
        exact = self.interpolation.interpolate(
            exact, None if parameters is None else parameters[local]
        )
        exact = scatter_fields(exact, self.free_dofs).to(predicted)
        return predicted.index_add(0, local.nonzero()[:, 0], exact)

    def forward_in_basis(
        self, force: Tensor, parameters: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return displacements (B, N, D) within the basis and a mask of local loads, (B,).

        `forward` returns the same displacements for loads that are not local.
        """
        linear, learnt, local = self._parts(force, parameters)
        return self.field(linear + learnt, force), local

    @property
    def flags_local_loads(self) -> bool:
        """See `FlagsLocalLoads`."""
        return self.linear_tol < torch.inf

    def for_correction(self) -> Self:
        """Return the network with shared weights that solves for the linear part of all loads."""
        net = copy.copy(self)
        net.linear_tol = 0.0
        return net

    def _parts(self, force: Tensor, parameters: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return coordinates of linear and learnt part (B, R), and a mask of local loads, (B,)."""
        images = self.input_orbits.images(force)
        linear = self.encode_loads(images, parameters)
        learnt = self.symmetrised_output(
            self.append_parameters(linear @ self.input_map, parameters)
        )
        return linear, learnt, self._is_local(images, linear, parameters)

    def encode_loads(self, images: Tensor, parameters: Tensor | None) -> Tensor:
        """Return coordinates of linear solutions (B, R); see `PODNet.encode_loads`."""
        read = (images @ self.load_basis.to(images)).unflatten(2, (self.interpolation.count, -1))
        inverse_actions = self.inverse_output_actions.to(images)
        every = [sum_over_images(one, inverse_actions) for one in read.unbind(2)]
        return self.interpolation.interpolate(torch.cat(every, dim=1), parameters)

    def projection_residual_estimate(self, images: Tensor, parameters: Tensor | None) -> Tensor:
        """Return estimates (B,) of the squared projection residuals of linear solutions.

        The estimate is the mean square of the products of the residual with random fields and all
        their images, so that it is the same for a load and its images.

        Args:
            images: Images of the loads at the representatives, (B, G, n' D).
            parameters: Parameters of the law, (B, P).
        """
        products = images @ self.probe_matrix.to(images)
        products = products.unflatten(2, (-1, len(self.group_products)))  # (B, G, K F, G)
        products = products.movedim(1, 2).flatten(2)[..., self.group_products].sum(dim=3)
        return self.interpolation.interpolate(products.flatten(1), parameters).square().mean(dim=1)

    def _is_local(self, images: Tensor, linear: Tensor, parameters: Tensor | None) -> Tensor:
        """Return the mask of loads whose projection residual is too large, (B,).

        Args:
            images: Images of the loads at the representatives, (B, G, n' D).
            linear: Coordinates of the linear solutions, (B, R).
            parameters: Parameters of the law, (B, P).
        """
        residual = self.projection_residual_estimate(images, parameters)
        return residual >= self.linear_tol**2 * (linear.square().sum(dim=1) + residual)

    def network(self, inputs: Tensor) -> Tensor:
        """Return coordinates (..., R) of the nonlinear part from inputs (..., M)."""
        x, extra = inputs.tensor_split([self.input_map.shape[1]], dim=-1)
        square = x.square().sum(dim=-1, keepdim=True)
        augmented = torch.cat([x, *(x * one[..., None] for one in extra.unbind(-1))], dim=-1)
        quadratic = self.output_scale * self.product(self.left(x) * self.right(augmented))
        return quadratic / (1 + square) + (square / (1 + square)) ** 1.5 * super().network(inputs)

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line each."""
        lines = super().skipped_work()
        lines.append("no learning of the linear part: K(0)^-1 f is projected onto the basis")
        if self.linear_tol < torch.inf:
            lines.append(
                "no modes for near fields: where the projection residual of K(0)^-1 f exceeds "
                f"{self.linear_tol:.2g}, the linear part is solved with the factor of K(0)"
            )
        if self.interpolation.count > 1:
            lines.append(
                f"no K(0) for every Poisson's ratio: K(0)^-1 is interpolated between "
                f"{self.interpolation.count} ratios"
            )
        return lines

    def fit_bases(self, samples: Sample, unit: float) -> None:
        """Compute the basis; see `TrainsInCoordinates`."""
        self.linear_unit.fill_(unit)
        force, displacement = self._columns(samples)
        linear = self.linear_solutions(force, samples.parameters, rtol=1e-12)
        size = displacement.norm(dim=1)
        weight = torch.where(size > 0, size.clamp(min=1e-12) ** -0.5, 0.0)
        nonlinear = weight[:, None] * (displacement - linear)
        snapshots = torch.cat([weight[:, None] * linear, nonlinear])
        basis = invariant_pod(snapshots, self.free_dofs, self.group, len(self.modes))
        # order the modes by their share of the nonlinear parts
        coordinates = nonlinear @ basis
        basis = basis @ torch.linalg.eigh(coordinates.T @ coordinates)[1].flip(1)
        actions = group_actions(basis, self.free_dofs, self.group)
        self._set_scales(linear @ basis, (displacement - linear) @ basis, weight, actions)
        self._set_actions(actions, actions)
        basis = pad_columns(basis, len(self.modes))
        self._set_modes(basis)
        self._set_load_functionals(basis)
        self.fitted.fill_(True)

    def _set_load_functionals(self, basis: Tensor) -> None:
        """Set the maps from loads to coordinates and projection residuals of linear solutions."""
        members = range(self.interpolation.count)
        read = [self._load_functionals(self._responses_at_loads(basis.T, k)) for k in members]
        self.load_basis.copy_(torch.cat(read).T)
        fields = self._random_residuals(basis)
        responses = [self._responses_at_loads(fields, k).T for k in members]
        probes = torch.cat([scatter_fields(one, self.load_dofs) for one in responses])
        images = self.input_orbits.images(probes.to(self.probe_matrix.device))
        self.probe_matrix.copy_((images * self.input_orbits.weights).flatten(0, 1).T)

    def _responses_at_loads(self, fields: Tensor, k: int) -> Tensor:
        """Return K(0)^-1 of fields (S, outputs) at the loaded degrees of freedom, (inputs, S)."""
        loaded = self.load_dofs.cpu()[self.free_dofs.cpu()]
        return self._solve(fields, k, rtol=1e-12)[:, loaded].T

    def _random_residuals(self, basis: Tensor) -> Tensor:
        """Return random fields orthogonal to a basis (outputs, R), (F, outputs)."""
        random = torch.Generator().manual_seed(0)
        count = self.probe_matrix.shape[1] // (len(self.input_actions) * self.interpolation.count)
        fields = torch.randn(count, len(basis), generator=random, dtype=torch.float64)
        return fields - (fields @ basis) @ basis.T

    def _set_scales(
        self, encoded: Tensor, targets: Tensor, weight: Tensor, actions: Tensor
    ) -> None:
        """See `PODNet._set_scales`; inputs are principal components of the linear solutions."""

        def covariance(columns: Tensor) -> Tensor:
            """Return the mean products of coordinates (S, C) over all images, (C, C)."""
            return (actions.mT @ (columns.T @ columns / len(columns)) @ actions).mean(dim=0)

        values, axes = (
            found.flip(-1) for found in torch.linalg.eigh(covariance(weight[:, None] * encoded))
        )
        count = min(self.input_map.shape[1], len(values))
        gaps = -values.diff()
        while 0 < count < len(values) and gaps[count - 1] < EIGENVALUE_TOL * values[count - 1]:
            count -= 1  # never split a family of equal eigenvalues
        axes = pad_columns(axes[:, :count], self.input_map.shape[1])
        size = ((axes.T @ covariance(encoded)) * axes.T).sum(dim=1).clamp(min=0).sqrt()
        self.input_map.zero_()[: len(axes)] = (axes / partial_whitening(size)).to(self.input_map)
        size = root_mean_square(targets)
        scale = (size * size.max()).sqrt()
        self.output_scale.zero_()[: len(size)] = scale.to(self.output_scale)

    def _reduce(self, samples: Sample) -> tuple[Tensor, Tensor, Tensor]:
        """See `PODNet._reduce`; the linear part of local loads has no projection error."""
        images = self.input_orbits.images(samples.force)
        linear = self.encode_loads(images, samples.parameters)
        whole = self.coordinates(samples.displacement)
        error = squared_projection_error(samples.displacement, whole)
        local = self._is_local(images, linear, samples.parameters)
        if local.any():
            force = samples.force[local][:, self.load_dofs]
            exact = self.linear_solutions(force, samples.parameters[local])
            nonlinear = samples.displacement[local] - scatter_fields(exact, self.free_dofs)
            error[local] = squared_projection_error(nonlinear, self.coordinates(nonlinear))
        return linear, whole - linear, error

    def linear_solutions(
        self, force: Tensor, parameters: Tensor, rtol: float = LINEAR_RTOL
    ) -> Tensor:
        """Return scaled linear solutions (S, outputs) of forces (S, inputs)."""
        parts = zip(force.split(256), parameters.split(256), strict=True)
        return torch.cat(
            [self.interpolation.interpolate(self.solve_linear(f, rtol), nu) for f, nu in parts]
        )

    def solve_linear(self, force: Tensor, rtol: float = LINEAR_RTOL) -> Tensor:
        """Return scaled K(0)^-1 f at the K nodes of the interpolation, (B, K outputs), float64.

        Args:
            force: Forces on the loaded degrees of freedom, (B, inputs).
            rtol: Relative residual.
        """
        forces = force.new_zeros(len(force), int(self.free_dofs.sum()))
        forces[:, self.load_dofs[self.free_dofs].to(force.device)] = force
        nodes = range(self.interpolation.count)
        return torch.cat([self._solve(forces, k, rtol) for k in nodes], dim=1)

    def _solve(self, forces: Tensor, k: int, rtol: float = LINEAR_RTOL) -> Tensor:
        """Return scaled K(0)^-1 f, (B, outputs), of forces (B, outputs) at node k."""
        factor = self.interpolation.solvers[k].factor
        found = [torch.from_numpy(factor.solve(one.numpy(), rtol)) for one in forces.cpu()]
        return float(self.linear_unit) * torch.stack(found).to(forces.device)


class _LinearSolve(torch.autograd.Function):
    """Scaled K(0)^-1 f; K(0) is symmetric, so the gradient is the same solve."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, net: Latent) -> Tensor:
        """Return solutions (B, K outputs) of forces (B, inputs)."""
        ctx.net = net
        return net.solve_linear(force)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Return the gradient with respect to forces, (B, inputs)."""
        net = ctx.net
        parts = gradient.chunk(net.interpolation.count, dim=1)
        solved = reduce(torch.add, (net._solve(part, k) for k, part in enumerate(parts)))
        return solved[:, net.load_dofs[net.free_dofs]], None
