"""Ridge regression of the maps of `dpl.models.Unrolled`, which keep parities."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem.parity import Parities, SignedOrbits

RIDGES = tuple(10.0 ** (-k / 2) for k in range(28, 5, -1))  # relative to the mean square [-]
ROUNDING = 1e-10  # norm of a feature over the largest below which it is rounding error
COARSE = 4  # every how many ridges are tried first
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


class RidgeFit(NamedTuple):
    """A fitted map.

    Attributes:
        matrix: (C F D D, R).
        ridge: The ridge that was chosen, relative to the squares of each feature [-].
        error: Weighted mean error of the held-out rows.
    """

    matrix: Tensor
    ridge: float
    error: float


def fit_map(rows: Rows, held_out: Rows, symmetry: MapParities) -> RidgeFit:
    """Return the linear map from features to targets that predicts held-out rows best.

    The map is the ridge regression on the rows and their images under reflections and half turns,
    and commutes with these. It maps features of one parity to coordinates of the same parity, so
    that it is the sum of a map for each parity, with fewer features. Each feature is divided by its
    root mean square before. The ridge is one of `RIDGES`, chosen by the held-out error.

    Source: Hoerl, Kennard (1970), Ridge regression, Technometrics 12.

    Args:
        rows, held_out: Rows to fit to, and to choose the ridge by.
        symmetry: Parities of features and targets.

    Raises:
        ValueError: The rows are not finite.
    """
    count = rows.features[0].numel()
    orbits = symmetry.orbits(rows.features.shape[2])
    blocks = []
    for p, characters in enumerate(symmetry.parities.characters):
        own = symmetry.coordinates == p
        fitted, held = (_of_parity(part, own, orbits, characters) for part in (rows, held_out))
        blocks.append(_Block(own, characters, _NormalEquations.of(*fitted), *held))
    best, chosen, least = _best_ridge(blocks)
    matrix = rows.targets.new_zeros(count, rows.targets.shape[1])
    for block, values in zip(blocks, best, strict=True):
        matrix[:, block.columns] = orbits.fields(values.T, block.characters, count).T
    return RidgeFit(matrix, RIDGES[chosen], least)


def _of_parity(
    rows: Rows, columns: Tensor, orbits: SignedOrbits, characters: Tensor
) -> tuple[Tensor, Tensor]:
    """Return weighted features (S, p) and targets (S, r) of one parity, see `_Block`."""
    features = orbits.coordinates(rows.features.flatten(1), characters)
    weights = rows.weights[:, None]
    return weights * features, weights * rows.targets[:, columns]


def _best_ridge(blocks: "Sequence[_Block]") -> tuple[list[Tensor], int, float]:
    """Return the matrices of the best ridge, its number in `RIDGES` and its held-out error.

    Every fourth ridge is tried until one is clearly worse, then those around the best one.
    """
    best: tuple[list[Tensor], int, float] = ([], 0, float("inf"))
    tried: set[int] = set()

    def attempt(number: int) -> float:
        nonlocal best
        if number in tried or not 0 <= number < len(RIDGES):
            return float("inf")
        tried.add(number)
        matrices = [m for one in blocks if (m := one.equations.solve(RIDGES[number])) is not None]
        if len(matrices) < len(blocks):
            return float("inf")
        squares = [
            (one.targets - one.features @ m).square().sum(dim=1)
            for one, m in zip(blocks, matrices, strict=True)
        ]
        error = float(torch.stack(squares).sum(dim=0).sqrt().mean())
        if error < best[2]:
            best = matrices, number, error
        return error

    for number in range(0, len(RIDGES), COARSE):
        if attempt(number) > WORSE * best[2]:
            break
    for step in (COARSE // 2, COARSE // 4):
        centre = best[1]
        for number in (centre - step, centre + step):
            attempt(number)
    if not best[0]:
        raise ValueError("the samples are not finite")
    return best


class _NormalEquations(NamedTuple):
    """Normal equations of features X, whose columns are divided by their norms, and targets Y.

    A ridge regression with fewer rows than features is solved in as many unknowns as rows, with the
    same result: (X^T X + r)^-1 X^T Y = X^T (X X^T + r)^-1 Y.

    Attributes:
        gram: X^T X, (p, p), or X X^T, (n, n).
        right: X^T Y, (p, R), or Y, (n, R).
        transposed: X^T, (p, n), in the latter case.
        factors: 1 over the norm of each feature, (p,); 0 for features that are zero or rounding
            errors, as at cells that symmetries map onto themselves.
    """

    gram: Tensor
    right: Tensor
    transposed: Tensor | None
    factors: Tensor

    @classmethod
    def of(cls, X: Tensor, Y: Tensor) -> Self:
        """Return the equations of features (n, p) and targets (n, R)."""
        scale = torch.linalg.vector_norm(X, dim=0)
        factors = torch.where(scale > ROUNDING * scale.max(), 1 / scale, 0.0)
        X = X * factors
        if len(X) < X.shape[1]:
            return cls(X @ X.T, Y, X.T, factors)
        return cls(X.T @ X, X.T @ Y, None, factors)

    def solve(self, ridge: float) -> Tensor | None:
        """Return the matrix (p, R) of a ridge; None if the equations are singular."""
        shifted = self.gram.clone()
        shifted.diagonal().add_(ridge * len(self.factors))
        factor, failed = torch.linalg.cholesky_ex(shifted)
        if failed:
            return None
        solution = torch.cholesky_solve(self.right, factor)
        whole = solution if self.transposed is None else self.transposed @ solution
        return whole * self.factors[:, None]


class _Block(NamedTuple):
    """Normal equations of one parity, and its held-out rows.

    Attributes:
        columns: Mask of the coordinates of this parity, (R,).
        characters: Factor of the parity under each symmetry, (M,).
        equations: The normal equations.
        features, targets: Held-out rows, (S, p) and (S, r).
    """

    columns: Tensor
    characters: Tensor
    equations: _NormalEquations
    features: Tensor
    targets: Tensor
