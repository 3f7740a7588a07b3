"""Static equilibrium of a body: built from a mesh, evaluated and linearised."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.boundary_conditions import (
    FoundationMatrix,
    Support,
    assemble_constraints,
    rigid_body_modes,
    unconstrained_modes,
)
from dpl.fem.assembly.discretisation import Discretisation, geometry
from dpl.fem.assembly.elements import QUADRATIC, basis_of, locking_warnings
from dpl.fem.assembly.equilibrium import norms, relative_residual
from dpl.fem.assembly.follower_loads import NO_LOADS, FollowerLoad, FollowerLoads
from dpl.fem.assembly.kernels import CompiledLoops
from dpl.fem.assembly.recovery import Recovery
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.assembly.tensor_assembly import TensorAssembly
from dpl.fem.materials.heterogeneous import Heterogeneous
from dpl.fem.materials.material import Material
from dpl.fem.mesh.generators import longest_side, near_origin
from dpl.fem.mesh.regions import Region
from dpl.fem.ranges import ParameterRange
from dpl.fem.units import Units

MIN_MIXED_VOLUME = 1e-3  # volume ratio of mixed integration points below which they are not used
MAX_BODIES = 64  # bodies of other parameters that are kept


class Evaluation(NamedTuple):
    """Internal force (B, N, D) [-], and min det F over the quadrature points (B,) [-]."""

    internal: Tensor
    volume_ratio: Tensor


class System(NamedTuple):
    """A linearised equilibrium K du = f - force.

    Attributes:
        force: (B, N, D) [-].
        tangent: Entries of K on the pattern, (B, nnz) [-].
        valid: Whether the strains that it was made at are those of some deformation, (B,).
        skew: Entries of (K - K^T) / 2 on the pattern, (B, nnz) [-], if a follower load has no
            potential; `tangent` is then the symmetric part. None if K is symmetric.
    """

    force: Tensor
    tangent: Tensor
    valid: Tensor
    skew: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """Static equilibrium f_int(u) = f of a hyperelastic body; build it with `Problem.build`.

    All quantities are dimensionless. Methods take displacements (B, N, D) in float64. `energy`,
    `internal_force`, `tangent`, `stress`, `tangent_product` and `volume_ratio` are differentiable
    tensor operations on the device of the body. `evaluate`, `linearise` and `update_strain_gap`
    have no derivatives and use compiled loops where the law has them.

    `dataclasses.replace` makes a body with another law, other follower loads or other supports. It
    shares everything that these do not change.

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
        follower_loads: Loads whose forces depend on the displacement: pressures, active stress,
            cables.
        volume_functions: Functions of the volume change in the cells, (E or 1, Q, M), see
            `CellVolumes`; None without mean dilatation.
        links: Pairs of nodes that follower loads join beyond the cells, (K, 2).
        young: Young's modulus by which boundary values are divided [Pa]; None if there is no such
            modulus, see `dpl.fem.units.Units`. No other quantity depends on it.
        discretisation: What is computed from mesh and supports; a new one is made unless the given
            one has the same mesh and free degrees of freedom.
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
    links: Tensor = NO_LOADS.links
    young: float | None = 1.0
    discretisation: Discretisation = field(default=None, repr=False)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        parts = {each.name: getattr(self, each.name) for each in fields(Discretisation)}
        given = self.discretisation
        if given is None or any(getattr(given, name) is not part for name, part in parts.items()):
            object.__setattr__(self, "discretisation", Discretisation(**parts))

    @classmethod
    def build(
        cls,
        mesh: skfem.Mesh,
        material: Material | Mapping[str, Material],
        *,
        regions: Mapping[str, Region] | None = None,
        fixed: Region | NDArray[np.bool_] | None = None,
        prescribed: NDArray[np.float64] | None = None,
        supports: Sequence[Support] = (),
        follower_loads: Sequence[FollowerLoad] = (),
        degree: int = 1,
        mean_dilatation: bool = False,
        length: float | None = None,
        young: float | None = 1.0,
    ) -> Self:
        """Return the problem of a body.

        Geometry is evaluated from an origin near the body, so that a body far from zero loses no
        more digits than its coordinates lack. Regions and fields use the coordinates of `mesh`.
        A warning names elements that will lock.

        Args:
            mesh: scikit-fem mesh [m]. A quadratic mesh overrides `degree`.
            material: The law; or the laws of several regions, by name, see `Heterogeneous`.
            regions: Regions of these laws, by name.
            fixed: Fixed part: a region (all components of its nodes), nodes (N,), or degrees of
                freedom (N, D).
            prescribed: Displacement over `length` at fixed degrees of freedom, (N, D) [-]; zero
                if left out.
            supports: Further prescribed displacements [m] and elastic foundations [N/m^3]; the last
                displacement on a degree of freedom counts.
            follower_loads: Follower pressures and active stresses [Pa] and tensions of cables [N],
                which add up; values or ranges.
            degree: Degree of the displacement, 1 or 2.
            mean_dilatation: Project the volume ratio in each cell, so that nearly incompressible
                bodies do not lock, see `CellVolumes`. Triangles and tetrahedra need degree 2.
            length: L [m]; the longest side of the body if left out.
            young: Young's modulus [Pa] by which boundary values are divided: stiffnesses of
                foundations, follower loads, and the tractions and body forces of `dpl.fem.loads`.
                The default of 1 Pa makes them values over E. None refuses them, for loads of
                several moduli.

        Raises:
            ValueError: A condition on the mesh, the law or a boundary value is not met.
        """
        if degree not in (1, 2):
            raise ValueError(f"degree = {degree} must be 1 or 2")
        if young is not None and not 0 < young < math.inf:
            raise ValueError(f"young = {young} must be a number above 0 [Pa]")
        degree = 2 if mesh.elem in QUADRATIC else degree
        length = longest_side(mesh.p.T) if length is None else length
        mesh, origin = near_origin(mesh)
        mesh, origin = mesh.scaled(1.0 / length), origin / length
        basis = basis_of(mesh, degree)
        units = Units(length, young)
        parts = geometry(basis, degree, mean_dilatation=mean_dilatation)
        given, springs = assemble_constraints(
            basis, units, supports, origin=origin, fixed=fixed, prescribed=prescribed
        )
        if isinstance(material, Mapping):
            material = Heterogeneous(material, regions or {})
        try:
            material = material.on(basis, length, origin)
        except ValueError as error:
            is_named = str(error).startswith(("material.", "regions:"))
            raise ValueError(f"{'' if is_named else 'material.'}{error}") from error
        nu = material.largest_poisson_ratio
        for line in locking_warnings(mesh, degree, nu, mean_dilatation=mean_dilatation):
            warnings.warn(line, stacklevel=2)
        loads = FollowerLoads.build(follower_loads, basis, units, material, origin)
        return cls(
            **parts,
            material=material,
            length=length,
            origin=origin,
            free=torch.from_numpy(np.isnan(given)),
            prescribed=torch.from_numpy(np.nan_to_num(given)),
            springs=springs,
            follower_loads=loads,
            links=loads.links,
            young=young,
        )

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without cached properties."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

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

    # ------------------------------------------------------------------ equilibrium

    def evaluate(self, displacement: Tensor) -> Evaluation:
        """Return internal force and min det F, without derivatives."""
        internal, lowest = self._loops(displacement).evaluate(displacement)
        return Evaluation(self._with_boundary_forces(internal, displacement), lowest)

    def linearise(self, displacement: Tensor, gap: Any = None) -> System:
        """Return the linearised equilibrium at (1, N, D), without derivatives.

        The gap is that of `update_strain_gap`; None for plain Newton.
        """
        force, tangent, lowest = self._loops(displacement).linearise(displacement, gap)
        with torch.no_grad():
            internal = self._with_boundary_forces(force, displacement)
            tangent, skew = self._with_boundary_entries(tangent, displacement)
        return System(internal, tangent, lowest > MIN_MIXED_VOLUME, skew)

    def update_strain_gap(
        self, gap: Any, length: float, update: Tensor, displacement: Tensor | None = None
    ) -> Any:
        """Return the gap between the strain of u and that of mixed points after a step.

        The strain at a mixed point advances linearly with length * update, and by the same part of
        the gap before the step. The gap is the difference to the strain of u. With mean dilatation
        the same holds for the volume changes of the cells. The gap before the step may be None.
        `update` is the full step and `displacement`, needed with mean dilatation only, u after the
        step, (1, N, D) [-].
        """
        return self._loops(update).update_strain_gap(gap, length, update, displacement)

    def _loops(self, displacement: Tensor) -> CompiledLoops | TensorAssembly:
        """Return the compiled loops, or the tensor operations where there are none.

        The loops would run past the end of a displacement of another body.
        """
        if tuple(displacement.shape[1:]) != tuple(self.shape):
            found, wanted = tuple(displacement.shape), ("B", *self.shape)
            raise ValueError(f"a displacement of shape {found} must have {wanted}")
        if displacement.dtype != torch.float64:
            raise ValueError(f"a displacement in {displacement.dtype} must be in torch.float64")
        return (self._compiled if displacement.device.type == "cpu" else None) or self.tensors

    @cached_property
    def _compiled(self) -> CompiledLoops | None:
        return self.discretisation.compiled(self.material)

    @cached_property
    def tensors(self) -> TensorAssembly:
        """Tensor operations of the cells alone, without foundation and follower loads."""
        return TensorAssembly(self.discretisation, self.material)

    @cached_property
    def _boundary_terms(self) -> list[FoundationMatrix | FollowerLoads]:
        """Parts of the energy beside that of the cells."""
        return [term for term in (self.springs, self.follower_loads) if term]

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the energy over E L^D, (B,) [-]: strain energy, foundation and follower loads.

        The energy of a follower load is its potential only if it has one, see `has_potential`.
        """
        works = (term.work(displacement) for term in self._boundary_terms)
        return sum(works, self.tensors.energy(displacement))

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return f_int, the gradient of the energy, (B, N, D) [-]; reactions at fixed nodes.

        Follower loads are a part of f_int, because they depend on the displacement.
        """
        return self._with_boundary_forces(self.tensors.internal_force(displacement), displacement)

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of K = d f_int / du on `pattern`, (B, nnz) [-].

        If a follower load has no potential, K is the symmetric part.
        """
        return self._with_boundary_entries(self.tensors.tangent(displacement), displacement)[0]

    def tangent_product(self, displacement: Tensor, direction: Tensor) -> Tensor:
        """Return K(u) v on all degrees of freedom without assembling K, (B, N, D) [-]."""
        return torch.func.jvp(self.internal_force, (displacement,), (direction,))[1]

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        return self.tensors.stress(displacement)

    def volume_ratio(self, displacement: Tensor) -> Tensor:
        """Return min det F over the quadrature points, (B,) [-]; a value <= 0 means inversion."""
        return self.tensors.volume_ratio(displacement)

    def _with_boundary_forces(self, internal: Tensor, displacement: Tensor) -> Tensor:
        """Return internal forces (B, N, D) plus those of foundation and follower loads."""
        return sum((term.force(displacement) for term in self._boundary_terms), internal)

    def _with_boundary_entries(
        self, tangent: Tensor, displacement: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return entries (B, nnz) with foundation and follower loads, and the skew part."""
        if self._foundation_entries is not None:
            tangent = tangent + self._foundation_entries
        if not self.follower_loads:
            return tangent, None
        added, skew = self.follower_loads.stiffness(displacement, self.pattern)
        return tangent + added, skew

    @cached_property
    def _foundation_entries(self) -> Tensor | None:
        return None if self.springs is None else self.springs.entries(self.pattern)

    # ------------------------------------------------------------------ residual

    def residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return f_int - f at free degrees of freedom, zero at fixed ones, (B, N, D) [-]."""
        return torch.where(self.free, self.internal_force(displacement) - force, 0.0)

    def relative_residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], see `relative_residual_of`."""
        return self.relative_residual_of(self.evaluate(displacement).internal, force)

    def relative_residual_of(self, internal: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], the criterion of equilibrium of all solvers.

        The internal force f_int and f are (B, N, D) [-]. See `dpl.fem.assembly.equilibrium` for
        ||f||. The result is ||R_free|| itself without forces, and NaN for a force that is not
        finite, also on fixed degrees of freedom, or too small to compute with.
        """
        return self._measured(internal, force)[0]

    def is_equilibrium(
        self, displacement: Tensor, internal: Tensor, force: Tensor, tol: float
    ) -> Tensor:
        """Return True where the relative residual is below tol or the roundoff bound, (B,)."""
        ratio, scale = self._measured(internal, force)
        is_rounding = (ratio < 1e-4) & (ratio * scale <= self.roundoff_bound(displacement))
        return (ratio < tol) | is_rounding

    def _measured(self, internal: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return `relative_residual_of` and the ||f|| that it is relative to, (B,) [-]."""
        loads = []
        if self.moved_supports:
            loads.append(norms(internal * (self.prescribed != 0)))
        if self.follower_loads:
            loads.append(norms(self.acting(self.force_at_rest.reshape(-1, *self.shape))))
        return relative_residual(internal, force, self._free_factors.to(force), loads)

    def acting(self, force: Tensor) -> Tensor:
        """Return a force (B, N, D) [-] at free degrees of freedom, where it has an effect.

        At fixed ones the result is 0, or NaN where the force is not finite.
        """
        return force * self._free_factors.to(force)

    @cached_property
    def _free_factors(self) -> Tensor:
        """1 at free degrees of freedom, else 0, (N, D): a product with a mask is slower."""
        return self.free.double()

    def roundoff_bound(self, displacement: Tensor) -> Tensor:
        """Return a bound of the rounding error of ||R_free||, (B,) [-]."""
        return self._rounding * displacement.abs().amax(dim=(1, 2)) + 10 * self.residual_force

    @cached_property
    def _rounding(self) -> Tensor:
        return self.discretisation.relative_rounding(self.material)

    @cached_property
    def residual_force(self) -> float:
        """||f_int|| of the residual stress at free degrees of freedom [-], see `Prestretched`.

        In equilibrium it is a rounding error.
        """
        if not self.material.has_residual_stress:
            return 0.0
        rest = torch.zeros_like(self.points)[None]
        return float(self.acting(self.tensors.internal_force(rest)).norm())

    def check_residual_stress(self) -> None:
        """Raise a ValueError unless the residual stress is in equilibrium, up to rounding."""
        if (force := self.reference.residual_force) > self.reference._rounding:
            raise ValueError(
                f"material: the residual stress has nodal forces of {force:.3g} E L^2 and "
                "must be in equilibrium; use mesh and stretch of dpl.fem.relaxed"
            )

    # ------------------------------------------------------------------ the body at rest

    def stiffness_at_rest(self) -> Tensor:
        """Return the entries of K(0), (nnz,) [-], without follower loads.

        The linear solution under follower loads is therefore that of dead loads on the body at
        rest, and all their values share one factor.
        """
        rest = torch.zeros(1, *self.shape, dtype=torch.float64)
        return self.under(0.0).linearise(rest).tangent[0]

    @cached_property
    def force_at_rest(self) -> Tensor:
        """f_int at u = 0: the force of the follower loads on the body at rest, (N, D) [-].

        It is minus the nodal forces of dead loads; zero without follower loads. (B, N, D) if each
        member of a batch has its own stresses.
        """
        forces = self.follower_loads.force(self.points.new_zeros(1, *self.shape))
        return forces[0] if len(forces) == 1 else forces

    @cached_property
    def support_force(self) -> Tensor:
        """K(0) times the prescribed displacement plus the follower loads at rest, (N, D) [-]."""
        if not self.moved_supports:
            return self.force_at_rest
        rest, moved = self.prescribed.new_zeros(1, *self.shape), self.prescribed[None]
        return self.under(0.0).tangent_product(rest, moved)[0] + self.force_at_rest

    @property
    def is_loaded_at_rest(self) -> bool:
        """True if u = 0 is no equilibrium without forces: moved supports, follower loads."""
        return self.moved_supports or bool(self.force_at_rest.any())

    @cached_property
    def moved_supports(self) -> bool:
        """True if a prescribed displacement is not zero."""
        return bool((self.prescribed != 0).any())

    @cached_property
    def has_potential(self) -> bool:
        """True if the tangent is symmetric under the follower loads, whatever their values.

        The stiffness of a follower load is symmetric or at most linear in u, so that one random
        displacement decides.
        """
        random = torch.Generator().manual_seed(0)
        noise = torch.rand(1, *self.shape, generator=random, dtype=torch.float64) - 0.5
        u = torch.where(self.free, 0.1 * noise.to(self.free.device), 0.7 * self.prescribed)
        return self.follower_loads.generic.stiffness(u, self.pattern)[1] is None

    def under(self, factor: float) -> Self:
        """Return the body under `factor` times its follower loads."""
        if not self.follower_loads or factor == 1:
            return self
        loads = self.follower_loads
        loads = FollowerLoads(loads.parts, factor * loads.values) if factor else NO_LOADS
        return replace(self, follower_loads=loads)

    # ------------------------------------------------------------------ parameters

    @cached_property
    def parameter_ranges(self) -> dict[str, ParameterRange]:
        """Ranges of what differs between loads beside forces and Young's modulus, by name.

        They are the ranges of the law [-], then those of follower loads [Pa or N].
        """
        return {**self.material.parameter_ranges, **self.follower_loads.ranges}

    def law_parameters(self, parameters: Tensor) -> Tensor:
        """Return those of the parameters (B, P) that belong to the law."""
        return parameters[:, : len(self.material.parameter_ranges)]

    def with_parameters(self, parameters: Tensor) -> Self:
        """Return the problem with values (B, P) in place of `parameter_ranges`.

        P = 0 returns the problem itself. With B > 1 each member of a batch has its own values: such
        a problem has energies, forces and residuals, but no tangent. It is differentiable in
        parameters that require a gradient.
        """
        if parameters.shape[-1] != len(self.parameter_ranges):
            raise ValueError(
                f"a load has {parameters.shape[-1]} parameters and the body has ranges of "
                f"{list(self.parameter_ranges)}; give Load(force, young, parameters) one value for "
                "each"
            )
        if not self.parameter_ranges:
            return self
        if len(parameters) > 1 or parameters.requires_grad:
            return self._with_values(parameters)
        body: Self = self._body_at(*parameters[0].tolist())
        return body

    @cached_property
    def _body_at(self) -> Callable[..., Any]:
        """The problem with one value of each parameter, kept for the last `MAX_BODIES` ones."""
        numbers = partial(torch.tensor, dtype=torch.float64)
        return lru_cache(MAX_BODIES)(lambda *values: self._with_values(numbers([values])))

    def _with_values(self, parameters: Tensor) -> Self:
        parameters = parameters.to(self.points.device, torch.float64)
        law, loads = self.material, self.follower_loads
        if loads.ranges and self.young is not None:
            loads = loads.with_values(parameters[:, len(law.parameter_ranges) :] / self.young)
        law = law.with_parameters(self.law_parameters(parameters))
        return replace(self, material=law, follower_loads=loads)

    @cached_property
    def reference(self) -> Self:
        """The problem at the middle of all ranges; itself without a range.

        Modes, scales and largest loads are those of this problem.
        """
        ranges = self.parameter_ranges.values()
        return self.with_parameters(torch.tensor([[ends.middle for ends in ranges]]).double())

    # ------------------------------------------------------------------ units and parts

    @property
    def units(self) -> Units:
        """L and E, by which boundary values are divided."""
        return Units(self.length, self.young)

    @property
    def has_one_modulus(self) -> bool:
        """True if the body is divided by one modulus: elastic foundation or follower loads."""
        return bool(self._boundary_terms)

    def check_modulus(self, young: float) -> None:
        """Check the Young's modulus [Pa] of a load on this body.

        Elastic foundations have a fixed stiffness and follower loads a fixed stress, so that
        their parts in f_int are those of one modulus. Other bodies allow all moduli.
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
    def points_in_metres(self) -> NDArray[np.float64]:
        """Nodes in the coordinates of the user, (N, D) [m]."""
        points: NDArray[np.float64] = self.length * (self.origin + self.points.numpy())
        return points

    @property
    def shape(self) -> tuple[int, int]:
        """N and D."""
        return self.discretisation.shape

    @property
    def basis(self) -> skfem.Basis:
        """scikit-fem's basis of one displacement component."""
        return self.discretisation.basis

    @property
    def pattern(self) -> Pattern:
        """Sparsity pattern of the tangent."""
        return self.discretisation.pattern

    @property
    def recovery(self) -> Recovery:
        """Values at nodes from values at quadrature points."""
        return self.discretisation.recovery

    @property
    def near_null(self) -> NDArray[np.float64]:
        """Near-null space for multigrid: rigid body modes at free degrees of freedom, (n, k)."""
        return rigid_body_modes(self.points)[0][self.free].numpy()

    def unconstrained_rigid_body_modes(self) -> list[str]:
        """Return the names of the rigid body modes that no boundary condition constrains."""
        return unconstrained_modes(self.points, self.free, self.springs)

    def restrict(self, field: Tensor) -> NDArray[np.float64]:
        """Return the values, (n,), of a nodal field (N, D) at the free degrees of freedom."""
        return field.numpy().reshape(-1)[self.discretisation.free_numbers]

    def extend(self, values: NDArray[np.float64]) -> Tensor:
        """Return the nodal field (N, D) with values (n,) where free and zero elsewhere."""
        field = np.zeros(self.shape)
        field.reshape(-1)[self.discretisation.free_numbers] = values
        return torch.from_numpy(field)
