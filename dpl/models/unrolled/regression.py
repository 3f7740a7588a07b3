"""Ridge regression of the maps of `dpl.models.Unrolled`, which commute with the symmetries."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem.parity import Parities, SignedOrbits
from dpl.models.irreps import Component

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


@dataclass(frozen=True)
class GroupAction:
    """Action of a symmetry group on tensors at sample cells and on coordinates.

    The sample cells are mapped onto themselves.

    Attributes:
        rotations: Q of each symmetry, (G, D, D).
        positions: Position to which each symmetry maps each sample cell, (G, C).
        coordinates: T of each symmetry, (G, R, R): an image has coordinates c T.
        representations: Irreducible representations of the group, see `dpl.models.irreps`.
        parities: Symmetries with diagonal matrices.
        parity: Parity of each coordinate, (R,).
    """

    rotations: Tensor
    positions: Tensor
    coordinates: Tensor
    representations: Sequence[Tensor]
    parities: Parities
    parity: Tensor

    @cached_property
    def _sources(self) -> Tensor:
        """Cell whose tensor each image takes at each representative cell, (G, M)."""
        sources = self.positions.argsort(dim=1)
        return sources[:, sources.amin(dim=0) == torch.arange(sources.shape[1])]

    def components(self, per_cell: int) -> list[Component]:
        """Return the isotypic components of features with so many values in each cell."""
        shares = 1 / (self._sources == self._sources[0]).sum(dim=0).double()
        weights = shares.repeat_interleave(per_cell)
        return [Component(D, weights) for D in self.representations]

    def with_exact_parity(self, matrix: Tensor, per_cell: int) -> Tensor:
        """Return a map (C F D D, R) whose columns have their parities without rounding errors.

        Args:
            matrix: The map, with rounding errors.
            per_cell: Number F of tensors in each cell.
        """
        positions = self.positions[self.parities.members]
        orbits = SignedOrbits.of_tensors(self.parities, positions, per_cell, 1)
        return orbits.symmetrised(matrix, self.parity, self.parities)

    def images(self, features: Tensor) -> Tensor:
        """Return the images (S, G, m) of features (S, C, F, D, D) at representative cells."""
        every = [
            Q @ features[:, cells] @ Q.mT
            for Q, cells in zip(self.rotations, self._sources, strict=True)
        ]
        return torch.stack(every, dim=1).flatten(2)

    def from_images(self, images: Tensor, shape: Sequence[int]) -> Tensor:
        """Return the adjoint (r, C F D D) of `images`, applied to (r, G, m).

        Args:
            images: Factors of the values of the images.
            shape: (C, F, D, D).
        """
        features = images.new_zeros(len(images), *shape)
        values = images.unflatten(2, (-1, *shape[1:]))
        for k, (Q, cells) in enumerate(zip(self.rotations.to(images), self._sources, strict=True)):
            features.index_add_(1, cells, Q.mT @ values[:, k] @ Q)
        return features.flatten(1)


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


def fit_map(rows: Rows, held_out: Rows, action: GroupAction) -> RidgeFit:
    """Return the linear map from features to targets that predicts held-out rows best.

    The map is the ridge regression on the rows and their images under the symmetries, and commutes
    with them. It is found in each isotypic component separately (Schur's lemma), so that the work
    is that of the rows without their images and of small matrices. Each feature is divided by its
    root mean square before. The ridge is one of `RIDGES`, chosen by the held-out error.

    Source: Hoerl, Kennard (1970), Ridge regression, Technometrics 12.

    Args:
        rows, held_out: Rows to fit to, and to choose the ridge by.
        action: The symmetries.

    Raises:
        ValueError: The rows are not finite.
    """
    shape = rows.features.shape[1:]
    images = [action.images(part.features) for part in (rows, held_out)]
    parts = []
    for component in action.components(shape[1:].numel()):
        coordinates = component.coordinate_parts(action.coordinates)
        sets = [
            _weighted_rows(component, coordinates, part, image)
            for part, image in zip((rows, held_out), images, strict=True)
        ]
        equations = _NormalEquations.of(*sets[0])
        parts.append(_ComponentFit(component, coordinates, equations, *sets[1]))
    best, chosen, least = _best_ridge(parts)
    maps = [p.whole(m, action, shape) for p, m in zip(parts, best, strict=True)]
    matrix = action.with_exact_parity(torch.stack(maps).sum(dim=0), shape[1])
    return RidgeFit(matrix, RIDGES[chosen], least)


def _best_ridge(parts: "Sequence[_ComponentFit]") -> tuple[list[Tensor], int, float]:
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
        matrices = [m for part in parts if (m := part.equations.solve(RIDGES[number])) is not None]
        if len(matrices) < len(parts):
            return float("inf")
        squares = [p.squared_errors(m) for p, m in zip(parts, matrices, strict=True)]
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
    same result: (X^H X + r)^-1 X^H Y = X^H (X X^H + r)^-1 Y.

    Attributes:
        gram: X^H X, (p, p), or X X^H, (n, n).
        right: X^H Y, (p, R), or Y, (n, R).
        adjoint: X^H, (p, n), in the latter case.
        factors: 1 over the norm of each feature, (p,); 0 for features of rounding errors. There are
            such features at cells that symmetries map onto themselves.
    """

    gram: Tensor
    right: Tensor
    adjoint: Tensor | None
    factors: Tensor

    @classmethod
    def of(cls, X: Tensor, Y: Tensor) -> Self:
        """Return the equations of features (n, p) and targets (n, R)."""
        scale = torch.linalg.vector_norm(X, dim=0)
        factors = torch.where(scale > ROUNDING * scale.max(), 1 / scale, 0.0)
        X = X * factors
        if len(X) < X.shape[1]:
            return cls(X @ X.mH, Y, X.mH, factors)
        return cls(X.mH @ X, X.mH @ Y, None, factors)

    def solve(self, ridge: float) -> Tensor | None:
        """Return the matrix (p, R) of a ridge; None if the equations are singular."""
        shifted = self.gram.clone()
        shifted.diagonal().add_(ridge * len(self.factors))
        factor, failed = torch.linalg.cholesky_ex(shifted)
        if failed:
            return None
        solution = torch.cholesky_solve(self.right, factor)
        whole = solution if self.adjoint is None else self.adjoint @ solution
        return whole * self.factors[:, None]


class _ComponentFit(NamedTuple):
    """Normal equations of an isotypic component, and its held-out rows.

    Attributes:
        component: The component.
        coordinates: See `Component.coordinate_parts`, (d, R, R).
        equations: The normal equations.
        features, targets: Held-out rows, (S d, p) and (S d, R).
    """

    component: Component
    coordinates: Tensor
    equations: _NormalEquations
    features: Tensor
    targets: Tensor

    def squared_errors(self, matrix: Tensor) -> Tensor:
        """Return the component of the squared error of each held-out sample, (S,)."""
        error = (self.targets - self.features @ matrix).abs().square().sum(dim=1)
        return self.component.copies * error.unflatten(0, (-1, len(self.coordinates))).sum(dim=1)

    def whole(self, matrix: Tensor, action: GroupAction, shape: Sequence[int]) -> Tensor:
        """Return the map from all features to all coordinates, (C F D D, R).

        Args:
            matrix: Map of the component, (p, R).
            action: The symmetries.
            shape: (C, F, D, D).
        """
        back = self.component.adjoint(matrix.T).unbind(dim=1)  # (R, G, m) each
        maps = [
            action.from_images(own, shape).T @ part.mH
            for own, part in zip(back, self.coordinates, strict=True)
        ]
        return self.component.copies * torch.stack(maps).sum(dim=0).real


def _weighted_rows(
    component: Component, parts: Tensor, rows: Rows, images: Tensor
) -> tuple[Tensor, Tensor]:
    """Return features (S d, d m) and targets (S d, R) of a component, times the weights."""
    weights = rows.weights[:, None, None]
    targets = torch.einsum("sa,jab->sjb", rows.targets.to(parts.dtype), parts)
    return (component.parts(images) * weights).flatten(0, 1), (targets * weights).flatten(0, 1)
