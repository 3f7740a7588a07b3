"""Ridge regression of the maps of `dpl.models.Unrolled`, which keep parities."""

from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.parity import Parities, SignedOrbits

RIDGES = tuple(10.0**-k for k in range(16, 2, -1))  # relative to the mean square [-]
ROUNDING = 1e-10  # norm of a feature over the largest below which it is rounding error
LEAST = 1e-12  # part of a row that the other rows never predict [-]


def weighted_error(error: Tensor, weights: Tensor) -> float:
    """Return the mean of the weighted norms of the rows of errors (S, R); inf for NaN.

    Norms and not squares: a few samples beyond an instability, which no map predicts, would
    otherwise decide.
    """
    mean = float((error * weights[:, None]).norm(dim=1).mean())
    return mean if mean == mean else float("inf")


class MapParities(NamedTuple):
    """Parities of tensors at sample cells and of coordinates.

    Attributes:
        parities: Symmetries with diagonal matrices.
        positions: Position to which each of them maps each sample cell, (M, C).
        coordinates: Parity of each coordinate, (R,).
    """

    parities: Parities
    positions: Tensor
    coordinates: Tensor

    def orbits(self, per_cell: int) -> SignedOrbits:
        """Return the orbits of the values of so many tensors in each cell."""
        return SignedOrbits.of_tensors(self.parities, self.positions, per_cell, 1)


def fit_map(
    features: Tensor,
    targets: Tensor,
    weights: Tensor,
    symmetry: MapParities,
    prior: Tensor,
    images: int = 1,
) -> tuple[Tensor, Tensor]:
    """Return the linear map (C F D D, R) from features to targets, and left-out errors (S, R).

    The map is the prior plus the ridge regression of what the prior leaves, on the rows and their
    images under reflections and half turns, and commutes with these. It maps features of one parity
    to coordinates of the same parity, so that it is the sum of a map for each parity, with fewer
    features. Each feature is divided by its root mean square before.

    The left-out error of a row is its target minus the prediction by the map that is fitted to the
    rows of all other samples. The ridge is that of `RIDGES` with the smallest mean left-out error.

    Sources: Hoerl, Kennard (1970), Ridge regression, Technometrics 12; Allen (1974), The
    relationship between variable selection and data augmentation, Technometrics 16 (left-out
    errors).

    Args:
        features: F tensors at each of C sample cells, (S, C, F, D, D).
        targets: Wanted coordinates, (S, R).
        weights: Factor of each row, (S,).
        symmetry: Parities of features and targets.
        prior: Map that the ridge shrinks to, (C F D D, R).
        images: Number of rows of each sample, its images; row k S / images + s belongs to sample s.

    Raises:
        ValueError: The rows are not finite.
    """
    orbits, weights = symmetry.orbits(features.shape[2]), weights[:, None]
    features = features.flatten(1)
    rest = targets - features @ prior
    if not (features.isfinite().all() and rest.isfinite().all()):
        raise ValueError("the samples are not finite")
    squares, blocks = torch.zeros(len(RIDGES), len(rest)), []
    for p, characters in enumerate(symmetry.parities.characters):
        own = symmetry.coordinates == p
        X = weights * orbits.coordinates(features, characters)
        errors, solved, basis = _ridge_path(X, weights * rest[:, own], images)
        blocks.append((own, characters, errors, solved, basis))
        squares = squares + errors.square().sum(dim=2)
    chosen = int(squares.sqrt().mean(dim=1).argmin())
    matrix, left_out = torch.zeros_like(prior), torch.empty_like(rest)
    for own, characters, errors, solved, basis in blocks:
        change = basis @ solved[chosen]
        matrix[:, own] = prior[:, own] + orbits.fields(change.T, characters, len(prior)).T
        left_out[:, own] = errors[chosen]
    left_out = left_out / weights.clamp(min=torch.finfo(torch.float64).tiny)
    return matrix, torch.where(weights > 0, left_out, targets - features @ matrix)


def _ridge_path(X: Tensor, Y: Tensor, images: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return left-out errors (K, n, R), solutions (K, k, R) and their basis (p, k) for all ridges.

    X is (n, p) and Y is (n, R), with so many rows of each sample. The map of ridge number j is
    `basis @ solutions[j]`. Columns that are zero or rounding errors, as at cells that symmetries
    map onto themselves, have no effect. A regression with fewer rows than features is solved in as
    many unknowns as rows: (X^T X + r)^-1 X^T Y = X^T (X X^T + r)^-1 Y.
    """
    size = torch.linalg.vector_norm(X, dim=0)
    factors = torch.where(size > ROUNDING * size.max(), 1 / size, 0.0)
    X = X * factors
    is_dual = len(X) <= X.shape[1]
    values, Q = torch.linalg.eigh(X @ X.T if is_dual else X.T @ X)
    T = Q if is_dual else X @ Q
    shifts = X.shape[1] * X.new_tensor(RIDGES)[:, None]
    inverse = 1 / (values.clamp(min=0) + shifts)  # (K, k)
    solved = inverse[:, :, None] * (T.T @ Y)
    fitted = T @ solved  # (K, n, R)
    of_samples = T.unflatten(0, (images, -1))
    rows = [[(a * b) @ inverse.T for b in of_samples] for a in of_samples]
    products = torch.stack([torch.stack(row) for row in rows]).permute(3, 2, 0, 1)
    one = torch.eye(images, dtype=X.dtype)
    if is_dual:
        error, part = fitted, products
    else:
        error, part = Y - fitted, (1 + LEAST) * one - products
    own = error.unflatten(1, (images, -1)).transpose(1, 2)  # (K, S, images, R)
    left_out = torch.linalg.solve(part, own).transpose(1, 2).flatten(1, 2)
    return left_out, solved, factors[:, None] * (X.T @ Q if is_dual else Q)
