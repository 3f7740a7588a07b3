"""Problem = mesh + law + supports: energy, internal force, residual and tangent, batched."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from scipy.linalg import qr
from torch import Tensor

from dpl.fem.dilatation import dilated, dilated_stress
from dpl.fem.kernels import Kernels
from dpl.fem.law import Isotropic, Material
from dpl.fem.mesh import aspect_ratio, longest_side
from dpl.fem.pattern import Pattern
from dpl.fem.regions import Region, nodes_in
from dpl.fem.supports import Displacement, Spring, Springs, Support, joined
from dpl.fem.tensors import green_lagrange, volume_change

# shape of the cell, degree -> element, polynomial order that the quadrature integrates exactly.
# Full quadrature: fewer points leave hourglass modes, more only cost time.
ELEMENTS = {
    ("Triangular", 1): (skfem.ElementTriP1, 0),
    ("Triangular", 2): (skfem.ElementTriP2, 2),
    ("Quadrilateral", 1): (skfem.ElementQuad1, 3),
    ("Quadrilateral", 2): (skfem.ElementQuad2, 5),
    ("Tetrahedral", 1): (skfem.ElementTetP1, 0),
    ("Tetrahedral", 2): (skfem.ElementTetP2, 2),
    ("Hexahedral", 1): (skfem.ElementHex1, 3),
    ("Hexahedral", 2): (skfem.ElementHex2, 5),
}
TWINS = 64  # bodies of other Poisson's ratios that are kept
QUADRATIC = {element for (_, degree), (element, _) in ELEMENTS.items() if degree == 2}


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
    """

    force: Tensor
    tangent: Tensor
    valid: Tensor


