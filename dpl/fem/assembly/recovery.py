"""Patch recovery: values at nodes from those at quadrature points.

The value at a node is that of a linear function, fitted by weighted least squares to the values in
the cells around the node. Source: Zienkiewicz, Zhu (1992), Int. J. Numer. Methods Eng. 33, parts 1
and 2.
"""

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from torch import Tensor

Array = NDArray[np.float64]
Samples = tuple[Array, Array]  # positions (S, D) and volumes (S,) of points with known values
NEAR = 0.1  # squared distance, over that of the farthest sample, at which weights have half of dV
SINGULAR = 1e-4  # smallest variance of samples along a direction, over their squared distance


@dataclass(frozen=True, eq=False)
class Recovery:
    """Linear map from values at quadrature points to values at nodes.

    Attributes:
        matrix: Weights, (N, E Q). Each row has the sum 1.
        n_points: Q, number of quadrature points in a cell.
    """

    matrix: csr_array
    n_points: int

    @classmethod
    def build(
        cls, points: Array, cells: NDArray[np.int64], boundary: NDArray[np.bool_], at: Array,
        dV: Array, degree: int,
    ) -> Self:  # fmt: skip
        """Return the recovery of a mesh with nodes (N, D), cells (E, A) and a mask of nodes (N,).

        The quadrature points `at` are (E, Q, D), and their volumes dV (E, Q).

        Quadratic elements: the samples are the quadrature points of the cells at the node.

        Linear elements: the samples are the means of cells, because the stress is most exact at
        their centres. The cells are those at the node; at a boundary node also those at the
        interior nodes of these cells, or at all their nodes if none is in the interior. If centres
        do not determine a linear function (one layer of cells), quadrature points replace them.

        The function is constant in directions in which no samples differ. With none that differ
        in any direction, the value is the mean over the samples.
        """
        count, quadrature = dV.shape
        all_points = at.reshape(-1, at.shape[-1]), dV.ravel()
        own = np.repeat(np.arange(count), cells.shape[1])
        pairs = np.ones(cells.size), (cells.ravel(), own)
        adjacent = csr_array(pairs, shape=(len(points), count))
        members = csr_array(
            (np.ones(dV.size), np.arange(dV.size), np.arange(count + 1) * quadrature)
        )
        if degree == 2:
            return cls(_fit(all_points, _product(adjacent, members), points)[0], quadrature)
        patches = _patches(adjacent, boundary)
        volumes = dV.sum(axis=1)
        shares = dV / volumes[:, None]
        centres = (at * shares[..., None]).sum(axis=1), volumes
        matrix, determined = _fit(centres, patches, points)
        matrix = matrix @ csr_array((shares.ravel(), members.indices, members.indptr))
        if quadrature > 1 and not determined.all():
            refined = _fit(all_points, _product(patches, members), points)[0]
            matrix = matrix.multiply(determined[:, None]) + refined.multiply(~determined[:, None])
        return cls(csr_array(matrix), quadrature)

    def restricted_to(self, nodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], "Recovery"]:
        """Return the cells, (K,), that determine values at nodes (S,), and their recovery."""
        rows = self.matrix[nodes]
        cells = np.unique(rows.indices // self.n_points)
        columns = (cells[:, None] * self.n_points + np.arange(self.n_points)).ravel()
        return cells, Recovery(csr_array(rows[:, columns]), self.n_points)

    def __call__(self, values: Tensor) -> Tensor:
        """Return values at nodes, (B, N, ...), of values at quadrature points (B, E, Q, ...)."""
        batch, rest = values.shape[0], values.shape[3:]
        columns = values.reshape(batch, self.matrix.shape[1], -1).transpose(0, 1)
        found = self._tensor.to(values.device) @ columns.reshape(self.matrix.shape[1], -1)
        return found.reshape(len(found), batch, -1).transpose(0, 1).reshape(batch, -1, *rest)

    @cached_property
    def _tensor(self) -> Tensor:
        matrix = self.matrix
        parts = matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64), matrix.data
        starts, columns, weights = map(torch.from_numpy, parts)
        with warnings.catch_warnings(), torch.inference_mode(False):  # also for derivatives
            warnings.simplefilter("ignore")  # sparse matrices of torch are in beta state
            return torch.sparse_csr_tensor(starts, columns, weights, matrix.shape)


def _patches(adjacent: csr_array, boundary: NDArray[np.bool_]) -> csr_array:
    """Return the cells of the patch of each node, (N, E), from the cells at each node, (N, E)."""
    neighbours = _product(adjacent, csr_array(adjacent.T))
    interior = csr_array(neighbours.multiply(~boundary[None]))
    interior.eliminate_zeros()
    alone = np.diff(interior.indptr) == 0
    through = interior + neighbours.multiply(alone[:, None])
    own = diags_array((~boundary).astype(np.float64))
    return _product(csr_array(through.multiply(boundary[:, None]) + own), adjacent)


def _fit(
    samples: Samples, patches: csr_array, points: Array
) -> tuple[csr_array, NDArray[np.bool_]]:
    """Return the value of the fit at each node as weights of samples, (N, S).

    Also returns a mask (N,) of the nodes whose samples determine a linear function.
    """
    first, column = patches.indptr[:-1], patches.indices
    row = np.repeat(np.arange(len(points)), np.diff(patches.indptr))
    at, volumes = samples
    offset = at[column] - points[row]
    square = (offset**2).sum(axis=1)
    farthest = np.maximum.reduceat(square, first)
    weight = volumes[column] / (square / farthest[row] + NEAR)
    weight /= np.add.reduceat(weight, first)[row]
    mean = np.add.reduceat(weight[:, None] * offset, first)
    offset -= mean[row]
    products = weight[:, None, None] * offset[:, :, None] * offset[:, None, :]
    variance, axes = np.linalg.eigh(np.add.reduceat(products, first))
    known = np.asarray(variance > SINGULAR * farthest[:, None])
    inverse = np.divide(1.0, variance, out=np.zeros_like(variance), where=known)
    slope = np.einsum("nij,nj,nkj,nk->ni", axes, inverse, axes, -mean)
    weight *= 1 + (offset * slope[row]).sum(axis=1)
    return csr_array((weight, column, patches.indptr), shape=patches.shape), np.all(known, axis=1)


def _product(left: csr_array, right: csr_array) -> csr_array:
    """Return the pattern of a product of patterns, with sorted columns."""
    found = csr_array(left @ right)
    found.eliminate_zeros()
    found.sort_indices()
    return found
