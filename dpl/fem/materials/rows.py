"""Small tensor algebra in rows: entries of 3 x 3 matrices one after the other, (..., 9, c).

Work runs along c points, and graphs have few nodes. The accuracy is that of
`dpl.fem.materials.tensors`.
"""

import numpy as np
import torch
from torch import Tensor

EYE = torch.eye(3, dtype=torch.float64).view(9, 1)
TRANSPOSE = torch.arange(9).view(3, 3).T.flatten()
# entries (i+1, j+1) and (i+1, j+2), and (i+2, j+2) and (i+2, j+1), modulo 3 of a matrix, (18,) each
MINORS = tuple(
    torch.tensor([3 * ((i + di) % 3) + (j + dj) % 3 for dj in order for i, j in np.ndindex(3, 3)])
    for di, order in ((1, (1, 2)), (2, (2, 1)))
)
# rows of A, of A^T and of B in the terms (k, i, j) of (A B)_ij = sum_k A_ik B_kj, (27,) each
PLAIN, TRANSPOSED, RIGHT = (
    torch.tensor([3 * term[a] + term[b] for term in np.ndindex(3, 3, 3)])
    for a, b in ((1, 0), (0, 1), (0, 2))
)


def in_rows(values: Tensor) -> Tensor:
    """Return matrices (..., c, 3, 3) in rows, (..., 9, c)."""
    return values.flatten(-2).mT


def transposed(X: Tensor) -> Tensor:
    """Return X^T in rows."""
    return X.index_select(-2, TRANSPOSE.to(X.device))


def minors(X: Tensor) -> Tensor:
    """Return cof X in rows."""
    first, second = (X.index_select(-2, rows.to(X.device)) for rows in MINORS)
    one, other = (first * second).split(9, dim=-2)
    return one - other


def invariants(X: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return tr X, its sum of principal minors and det X, (..., 1, c), and cof X in rows."""
    cofactor = minors(X)
    first, second = (part[..., ::4, :].sum(dim=-2, keepdim=True) for part in (X, cofactor))
    return first, second, (X * cofactor).sum(dim=-2, keepdim=True) / 3, cofactor


def product(A: Tensor, B: Tensor, left: Tensor = PLAIN) -> Tensor:
    """Return A B in rows, or A^T B for `left` = `TRANSPOSED`."""
    terms = A.index_select(-2, left.to(A.device)) * B.index_select(-2, RIGHT.to(B.device))
    return terms.unflatten(-2, (3, 9)).sum(dim=-3)
