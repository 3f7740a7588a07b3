"""A convolutional network on the grid that immerses the body: U-Mesh."""

import math
import os
from itertools import pairwise, product

import torch
from torch import Tensor, nn

from dpl.fem.problem import Problem
from dpl.scene import Scene

SAME = 1e-4  # nodes this close to a grid point, in spacings, are at it; files in float32 are
COARSE = 3  # grid points along a side across which two convolutions carry everything
LEAK = 0.25  # slope of negative values: near enough to linear that training does not stall
CONVOLUTION: dict[int, type[nn.Module]] = {2: nn.Conv2d, 3: nn.Conv3d}
TRANSPOSED: dict[int, type[nn.Module]] = {2: nn.ConvTranspose2d, 3: nn.ConvTranspose3d}


class CNN(nn.Module):
    """A U-Net on the points of a regular grid around the body.

    Nodal forces are spread onto the grid, and displacements are read off it, with the same
    multilinear weights; where the nodes are the points of a regular grid, one goes over into the
    other. Constant channels say what part of a grid point's voxel the body fills, and what is held;
    those that say nothing are left out. Each step downwards is a convolution of stride 2 and each
    step upwards its transpose, so that any number of points works; a side of one cell is not
    coarsened. Nothing is normalised over a sample: the size of a load matters.

    Source: Mendizabal, Marquez-Neila, Cotin (2020), Simulation of hyperelastic materials in
    real-time using deep learning, Medical Image Analysis 59, section 3.
    """

    constant: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        channels: int = 16,
        steps: int | None = None,
        grid: int | None = None,
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: What it is to answer.
            channels: Of the finest grid; every step downwards has twice as many.
            steps: Steps downwards; if left out, until every point of the coarsest grid sees all.
            grid: Points along the longest side of the bounding box, about equally far apart on the
                others. If left out, the nodes where they are a regular grid, else about as many
                points as nodes.
            memory_limit: Memory that training on one sample may take [GB]; what the machine has if
                left out.

        Raises:
            ValueError: `channels`, `steps` or `grid` is out of range.
            MemoryError: Parameters and one sample would not fit.
        """
        super().__init__()
        if channels < 1:
            raise ValueError(f"channels = {channels} must be 1 or more")
        if grid is not None and grid < 2:
            raise ValueError(f"grid = {grid} must be 2 or more")
        problem = scene.problem
        points, dim = problem.points, problem.shape[1]
        own = own_grid(points)
        shape = own if own and grid in (None, max(own)) else _shape(points, grid)
        sizes = _sizes(shape, steps)
        widths = [channels * 2**level for level in range(len(sizes))]
        _refuse_beyond_memory(sizes, widths, memory_limit)
        self.immersion = Permutation(points, shape) if shape == own else Immersion(points, shape)
        constant = self._constant(problem, shape)
        self.register_buffer("constant", constant, persistent=False)
        self.net = UNet(dim + len(constant), dim, sizes, widths)

    def _constant(self, problem: Problem, shape: tuple[int, ...]) -> Tensor:
        """Return the channels that no load changes and that are not the same everywhere."""
        held = (~problem.free).float()
        if (held == held[:, :1]).all():
            held = held[:, :1]
        ones = torch.ones(1, len(held), 1)
        share = self.immersion.spread(held[None])[0] / self.immersion.spread(ones)[0].clamp(1e-6)
        volume = problem.dV.expand(len(problem.cells), -1).sum()
        box = (problem.points.amax(0) - problem.points.amin(0)).prod()
        self.full = bool(volume > 0.999 * box)  # a grid of nodes may have cells left out
        channels = [*share] if self.full else [*share, filling(problem, shape).float()]
        varying = [channel for channel in channels if channel.min() < channel.max()]
        return torch.stack(varying) if varying else share[:0]

    def forward(self, force: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32."""
        constant = self.constant.expand(len(force), *self.constant.shape)
        return self.immersion.read(self.net(torch.cat([self.immersion.spread(force), constant], 1)))

    def plan(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        lines = []
        if isinstance(self.immersion, Permutation):
            size = " x ".join(map(str, self.immersion.shape))
            lines.append(f"no interpolation: the nodes are the points of a grid, {size}")
        if self.full:
            lines.append("no input for what lies inside the body: all of the grid does")
        return lines


class Permutation(nn.Module):
    """Nodes that are the points of a regular grid, and back; the counterpart of `Immersion`.

    Attributes:
        shape: Grid points along each side.
    """

    nodes: Tensor
    places: Tensor

    def __init__(self, points: Tensor, shape: tuple[int, ...]) -> None:
        """Number nodes (N, D) as the points of their grid."""
        super().__init__()
        self.shape = shape
        places = _ravel(_in_spacings(points, points, shape).round().long(), shape)
        self.register_buffer("places", places, persistent=False)
        self.register_buffer("nodes", places.argsort(), persistent=False)

    def spread(self, values: Tensor) -> Tensor:
        """Return nodal values (B, N, C) on the grid, (B, C, *shape)."""
        return values[:, self.nodes].mT.unflatten(2, self.shape)

    def read(self, field: Tensor) -> Tensor:
        """Return the values of a field (B, C, *shape) at the nodes, (B, N, C)."""
        return field.flatten(2)[:, :, self.places].mT


class Immersion(nn.Module):
    """Multilinear interpolation from a regular grid to nodes, and its adjoint.

    Attributes:
        shape: Grid points along each side of the nodes' bounding box, which the grid fills.
        corners: Grid points of the cell that a node lies in, (N, 2^D).
        weights: Of these, (N, 2^D) [-], float32; they sum to 1.
    """

    corners: Tensor
    weights: Tensor

    def __init__(self, points: Tensor, shape: tuple[int, ...]) -> None:
        """Find the cells that nodes (N, D) lie in."""
        super().__init__()
        self.shape = shape
        corners, weights = _stencil(_in_spacings(points, points, shape), shape)
        self.register_buffer("corners", corners, persistent=False)
        self.register_buffer("weights", weights.float(), persistent=False)

    def spread(self, values: Tensor) -> Tensor:
        """Return nodal values (B, N, C) shared out to the grid, (B, C, *shape): sums are kept."""
        shares = (values[:, :, None] * self.weights[..., None]).flatten(1, 2)
        field = values.new_zeros(len(values), math.prod(self.shape), values.shape[2])
        return field.index_add(1, self.corners.flatten(), shares).mT.unflatten(2, self.shape)

    def read(self, field: Tensor) -> Tensor:
        """Return the values of a field (B, C, *shape) at the nodes, (B, N, C)."""
        around = field.flatten(2).mT.index_select(1, self.corners.flatten())
        return (around.unflatten(1, self.corners.shape) * self.weights[..., None]).sum(2)


class UNet(nn.Module):
    """Convolutions on ever coarser grids and back, each joined by what was found on the way down.

    Source: Ronneberger, Fischer, Brox (2015), U-Net; with strides for pooling and no norm.
    """

    def __init__(
        self, inputs: int, outputs: int, sizes: list[tuple[int, ...]], widths: list[int]
    ) -> None:
        """Build the network.

        Args:
            inputs: Channels of what enters.
            outputs: Channels of what leaves.
            sizes: Grid points along each side, from the finest grid to the coarsest.
            widths: Channels on each grid.
        """
        super().__init__()
        dim = len(sizes[0])
        self.encoders = nn.ModuleList([_pair(inputs, widths[0], dim)])
        self.decoders, self.descents, self.ascents = (nn.ModuleList() for _ in range(3))
        for (fine, coarse), (few, many) in zip(pairwise(sizes), pairwise(widths), strict=True):
            stride = tuple(1 + (n > m) for n, m in zip(fine, coarse, strict=True))
            left = tuple(n - s * (m - 1) - 1 for n, m, s in zip(fine, coarse, stride, strict=True))
            self.descents.append(CONVOLUTION[dim](few, many, 3, stride, 1))
            self.encoders.append(_pair(many, many, dim))
            self.ascents.append(TRANSPOSED[dim](many, few, 3, stride, 1, left))
            self.decoders.append(_pair(2 * few, few, dim))
        self.last = CONVOLUTION[dim](widths[0], outputs, 1)
        self.rectify = nn.LeakyReLU(LEAK)
        self.apply(_initialise)

    def forward(self, field: Tensor) -> Tensor:
        """Return a field (B, outputs, *sizes[0]) of one (B, inputs, *sizes[0])."""
        field = self.encoders[0](field)
        passed = []
        for descent, encoder in zip(self.descents, self.encoders[1:], strict=True):
            passed.append(field)
            field = encoder(self.rectify(descent(field)))
        for ascent, decoder in zip(reversed(self.ascents), reversed(self.decoders), strict=True):
            field = decoder(torch.cat([passed.pop(), ascent(field)], dim=1))
        return self.last(field)


def own_grid(points: Tensor) -> tuple[int, ...] | None:
    """Return the sides of the regular grid that nodes (N, D) are all points of, or None."""
    shape = []
    for coordinate in points.mT:
        ordered = coordinate.sort().values
        apart = ordered.diff() > 1e-6 * (ordered[-1] - ordered[0])
        shape.append(int(apart.sum()) + 1)
    if math.prod(shape) != len(points):
        return None
    place = _in_spacings(points, points, shape)
    regular = (place - place.round()).abs().max() < SAME
    every = len(_ravel(place.round().long(), shape).unique()) == len(points)
    return tuple(shape) if regular and every else None


def filling(problem: Problem, shape: tuple[int, ...]) -> Tensor:
    """Return what part of each grid point's voxel the body fills, (*shape) [-].

    The volume of small parts of cells, spread with multilinear weights: it sums to the body's.
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
    """Return even points (P, D) of the reference cube or simplex and their weights (P,)."""
    side = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    points = torch.cartesian_prod(*[side] * dim)
    if not simplex:
        return points, side.new_ones(len(points))
    # the cube folded onto one of its Kuhn simplices, and that one sheared onto the reference
    folded, copies = points.sort(dim=1).values.unique(dim=0, return_counts=True)
    return folded.diff(dim=1, prepend=folded.new_zeros(len(folded), 1)), copies.double()


def _in_spacings(where: Tensor, points: Tensor, shape: tuple[int, ...] | list[int]) -> Tensor:
    """Return places (P, D) in spacings of the grid on the bounding box of nodes (N, D)."""
    low, high = points.amin(0), points.amax(0)
    return (where - low) / (high - low) * (torch.tensor(shape) - 1)


def _ravel(place: Tensor, shape: tuple[int, ...] | list[int]) -> Tensor:
    """Return the numbers of grid points (..., D)."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    return (place * torch.tensor(strides)).sum(-1)


def _stencil(place: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return the corners of the cells that places (P, D) lie in and their weights, (P, 2^D)."""
    last = torch.tensor(shape) - 1
    low = place.floor().clamp(min=torch.zeros_like(last), max=last - 1)
    part = (place - low).clamp(0, 1)[:, None]
    corner = torch.tensor(list(product([0, 1], repeat=len(shape))))
    weight = torch.where(corner == 1, part, 1 - part).prod(-1)
    return _ravel(low.long()[:, None] + corner, shape), weight


def _shape(points: Tensor, grid: int | None) -> tuple[int, ...]:
    """Return the sides of a grid of nearly cubic cells on the bounding box of nodes (N, D)."""
    sides = (points.amax(0) - points.amin(0)).tolist()

    def shape(cells: float) -> tuple[int, ...]:
        return tuple(max(1, round(side / max(sides) * cells)) + 1 for side in sides)

    if grid is not None:
        return shape(grid - 1)
    cells = 1
    while math.prod(shape(cells + 1)) <= len(points):
        cells += 1
    return shape(cells)


def _sizes(shape: tuple[int, ...], steps: int | None) -> list[tuple[int, ...]]:
    """Return the sides of the grids, from the finest to the coarsest.

    Raises:
        ValueError: `steps` is negative or more than there are cells for.
    """
    if steps is not None and steps < 0:
        raise ValueError(f"steps = {steps} must be 0 or more")
    sizes = [shape]
    while max(sizes[-1]) > COARSE if steps is None else len(sizes) <= steps:
        if max(sizes[-1]) == 2:
            raise ValueError(
                f"steps = {steps} must be {len(sizes) - 1} or less: "
                f"after them the grid of {' x '.join(map(str, shape))} points is one cell"
            )
        sizes.append(tuple((n + 1) // 2 if n > 2 else n for n in sizes[-1]))
    return sizes


def _pair(inputs: int, outputs: int, dim: int) -> nn.Sequential:
    """Return two convolutions, each with its rectifier."""
    first = CONVOLUTION[dim](inputs, outputs, 3, 1, 1)
    second = CONVOLUTION[dim](outputs, outputs, 3, 1, 1)
    return nn.Sequential(first, nn.LeakyReLU(LEAK), second, nn.LeakyReLU(LEAK))


def _initialise(module: nn.Module) -> None:
    """Draw the weights of a convolution so that values keep their size (He et al. 2015)."""
    if not isinstance(module, nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d):
        return
    taps = float(module.in_channels * math.prod(module.kernel_size))
    if module.transposed:  # a point meets one tap in each stride
        taps /= math.prod(module.stride)
    nn.init.normal_(module.weight, std=math.sqrt(2 / (1 + LEAK**2) / taps))
    assert module.bias is not None
    nn.init.zeros_(module.bias)


def _refuse_beyond_memory(
    sizes: list[tuple[int, ...]], widths: list[int], limit: float | None
) -> None:
    """Raise where training in float32 would not fit, even on one sample."""
    kernel = 3 ** len(sizes[0])
    # a level: 2 convolutions down and 2 up, of twice the width, its stride and that one's transpose
    parameters = sum(9 * kernel * width**2 for width in widths)
    fields = sum(10 * width * math.prod(size) for size, width in zip(sizes, widths, strict=True))
    if limit is None:
        if torch.cuda.is_available():
            limit = torch.cuda.mem_get_info()[1] / 1e9
        else:
            limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    needed = (parameters * 4 * 4 + fields * 4) / 1e9  # as many gradients and two moments; 4 bytes
    if needed > limit:
        raise MemoryError(
            f"about {parameters:,} parameters and a grid of {' x '.join(map(str, sizes[0]))} "
            f"points need {needed:.1f} GB, there are {limit:.1f} GB; "
            "take a smaller model.grid, model.channels or model.steps"
        )
