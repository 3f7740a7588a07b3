"""Nonlinear strain and unbalanced stress at a few sample cells of a body.

All functions take displacement gradients H = du/dX (..., 3, 3), in 2D padded with zeros, or rows of
their entries, and are differentiable tensor operations that keep their relative accuracy for small
H. In rows, (..., 9, c), work runs along cells, and graphs have few nodes.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.material import Material
from dpl.fem.materials.rows import (
    EYE,
    TRANSPOSED,
    in_rows,
    invariants,
    minors,
    product,
    transposed,
)
from dpl.fem.problem import Problem
from dpl.fem.solvers.rotation_strain import rotated_strain
from dpl.models.unrolled.feature_loops import MIN_VOLUME_RATIO, POLAR_ITER


class SampleCells(NamedTuple):
    """Cells at which strain and stress of a displacement in a subspace are evaluated.

    A displacement has R coordinates c and, as the last one, the constant 1, the coordinate of the
    prescribed displacement.

    Attributes:
        gradients: Displacement gradients of the coordinates at the C cells, (R + 1, C, D, D).
    """

    gradients: Tensor

    def gradient(self, coordinates: Tensor) -> Tensor:
        """Return H at the cells, (B, C, 3, 3), in 2D padded with zeros, of c (B, R)."""
        R, C, D, _ = self.gradients.shape
        rows = self.gradients.reshape(R, -1)
        H = (coordinates @ rows[:-1] + rows[-1]).view(-1, C, D, D)
        return H if D == 3 else pad(H, (0, 1, 0, 1))

    def first_features(self, linear: Tensor) -> Tensor:
        """Return `rotated_strain`, (B, C, 1, D, D), of the linear solution's H (B, C, 3, 3)."""
        D = self.gradients.shape[-1]
        return rotated_strain(in_rows(linear)).mT.unflatten(-1, (1, 3, 3))[..., :D, :D]

    def features(self, law: Material, coordinates: Tensor, linear: Tensor) -> Tensor:
        """Return `unbalanced_stress` (B, C, 2, D, D) of c (B, R) and the linear H (B, C, 3, 3)."""
        D, rest = self.gradients.shape[-1], law.rest_stress(linear[:, :, None])[:, :, 0]
        rows = unbalanced_stress(law, in_rows(self.gradient(coordinates)), in_rows(rest))
        return rows.mT.unflatten(-1, (2, 3, 3))[..., :D, :D]


def cell_gradients(problem: Problem, fields: Tensor, cells: Tensor) -> Tensor:
    """Return mean gradients (R, C, D, D) of displacements (R, N, D) in cells, by number (C,)."""
    share = problem.dV / problem.dV.sum(dim=1, keepdim=True)
    mean = (problem.dN * share[..., None, None]).sum(dim=1).expand(len(problem.cells), -1, -1)
    return fields[:, problem.cells[cells]].mT @ mean[cells]


def mechanical_maps(
    problem: Problem, cells: Tensor, gradients: Tensor, inverse: Tensor
) -> list[Tensor]:
    """Return the maps (C D D, R) and (2 C D D, R) to which the ridge of the fit shrinks.

    The volumes of the sample cells are scaled to the volume of the body. The first map is the
    Galerkin solution of the linear body under the stress of the rotated strain. The others are a
    modified Newton iteration: the Galerkin solution under the stress -R^T dP.

    Args:
        problem, cells: The body, and numbers of its sample cells, (C,).
        gradients: Displacement gradients of the modes at them, (R, C, D, D).
        inverse: (V^T K(0) V)^-1, (R, R).
    """
    volumes = problem.dV.sum(dim=1).expand(len(problem.cells))
    shares = volumes[cells] * (volumes.sum() / volumes[cells].sum())
    dim, law = gradients.shape[-1], problem.reference.material.of_cells(cells).centred()
    whole = pad(gradients, (0, 3 - dim, 0, 3 - dim))[:, :, None]
    stress = law.rest_stress(whole)[:, :, 0, :dim, :dim]
    both = torch.stack([-gradients, torch.zeros_like(gradients)], dim=2)
    weighted = (shares[:, None, None] * stress, shares[:, None, None, None] * both)
    return [part.flatten(1).T @ inverse for part in weighted]


