"""Reduced stiffness at rest as a function of the parameters of the law."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.interface import full_matrix
from dpl.fem.linear.krylov import conjugate_gradients_of_tensors
from dpl.fem.rom.pod import scatter_fields
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

EXACT = 1e-12  # relative error of reduced solutions [-]

ReducedInverse = tuple[NDArray[np.float64], NDArray[np.float64]]


class ReducedStiffness:
    """V^T K(0) [V, p] = sum_k a_k A_k + C, with the factors a of a law, see `StiffnessTerms`.

    p is the prescribed displacement and C is that of the springs. The last column of C also has
    the constant follower loads at rest, V^T f_int(0).

    Attributes:
        parts: A_1, ..., A_T and C, (T + 1, R, R + 1).
    """

    def __init__(self, parts: Tensor, terms: StiffnessTerms) -> None:
        """Compute the inverse of the node from `reduced_terms` and the terms of the whole matrix.

        A projection has no larger condition number than K(node)^-1 K(0).
        """
        self.parts, self._steps = parts, 4 * terms.bound if terms.varies else 0
        self._inverse = torch.linalg.inv_ex(self.at(terms.node.to(parts))[0, :, :-1]).inverse

    def solve(self, factors: Tensor, right: Tensor) -> Tensor:
        """Return the coordinates (B, R) of Galerkin linear solutions of V^T f, (B, R).

        The factors a are (1, T) or (B, T). ONNX has no linear solver: the steps of conjugate
        gradients are the same in a graph. Four times the steps of a solution have the fourth power
        of its error; the maps amplify errors of large loads.
        """
        factors = pad(factors.to(right).expand(right.shape[0], -1), (0, 1), value=1.0)
        parts, inverse = self.parts.to(right), self._inverse.to(right)
        right = right - factors @ parts[..., -1]
        if not self._steps:
            return right @ inverse

        def product(x: Tensor) -> Tensor:
            return torch.einsum("bk,bi,kij->bj", factors, x, parts[..., :-1])

        maps = product, lambda r: r @ inverse
        return conjugate_gradients_of_tensors(*maps, right, EXACT, self._steps)

    def inverse(self, factors: Tensor) -> ReducedInverse:
        """Return (V^T K(0) V)^-1, (R, R), and V^T K(0) p, (R,), of factors (1, T)."""
        whole = self.at(factors)[0].numpy()
        return np.ascontiguousarray(np.linalg.inv(whole[:, :-1])), whole[:, -1].copy()

    def at(self, factors: Tensor) -> Tensor:
        """Return V^T K(0) [V, p], (B, R, R + 1), of factors (B, T)."""
        parts = self.parts.to(factors)
        return torch.einsum("bk,kij->bij", factors, parts[:-1]) + parts[-1]


def reduced_terms(terms: StiffnessTerms, modes: Tensor) -> Tensor:
    """Return V^T K_k [V, p] of each term and of the springs, (T + 1, R, R + 1), of V (n, R)."""
    problem, modes, products = terms.problem, modes.double(), []
    (*supports, constant), columns = terms.support_forces()[:, problem.free], modes.numpy()
    for body, moved in zip(terms.bodies, supports, strict=True):
        matrix = full_matrix(body.pattern, body.stiffness_at_rest().numpy())
        own = torch.from_numpy(columns.T @ (matrix @ columns))
        products.append(torch.cat([(own + own.T) / 2, modes.T @ moved[:, None]], 1))
    products.append(torch.zeros_like(products[0]))
    if problem.springs is not None:
        forces = problem.springs.force(scatter_fields(modes.T, problem.free))
        products[-1][:, :-1] = modes.T @ forces[:, problem.free].T
    products[-1][:, -1] = modes.T @ constant
    return torch.stack(products)
