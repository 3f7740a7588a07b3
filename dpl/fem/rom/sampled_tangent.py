"""Tangent of a body in a subspace, its nonlinear part sampled at one point of each chosen cell."""

from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly import reduced_loops
from dpl.fem.assembly.kernels import call_compiled, constants_of
from dpl.fem.assembly.numba_laws import Law, required_terms
from dpl.fem.linear.interface import full_matrix
from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.materials.material import Material
from dpl.fem.problem import Problem
from dpl.fem.rom.ecsw import Cubature, whitening
from dpl.fem.rom.reduced_stiffness import reduced_terms
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class SampledTangent:
    """W^T K(u) W with W = V L^-T, L L^T = V^T K(0) V, so that it is the identity at rest.

    With a cubature it is W^T K(0) W + sum_e w_e vol_e G_e^T (A(H_e) - A(0)) G_e, where H_e is the
    mean displacement gradient of the cell, G_e that of W, and A = dP/dF. The sum is zero at rest;
    only it is sampled, in float32, which suffices because W^T K W has eigenvalues close to one.
    Without a cubature it is the tangent of the whole body.

    Attributes:
        problem: The body; its law may have ranges.
        scale: L^-T, (R, R), at the centres of the ranges.
        rows: W, (N D, R), in float32.
    """

    def __init__(self, problem: Problem, vectors: Tensor, cubature: Cubature | None) -> None:
        """Reduce a body to V (N, D, R) and to weighted cells; None: all cells, not sampled."""
        self.problem = problem
        scale = whitening(problem.reference, vectors)
        white = (vectors @ scale).flatten(0, 1)
        self.scale = scale.numpy()
        self.rows: Single = white.float().numpy()
        self._white = white.numpy()
        if cubature is not None:
            self._sample(cubature)
        self._has_cells = cubature is not None

    def _sample(self, chosen: Cubature) -> None:
        problem, count = self.problem, len(chosen.cells)

        def of_cells(tensor: Tensor) -> Tensor:
            return tensor.expand(len(problem.cells), *tensor.shape[1:])[chosen.cells]

        dN, dV = of_cells(problem.dN), of_cells(problem.dV)
        volume = dV.sum(1)
        mean = (dN * dV[..., None, None]).sum(1) / volume[:, None, None]  # (C, A, D)
        nodes = problem.cells[chosen.cells]
        dim, rank = problem.shape[1], self.rows.shape[1]
        white = torch.from_numpy(self._white).view(*problem.shape, rank)
        basis = torch.einsum("cair,caj->cijr", white[nodes], mean)
        self._cells = chosen.cells
        self._nodes = nodes.contiguous().numpy()
        self._dN = mean[:, None].contiguous().numpy()
        self._dV = (volume * chosen.weights.double())[:, None].contiguous().numpy()
        self._basis: Single = basis.reshape(count, dim * dim, rank).float().contiguous().numpy()

    def at(self, problem: Problem, displacement: Tensor, *, whole: bool = False) -> Array:
        """Return the matrix (R, R) at a displacement (N, D) of the body with its parameters.

        Only its symmetric part has a meaning; rounding makes the matrix slightly unsymmetric.

        Args:
            problem: The body with its parameters.
            displacement: (N, D) [-].
            whole: Sum over all cells, not the chosen ones.
        """
        if whole or not self._has_cells:
            return self._projection(problem, problem.linearise(displacement[None]).tangent[0])
        product = self._moduli_change_product(problem, displacement)
        rank = product.shape[2]
        change = self._basis.reshape(-1, rank).T @ product.reshape(-1, rank)
        return self._at_rest(problem.material) + change

    def _moduli_change_product(self, problem: Problem, displacement: Tensor) -> Single:
        """Return w vol (A(H) - A(0)) G, (C, D D, R)."""
        law = one_law(problem.material.of_cells(self._cells).centred())
        if (form := law.compiled_form) is None:
            return self._reference_product(law, displacement)
        out = np.empty_like(self._basis)
        u = displacement.contiguous().numpy()
        call_compiled(
            reduced_loops.moduli_change_product,
            *(Law.of(form, reduced_loops.SOURCES), constants_of(law)[0]),
            *(self._required_terms, float(law.finite)),
            *(u, self._nodes, self._dN, self._dV, self._basis, out),
        )
        return out

    def _reference_product(self, law: Material, displacement: Tensor) -> Single:
        """Return the same by tensor operations, for laws without compiled loops."""
        dim = self.problem.shape[1]
        at_cells = displacement[torch.from_numpy(self._nodes)]
        H = torch.einsum("cai,caj->cij", at_cells, torch.from_numpy(self._dN[:, 0]))
        H = torch.nn.functional.pad(H, (0, 3 - dim, 0, 3 - dim))[None, :, None]
        change = (law.tangent(H) - law.tangent(torch.zeros_like(H)))[0, :, 0]
        change = (
            change[:, :dim, :dim, :dim, :dim] * torch.from_numpy(self._dV)[..., None, None, None]
        )
        return change.reshape(-1, dim * dim, dim * dim).float().numpy() @ self._basis

    @cached_property
    def _required_terms(self) -> int:
        form = one_law(self.problem.reference.material).compiled_form
        assert form is not None
        return required_terms(form)

    def _at_rest(self, law: Material) -> Array:
        """Return W^T K(0) W, (R, R), of a law of the body."""
        if not self.problem.material.parameter_ranges:
            return np.eye(len(self.scale))
        factors = np.append(self._terms.factors(law)[0].numpy(), 1.0)
        return np.tensordot(factors, self._reduced_terms, 1)

    @cached_property
    def _reduced_terms(self) -> Array:
        """W^T K_k W of the terms of K(0) and of the springs, (T + 1, R, R)."""
        free = self.problem.free.flatten().numpy()
        return reduced_terms(self._terms, torch.from_numpy(self._white[free]))[..., :-1].numpy()

    @cached_property
    def _terms(self) -> StiffnessTerms:
        return StiffnessTerms.of(self.problem)

    def _projection(self, problem: Problem, tangent: Tensor) -> Array:
        """Return W^T K W of the entries (nnz,) of a tangent."""
        free = problem.free.flatten().numpy()
        white = self._white if free.all() else self._white[free]
        return white.T @ (full_matrix(problem.pattern, tangent.numpy()) @ white)
