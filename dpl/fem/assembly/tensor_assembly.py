"""Energy, internal force and tangent of a body as batched tensor operations."""

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly import mean_dilatation
from dpl.fem.assembly.boundary_conditions import FoundationMatrix
from dpl.fem.assembly.elements import basis_of
from dpl.fem.assembly.follower_loads import NO_LOADS, FollowerLoads, LoadedPart, Places
from dpl.fem.assembly.mean_dilatation import CellVolumes
from dpl.fem.assembly.recovery import Recovery
from dpl.fem.assembly.rigid_body_modes import rigid_body_modes, unconstrained_modes
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.materials.material import Material
from dpl.fem.materials.tensors import green_lagrange, volume_change
from dpl.fem.units import Units


@dataclass(frozen=True, eq=False)
class TensorAssembly:
    """Hyperelastic body: mesh, material law and boundary conditions.

    All quantities are dimensionless. Methods take displacements (B, N, D) in float64 and return
    tensors on the same device. They are differentiable and contain no Python loop over cells.

    Attributes:
        mesh: Geometry; coordinates relative to `origin`, divided by `length`.
        degree: Polynomial degree of the displacement, 1 or 2.
        material: The law.
        length: L, longest side of the body [m].
        origin: Origin of the coordinates over `length`, (D,) [-]. It is zero unless the body lies
            farther from zero than its size. Nodes are at L (origin + points) [m].
        points: Nodes (N, D) [-], for degree 2 including those of edges, faces and cells.
        cells: Nodes of each cell, (E, A).
        dN: Gradients of the shape functions, (E, Q, A, D) [-]; (1, Q, A, D) if all cells are equal.
        dV: Volumes of the quadrature points, (E, Q) [-]; (1, Q) if all cells are equal.
        free: Mask of the free degrees of freedom, (N, D).
        prescribed: Displacement of the fixed ones at full load, (N, D) [-]; zero where free.
        boundary: Mask of the nodes on the boundary, (N,).
        springs: Elastic foundation (Robin conditions), or None.
        follower_loads: Loads whose forces depend on the displacement: pressures, active stress.
        volume_functions: Functions of the volume change in the cells, (E or 1, Q, M), see
            `CellVolumes`; None without mean dilatation.
        young: Young's modulus by which boundary values are divided [Pa]; None if there is no such
            modulus, see `dpl.fem.units.Units`. No other quantity depends on it.
    """

    mesh: skfem.Mesh
    degree: int
    material: Material
    length: float
    origin: NDArray[np.float64]
    points: Tensor
    cells: Tensor
    dN: Tensor
    dV: Tensor
    free: Tensor
    prescribed: Tensor
    boundary: Tensor
    springs: FoundationMatrix | None = None
    follower_loads: FollowerLoads = NO_LOADS
    volume_functions: Tensor | None = None
    young: float | None = 1.0

    def to(self, device: torch.device | str) -> Self:
        """Return the same body with its tensors on a device."""
        tensors: dict[str, Any] = {
            each.name: value.to(device)
            for each in fields(self)
            if isinstance(value := getattr(self, each.name), Tensor)
        }
        if self.springs is not None:
            tensors["springs"] = FoundationMatrix(*(part.to(device) for part in self.springs))
        return replace(self, **tensors, follower_loads=self.follower_loads.to(device))

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without cached properties."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def basis(self) -> skfem.Basis:
        """scikit-fem's basis of one displacement component."""
        return basis_of(self.mesh, self.degree)

    @property
    def units(self) -> Units:
        """L and E, by which boundary values are divided."""
        return Units(self.length, self.young)

    @property
    def has_one_modulus(self) -> bool:
        """True if the body is divided by one modulus: elastic foundation or follower loads."""
        return self.springs is not None or bool(self.follower_loads)

    def check_modulus(self, young: float) -> None:
        """Check the Young's modulus [Pa] of a load on this body.

        Elastic foundations have a fixed stiffness and follower loads a fixed stress, so that
        their parts in f_int are those of one modulus. Other bodies allow all moduli.

        Raises:
            ValueError: The modulus is not that of the foundation or the follower loads.
        """
        if not self.has_one_modulus or self.young is None or math.isclose(young, self.young):
            return
        part = self.follower_loads.kinds
        part = part if self.springs is None else "stiffness of the elastic foundation"
        raise ValueError(
            f"young = {young:g} must be {self.young:g} [Pa], by which the {part} is divided; "
            f"build another body with young = {young:g}"
        )

    @property
    def mesh_in_metres(self) -> skfem.Mesh:
        """The mesh in the coordinates of the user [m]."""
        return self.mesh.scaled(self.length).translated(self.length * self.origin)

    @property
    def shape(self) -> tuple[int, int]:
        """N and D."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def equal_cells(self) -> bool:
        """True if all cells share one set of gradients."""
        return len(self.dN) == 1

    @property
    def supports_mip(self) -> bool:
        """True if `mixed_system` is available: mixed integration points (MIP)."""
        return self.material.has_response

    @property
    def volumes(self) -> CellVolumes | None:
        """Polynomials of the volume change in the cells; None without mean dilatation."""
        functions = self.volume_functions
        return None if functions is None else CellVolumes(functions, self.dV)

    @property
    def near_null(self) -> NDArray[np.float64]:
        """Near-null space for multigrid: rigid body modes at free degrees of freedom, (n, k)."""
        return rigid_body_modes(self.points)[0][self.free].numpy()

    def unconstrained_rigid_body_modes(self) -> list[str]:
        """Return the names of the rigid body modes that no boundary condition constrains."""
        return unconstrained_modes(self.points, self.free, self.springs)

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the energy over E L^D, (B,) [-]: strain energy, foundation and follower loads.

        The energy of a follower load is its potential only if it has one, see `has_potential`.
        """
        H = self.gradient(displacement)
        if self.volumes is None:
            density = self.material.energy(H)
        else:
            density = mean_dilatation.energy(self.material, H, self.volumes)
        energy = (density * self.dV).sum((-2, -1))
        if self.springs is not None:
            pull = self.springs.force(displacement)
            energy = energy + (pull * displacement).sum((-2, -1)) / 2
        if self.follower_loads:
            energy = energy + self.follower_loads.work(displacement)
        return energy

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return f_int, the gradient of the energy, (B, N, D) [-]; reactions at fixed nodes.

        Follower loads are a part of f_int, because they depend on the displacement.
        """
        forces = self._nodal_forces(self.stress(displacement))
        return self._with_boundary_forces(forces, displacement)

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of K = d f_int / du on `pattern`, (B, nnz) [-].

        If a follower load has no potential, K is the symmetric part.
        """
        H = self.gradient(displacement)
        if self.volumes is None:
            entries = self._assembled(self.material.tangent(H))
        else:
            entries = self._assembled(*mean_dilatation.tangent(self.material, H, self.volumes))
        return self._with_boundary_entries(entries, displacement)[0]

    def strain(self, displacement: Tensor) -> Tensor:
        """Return the Green-Lagrange strain at the quadrature points, (B, E, Q, 3, 3) [-]."""
        return green_lagrange(self.gradient(displacement))

    def quadratic_strain(self, update: Tensor) -> Tensor:
        """Return the quadratic part of the strain of a step, dH^T dH / 2, (B, E, Q, 3, 3) [-]."""
        dH = self.gradient(update)
        return dH.mT @ dH / 2

    def mixed_system(self, displacement: Tensor, gap: Any) -> tuple[Tensor, Tensor]:
        """Return force (B, N, D) and tangent (B, nnz) with mixed integration points (MIP).

        The strain at each quadrature point is an independent unknown, which the point eliminates.
        Stress and moduli are evaluated at the strain of u minus `gap`, (B, E, Q, 3, 3), and the
        stress is extrapolated linearly to the strain of u. With a zero gap the results are
        `internal_force` and `tangent`. With mean dilatation the gap is a `MixedGap`, and volume
        changes and pressures of the cells are unknowns too.

        Source: Magisano, Leonetti, Garcea (2017), CMAME 313, section 3.
        """
        H = self.gradient(displacement)
        parts: tuple[Tensor, ...]
        if self.volumes is None:
            response = self.material.response(green_lagrange(H) - gap)
            S = response.stress + response.product(gap)
            stress, parts = S + H @ S, (response.tangent(H),)
        else:
            stress, parts = mean_dilatation.mixed_system(self.material, H, gap, self.volumes)
        force = self._with_boundary_forces(self._nodal_forces(stress), displacement)
        return force, self._with_boundary_entries(self._assembled(*parts), displacement)[0]

    def tangent_product(self, displacement: Tensor, direction: Tensor) -> Tensor:
        """Return K(u) v on all degrees of freedom without assembling K, (B, N, D) [-]."""
        return torch.func.jvp(self.internal_force, (displacement,), (direction,))[1]

    def volume_ratio(self, displacement: Tensor) -> Tensor:
        """Return min det F over the quadrature points, (B,) [-]; a value <= 0 means inversion."""
        change = volume_change(self.gradient(displacement))
        return 1 + torch.nan_to_num(change, nan=-torch.inf).flatten(1).amin(dim=1)

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        H = self.gradient(displacement)
        if self.volumes is None:
            return self.material.stress(H)
        return mean_dilatation.stress(self.material, H, self.volumes)

    @cached_property
    def force_at_rest(self) -> Tensor:
        """f_int at u = 0: the force of the follower loads on the body at rest, (N, D) [-].

        It is minus the nodal forces of dead loads; zero without follower loads. (B, N, D) if each
        member of a batch has its own stresses.
        """
        forces = self.follower_loads.force(self.points.new_zeros(1, *self.shape))
        return forces[0] if len(forces) == 1 else forces

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity pattern of the tangent."""
        return Pattern.build(self.cells.cpu().numpy(), self.free.cpu().numpy())

    @cached_property
    def recovery(self) -> Recovery:
        """Values at nodes from values at quadrature points; a body of another law shares it."""
        if (twin := self.__dict__.get("_same_mesh")) is not None:
            return twin.recovery
        at = np.asarray(self.basis.global_coordinates()).transpose(1, 2, 0)
        dV = self.dV.expand(len(self.cells), -1)
        points, cells, boundary, volumes = (
            part.cpu().numpy() for part in (self.points, self.cells, self.boundary, dV)
        )
        return Recovery.build(points, cells, boundary, at, volumes, self.degree)

    @cached_property
    def _operator(self) -> Tensor:
        """Gradients as matrices (E, A, Q D), or as one matrix (A, Q D) if all cells are equal."""
        operator = self.dN.transpose(1, 2).flatten(-2).contiguous()
        return operator[0] if self.equal_cells else operator

    def gradient(self, displacement: Tensor) -> Tensor:
        """Return H = du/dX, (B, E, Q, 3, 3) [-]; in 2D padded with zeros."""
        return self._cell_gradient(displacement[:, self.cells].mT)

    def _cell_gradient(self, at_cells: Tensor) -> Tensor:
        """Return H, (B, E, Q, 3, 3) [-], of the displacements of each cell's nodes (B, E, D, A)."""
        dim = self.shape[1]
        gradient = (at_cells @ self._operator).unflatten(-1, (-1, dim))  # (B, E, D, Q, D)
        # components first in memory, so that laws operate on long rows instead of 3 x 3 matrices
        gradient = gradient.permute(2, 4, 0, 1, 3).contiguous().permute(2, 3, 4, 0, 1)
        return gradient if dim == 3 else torch.nn.functional.pad(gradient, (0, 1, 0, 1))

    def _nodal_forces(self, stress: Tensor) -> Tensor:
        """Return the nodal forces (B, N, D) of first Piola-Kirchhoff stresses (B, E, Q, 3, 3)."""
        return self._sum_at_nodes(self._cell_forces(stress))

    def _cell_forces(self, stress: Tensor) -> Tensor:
        """Return the forces of each cell at its nodes (B, E, A, D) of stresses (B, E, Q, 3, 3)."""
        dim = self.shape[1]
        weighted = stress[..., :dim, :dim] * self.dV[..., None, None]
        weighted = weighted.transpose(-3, -2).flatten(-2)  # (B, E, D, QD)
        return (weighted @ self._operator.mT).mT

    def _sum_at_nodes(self, per_cell: Tensor) -> Tensor:
        """Return the sums at nodes (B, N, D) of values of each cell at its nodes (B, E, A, D)."""
        force = per_cell.new_zeros(len(per_cell), *self.shape)
        return force.index_add(1, self.cells.flatten(), per_cell.flatten(1, 2))

    def _with_boundary_forces(self, internal: Tensor, displacement: Tensor) -> Tensor:
        """Return internal forces (B, N, D) plus those of foundation and follower loads."""
        if self.springs is not None:
            internal = internal + self.springs.force(displacement)
        if self.follower_loads:
            internal = internal + self.follower_loads.force(displacement)
        return internal

    def _with_boundary_entries(
        self, tangent: Tensor, displacement: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return entries (B, nnz) with foundation and follower loads, and the skew part."""
        if self.springs is not None:
            rows, columns, stiffness = (part.cpu().numpy() for part in self.springs)
            places = self.pattern.between(rows, columns)
            added = np.bincount(places.ravel(), stiffness.ravel(), len(self.pattern.indices) + 1)
            tangent = tangent + torch.from_numpy(added[:-1]).to(tangent.device)
        if not self.follower_loads:
            return tangent, None
        added, skew = self._follower_stiffness(self.follower_loads, displacement)
        return tangent + added, skew

    def _follower_stiffness(
        self, loads: FollowerLoads, displacement: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return `FollowerLoads.stiffness`."""
        for part in loads.parts:
            if part not in self._follower_places:
                self._follower_places[part] = part.places(self.pattern)
        return loads.stiffness(displacement, self.pattern, self._follower_places)

    @cached_property
    def _follower_places(self) -> dict[LoadedPart, Places]:
        """Places of the stiffness of the follower loads on the pattern."""
        return {}

    def _assembled(
        self, moduli: Tensor, slope: Tensor | None = None, stiffness: Tensor | None = None
    ) -> Tensor:
        """Return the entries of the tangent (B, nnz) of dP/dF (B, E, Q, 3, 3, 3, 3).

        With mean dilatation `slope` and `stiffness` are those of `PointTangent`.
        """
        samples, dim = len(moduli), self.shape[1]
        A = moduli[..., :dim, :dim, :dim, :dim] * self.dV[..., None, None, None, None]
        A = A.transpose(-4, -3)  # (B, E, Q, j, i, k, l)
        right = A.flatten(-4, -2) @ self.dN.mT  # (B, E, Q, jik, A)
        right = right.unflatten(-2, (dim, dim * dim)).flatten(-2).flatten(-3, -2)  # (B, E, Qj, ikA)
        matrices = self._operator @ right  # (B, E, A, ikA)
        if slope is not None and self.volume_functions is not None:
            functions = self.volume_functions.mT[..., None, None]  # (E, M, Q, 1, 1)
            each = [self._cell_forces(slope * functions[:, m]) for m in range(functions.shape[1])]
            slopes = torch.stack(each, dim=2)  # (B, E, M, A, D)
            volumetric = torch.einsum("bemai,bemn,benck->beaikc", slopes, stiffness, slopes)
            matrices = matrices + volumetric.flatten(-3)
        return self._entries(matrices.reshape(samples, -1))

    def _entries(self, matrices: Tensor) -> Tensor:
        """Return the tangent (B, nnz) of cell matrices (B, E A D D A), laid out aikb."""
        kept = matrices[:, self.pattern.source.to(matrices.device)]
        values = kept.new_zeros(len(kept), len(self.pattern.indices))
        return values.index_add(1, self.pattern.target.to(matrices.device), kept)
