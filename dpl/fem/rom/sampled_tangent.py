"""Tangent of a body in a subspace, its nonlinear part sampled at one point of each chosen cell."""

from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from dpl.fem.assembly import element_loops
from dpl.fem.assembly.kernels import call_compiled, constants_of
from dpl.fem.assembly.numba_laws import Law
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.materials.material import Material
from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, ReducedMesh, whitening
from dpl.fem.rom.reduced_stiffness import reduced_terms
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class SampledTangent:
    """W^T K(u) W with W = V L^-T, L L^T = V^T K(0) V, so that it is the identity at rest.

    With a cubature it is W^T K(0) W + sum_e w_e vol_e G_e^T (A(H_e) - A(0)) G_e, where H_e is the
    mean displacement gradient of the cell, G_e that of W, and A = dP/dF. The sum is zero at rest;
    only it is sampled, in float32, which suffices because W^T K W has eigenvalues close to one.
    Without a cubature it is the tangent of the whole body. The stiffness of follower loads is added
    for all facets and cells under them, its symmetric part only.

    Attributes:
        problem: The body; its law may have ranges.
        scale: L^-T, (R, R), at the centres of the ranges.
        rows: W, (N D, R), in float32.
    """

    def __init__(self, problem: Problem, vectors: Tensor, cubature: Cubature | None) -> None:
        """Reduce a body to V (N, D, R) and to weighted cells; None: all cells, not sampled."""
        self.problem, self._has_cells = problem, cubature is not None
        scale = whitening(problem.reference, vectors)
        white = vectors @ scale
        self.scale, self._white = scale.numpy(), white[problem.free].numpy()
        self.rows: Single = white.flatten(0, 1).float().numpy()
        self._last: tuple[Material, tuple[Material, tuple[Any, ...] | None]] | None = None
        if cubature is not None:
            self._cells = cubature.cells
            sampled = ReducedMesh(problem, white, self._cells, cubature.weights.double())
            dN, dV, nodes = sampled.problem.dN, sampled.problem.dV, problem.cells[self._cells]
            volume = dV.sum(dim=1, keepdim=True)
            mean = (dN * (dV / volume)[..., None, None]).sum(dim=1)  # (C, A, D)
            basis = torch.einsum("cair,caj->cijr", white[nodes], mean).flatten(1, 2)
            self._nodes, self._dV = nodes.numpy(), volume.numpy()
            self._dN: Array = mean[:, None].contiguous().numpy()
            self._basis: Single = basis.float().contiguous().numpy()
        if problem.follower_loads:
            self._loaded, dofs = problem.follower_loads.pattern_on(problem.pattern)
            self._loaded_rows = self._white[dofs]

    def at(self, problem: Problem, displacement: Tensor, *, whole: bool = False) -> Array:
        """Return the matrix (R, R) at a displacement (N, D) of the body with its parameters.

        Only its symmetric part has a meaning; rounding makes the matrix slightly unsymmetric. With
        `whole` it sums over all cells instead of the chosen ones.
        """
        if whole or not self._has_cells:
            entries = problem.linearise(displacement[None]).tangent[0]
            return _projection(problem.pattern, entries, self._white)
        product, rank = self._moduli_change_product(problem, displacement), len(self.scale)
        change = self._basis.reshape(-1, rank).T @ product.reshape(-1, rank)
        if problem.follower_loads:
            stiffness, _ = problem.follower_loads.stiffness(displacement[None], self._loaded)
            change = change + _projection(self._loaded, stiffness[0], self._loaded_rows)
        if not self.problem.material.parameter_ranges:
            return np.eye(rank) + change
        terms, matrices = self._terms
        factors = np.append(terms.factors(problem.material)[0].numpy(), 1.0)
        return np.tensordot(factors, matrices, 1) + change

    def _moduli_change_product(self, problem: Problem, displacement: Tensor) -> Single:
        """Return w vol (A(H) - A(0)) G, (C, D D, R)."""
        law, compiled = self._law(problem)
        if compiled is None:
            return self._reference_product(law, displacement)
        out = np.empty_like(self._basis)
        u = displacement.contiguous().numpy()
        arrays = u, self._nodes, self._dN, self._dV, self._basis, out
        call_compiled(element_loops.moduli_change_product, *compiled, *arrays)
        return out

    def _law(self, problem: Problem) -> tuple[Material, tuple[Any, ...] | None]:
        """Return the law of the cells, the last one kept, and as first arguments of the loop."""
        last = self._last  # read once: another thread may replace it
        if last and last[0] is problem.material:
            return last[1]
        law = one_law(problem.material.of_cells(self._cells).centred())
        arguments, form = None, law.compiled_form
        if form is not None:
            key = Law.of(form, element_loops.SOURCES)
            arguments = key, constants_of(law)[0], float(law.finite)
        self._last = problem.material, (law, arguments)
        return law, arguments

    def _reference_product(self, law: Material, displacement: Tensor) -> Single:
        """Return the same by tensor operations, for laws without compiled loops."""
        dim = self.problem.shape[1]
        at_cells = displacement[torch.from_numpy(self._nodes)]
        H = torch.einsum("cai,caj->cij", at_cells, torch.from_numpy(self._dN[:, 0]))
        H = torch.nn.functional.pad(H, (0, 3 - dim, 0, 3 - dim))[None, :, None]
        change = (law.tangent(H) - law.tangent(torch.zeros_like(H)))[0, :, 0]
        change = change[:, :dim, :dim, :dim, :dim].reshape(-1, dim * dim, dim * dim)
        return (change * torch.from_numpy(self._dV)[..., None]).float().numpy() @ self._basis

    @cached_property
    def _terms(self) -> tuple[StiffnessTerms, Array]:
        """Terms of K(0), and W^T K_k W of them and of the springs, (T + 1, R, R)."""
        terms = StiffnessTerms.of(self.problem)
        return terms, reduced_terms(terms, torch.from_numpy(self._white))[..., :-1].numpy()


def _projection(pattern: Pattern, entries: Tensor, rows: Array) -> Array:
    """Return W^T K W, (R, R), of the upper entries (nnz,) of a matrix and the rows W (n, R)."""
    upper = csr_array((entries.numpy(), pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    half = rows.T @ (upper @ rows - upper.diagonal()[:, None] / 2 * rows)
    return half + half.T
