"""Problem = mesh + law + supports: energy, internal force, residual and tangent, batched."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.materials import Material, green_lagrange, volume_change
from dpl.fem.mesh import longest_side

Region = Callable[[NDArray[np.float64]], NDArray[np.bool_]]  # points (N, D) [m] -> (N,)

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
QUADRATIC = {element for (_, degree), (element, _) in ELEMENTS.items() if degree == 2}


@dataclass(frozen=True)
class Pattern:
    """Where the tangent has entries: upper triangle over the free degrees of freedom, in CSR.

    Attributes:
        size: n, the number of free degrees of freedom.
        indptr, indices: CSR structure, columns sorted, (n + 1,) and (nnz,).
        source: For each kept entry of all cell matrices its place in them.
        target: For each kept entry its place among the nnz.
    """

    size: int
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    source: Tensor
    target: Tensor


@dataclass(frozen=True, eq=False)
class Problem:
    """Static equilibrium of one hyperelastic body; build it with `Problem.build`.

    All quantities are dimensionless. Methods take displacements (B, N, D) in float64 and return
    values on the same device; none of them loops over cells in Python.

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

    @classmethod
    def build(
        cls,
        mesh: skfem.Mesh,
        material: Material,
        *,
        fixed: Region | NDArray[np.bool_] | None = None,
        prescribed: NDArray[np.float64] | None = None,
        degree: int = 1,
        length: float | None = None,
    ) -> Self:
        """Return the problem of a body.

        Args:
            mesh: scikit-fem mesh [m]. Its own degree, if higher, takes the place of `degree`.
            material: The law.
            fixed: What is held: a region (all components of its nodes), or nodes (N,), or
                degrees of freedom (N, D).
            prescribed: Displacement over `length` where fixed, (N, D); zero if left out.
            degree: 1 or 2.
            length: L [m]; the longest side of the body if left out.

        Raises:
            ValueError: `degree` is neither 1 nor 2, no such cells, or `fixed` is empty.
        """
        if degree not in (1, 2):
            raise ValueError(f"degree = {degree} must be 1 or 2")
        degree = 2 if mesh.elem in QUADRATIC else degree
        length = longest_side(mesh.p.T) if length is None else length
        mesh = mesh.scaled(1.0 / length)
        basis = _basis(mesh, degree)
        nodes, dim = basis.N, mesh.dim()
        points = basis.doflocs.T
        if fixed is None:
            held = np.zeros((nodes, dim), dtype=bool)
        else:
            where = fixed(points * length) if callable(fixed) else np.asarray(fixed)
            if not where.any():
                raise ValueError(f"{fixed} holds no node of the mesh")
            held = np.broadcast_to(where[:, None] if where.ndim == 1 else where, (nodes, dim))
        gradients = np.stack([b[0].grad for b in basis.basis])  # (A, D, E, Q)
        dN, dV = gradients.transpose(2, 3, 0, 1), basis.dx
        if np.allclose(dN, dN[:1], rtol=0, atol=1e-11 * np.abs(dN).max()) and np.allclose(
            dV, dV[:1], rtol=1e-11
        ):
            dN, dV = dN[:1], dV[:1]
        boundary = np.zeros(nodes, dtype=bool)
        boundary[basis.get_dofs(mesh.boundary_facets()).all()] = True
        given = np.zeros((nodes, dim)) if prescribed is None else np.where(held, prescribed, 0.0)
        return cls(
            mesh=mesh,
            degree=degree,
            material=material,
            length=length,
            points=torch.from_numpy(np.ascontiguousarray(points)),
            cells=torch.from_numpy(basis.element_dofs.T.astype(np.int64)),
            dN=torch.from_numpy(np.ascontiguousarray(dN)),
            dV=torch.from_numpy(np.ascontiguousarray(dV)),
            free=torch.from_numpy(~held),
            prescribed=torch.from_numpy(given),
            boundary=torch.from_numpy(boundary),
        )

    def to(self, device: torch.device | str) -> Self:
        """Return the same problem with its tensors on a device."""
        tensors: dict[str, Any] = {
            field.name: value.to(device)
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        return replace(self, **tensors)

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

    def energy(self, displacement: Tensor) -> Tensor:
        """Return the strain energy over E L^D, (B,) [-]."""
        density = self.material.energy(self._gradient(displacement))
        return (density * self.dV).sum((-2, -1))

    def internal_force(self, displacement: Tensor) -> Tensor:
        """Return f_int, the slope of the energy, (B, N, D) [-]; on held nodes the reactions."""
        return self._spread(self.material.stress(self._gradient(displacement)))

    def residual(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return f_int - f where free and zero where held, (B, N, D) [-]."""
        return torch.where(self.free, self.internal_force(displacement) - force, 0.0)

    def residual_ratio(self, displacement: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-], see `imbalance`."""
        return self.imbalance(self.internal_force(displacement), force)

    def imbalance(self, internal: Tensor, force: Tensor) -> Tensor:
        """Return ||R_free|| / ||f||, (B,) [-]: the one criterion by which answers are judged.

        Where supports are moved (`prescribed`), the reactions count as a load too: the larger norm
        is taken. Zero load: the norm of R itself.
        """
        residual = torch.where(self.free, internal - force, 0.0).flatten(1).norm(dim=1)
        scale = force.flatten(1).norm(dim=1)
        if self.moved_supports:
            reaction = torch.where(self.free, 0.0, internal).flatten(1).norm(dim=1)
            scale = torch.maximum(scale, reaction)
        return residual / torch.where(scale > 0, scale, 1.0)

    @cached_property
    def moved_supports(self) -> bool:
        """Whether some prescribed displacement is not zero."""
        return bool((self.prescribed != 0).any())

    def tangent(self, displacement: Tensor) -> Tensor:
        """Return the entries of K = d f_int / du on `pattern`, (B, nnz) [-]."""
        return self._assembled(self.material.tangent(self._gradient(displacement)))

    def strain(self, displacement: Tensor) -> Tensor:
        """Return the Green-Lagrange strain at the quadrature points, (B, E, Q, 3, 3) [-]."""
        return green_lagrange(self._gradient(displacement))

    def strain_change(self, displacement: Tensor, update: Tensor) -> Tensor:
        """Return B(u) du, the strain's linear change, (B, E, Q, 3, 3) [-]."""
        H, dH = self._gradient(displacement), self._gradient(update)
        change = dH + H.mT @ dH
        return (change + change.mT) / 2

    def mixed_system(self, displacement: Tensor, strain: Tensor) -> tuple[Tensor, Tensor]:
        """Return force (B, N, D) and tangent (B, nnz) of Newton with mixed integration points.

        The strain at the quadrature points, (B, E, Q, 3, 3), is an unknown of its own that each
        point eliminates: stress and moduli are those of `strain`, moved to the strain of u by one
        linear step. Where both strains agree these are `internal_force` and `tangent`.

        Source: Magisano, Leonetti, Garcea (2017), CMAME 313, section 3.
        """
        H = self._gradient(displacement)
        response = self.material.response(strain)
        stress = response.stress + response.product(green_lagrange(H) - strain)
        return self._spread(stress + H @ stress), self._assembled(response.tangent(H))

    def _spread(self, stress: Tensor) -> Tensor:
        """Return the nodal forces (B, N, D) of first Piola-Kirchhoff stresses (B, E, Q, 3, 3)."""
        dim = self.shape[1]
        weighted = stress[..., :dim, :dim] * self.dV[..., None, None]
        weighted = weighted.transpose(-3, -2).flatten(-2)  # (B, E, D, QD)
        return self._gathered((weighted @ self._operator.mT).mT)

    def _gathered(self, per_cell: Tensor) -> Tensor:
        """Return the nodal sums (B, N, D) of what each cell has at its nodes (B, E, A, D)."""
        force = per_cell.new_zeros(len(per_cell), *self.shape)
        return force.index_add(1, self.cells.flatten(), per_cell.flatten(1, 2))

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
        change = volume_change(self._gradient(displacement))
        return 1 + torch.nan_to_num(change, nan=-torch.inf).flatten(1).amin(dim=1)

    def stress(self, displacement: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress over E at the quadrature points, (B,E,Q,3,3)."""
        return self.material.stress(self._gradient(displacement))

    @cached_property
    def pattern(self) -> Pattern:
        """The tangent's sparsity, analysed once."""
        nodes, dim = self.shape
        free = self.free.cpu().numpy()
        number = np.full(nodes * dim, -1, dtype=np.int64)
        number[free.ravel()] = np.arange(free.sum())
        cells = self.cells.cpu().numpy()
        dofs = number.reshape(nodes, dim)[cells]  # (E, A, D)
        rows = dofs[:, :, :, None, None]  # laid out as the cell matrices: (E, A, i, k, A)
        columns = dofs.transpose(0, 2, 1)[:, None, None]
        kept = np.flatnonzero((rows >= 0) & (rows <= columns))
        shape = (*dofs.shape, dim, dofs.shape[1])
        rows, columns = (np.broadcast_to(d, shape).ravel()[kept] for d in (rows, columns))
        size = int(free.sum())
        codes, target = np.unique(rows * size + columns, return_inverse=True)
        indptr = np.searchsorted(codes // size, np.arange(size + 1))
        return Pattern(
            size=size,
            indptr=indptr.astype(np.int32),
            indices=(codes % size).astype(np.int32),
            source=torch.from_numpy(kept),
            target=torch.from_numpy(target.ravel()),
        )

    def loose_modes(self) -> list[str]:
        """Return the rigid motions that the supports leave free, named; none of them if held."""
        points = self.points.cpu().numpy() - self.points.cpu().numpy().mean(axis=0)
        nodes, dim = points.shape
        motions, names = [], []
        for axis in range(dim):
            motions.append(np.tile(np.eye(dim)[axis], (nodes, 1)))
            names.append(f"translation along {'xyz'[axis]}")
        for i, j in [(1, 2), (0, 2), (0, 1)] if dim == 3 else [(0, 1)]:
            turn = np.zeros((nodes, dim))
            turn[:, i], turn[:, j] = -points[:, j], points[:, i]
            motions.append(turn)
            names.append(f"rotation about {'xyz'[3 - i - j]}")
        held = ~self.free.cpu().numpy()
        grip = np.stack([motion[held] for motion in motions], axis=1)  # (held, motions)
        if not len(grip):
            return names
        rank = np.linalg.matrix_rank(grip, tol=1e-8 * max(1.0, np.abs(grip).max()))
        if rank == len(names):
            return []
        null = np.linalg.svd(grip)[2][rank:]
        return [names[k] for k in np.unique(np.abs(null).argmax(axis=1))]

    @cached_property
    def _operator(self) -> Tensor:
        """Gradients as matrices (E or 1, A, Q D); a plain matrix (A, Q D) where cells are equal."""
        operator = self.dN.transpose(1, 2).flatten(-2).contiguous()
        return operator[0] if self.equal_cells else operator

    def _gradient(self, displacement: Tensor) -> Tensor:
        """Return H = du/dX, (B, E, Q, 3, 3) [-]; in 2D with zeros out of the plane."""
        dim = displacement.shape[-1]
        at_cells = displacement[:, self.cells].mT  # (B, E, D, A)
        gradient = (at_cells @ self._operator).unflatten(-1, (-1, dim))  # (B, E, D, Q, D)
        # components first in memory: laws work on long rows and not on 3 x 3
        gradient = gradient.permute(2, 4, 0, 1, 3).contiguous().permute(2, 3, 4, 0, 1)
        return gradient if dim == 3 else torch.nn.functional.pad(gradient, (0, 1, 0, 1))


def _basis(mesh: skfem.Mesh, degree: int) -> skfem.Basis:
    shape = mesh.elem.refdom.name
    if (shape, degree) not in ELEMENTS:
        raise ValueError(f"{shape} cells cannot be solved")
    element, order = ELEMENTS[shape, degree]
    return skfem.Basis(mesh, element(), intorder=order)
