"""Cells and shape functions of a body, and the linear maps between fields, points and nodes."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.elements import (
    QUADRATICALLY,
    basis_of,
    gradients,
    is_simplex,
    reference_gradients,
)
from dpl.fem.assembly.kernels import CompiledLoops, Kernels
from dpl.fem.assembly.mean_dilatation import POINT_SHEAR, CellVolumes, polynomials
from dpl.fem.assembly.recovery import Recovery
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.materials.material import Material


def geometry(basis: skfem.Basis, degree: int, *, mean_dilatation: bool) -> dict[str, Any]:
    """Return the attributes of a `Discretisation` that a basis decides, by name."""
    dN, dV = gradients(basis)
    functions = None
    if mean_dilatation:
        if degree == 1 and is_simplex(basis.mesh):
            raise ValueError(
                "mean_dilatation = true must be used with hexahedra, quadrilaterals or quadratic "
                f"elements; {QUADRATICALLY}, or mesh the body with hexahedra"
            )
        at = np.asarray(basis.global_coordinates())[:, : len(dV)].transpose(1, 2, 0)
        points = torch.from_numpy(np.ascontiguousarray(at))
        linear = degree == 2 and not is_simplex(basis.mesh)
        functions = polynomials(points, torch.from_numpy(dV.copy()), linear=linear)
    boundary = np.zeros(basis.N, dtype=bool)
    boundary[basis.get_dofs(basis.mesh.boundary_facets()).all()] = True
    arrays = {
        "points": basis.doflocs.T,
        "cells": basis.element_dofs.T.astype(np.int64),
        **{"dN": dN, "dV": dV, "boundary": boundary},
    }
    tensors = {key: torch.from_numpy(np.ascontiguousarray(a)) for key, a in arrays.items()}
    return {"mesh": basis.mesh, "degree": degree, "volume_functions": functions, **tensors}


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Parts of a body that depend neither on its law nor on its loads.

    It is made once and shared by all bodies that `dataclasses.replace` makes from the first one,
    together with everything that is computed from it at the first use.

    Attributes: See `Problem`.
    """

    mesh: skfem.Mesh
    degree: int
    points: Tensor
    cells: Tensor
    dN: Tensor
    dV: Tensor
    free: Tensor
    boundary: Tensor
    volume_functions: Tensor | None
    links: Tensor

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without cached properties."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def shape(self) -> tuple[int, int]:
        """N and D."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def equal_cells(self) -> bool:
        """True if all cells share one set of gradients."""
        return len(self.dN) == 1

    @property
    def volumes(self) -> CellVolumes | None:
        """Polynomials of the volume change in the cells; None without mean dilatation."""
        if (functions := self.volume_functions) is None:
            return None
        is_reduced = self.degree == 2 and functions.shape[-1] == 1  # simplices
        return CellVolumes(functions, self.dV, POINT_SHEAR if is_reduced else 0.0)

    @cached_property
    def basis(self) -> skfem.Basis:
        """scikit-fem's basis of one displacement component."""
        return basis_of(self.mesh, self.degree)

    @cached_property
    def free_numbers(self) -> NDArray[np.int64]:
        """Numbers of the free degrees of freedom, (n,)."""
        return np.flatnonzero(self.free.numpy())

    @cached_property
    def pattern(self) -> Pattern:
        """Sparsity pattern of the tangent."""
        return Pattern.build(*(part.cpu().numpy() for part in (self.cells, self.links, self.free)))

    @cached_property
    def recovery(self) -> Recovery:
        """Values at nodes from values at quadrature points."""
        at = np.asarray(self.basis.global_coordinates()).transpose(1, 2, 0)
        dV = self.dV.expand(len(self.cells), -1)
        points, cells, boundary, volumes = (
            part.cpu().numpy() for part in (self.points, self.cells, self.boundary, dV)
        )
        return Recovery.build(points, cells, boundary, at, volumes, self.degree)

    def compiled(self, material: Material) -> CompiledLoops | None:
        """Return the compiled loops of a law, None where it has none."""
        groups = material.groups(len(self.cells))
        if any(law.compiled_form is None for law, _ in groups):
            return None
        loops = [self._loops_over(cells.numpy()).with_law(law) for law, cells in groups]
        return CompiledLoops(loops, len(self.pattern.indices))

    def _loops_over(self, numbers: NDArray[np.int64]) -> Kernels:
        """Return the loops over some cells, whose arrays all laws share."""
        key = numbers.tobytes()
        if key not in self._kernels:
            own, volumes = [0] if self.equal_cells else numbers, self.volumes
            if volumes is not None:
                volumes = volumes._replace(functions=volumes.functions[own])
            self._kernels[key] = Kernels(
                cells=self.cells.numpy()[numbers],
                reference=reference_gradients(self.mesh, self.degree),
                dN=self.dN.numpy()[own],
                dV=self.dV.numpy()[own],
                places=self.pattern.places.reshape(len(self.cells), -1)[numbers],
                volumes=volumes,
            )
        return self._kernels[key]

    @cached_property
    def _kernels(self) -> dict[bytes, Kernels]:
        return {}

    def gradient(self, displacement: Tensor) -> Tensor:
        """Return H = du/dX, (B, E, Q, 3, 3) [-]; in 2D padded with zeros."""
        dim, at_cells = self.shape[1], displacement[:, self.cells].mT  # (B, E, D, A)
        gradient = (at_cells @ self._operator).unflatten(-1, (-1, dim))  # (B, E, D, Q, D)
        # components first in memory, so that laws operate on long rows instead of 3 x 3 matrices
        gradient = gradient.permute(2, 4, 0, 1, 3).contiguous().permute(2, 3, 4, 0, 1)
        return gradient if dim == 3 else torch.nn.functional.pad(gradient, (0, 1, 0, 1))

    @cached_property
    def _operator(self) -> Tensor:
        """Gradients as matrices (E, A, Q D), or as one matrix (A, Q D) if all cells are equal."""
        operator = self.dN.transpose(1, 2).flatten(-2).contiguous()
        return operator[0] if self.equal_cells else operator

    def nodal_forces(self, stress: Tensor) -> Tensor:
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
        force = per_cell.new_zeros(per_cell.shape[0], *self.shape)
        return force.index_add(1, self.cells.flatten(), per_cell.flatten(1, 2))

    def relative_rounding(self, material: Material) -> Tensor:
        """Return a bound of the rounding error of ||R_free|| over max |u|, (1,) or (B,) [-].

        The bound follows from magnitudes: every nodal force is a sum of products of displacement,
        gradient, modulus and gradient. On slivers it exceeds any tolerance.
        """
        size = self.dN.norm(dim=-1)  # (E or 1, Q, A)
        terms = (self.dV[..., None] * size * size.sum(-1, keepdim=True)).sum(1)
        modulus = material.lam + 2 * material.mu
        terms = (modulus.to(terms) * terms[None])[..., None]  # (B or 1, E, A, 1)
        terms = terms.expand(-1, len(self.cells), -1, self.shape[1])
        summed = torch.where(self.free.any(dim=1), self._sum_at_nodes(terms)[..., 0], 0.0)
        return torch.finfo(torch.float64).eps * summed.norm(dim=1)

    def entries(
        self, moduli: Tensor, slope: Tensor | None = None, stiffness: Tensor | None = None
    ) -> Tensor:
        """Return the entries of the tangent (B, nnz) of dP/dF (B, E, Q, 3, 3, 3, 3).

        With mean dilatation `slope` and `stiffness` are the other parts of
        `mean_dilatation.Tangent`.
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
        count, nnz = self.cells.shape[1], len(self.pattern.indices)
        matrices = matrices.unflatten(-1, (dim, dim, count)).movedim(-1, 3)  # laid out abik
        b, a = np.tril_indices(count)
        pairs = matrices[:, :, a, b].flatten(1)
        values = pairs.new_zeros(samples, nnz + 1)
        return values.index_add(1, self._places.to(pairs.device), pairs)[:, :nnz]

    @cached_property
    def _places(self) -> Tensor:
        """Positions of the entries of all cell matrices, see `Pattern.places`."""
        return torch.from_numpy(self.pattern.places.ravel())
