"""Ridge regression of the maps of `dpl.models.Unrolled`, which commute with the symmetries."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.rom.parity import Orbits, Parities

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
        parities: Symmetries with diagonal matrices.
        parity: Parity of each coordinate, (R,).
    """

    rotations: Tensor
    positions: Tensor
    coordinates: Tensor
    parities: Parities
    parity: Tensor

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

    def by_parity(
        self, gram: Tensor, product: Tensor, shape: Sequence[int]
    ) -> "list[NormalEquations]":
        """Return the normal equations of each parity; arguments as of `average`."""
        positions = self.positions[self.parities.members]
        orbits = Orbits.of_tensors(self.parities, positions, shape[1], 1).without_filling()
        equations = []
        for p, characters in enumerate(self.parities.characters):
            own = (self.parity == p).nonzero()[:, 0]
            half = orbits.folded(orbits.folded(gram, characters).T, characters)
            right = orbits.folded(product[:, own], characters)
            equations.append(NormalEquations(half, right, own, characters, orbits))
        return equations


class NormalEquations(NamedTuple):
    """X^T X b = X^T Y for one value of each orbit of features, scaled to a diagonal of ones.

    Attributes:
        gram: X^T X, (m, m).
        product: X^T Y, (m, r).
        columns: The coordinates of this parity, (r,).
        characters: Factor of this parity under each symmetry, (M,).
        orbits: Orbits of the features.
    """

    gram: Tensor
    product: Tensor
    columns: Tensor
    characters: Tensor
    orbits: Orbits

    def solve(self, ridge: float) -> Tensor | None:
        """Return b, (m, r), with a ridge relative to the squares of each feature, None if singular.

        Features without values count as zero.
        """
        scale = self.gram.diagonal().clamp(min=0).sqrt()
        scale = torch.where(scale > 1e-12 * scale.max(), scale, torch.inf)
        shifted = self.gram / scale[:, None] / scale
        shifted.diagonal().add_(ridge)
        factor, failed = torch.linalg.cholesky_ex(shifted)
        if failed:
            return None
        return torch.cholesky_solve(self.product / scale[:, None], factor) / scale[:, None]


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
    equations = action.by_parity(gram, product, shape)
    best: RidgeFit | None = None
    for ridge in RIDGES[start:]:
        found = [one.solve(ridge * len(gram)) for one in equations]
        matrix = torch.zeros_like(product)
        for one, values in zip(equations, found, strict=True):
            if values is not None:
                matrix[:, one.columns] = one.orbits.unfolded(values, one.characters, len(gram))
        if any(values is None for values in found):
            continue
        error = held_out.error(matrix)
        if best is None or error < best.error:
            best = RidgeFit(matrix, ridge, error)
        elif error > WORSE * best.error:
            break
    if best is None:
        raise ValueError("the samples are not finite")
    return best
