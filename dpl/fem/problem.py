"""Static equilibrium of a body: built from a mesh, evaluated and linearised by compiled loops."""

import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.boundary_conditions import Support, assemble_constraints
from dpl.fem.assembly.elements import QUADRATIC, basis_of, gradients
from dpl.fem.assembly.follower_loads import FollowerLoad, FollowerLoads
from dpl.fem.assembly.kernels import GroupedKernels, Kernels
from dpl.fem.assembly.mean_dilatation import CellVolumes, MixedGap, volume_gap
from dpl.fem.assembly.numba_laws import CompiledLaw
from dpl.fem.assembly.variants import BodyVariants
from dpl.fem.materials.heterogeneous import Heterogeneous
from dpl.fem.materials.material import Material
from dpl.fem.materials.tensors import volume_change
from dpl.fem.mesh.generators import aspect_ratio, longest_side, near_origin
from dpl.fem.mesh.regions import Region
from dpl.fem.units import Units, check_young

MIN_MIXED_VOLUME = 1e-3  # volume ratio of mixed integration points below which they are not used


class Evaluation(NamedTuple):
    """What a displacement is judged by.

    Attributes:
        internal: f_int, (B, N, D) [-].
        volume_ratio: min det F over the quadrature points, (B,) [-].
    """

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


