"""Regular grids around a body: transfer of nodal fields, and the volume fraction of voxels."""

import math
from itertools import product

import numpy as np
import torch
from torch import Tensor, nn

from dpl.fem import Problem

GRID_TOL = 1e-4  # distance of a node from its grid point, in spacings; allows float32 meshes


class Immersion(nn.Module):
    """Multilinear interpolation from a regular grid to nodes, and its adjoint.

    Attributes:
        shape: Grid points along each side of the bounding box of the nodes.
        corners: Grid points of the cell that contains a node, (N, 2^D); (N, 1) if all nodes are
            grid points.
        weights: Their interpolation weights [-], float32; they sum to 1.
    """

    corners: Tensor
    weights: Tensor

    def __init__(self, points: Tensor, shape: tuple[int, ...]) -> None:
        """Find the cells that contain nodes (N, D)."""
        super().__init__()
        self.shape = shape
        place = _in_spacings(points, points, shape)
        corners, weights = _ravel(place.round().long(), shape)[:, None], place.new_ones(1, 1)
        if (place - place.round()).abs().max() > GRID_TOL:
            corners, weights = _stencil(place, shape)
        self.register_buffer("corners", corners, persistent=False)
        self.register_buffer("weights", weights.float(), persistent=False)

    def spread(self, values: Tensor) -> Tensor:
        """Return nodal values (B, N, C) distributed to the grid, (B, C, *shape); preserves sums."""
        shares = (values[:, :, None] * self.weights[..., None]).flatten(1, 2)
        field = values.new_zeros(values.shape[0], math.prod(self.shape), values.shape[2])
        return field.index_add(1, self.corners.flatten(), shares).mT.unflatten(2, self.shape)

    def read(self, field: Tensor) -> Tensor:
        """Return the values of a field (B, C, *shape) at the nodes, (B, N, C)."""
        around = field.flatten(2).mT.index_select(1, self.corners.flatten())
        return (around.unflatten(1, self.corners.shape) * self.weights[..., None]).sum(2)


def own_grid(points: Tensor) -> tuple[int, ...] | None:
    """Return the shape of the regular grid that nodes (N, D) form, None if they do not."""
    shape = []
    for coordinate in points.mT:
        ordered = coordinate.sort().values
        distinct = ordered.diff() > 1e-6 * (ordered[-1] - ordered[0])
        shape.append(int(distinct.sum()) + 1)
    if math.prod(shape) != len(points):
        return None
    place = _in_spacings(points, points, shape)
    regular = (place - place.round()).abs().max() < GRID_TOL
    every = len(_ravel(place.round().long(), shape).unique()) == len(points)
    return tuple(shape) if regular and every else None


def cubic_grid(points: Tensor, grid: int | None) -> tuple[int, ...]:
    """Return the shape of a grid of nearly cubic cells on the bounding box of nodes (N, D)."""
    sides = (points.amax(0) - points.amin(0)).tolist()

    def shape(cells: float) -> tuple[int, ...]:
        return tuple(max(1, round(side / max(sides) * cells)) + 1 for side in sides)

    if grid is not None:
        return shape(grid - 1)
    cells = 1
    while math.prod(shape(cells + 1)) <= len(points):
        cells += 1
    return shape(cells)


def filling(problem: Problem, shape: tuple[int, ...]) -> Tensor:
    """Return the volume fraction of the body in the voxel of each grid point, (*shape) [-].

    Cells are divided into small parts, whose volumes are distributed to the grid with multilinear
    weights. The sum over voxels is the volume of the body.
    """
    points, mapping, cell = problem.points, problem.basis.mapping, problem.mesh.elem.refdom
    simplex = cell.name in ("Triangular", "Tetrahedral")
    at_cells = _in_spacings(points, points, shape)[problem.cells]
    extent = (at_cells.amax(1) - at_cells.amin(1)).amax(1)  # (E,), in spacings
    parts = 2 ** ((4 if simplex else 2) * extent).clamp(min=1).log2().ceil().long()  # along a side
    cell_volume = problem.dV.expand(len(problem.cells), -1).sum(1, keepdim=True)
    volume = points.new_zeros(math.prod(shape))
    for count in parts.unique():
        local, weight = _lattice(int(count), points.shape[1], simplex=simplex)
        for some in (parts == count).nonzero()[:, 0].split(max(1, 500_000 // len(local))):
            cells, X = some.numpy(), local.mT.numpy()
            where = torch.from_numpy(mapping.F(X, tind=cells)).flatten(1).mT
            shares = torch.from_numpy(mapping.detDF(X, tind=cells)).abs() * weight
            shares = cell_volume[some] * shares / shares.sum(1, keepdim=True)
            index, part = _stencil(_in_spacings(where, points, shape), shape)
            volume.index_add_(0, index.flatten(), (part * shares.flatten()[:, None]).flatten())
    voxel = points.new_ones(())
    for side, count in zip((points.amax(0) - points.amin(0)).tolist(), shape, strict=True):
        width = torch.full((count,), side / (count - 1), dtype=points.dtype)
        width[[0, -1]] /= 2
        voxel = voxel[..., None] * width
    return volume.view(shape) / voxel


def _lattice(count: int, dim: int, *, simplex: bool) -> tuple[Tensor, Tensor]:
    """Return evenly spaced points (P, D) of the reference cube or simplex and weights (P,)."""
    side = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    points = torch.cartesian_prod(*[side] * dim)
    if not simplex:
        return points, side.new_ones(len(points))
    # fold the cube onto one of its Kuhn simplices and shear that onto the reference simplex
    folded, copies = points.sort(dim=1).values.unique(dim=0, return_counts=True)
    return folded.diff(dim=1, prepend=folded.new_zeros(len(folded), 1)), copies.double()


def _in_spacings(where: Tensor, points: Tensor, shape: tuple[int, ...] | list[int]) -> Tensor:
    """Return positions (P, D) in spacings of the grid on the bounding box of nodes (N, D)."""
    low, high = points.amin(0), points.amax(0)
    return (where - low) / (high - low) * (torch.tensor(shape) - 1)


def _ravel(place: Tensor, shape: tuple[int, ...] | list[int]) -> Tensor:
    """Return the flat indices of grid points (..., D)."""
    return torch.from_numpy(np.ravel_multi_index(tuple(place.numpy().T), shape).T)


def _stencil(place: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return the corners of the cells that contain positions (P, D), and weights, (P, 2^D)."""
    last = torch.tensor(shape) - 1
    low = place.floor().clamp(min=torch.zeros_like(last), max=last - 1)
    part = (place - low).clamp(0, 1)[:, None]
    corner = torch.tensor(list(product([0, 1], repeat=len(shape))))
    weight = torch.where(corner == 1, part, 1 - part).prod(-1)
    return _ravel(low.long()[:, None] + corner, shape), weight
