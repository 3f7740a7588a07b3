"""Ridge regression of the maps of `dpl.models.Unrolled`, which commute with the symmetries."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

RIDGES = tuple(10.0 ** (-k / 2) for k in range(28, 5, -1))  # relative to the mean square [-]
WORSE = 1.05  # ratio of held-out errors at which larger ridges are not tried


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

    def error(self, matrix: Tensor) -> float:
        """Return the weighted root mean square of targets minus features times a matrix."""
        error = self.targets - self.features.flatten(1) @ matrix
        return weighted_error(error, self.weights)


def weighted_error(error: Tensor, weights: Tensor) -> float:
    """Return the root of the mean weighted squares of the rows of errors (S, R); inf for NaN."""
    mean = float((error * weights[:, None]).square().sum(dim=1).mean().sqrt())
    return mean if mean == mean else float("inf")


@dataclass(frozen=True)
class GroupAction:
    """Action of a symmetry group on tensors at sample cells and on coordinates.

    The sample cells are mapped onto themselves. Empty lists stand for the identity alone.

    Attributes:
        rotations: Q of each symmetry, (G, D, D).
        positions: Position to which each symmetry maps each sample cell, (G, C).
        coordinates: T of each symmetry, (G, R, R): an image has coordinates c T.
    """

    rotations: Tensor
    positions: Tensor
    coordinates: Tensor

    def image(self, features: Tensor, k: int) -> Tensor:
        """Return the features (S, C, F, D, D) of the images under symmetry k."""
        Q = self.rotations[k]
        image = torch.empty_like(features)
        image[:, self.positions[k]] = Q @ features @ Q.mT
        return image

    def average(self, gram: Tensor, product: Tensor, shape: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return X^T X and X^T Y of the rows X, Y and all their images.

        Args:
            gram: X^T X of the rows, (C F D D, C F D D).
            product: X^T Y, (C F D D, R).
            shape: (C, F, D, D).
        """
        grams, products = torch.zeros_like(gram), torch.zeros_like(product)
        for k, T in enumerate(self.coordinates):
            half = self.image(gram.unflatten(1, shape), k).flatten(1)
            grams += self.image(half.T.unflatten(1, shape), k).flatten(1)
            products += self.image(product.T.unflatten(1, shape), k).flatten(1).T @ T
        return grams, products


class RidgeFit(NamedTuple):
    """A fitted map.

    Attributes:
        matrix: (C F D D, R).
        ridge: The ridge that was chosen, relative to the squares of each feature [-].
        error: Weighted root mean square error of the held-out rows.
    """

    matrix: Tensor
    ridge: float
    error: float


def fit_map(rows: Rows, held_out: Rows, action: GroupAction, start: int = 0) -> RidgeFit:
    """Return the linear map from features to targets that predicts held-out rows best.

    The map is the ridge regression on the rows and their images under the symmetries, and commutes
    with them. Each feature is divided by its root mean square before. The ridge is the one of
    `RIDGES` with the smallest held-out error; larger ones than the first that is clearly worse are
    not tried.

    Source: Hoerl, Kennard (1970), Ridge regression, Technometrics 12.

    Args:
        rows, held_out: Rows to fit to, and to choose the ridge by.
        action: The symmetries.
        start: Position in `RIDGES` of the first ridge.
    """
    X = rows.features.flatten(1) * rows.weights[:, None]
    shape = rows.features.shape[1:]
    gram, product = action.average(X.T @ X, X.T @ (rows.targets * rows.weights[:, None]), shape)
    scale = gram.diagonal().sqrt().clamp(min=1e-300)
    gram, product = gram / scale[:, None] / scale, product / scale[:, None]
    best: RidgeFit | None = None
    for ridge in RIDGES[start:]:
        shifted = gram.clone()
        shifted.diagonal().add_(ridge * len(gram))
        factor, failed = torch.linalg.cholesky_ex(shifted)
        if failed:
            continue
        matrix = torch.cholesky_solve(product, factor) / scale[:, None]
        error = held_out.error(matrix)
        if best is None or error < best.error:
            best = RidgeFit(matrix, ridge, error)
        elif error > WORSE * best.error:
            break
    if best is None:
        raise ValueError("the samples are not finite")
    return best
