"""Ridge regression of the maps of `dpl.models.Unrolled`, which keep parities."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.fem.parity import Parities, SignedOrbits
from dpl.system.threads import on_threads

RIDGES = tuple(10.0**-k for k in range(16, 2, -1))  # relative to the mean square [-]
GAIN_RIDGES = tuple(10.0**k for k in range(-6, 3))  # the same, of gains of a step
ROUNDING = 1e-10  # norm of a feature over the largest below which it is rounding error
LEAST = 1e-12  # part of a row that the other rows never predict [-]
CHOOSING = 256  # samples whose left-out errors choose the ridge


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
    threads: int = 1,
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
        threads: Number of threads that decompose the regressions of the parities.

    Raises:
        ValueError: The rows are not finite.
    """
    orbits, weights = symmetry.orbits(features.shape[2]), weights[:, None]
    features = features.flatten(1).mT.contiguous().mT  # each column in one piece
    rest = targets - features @ prior
    if not (features.isfinite().all() and rest.isfinite().all()):
        raise ValueError("the samples are not finite")
    masks = [symmetry.coordinates == p for p in range(len(symmetry.parities.characters))]

    def decomposed(p: int) -> _Decomposed:
        X = weights * orbits.coordinates(features, symmetry.parities.characters[p])
        return _decomposed(X, weights * rest[:, masks[p]])

    blocks = on_threads(decomposed, range(len(masks)), threads)
    ridge = _best_ridge(blocks, RIDGES, images)
    matrix, left_out = torch.zeros_like(prior), torch.empty_like(rest)
    for own, characters, block in zip(masks, symmetry.parities.characters, blocks, strict=True):
        change = block.basis @ _solved(block, ridge)[0]
        matrix[:, own] = prior[:, own] + orbits.fields(change.T, characters, len(prior)).T
        left_out[:, own] = _left_out(block, ridge, images, len(rest))[0]
    left_out = left_out / weights.clamp(min=torch.finfo(torch.float64).tiny)
    return matrix, torch.where(weights > 0, left_out, targets - features @ matrix)


def fit_gains(steps: Tensor, targets: Tensor, weights: Tensor, parity: Tensor) -> Tensor:
    """Return M (R, R) from steps s to targets M s, (S, R) both.

    It is found as the maps are, with a prior of zero and ridges of `GAIN_RIDGES`, and maps
    coordinates of one parity, (R,), to such coordinates.
    """
    gains, weights = steps.new_zeros(2 * parity.shape), weights[:, None]
    masks = [parity == p for p in parity.unique()]
    blocks = [_decomposed(weights * steps[:, own], weights * targets[:, own]) for own in masks]
    ridge = _best_ridge(blocks, GAIN_RIDGES, 1)
    for own, block in zip(masks, blocks, strict=True):
        gains[own[:, None] & own] = (block.basis @ _solved(block, ridge)[0]).T.flatten()
    return gains


class _Decomposed(NamedTuple):
    """Regression of Y (n, R) on X (n, p) in the axes of X^T X or, with is_dual, of X X^T."""

    values: Tensor  # eigenvalues over the number of columns, (k,)
    rows: Tensor  # X in the axes, or the axes, (n, k)
    basis: Tensor  # solutions in the axes become maps by it, (p, k)
    targets: Tensor  # Y
    is_dual: bool


def _decomposed(X: Tensor, Y: Tensor) -> _Decomposed:
    """Decompose the regression of Y (n, R) on X (n, p), each column divided by its norm.

    Columns that are zero or rounding errors, as at cells that symmetries map onto themselves, have
    no effect. A regression with fewer rows than features is solved in as many unknowns as rows:
    (X^T X + r)^-1 X^T Y = X^T (X X^T + r)^-1 Y.
    """
    size = torch.linalg.vector_norm(X, dim=0)
    factors = torch.where(size > ROUNDING * size.max(), 1 / size, 0.0)
    X = X * factors
    is_dual = len(X) <= X.shape[1]
    rows = X.numpy() if is_dual else X.T.numpy()  # numpy uses the symmetry of the product
    values, Q = map(torch.from_numpy, np.linalg.eigh(rows @ rows.T))
    basis = factors[:, None] * (X.T @ Q if is_dual else Q)
    values = values.clamp(min=0) / max(X.shape[1], 1)
    return _Decomposed(values, Q if is_dual else X @ Q, basis, Y, is_dual)


def _best_ridge(blocks: Sequence[_Decomposed], ridges: Sequence[float], images: int) -> Tensor:
    """Return the ridge, (1,), with the smallest mean left-out error of all blocks."""
    every = blocks[0].values.new_tensor(ridges)
    squares = [_left_out(block, every, images, CHOOSING).square().sum(dim=2) for block in blocks]
    return every[torch.stack(squares).sum(dim=0).sqrt().mean(dim=1).argmin()][None]


def _solved(block: _Decomposed, ridges: Tensor) -> Tensor:
    """Return the solutions (K, k, R) in the axes for K ridges."""
    inverse = 1 / ((block.values + ridges[:, None]) * max(len(block.basis), 1))
    return inverse[:, :, None] * (block.rows.T @ block.targets)


def _left_out(block: _Decomposed, ridges: Tensor, images: int, count: int) -> Tensor:
    """Return left-out errors (K, m, R) for K ridges, of images of the first `count` samples."""
    inverse = 1 / ((block.values + ridges[:, None]) * max(len(block.basis), 1))  # (K, k)
    T, Y = (part.unflatten(0, (images, -1))[:, :count] for part in (block.rows, block.targets))
    fitted = T.flatten(0, 1) @ _solved(block, ridges)  # (K, m, R)
    products = torch.stack([torch.stack([(a * b) @ inverse.T for b in T]) for a in T])
    part, error = products.permute(3, 2, 0, 1), fitted  # (K, S, images, images)
    if not block.is_dual:
        one = torch.eye(images, dtype=T.dtype)
        part, error = (1 + LEAST) * one - part, Y.flatten(0, 1) - fitted
    own = error.unflatten(1, (images, -1)).transpose(1, 2)
    return torch.linalg.solve(part, own).transpose(1, 2).flatten(1, 2)
