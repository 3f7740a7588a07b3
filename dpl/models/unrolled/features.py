"""Nonlinear strain and unbalanced stress at a few sample cells of a body.

All functions take displacement gradients H = du/dX (..., 3, 3), in 2D padded with zeros, and are
differentiable tensor operations that keep their relative accuracy for small H.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.materials.material import Material
from dpl.fem.materials.tensors import product, volume_change
from dpl.fem.problem import Problem
from dpl.fem.solvers.rotation_strain import rotated_strain
from dpl.models.unrolled.feature_loops import MIN_VOLUME_RATIO, POLAR_ITER

# entries (i+1, j+1), (i+2, j+2), (i+1, j+2), (i+2, j+1) modulo 3 of a matrix, (4, 9)
MINORS = torch.tensor(
    [
        [3 * ((i + di) % 3) + (j + dj) % 3 for i in range(3) for j in range(3)]
        for di, dj in ((1, 1), (2, 2), (1, 2), (2, 1))
    ]
)


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
        return rotated_strain(linear)[:, :, None, :D, :D]

    def features(self, law: Material, coordinates: Tensor, linear: Tensor) -> Tensor:
        """Return `unbalanced_stress` (B, C, 2, D, D) of c (B, R) and the linear H (B, C, 3, 3)."""
        D = self.gradients.shape[-1]
        H = self.gradient(coordinates)
        return unbalanced_stress(law, H[:, :, None], linear[:, :, None])[:, :, 0, :, :D, :D]


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


def unbalanced_stress(law: Material, H: Tensor, linear: Tensor) -> Tensor:
    """Return [R^T dP, dP], (..., 2, 3, 3), with dP = P(H) - P(0) - A(0) : linear.

    P(0) is in equilibrium, and A(0) : linear is in equilibrium with the load, so that dP is the
    stress which is not. R is the rotation of F = I + H (polar decomposition). Where det F is below
    `MIN_VOLUME_RATIO`, H counts as zero, so that the result is finite.

    Args:
        law: The law; of a batch, H is (B, C, 1, 3, 3).
        H: Displacement gradient.
        linear: Displacement gradient of the linear solution.
    """
    valid = volume_change(H) > MIN_VOLUME_RATIO - 1
    H = torch.where(valid[..., None, None], H, 0.0)
    stress = law.stress(H) - law.residual_stress(H) - law.rest_stress(linear)
    return torch.stack([product(rotation(H).mT, stress), stress], dim=-3)


def rotation(H: Tensor) -> Tensor:
    """Return the rotation R (..., 3, 3) of F = I + H, det F > 0.

    Source: Higham (1986), SIAM J. Sci. Stat. Comput. 7: X <- (X + X^-T) / 2.
    """
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    X = F.flatten(-2).movedim(-1, 0)  # components first: work runs along rows, graphs are small
    for _ in range(POLAR_ITER):
        a, b, c, d = (X.index_select(0, rows) for rows in MINORS.to(H.device))
        minors = a * b - c * d
        X = (X + minors / (X[:3] * minors[:3]).sum(dim=0)) / 2
    return X.movedim(0, -1).unflatten(-1, (3, 3))