@dataclass(frozen=True, eq=False)
class Problem:
    """Static equilibrium of one hyperelastic body; build it with `Problem.build`.

    All quantities are dimensionless. Methods take displacements (B, N, D) in float64 and return
    values on the same device; none of them loops over cells in Python. `energy`, `internal_force`
    and `tangent` are tensor operations, differentiable, on any device; `evaluate` and `linearise`
    say the same without derivatives, by compiled loops where body and law have them.

    Attributes:
        mesh: Geometry, coordinates over `length`.
        degree: Polynomial degree of the displacement, 1 or 2.
        material: The law.
        length: L, longest side of the body [m].
        points: Nodes (N, D) [-]; for degree 2 those of edges, faces and cells too.
        cells: Nodes of each cell, (E, A).
        dN: Gradients of the shape functions, (E, Q, A, D) [-]; (1, Q, A, D) if all cells are equal.
        dV: Volumes of the quadrature points, (E, Q) [-]; (1, Q) if all cells are equal.
        free: Degrees of freedom that may move, (N, D).
        prescribed: Displacement of the others at full load, (N, D) [-]; zero where free.
        boundary: Nodes on the boundary, (N,).
        springs: Robin conditions; None if there are none.
        mean_dilatation: Whether a cell's points share its mean volume ratio.
    """

    mesh: skfem.Mesh
    degree: int
    material: Material
    length: float
    points: Tensor
    cells: Tensor
    dN: Tensor
    dV: Tensor
    free: Tensor
    prescribed: Tensor
    boundary: Tensor
    springs: Springs | None = None
    mean_dilatation: bool = False

    @classmethod
    def build(
        cls,
        mesh: skfem.Mesh,
        material: Material,
        *,
        fixed: Region | NDArray[np.bool_] | None = None,
        prescribed: NDArray[np.float64] | None = None,
        supports: Sequence[Support] = (),
        degree: int = 1,
        mean_dilatation: bool = False,
        length: float | None = None,
    ) -> Self:
        """Return the problem of a body.

        Args:
            mesh: scikit-fem mesh [m]. Its own degree, if higher, takes the place of `degree`.
            material: The law.
            fixed: What is held: a region (all components of its nodes), or nodes (N,), or
                degrees of freedom (N, D).
            prescribed: Displacement over `length` where fixed, (N, D); zero if left out.
            supports: Prescribed displacements and springs besides; of two on one degree of freedom
                the later counts.
            degree: 1 or 2.
            mean_dilatation: Let the points of a cell share its mean volume ratio, so that nearly
                incompressible bodies of linear quadrilaterals and hexahedra do not lock.
            length: L [m]; the longest side of the body if left out.

        Raises:
            ValueError: `degree` is neither 1 nor 2, no such cells, a region is empty, or
                `mean_dilatation` is asked of cells that it does nothing for.

        Warns:
            UserWarning: Linear elements will lock: see `advice`.
        """
        if degree not in (1, 2):
            raise ValueError(f"degree = {degree} must be 1 or 2")
        degree = 2 if mesh.elem in QUADRATIC else degree
        length = longest_side(mesh.p.T) if length is None else length
        mesh = mesh.scaled(1.0 / length)
        basis = _basis(mesh, degree)
        nodes, dim = basis.N, mesh.dim()
        if mean_dilatation and (degree == 2 or basis.dx.shape[1] == 1):
            raise ValueError(
                "mean_dilatation: is for linear quadrilaterals and hexahedra; "
                "set degree=2 instead, quadratic elements hardly lock"
            )
        points = basis.doflocs.T
        given = np.full((nodes, dim), np.nan)
        if fixed is not None:
            where = fixed if isinstance(fixed, np.ndarray) else nodes_in(fixed, basis, length)
            if not where.any():
                raise ValueError(f"{fixed} holds no node of the mesh")
            held = np.broadcast_to(where[:, None] if where.ndim == 1 else where, (nodes, dim))
            given = np.where(held, 0.0 if prescribed is None else prescribed, np.nan)
        for support in supports:
            if isinstance(support, Displacement):
                value = support.on(basis, length)
                given = np.where(np.isnan(value), given, value)
        beds = [s.on(basis, length) for s in supports if isinstance(s, Spring)]
        gradients = np.stack([b[0].grad for b in basis.basis])  # (A, D, E, Q)
        dN, dV = gradients.transpose(2, 3, 0, 1), basis.dx
        if np.allclose(dN, dN[:1], rtol=0, atol=1e-11 * np.abs(dN).max()) and np.allclose(
            dV, dV[:1], rtol=1e-11
        ):
            dN, dV = dN[:1], dV[:1]
        boundary = np.zeros(nodes, dtype=bool)
        boundary[basis.get_dofs(mesh.boundary_facets()).all()] = True
        problem = cls(
            mesh=mesh,
            degree=degree,
            material=material,
            length=length,
            points=torch.from_numpy(np.ascontiguousarray(points)),
            cells=torch.from_numpy(np.ascontiguousarray(basis.element_dofs.T.astype(np.int64))),
            dN=torch.from_numpy(np.ascontiguousarray(dN)),
            dV=torch.from_numpy(np.ascontiguousarray(dV)),
            free=torch.from_numpy(np.isnan(given)),
            prescribed=torch.from_numpy(np.nan_to_num(given)),
            boundary=torch.from_numpy(boundary),
            springs=joined(beds),
            mean_dilatation=mean_dilatation,
        )
        for line in problem.advice():
            warnings.warn(line, stacklevel=2)
        return problem

    def advice(self) -> list[str]:
        """Return where linear elements will be far too stiff, a line each."""
        lines, shape = [], self.mesh.elem.refdom.name.lower()
        constant = self.dV.shape[1] == 1
        nu = (self.material.poisson_range or (self.material.poisson_ratio,))[-1]
        if self.degree == 1 and nu >= 0.45 and not self.mean_dilatation:
            remedy = "degree=2" if constant else "degree=2 or mean_dilatation=true"
            lines.append(f"linear {shape} elements lock at Poisson's ratio {nu:.4g}: set {remedy}")
        aspect = float(aspect_ratio(self.mesh).max()) if self.degree == 1 else 0.0
        if aspect > 20:
            lines.append(
                f"linear {shape} elements of aspect ratio {aspect:.0f} lock in bending: "
                "set degree=2"
            )
        return lines

    def to(self, device: torch.device | str) -> Self:
        """Return the same problem with its tensors on a device."""
        tensors: dict[str, Any] = {
            field.name: value.to(device)
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        if self.springs is not None:
            tensors["springs"] = Springs(*(part.to(device) for part in self.springs))
        return replace(self, **tensors)

    def at(self, poisson: Tensor | float) -> Self:
        """Return the body of another Poisson's ratio: mesh, pattern and compiled loops are shared.

        Args:
            poisson: Poisson's ratio [-]; or those of loads, (B, P): with P = 0 the body itself,
                with P = 1 and B > 1 one of which each member of a batch has its own. Such a one has
                energy, forces and residuals, but is linearised one by one.

        Raises:
            ValueError: Loads say none and the body has a range, or the law has none.
        """
        if isinstance(poisson, Tensor) and not poisson.shape[-1]:
            if (span := self.material.poisson_range) is not None:
                raise ValueError(
                    f"poisson: the body has a range of them, {list(span)}, and the load does not "
                    "say which: Load(force, young, poisson)"
                )
            return self
        if isinstance(poisson, Tensor) and len(poisson) != 1:
            return self._twin(poisson.detach().to(self.points.device, torch.float64))
        one = float(poisson)
        if one not in self._twins:
            if len(self._twins) >= TWINS:
                self._twins.clear()
            self._twins[one] = self._twin(one)
        return self._twins[one]

    def _twin(self, poisson: Tensor | float) -> Self:
        twin = replace(self, material=self.material.at(poisson))
        for name in ("pattern", "moved_supports", "_operator"):
            twin.__dict__[name] = getattr(self, name)
        if self.material.poisson_range is None:
            twin.__dict__["_first"] = self.__dict__.get("_first", self)
        elif isinstance(poisson, Tensor) or poisson != self._middle:
            twin.__dict__["_first"] = self.reference
        return twin

    @cached_property
    def _twins(self) -> dict[float, Self]:
        return {}

    @property
    def _middle(self) -> float:
        low, high = self.material.poisson_range or (0.0, 0.0)
        return (low + high) / 2

    @property
    def reference(self) -> Self:
        """The body in the middle of the range of Poisson's ratios; itself if there is none.

        What all loads share is its: modes, scales, largest loads.
        """
        return self if self.material.poisson_range is None else self.at(self._middle)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without what is computed from the rest."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def basis(self) -> skfem.Basis:
        """scikit-fem's basis of one displacement component."""
        return _basis(self.mesh, self.degree)

    @property
    def shape(self) -> tuple[int, int]:
        """N and D."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def equal_cells(self) -> bool:
        """Whether all cells share one set of gradients."""
        return len(self.dN) == 1

    @property
    def mixes(self) -> bool:
        """Whether the strains of its points can be unknowns of their own, see `linearise`."""
        return self.material.has_response and not self.mean_dilatation

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the strain energy over E L^D, that of springs included, (B,) [-]."""
        H = self.gradient(displacement)
        if self.mean_dilatation:
            H = dilated(self.material, H, self.dV, self.shape[1])
        energy = (self.material.energy(H) * self.dV).sum((-2, -1))
        if self.springs is not None:
            pull = self.springs.force(displacement)
            energy = energy + (pull * displacement).sum((-2, -1)) / 2
        return energy

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return f_int, the slope of the energy, (B, N, D) [-]; on held nodes the reactions."""
        stress = self._effective_stress(self.gradient(displacement))
        return self._with_springs(self._spread(stress), displacement)

    def residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return f_int - f where free and zero where held, (B, N, D) [-]."""
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
        internal = self._with_springs(internal, displacement)
        return Evaluation(internal, torch.tensor(lowest, dtype=torch.float64))

    def residual_ratio(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], see `imbalance`."""
        return self.imbalance(self.evaluate(displacement).internal, force)

    def imbalance(self, internal: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-]: the one criterion by which answers are judged.

        Where supports are moved (`prescribed`), the reactions count as a load too: the larger norm
        is taken. Zero load: the norm of R itself. A load that is not finite, on held nodes too, is
        in balance with nothing: NaN.
        """
        residual = torch.where(self.free, internal - force, 0.0).flatten(1).norm(dim=1)
        scale = force.flatten(1).norm(dim=1)
        if self.moved_supports:
            reaction = torch.where(self.free, 0.0, internal).flatten(1).norm(dim=1)
            scale = torch.maximum(scale, reaction)
        scale = torch.where(scale.isfinite(), scale, torch.nan)
        return residual / torch.where(scale == 0, 1.0, scale)

    def balanced(self, displacement: Tensor, internal: Tensor, force: Tensor, tol: float) -> Tensor:
        """Return whether `imbalance` is below tol, or as small as rounding lets it be, (B,)."""
        residual = torch.where(self.free, internal - force, 0.0).flatten(1).norm(dim=1)
        ratio = self.imbalance(internal, force)
        return (ratio < tol) | ((ratio < 1e-4) & (residual <= self.rounding(displacement)))

    def rounding(self, displacement: Tensor) -> Tensor:
        """Return what rounding alone can make of ||R_free||, (B,) [-].

        A bound from magnitudes: every nodal force is a sum of products of displacement, gradient,
        modulus and gradient. On slivers it exceeds any tolerance.
        """
        return self._rounding * displacement.abs().amax(dim=(1, 2))

    @cached_property
    def _rounding(self) -> float | Tensor:
        size = self.dN.norm(dim=-1)  # (E or 1, Q, A)
        moduli, each = self.material.lam + 2 * self.material.mu, 1.0
        if isinstance(moduli, Tensor):
            moduli, each = 1.0, moduli.flatten()
        terms = moduli * (self.dV[..., None] * size * size.sum(-1, keepdim=True)).sum(1)
        terms = terms.expand(len(self.cells), -1)[None, ..., None]
        held = ~self.free.any(dim=1)
        summed = self._gathered(terms.expand(-1, -1, -1, self.shape[1]))[0, :, 0]
        summed = torch.where(held, 0.0, summed)
        return torch.finfo(torch.float64).eps * float(summed.norm()) * each

    @cached_property
    def moved_supports(self) -> bool:
        """Whether some prescribed displacement is not zero."""
        return bool((self.prescribed != 0).any())

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of K = d f_int / du on `pattern`, (B, nnz) [-]."""
        if self.mean_dilatation:
            return self._with_spring_entries(self._entries(self._cell_tangents(displacement)))
        moduli = self.material.tangent(self.gradient(displacement))
        return self._with_spring_entries(self._assembled(moduli))

    def strain(self, displacement: Tensor) -> Tensor:
        """Return the Green-Lagrange strain at the quadrature points, (B, E, Q, 3, 3) [-]."""
        return green_lagrange(self.gradient(displacement))

    def bending(self, update: Tensor) -> Tensor:
        """Return what a step's strain is beyond linear, dH^T dH / 2, (B, E, Q, 3, 3) [-]."""
        dH = self.gradient(update)
        return dH.mT @ dH / 2

    def mixed_system(self, displacement: Tensor, gap: Tensor) -> tuple[Tensor, Tensor]:
        """Return force (B, N, D) and tangent (B, nnz) of Newton with mixed integration points.

        The strain at the quadrature points is an unknown of its own that each point eliminates:
        stress and moduli are those at the strain of u less `gap`, (B, E, Q, 3, 3), moved to the
        strain of u by one linear step. Without a gap these are `internal_force` and `tangent`.

        Source: Magisano, Leonetti, Garcea (2017), CMAME 313, section 3.
        """
        H = self.gradient(displacement)
        response = self.material.response(green_lagrange(H) - gap)
        stress = response.stress + response.product(gap)
        force = self._with_springs(self._spread(stress + H @ stress), displacement)
        return force, self._with_spring_entries(self._assembled(response.tangent(H)))

    def linearise(self, displacement: Tensor, gap: Any = None) -> System:
        """Return the linearised equilibrium at (1, N, D), without derivatives.

        Args:
            displacement: u.
            gap: What `widened` returned; None for plain Newton.
        """
        if (kernels := self._kernels(displacement)) is None:
            return self._reference_system(displacement, gap)
        force = np.zeros(self.shape)
        values = np.zeros(len(self.pattern.indices) + 1)
        lowest = kernels.system(displacement[0].contiguous().numpy(), gap, force, values)
        internal = self._with_springs(torch.from_numpy(force)[None], displacement)
        tangent = self._with_spring_entries(torch.from_numpy(values[:-1])[None])
        return System(internal, tangent, torch.tensor([lowest > 1e-3]))

    @torch.no_grad()
    def _reference_system(self, displacement: Tensor, gap: Tensor | None) -> System:
        if gap is None:
            force, tangent = self.internal_force(displacement), self.tangent(displacement)
            return System(force, tangent, torch.ones(len(force), dtype=torch.bool))
        lowest = 1 + volume_change(2 * (self.strain(displacement) - gap)).flatten(1).amin(1)
        return System(*self.mixed_system(displacement, gap), lowest > 1e-3)

    def widened(self, gap: Any, length: float, update: Tensor) -> Any:
        """Return the gap between the strain of u and that of mixed points after a step.

        Points move with the strain's linear change along length * update and close as much of the
        gap that there was; what the change is short of is the gap.

        Args:
            gap: Before the step; None: none.
            length: Part of the step that is taken.
            update: The full step, (1, N, D) [-].
        """
        if (kernels := self._kernels(update)) is not None:
            return kernels.widened(gap, length, update[0].contiguous().numpy())
        wider = length**2 * self.bending(update)
        return wider if gap is None else (1 - length) * gap + wider

    def _kernels(self, displacement: Tensor) -> Kernels | None:
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
    def _compiled(self) -> Kernels | None:
        law = self.material
        if self.mean_dilatation or not isinstance(law, Isotropic):
            return None
        if (first := self.__dict__.get("_first")) is not None and first._compiled is not None:
            return first._compiled.under(law)
        # Copies: sending a problem to a worker process moves the memory of its tensors.
        cells, dN, dV = (tensor.numpy().copy() for tensor in (self.cells, self.dN, self.dV))
        places = self.pattern.places
        return Kernels(law, cells, dN, dV, places.reshape(len(places), -1))

    def _spread(self, stress: Tensor) -> Tensor:
        """Return the nodal forces (B, N, D) of first Piola-Kirchhoff stresses (B, E, Q, 3, 3)."""
        return self._gathered(self._cell_forces(stress))

    def _cell_forces(self, stress: Tensor) -> Tensor:
        """Return what each cell has at its nodes, (B, E, A, D), of stresses (B, E, Q, 3, 3)."""
        dim = self.shape[1]
        weighted = stress[..., :dim, :dim] * self.dV[..., None, None]
        weighted = weighted.transpose(-3, -2).flatten(-2)  # (B, E, D, QD)
        return (weighted @ self._operator.mT).mT

    def _gathered(self, per_cell: Tensor) -> Tensor:
        """Return the nodal sums (B, N, D) of what each cell has at its nodes (B, E, A, D)."""
        force = per_cell.new_zeros(len(per_cell), *self.shape)
        return force.index_add(1, self.cells.flatten(), per_cell.flatten(1, 2))

    def _with_springs(self, internal: Tensor, displacement: Tensor) -> Tensor:
        """Return forces (B, N, D) with those of the springs."""
        if self.springs is None:
            return internal
        return internal + self.springs.force(displacement)

    def _with_spring_entries(self, tangent: Tensor) -> Tensor:
        """Return a tangent's entries (B, nnz) with those of the springs."""
        if self.springs is None:
            return tangent
        rows, columns, stiffness = (part.cpu().numpy() for part in self.springs)
        places = self.pattern.between(rows, columns)
        added = np.bincount(places.ravel(), stiffness.ravel(), len(self.pattern.indices) + 1)
        return tangent + torch.from_numpy(added[:-1]).to(tangent.device)

    def _effective_stress(self, H: Tensor) -> Tensor:
        """Return the stress that does work on H, (B, E, Q, 3, 3) [-]."""
        if not self.mean_dilatation:
            return self.material.stress(H)
        return dilated_stress(self.material, H, self.dV, self.shape[1])

    def _cell_tangents(self, displacement: Tensor) -> Tensor:
        """Return the cell matrices (B, E A D D A), laid out aikb, by derivatives of cell forces."""
        at_cells = displacement[:, self.cells]  # (B, E, A, D)
        nodes, dim = at_cells.shape[-2:]

        def forces(local: Tensor) -> Tensor:
            return self._cell_forces(self._effective_stress(self._cell_gradient(local.mT)))

        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(forces, (at_cells,), (direction.expand_as(at_cells),))[1]

        directions = torch.eye(nodes * dim, dtype=displacement.dtype, device=displacement.device)
        columns = torch.func.vmap(along)(directions.view(-1, nodes, dim))  # (bk, B, E, A, D)
        columns = columns.unflatten(0, (nodes, dim))
        return columns.permute(2, 3, 4, 5, 1, 0).flatten(1)

    def _assembled(self, moduli: Tensor) -> Tensor:
        """Return the tangent's entries (B, nnz) of dP/dF (B, E, Q, 3, 3, 3, 3)."""
        samples, dim = len(moduli), self.shape[1]
        A = moduli[..., :dim, :dim, :dim, :dim] * self.dV[..., None, None, None, None]
        A = A.transpose(-4, -3)  # (B, E, Q, j, i, k, l)
        right = A.flatten(-4, -2) @ self.dN.mT  # (B, E, Q, jik, A)
        right = right.unflatten(-2, (dim, dim * dim)).flatten(-2).flatten(-3, -2)  # (B, E, Qj, ikA)
        return self._entries((self._operator @ right).reshape(samples, -1))

    def _entries(self, matrices: Tensor) -> Tensor:
        """Return the tangent's entries (B, nnz) of cell matrices (B, E A D D A), laid out aikb."""
        kept = matrices[:, self.pattern.source.to(matrices.device)]
        values = kept.new_zeros(len(kept), len(self.pattern.indices))
        return values.index_add(1, self.pattern.target.to(matrices.device), kept)

    def tangent_product(self, displacement: Tensor, direction: Tensor) -> Tensor:
        """Return K(u) v, (B, N, D) [-], on all degrees of freedom, without K."""
        return torch.func.jvp(self.internal_force, (displacement,), (direction,))[1]

    def volume_ratio(self, displacement: Tensor) -> Tensor:
        """Return min det F over the quadrature points, (B,) [-]; not above 0: inverted."""
        change = volume_change(self.gradient(displacement))
        return 1 + torch.nan_to_num(change, nan=-torch.inf).flatten(1).amin(dim=1)

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        H = self.gradient(displacement)
        if self.mean_dilatation:
            H = dilated(self.material, H, self.dV, self.shape[1])
        return self.material.stress(H)

    @cached_property
    def pattern(self) -> Pattern:
        """The tangent's sparsity, analysed once."""
        return Pattern.build(self.cells.cpu().numpy(), self.free.cpu().numpy())

    def rigid_motions(self) -> tuple[Tensor, list[str]]:
        """Return the rigid motions (N, D, 3 in 2D or 6) about the centre, and their names."""
        points = self.points - self.points.mean(dim=0)
        dim = points.shape[1]
        motions, names = [], []
        for axis in range(dim):
            motions.append(torch.eye(dim, dtype=points.dtype)[axis].expand_as(points))
            names.append(f"translation along {'xyz'[axis]}")
        for i, j in [(1, 2), (0, 2), (0, 1)] if dim == 3 else [(0, 1)]:
            turn = torch.zeros_like(points)
            turn[:, i], turn[:, j] = -points[:, j], points[:, i]
            motions.append(turn)
            names.append(f"rotation about {'xyz'[3 - i - j]}")
        return torch.stack(motions, dim=-1), names

    def loose_modes(self) -> list[str]:
        """Return the rigid motions that the supports leave free, named; none of them if held."""
        motions, names = self.rigid_motions()
        grip = motions[~self.free].numpy()  # (held, motions)
        held = grip.T @ grip
        if self.springs is not None:
            pull = self.springs.force(motions.movedim(-1, 0)).flatten(1)
            springs = (pull @ motions.flatten(0, 1)).numpy()
            held = held + springs / max(float(self.springs.stiffness.max()), 1e-300)
        if not held.any():
            return names
        values, vectors = np.linalg.eigh(held)
        null = vectors[:, values < 1e-14 * max(1.0, values.max())]
        if not null.size:
            return []
        _, pivots = qr(null.T, mode="r", pivoting=True)  # motions that span what is loose
        return [names[k] for k in np.sort(pivots[: null.shape[1]])]

    @cached_property
    def _operator(self) -> Tensor:
        """Gradients as matrices (E or 1, A, Q D); a plain matrix (A, Q D) where cells are equal."""
        operator = self.dN.transpose(1, 2).flatten(-2).contiguous()
        return operator[0] if self.equal_cells else operator

    def gradient(self, displacement: Tensor) -> Tensor:
        """Return H = du/dX, (B, E, Q, 3, 3) [-]; in 2D with zeros out of the plane."""
        return self._cell_gradient(displacement[:, self.cells].mT)

    def _cell_gradient(self, at_cells: Tensor) -> Tensor:
        """Return H, (B, E, Q, 3, 3) [-], of the displacements of each cell's nodes (B, E, D, A)."""
        dim = self.shape[1]
        gradient = (at_cells @ self._operator).unflatten(-1, (-1, dim))  # (B, E, D, Q, D)
        # components first in memory: laws work on long rows and not on 3 x 3
        gradient = gradient.permute(2, 4, 0, 1, 3).contiguous().permute(2, 3, 4, 0, 1)
        return gradient if dim == 3 else torch.nn.functional.pad(gradient, (0, 1, 0, 1))


def _basis(mesh: skfem.Mesh, degree: int) -> skfem.Basis:
    shape = mesh.elem.refdom.name
    if (shape, degree) not in ELEMENTS:
        raise ValueError(f"{shape} cells cannot be solved")
    element, order = ELEMENTS[shape, degree]
    if (shape, degree) == ("Triangular", 1):  # scikit-fem's smallest rule has three points
        centre = np.array([[1 / 3], [1 / 3]]), np.array([1 / 2])
        return skfem.Basis(mesh, element(), quadrature=centre)
    return skfem.Basis(mesh, element(), intorder=order)
