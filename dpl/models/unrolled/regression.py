"""Ridge regression of the maps of `dpl.models.Unrolled`, which keep parities."""

from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.parity import Parities, SignedOrbits

RIDGES = tuple(10.0**-k for k in range(16, 2, -1))  # relative to the mean square [-]
ROUNDING = 1e-10  # norm of a feature over the largest below which it is rounding error
LEAST = 1e-12  # smallest part of a row that the other rows do not predict [-]


class Rows(NamedTuple):
    """Rows of a regression.

    Attributes:
        features: (S, C, F, D, D): F tensors at each of C sample cells.
        targets: (S, R).
        weights: Factor of each row, (S,).
    """

    features: Tensor
    targets: Tensor
    weights: Tensor


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


def fit_map(rows: Rows, symmetry: MapParities, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return the linear map (C F D D, R) from features to targets, and left-out errors (S, R).

    The map is the prior plus the ridge regression of what the prior leaves, on the rows and their
    images under reflections and half turns, and commutes with these. It maps features of one parity
    to coordinates of the same parity, so that it is the sum of a map for each parity, with fewer
    features. Each feature is divided by its root mean square before.

    The left-out error of a row is its target minus the prediction by the map that is fitted to all
    other rows. The ridge is the one of `RIDGES` with the smallest mean left-out error.

    Sources: Hoerl, Kennard (1970), Ridge regression, Technometrics 12; Allen (1974), The
    relationship between variable selection and data augmentation, Technometrics 16 (left-out
    errors).

    Args:
        rows: Rows to fit to.
        symmetry: Parities of features and targets.
        prior: Map that the ridge shrinks to, (C F D D, R).

    Raises:
        ValueError: The rows are not finite.
    """
    features, weights = rows.features.flatten(1), rows.weights[:, None]
    rest = rows.targets - features @ prior
    if not (features.isfinite().all() and rest.isfinite().all()):
        raise ValueError("the samples are not finite")
    orbits, squares = symmetry.orbits(rows.features.shape[2]), torch.zeros(len(RIDGES), len(rest))
    blocks = []
    for p, characters in enumerate(symmetry.parities.characters):
        own = symmetry.coordinates == p
        X = weights * orbits.coordinates(features, characters)
        changes, errors = _ridge_path(X, weights * rest[:, own])
        start = orbits.coordinates(prior[:, own].T, characters).T
        blocks.append((own, characters, start + changes, errors))
        squares = squares + errors.square().sum(dim=2)
    chosen = int(squares.sqrt().mean(dim=1).argmin())
    matrix, left_out = torch.zeros_like(prior), torch.empty_like(rest)
    for own, characters, maps, errors in blocks:
        matrix[:, own] = orbits.fields(maps[chosen].T, characters, len(prior)).T
        left_out[:, own] = errors[chosen]
    left_out = left_out / weights.clamp(min=torch.finfo(torch.float64).tiny)
    return matrix, torch.where(weights > 0, left_out, rows.targets - features @ matrix)


def _ridge_path(X: Tensor, Y: Tensor) -> tuple[Tensor, Tensor]:
    """Return maps (K, p, R) and left-out errors (K, n, R) of X (n, p) and Y (n, R) for all ridges.

    Columns that are zero or rounding errors, as at cells that symmetries map onto themselves, have
    no effect. A regression with fewer rows than features is solved in as many unknowns as rows:
    (X^T X + r)^-1 X^T Y = X^T (X X^T + r)^-1 Y.
    """
    size = torch.linalg.vector_norm(X, dim=0)
    factors = torch.where(size > ROUNDING * size.max(), 1 / size, 0.0)
    X = X * factors
    (n, p), maps, errors = X.shape, [], []
    values, Q = torch.linalg.eigh(X @ X.T if n <= p else X.T @ X)
    T = Q if n <= p else X @ Q
    squares, right = T.square(), T.T @ Y
    for ridge in RIDGES:
        shift = ridge * p
        inverse = 1 / (values.clamp(min=0) + shift)
        solved = inverse[:, None] * right
        if n <= p:
            maps.append(X.T @ (Q @ solved))
            error, part = shift * (Q @ solved), shift * (squares @ inverse)
        else:
            maps.append(Q @ solved)
            error, part = Y - T @ solved, 1 - squares @ inverse
        errors.append(error / part.clamp(min=LEAST)[:, None])
    return factors[:, None] * torch.stack(maps), torch.stack(errors)
