"""Reduced stiffness at rest as a function of the parameters of the law."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.linear.interface import full_matrix
from dpl.fem.problem import Problem
from dpl.fem.rom.stiffness_iteration import StiffnessIteration, conjugate_gradients
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

EXACT = 1e-12  # relative error of reduced solutions in graphs [-]

ReducedInverse = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class ReducedStiffness:
    """V^T K(0) [V, p] = sum_k a_k A_k + C, with the factors a of a law, see `StiffnessTerms`.

    p is the prescribed displacement and C is that of the springs.

    Attributes:
        parts: A_1, ..., A_T and C, (T + 1, R, R + 1).
        iteration: How traced graphs solve with three or more terms: ONNX has no linear solver.
    """

    parts: Tensor
    iteration: StiffnessIteration | None = None

    @classmethod
    def of(cls, terms: StiffnessTerms, modes: Tensor) -> "ReducedStiffness":
        """Return the stiffness of a body in modes V at its free degrees of freedom, (n, R)."""
        columns, free = modes.double().numpy(), terms.problem.free
        supports, products = terms.support_forces()[:-1, free], []
        for body, moved in zip(terms.bodies, supports, strict=True):
            matrix = full_matrix(body.pattern, body.stiffness_at_rest().numpy())
            own = torch.from_numpy(columns.T @ (matrix @ columns))
            products.append(torch.cat([(own + own.T) / 2, modes.double().T @ moved[:, None]], 1))
        return cls(torch.stack([*products, _springs(terms.problem, modes.double())]))

    def prepared(self) -> Self:
        """Return the stiffness with its factors, which a traced graph takes as constants."""
        if not self.parts.numel():
            return self
        if self._is_diagonal:
            self._spectrum  # noqa: B018  # computed and kept
        elif self.iteration is not None:
            self._inverse_of_node  # noqa: B018  # computed and kept
        return self

    def solve(self, factors: Tensor, right: Tensor) -> Tensor:
        """Return the coordinates (B, R) of Galerkin linear solutions.

        Without springs two terms are diagonal in one basis, W^T A_1 W = I and W^T A_2 W = diag(b),
        so that the inverse is W diag(1 / (a_1 + a_2 b)) W^T for all factors.

        Args:
            factors: a, (1, T) or (B, T).
            right: V^T f, (B, R).
        """
        factors = factors.to(right)
        right = right - factors @ self.parts[:-1, :, -1].to(right) - self.parts[-1, :, -1].to(right)
        if not self._is_diagonal:
            whole = self.at(factors)[..., :-1]
            if torch.compiler.is_compiling() and self.iteration is not None:
                return self._iterated(whole, right)
            return torch.linalg.solve(whole, right[..., None])[..., 0]
        vectors, values = (part.to(right) for part in self._spectrum)
        return (right @ vectors / (factors @ values)) @ vectors.T

    def _iterated(self, matrix: Tensor, right: Tensor) -> Tensor:
        """Return A^-1 b, (B, R), of A (B, R, R) and b (B, R), by conjugate gradients.

        A projection has no larger condition number than K(node)^-1 K(0). Four times the steps of a
        solution have the fourth power of its error: the maps amplify errors of large loads.
        """
        assert self.iteration is not None
        inverse = self._inverse_of_node.to(right)

        def product(x: Tensor) -> Tensor:
            return (matrix @ x[..., None])[..., 0]

        steps = 4 * self.iteration.bound
        return conjugate_gradients(product, lambda r: r @ inverse, right, steps, EXACT)

    @cached_property
    def _inverse_of_node(self) -> Tensor:
        """(V^T K(node) V)^-1, (R, R)."""
        assert self.iteration is not None
        node = torch.tensor([self.iteration.node], dtype=torch.float64)
        return torch.linalg.inv(self.at(node.to(self.parts))[0, :, :-1])

    def inverse(self, factors: Tensor) -> ReducedInverse:
        """Return (V^T K(0) V)^-1, (R, R), and V^T K(0) p, (R,), of factors (1, T)."""
        whole = self.at(factors)[0].numpy()
        if not self._is_diagonal:
            return np.ascontiguousarray(np.linalg.inv(whole[:, :-1])), whole[:, -1].copy()
        vectors, values = (part.numpy() for part in self._spectrum)
        return (vectors / (factors[0].numpy() @ values)) @ vectors.T, whole[:, -1].copy()

    @cached_property
    def _is_diagonal(self) -> bool:
        """True if one basis makes all terms diagonal: there are at most two, and no springs."""
        return len(self.parts) <= 3 and not self.parts[-1].any()

    @cached_property
    def _spectrum(self) -> tuple[Tensor, Tensor]:
        """W, (R, R), and diagonals of the terms, 1 and b, (T, R); see `solve`."""
        terms = [part[:, :-1].numpy() for part in self.parts[:-1].cpu()]
        values, vectors = scipy.linalg.eigh(terms[-1], terms[0])
        diagonals = [np.ones_like(values), values][: len(terms)]
        return torch.from_numpy(vectors), torch.from_numpy(np.stack(diagonals))

    def at(self, factors: Tensor) -> Tensor:
        """Return V^T K(0) [V, p], (B, R, R + 1), of factors (B, T)."""
        parts = self.parts.to(factors)
        return torch.einsum("bk,kij->bij", factors, parts[:-1]) + parts[-1]


def _springs(problem: Problem, modes: Tensor) -> Tensor:
    """Return V^T C [V, p], (R, R + 1), of the foundation."""
    count = modes.shape[1]
    if problem.springs is None:
        return torch.zeros(count, count + 1, dtype=torch.float64)
    fields = torch.zeros(count + 1, *problem.shape, dtype=torch.float64)
    fields[:-1, problem.free] = modes.T
    fields[-1] = problem.prescribed
    return modes.T @ problem.springs.force(fields)[:, problem.free].T