class Problem(BodyVariants):
    """Static equilibrium of one body, see `TensorAssembly`; build it with `Problem.build`.

    `evaluate`, `linearise` and `update_strain_gap` say what its tensor operations say, without
    derivatives, by compiled loops where body and law have them.
    """

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
            follower_loads: Follower pressures and active stresses [Pa], which add up; values or
                ranges.
            degree: Degree of the displacement, 1 or 2.
            mean_dilatation: Project the volume ratio in each cell, so that nearly incompressible
                bodies of quadrilaterals and hexahedra do not lock, see `CellVolumes`.
            length: L [m]; the longest side of the body if left out.
            young: Young's modulus [Pa] by which boundary values are divided: stiffnesses of
                foundations, follower loads, and the tractions and body forces of `dpl.fem.loads`.
                The default of 1 Pa makes them values over E. None refuses them, for loads of
                several moduli.

        Raises:
            ValueError: `degree` is neither 1 nor 2, the cell type is unknown, a region is empty, a
                boundary value is invalid, or `mean_dilatation` has no effect on the cells.

        Warns:
            UserWarning: Linear elements will lock, see `locking_warnings`.
        """
        if degree not in (1, 2):
            raise ValueError(f"degree = {degree} must be 1 or 2")
        check_young(young)
        degree = 2 if mesh.elem in QUADRATIC else degree
        length = longest_side(mesh.p.T) if length is None else length
        mesh, origin = near_origin(mesh)
        mesh, origin = mesh.scaled(1.0 / length), origin / length
        basis = basis_of(mesh, degree)
        if mean_dilatation and mesh.elem.refdom.name not in ("Quadrilateral", "Hexahedral"):
            raise ValueError(
                "mean_dilatation: applies to quadrilaterals and hexahedra only; "
                "set degree=2 instead, quadratic elements hardly lock"
            )
        units = Units(length, young)
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
        dN, dV = gradients(basis)
        functions = None
        if mean_dilatation:
            at = np.asarray(basis.global_coordinates())[:, : len(dV)].transpose(1, 2, 0)
            both = torch.from_numpy(np.ascontiguousarray(at)), torch.from_numpy(dV.copy())
            functions = CellVolumes.of(*both, linear=degree == 2).functions
        boundary = np.zeros(basis.N, dtype=bool)
        boundary[basis.get_dofs(mesh.boundary_facets()).all()] = True
        problem = cls(
            mesh=mesh,
            degree=degree,
            material=material,
            length=length,
            origin=origin,
            points=torch.from_numpy(np.ascontiguousarray(basis.doflocs.T)),
            cells=torch.from_numpy(np.ascontiguousarray(basis.element_dofs.T.astype(np.int64))),
            dN=torch.from_numpy(np.ascontiguousarray(dN)),
            dV=torch.from_numpy(np.ascontiguousarray(dV)),
            free=torch.from_numpy(np.isnan(given)),
            prescribed=torch.from_numpy(np.nan_to_num(given)),
            boundary=torch.from_numpy(boundary),
            springs=springs,
            follower_loads=FollowerLoads.build(follower_loads, basis, units, material, origin),
            volume_functions=functions,
            young=young,
        )
        for line in problem.locking_warnings():
            warnings.warn(line, stacklevel=2)
        return problem

    def locking_warnings(self) -> list[str]:
        """Return one line for each reason why linear elements will lock."""
        lines, shape = [], self.mesh.elem.refdom.name.lower()
        constant = self.dV.shape[1] == 1
        nu = self.material.largest_poisson_ratio
        if self.degree == 1 and nu >= 0.45 and self.volumes is None:
            remedy = "degree=2" if constant else "degree=2 or mean_dilatation=true"
            lines.append(f"linear {shape} elements lock at Poisson's ratio {nu:.4g}: set {remedy}")
        aspect = float(aspect_ratio(self.mesh).max()) if self.degree == 1 else 0.0
        if aspect > 20:
            lines.append(
                f"linear {shape} elements of aspect ratio {aspect:.0f} lock in bending: "
                "set degree=2"
            )
        return lines

    def restrict(self, field: Tensor) -> NDArray[np.float64]:
        """Return the values, (n,), of a nodal field (N, D) at the free degrees of freedom."""
        return field.numpy().reshape(-1)[self._free_numbers]

    def extend(self, values: NDArray[np.float64]) -> Tensor:
        """Return the nodal field (N, D) with values (n,) where free and zero elsewhere."""
        field = np.zeros(self.shape)
        field.reshape(-1)[self._free_numbers] = values
        return torch.from_numpy(field)

    @cached_property
    def _free_numbers(self) -> NDArray[np.int64]:
        """Numbers of the free degrees of freedom, (n,)."""
        return np.flatnonzero(self.free.numpy())

    def residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return f_int - f at free degrees of freedom, zero at fixed ones, (B, N, D) [-]."""
        return torch.where(self.free, self.internal_force(displacement) - force, 0.0)

    def evaluate(self, displacement: Tensor) -> Evaluation:
        """Return internal force and min det F, without derivatives."""
        if (kernels := self._kernels(displacement)) is None:
            with torch.no_grad():
                internal = self.internal_force(displacement)
                return Evaluation(internal, self.volume_ratio(displacement))
        displacement = displacement.detach().contiguous()
        internal = torch.zeros(displacement.shape, dtype=torch.float64)
        lowest = [
            kernels.force(u.numpy(), out.numpy(), k)
            for k, (u, out) in enumerate(zip(displacement, internal, strict=True))
        ]
        internal = self._with_boundary_forces(internal, displacement)
        return Evaluation(internal, torch.tensor(lowest, dtype=torch.float64))

    def relative_residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], see `relative_residual_of`."""
        return self.relative_residual_of(self.evaluate(displacement).internal, force)

    def linearise(self, displacement: Tensor, gap: Any = None) -> System:
        """Return the linearised equilibrium at (1, N, D), without derivatives.

        Args:
            displacement: u.
            gap: What `update_strain_gap` returned; None for plain Newton.
        """
        if (kernels := self._kernels(displacement)) is None:
            return self._reference_system(displacement, gap)
        force = np.zeros(self.shape)
        values = np.zeros(len(self.pattern.indices) + 1)
        lowest = kernels.system(displacement[0].contiguous().numpy(), gap, force, values)
        internal = self._with_boundary_forces(torch.from_numpy(force)[None], displacement)
        entries = torch.from_numpy(values[:-1])[None]
        tangent, skew = self._with_boundary_entries(entries, displacement)
        valid = torch.tensor([lowest > MIN_MIXED_VOLUME])
        return System(internal, tangent, valid, skew)

    def stiffness_at_rest(self) -> Tensor:
        """Return the entries of K(0), (nnz,) [-], without follower loads.

        The linear solution under follower loads is therefore that of dead loads on the body at
        rest, and all their values share one factor.
        """
        rest = torch.zeros(1, *self.shape, dtype=torch.float64)
        return self.without_follower_loads.linearise(rest).tangent[0]

    @torch.no_grad()
    def _reference_system(self, displacement: Tensor, gap: Any) -> System:
        if gap is None:
            force, tangent = self.internal_force(displacement), self.tangent(displacement)
            valid = torch.ones(len(force), dtype=torch.bool)
        else:
            force, tangent = self.mixed_system(displacement, gap)
            strain_gap = gap.strain if isinstance(gap, MixedGap) else gap
            lowest = volume_change(2 * (self.strain(displacement) - strain_gap)).flatten(1).amin(1)
            if self.volumes is not None:
                change = volume_change(self.gradient(displacement))
                mean = self.volumes.at_points(self.volumes.coefficients(change) - gap.volume)
                lowest = torch.minimum(lowest, mean.flatten(1).amin(1))
            valid = 1 + lowest > MIN_MIXED_VOLUME
        _, skew = self._with_boundary_entries(torch.zeros_like(tangent), displacement)
        return System(force, tangent, valid, skew)

    def update_strain_gap(
        self, gap: Any, length: float, update: Tensor, displacement: Tensor | None = None
    ) -> Any:
        """Return the gap between the strain of u and that of mixed points after a step.

        Points move with the strain's linear change along length * update and close as much of the
        gap that there was; what the change is short of is the gap. With mean dilatation the same
        holds for the volume changes of the cells, and the gap has two parts, see `MixedGap`.

        Args:
            gap: Before the step; None: none.
            length: Part of the step that is taken.
            update: The full step, (1, N, D) [-].
            displacement: u after the step, (1, N, D) [-]; needed with mean dilatation only.
        """
        if (kernels := self._kernels(update)) is not None:
            u = None if displacement is None else displacement[0].contiguous().numpy()
            return kernels.update_strain_gap(gap, length, update[0].contiguous().numpy(), u)
        wider = length**2 * self.quadratic_strain(update)
        if self.volumes is None or displacement is None:
            return wider if gap is None else (1 - length) * gap + wider
        step = length * self.gradient(update)
        volume = volume_gap(self.gradient(displacement), step, self.volumes)
        if gap is None:
            return MixedGap(wider, volume)
        left = 1 - length
        return MixedGap(left * gap.strain + wider, left * gap.volume + volume)

    def _kernels(self, displacement: Tensor) -> Kernels | GroupedKernels | None:
        """Return the compiled loops, None where there are none.

        Raises:
            ValueError: The displacement is that of another body: the loops would run past its end.
                Or not in float64.
        """
        if tuple(displacement.shape[1:]) != tuple(self.shape):
            found, wanted = tuple(displacement.shape), ("B", *self.shape)
            raise ValueError(f"a displacement of shape {found} must have {wanted}")
        if displacement.dtype != torch.float64:
            raise ValueError(f"a displacement in {displacement.dtype} must be in torch.float64")
        return self._compiled if displacement.device.type == "cpu" else None

    @cached_property
    def _compiled(self) -> Kernels | GroupedKernels | None:
        groups = self.material.groups(len(self.cells))
        laws = [law for law, _ in groups if isinstance(law, CompiledLaw)]
        if len(laws) < len(groups):
            return None
        first = self.__dict__.get("_first", self).reference
        if first is not self and first._compiled is not None:
            return first._compiled.with_moduli(laws)
        places = self.pattern.places.reshape(len(self.cells), -1)
        kernels = []
        for law, (_, chosen) in zip(laws, groups, strict=True):
            # An index by numbers copies: sending a problem to a worker moves the memory of tensors.
            numbers = chosen.numpy()
            own = [0] if self.equal_cells else numbers
            dN, dV = self.dN.numpy()[own], self.dV.numpy()[own]
            psi = None if self.volume_functions is None else self.volume_functions.numpy()[own]
            kernels.append(Kernels(law, self.cells.numpy()[numbers], dN, dV, places[numbers], psi))
        return kernels[0] if len(kernels) == 1 else GroupedKernels(kernels)