def unbalanced_stress(law: Material, H: Tensor, rest: Tensor) -> Tensor:
    """Return [R^T dP, dP] in rows, (B, ..., 18, c), with dP = P(H) - P(0) - A(0) : linear.

    P(0) is in equilibrium, and A(0) : linear is in equilibrium with the load, so that dP is the
    stress which is not. R is the rotation of F = I + H (polar decomposition). Where det F is below
    `MIN_VOLUME_RATIO`, H counts as zero, so that the result is finite.

    Args:
        law: The law of the C cells.
        H: Displacement gradients in rows, (B, ..., 9, c).
        rest: A(0) : H of the linear solution in rows, (B, ..., 9, c).
    """
    first, second, third, _ = invariants(H)
    change = first + second + third
    valid = change > MIN_VOLUME_RATIO - 1
    H, change = torch.where(valid, H, 0.0), torch.where(valid, change, 0.0)
    stress = _stress(law, H, change) - rest
    return torch.cat([product(_rotation(H), stress, TRANSPOSED), stress], dim=-2)


def by_points(function: Callable[[Tensor], Tensor], H: Tensor) -> Tensor:
    """Return a function of one point of each cell, (B, C, 1, 3, 3), at H in rows, in rows."""
    found = function(H.mT.flatten(1, -2).unflatten(-1, (3, 3))[:, :, None])
    return found.flatten(-2)[:, :, 0].reshape(H.mT.shape).mT


def rest_stress(law: Material, H: Tensor) -> Tensor:
    """Return A(0) : H, the stress of small strains, in rows of H in rows, (B, ..., 9, c)."""
    law = one_law(law)
    if not isinstance(law, InvariantBasedMaterial):
        return by_points(law.rest_stress, H)
    trace = H[..., ::4, :].sum(dim=-2, keepdim=True)
    mu, lam = (_in_row(x, trace.flatten(1).unsqueeze(-1), trace) for x in law.moduli_at_rest)
    return mu * (H + transposed(H)) + lam * trace * EYE.to(H)


def _stress(law: Material, H: Tensor, change: Tensor) -> Tensor:
    """Return P(H) - P(0) in rows of H in rows, det F = 1 + change; see `InvariantBasedMaterial`.

    I - X = 2 E X is taken from the cofactors of 2 E, in which no terms cancel.
    """
    law = one_law(law)
    if not isinstance(law, InvariantBasedMaterial):
        return by_points(lambda at: law.stress(at) - law.residual_stress(at), H)
    e = H + transposed(H)
    e = e + product(H, H, TRANSPOSED) if law.finite else e
    i1, second, third, cofactor = invariants(e)
    j, first, other = (s.flatten(1).unsqueeze(-1) for s in (change, i1, 2 * i1 + second))
    log_j = torch.log1p(j)
    m1 = torch.expm1(-2 / 3 * log_j)
    found = law.invariant_derivatives(law.constants, first, other, j, log_j, m1)
    rest, W2, p = (_in_row(s, j, i1) if isinstance(s, Tensor) else s for s in found[:3])
    eye = EYE.to(H)
    S: Tensor = rest * eye
    if isinstance(W2, Tensor) or W2:
        S = S + 2 * W2 * (i1 * eye - e)
    if isinstance(p, Tensor) or p:  # else a collapsed body, C singular, has a stress too
        beyond = second + third
        S = S + p / (1 + i1 + beyond) * (cofactor - e - beyond * eye)
    return S + product(H, S) if law.finite else S


def _in_row(values: Tensor, points: Tensor, row: Tensor) -> Tensor:
    """Return values that broadcast with `points`, (B, C, 1), in the shape of `row`."""
    is_whole = values.shape[1:] == points.shape[1:]  # graphs need no copy of them
    return (values if is_whole else values.expand_as(points)).reshape(row.shape)


def _rotation(H: Tensor) -> Tensor:
    """Return the rotation R of F = I + H, det F > 0, all in rows.

    Source: Higham (1986), SIAM J. Sci. Stat. Comput. 7: X <- (X + X^-T) / 2.
    """
    X = H + EYE.to(H)
    for _ in range(POLAR_ITER):
        cofactor = minors(X)
        X = 0.5 * X + cofactor * (1.5 / (X * cofactor).sum(dim=-2, keepdim=True))
    return X
