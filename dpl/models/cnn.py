"""Convolutional network (U-Net) on a regular grid around the body."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, avg_pool3d

from dpl.fem import Problem
from dpl.models.grid import Immersion, cubic_grid, filling, own_grid
from dpl.models.interface import Inputs
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.memory import refuse_beyond

COARSE = 3  # grid points per side that two convolutions connect completely
LEAK = 0.25  # slope of rectifiers at negative values; nearly linear units train faster
CONVOLUTION: dict[int, type[nn.Module]] = {2: nn.Conv2d, 3: nn.Conv3d}
TRANSPOSED: dict[int, type[nn.Module]] = {2: nn.ConvTranspose2d, 3: nn.ConvTranspose3d}


class CNN(nn.Module):
    """U-Net on a regular grid around the body.

    Nodal forces are distributed to the grid and displacements interpolated from it with the same
    multilinear weights. If the nodes form a regular grid, they are its points. Constant channels
    contain the volume fraction of the body and the fixed degrees of freedom; channels that are
    uniform are omitted. Each coarsening is a convolution of stride 2 and each refinement its
    transpose, for any number of points; a side of one cell is not coarsened. There is no
    normalisation over samples, because it would remove the magnitude of the load.

    Source: Mendizabal, Marquez-Neila, Cotin (2020), Simulation of hyperelastic materials in
    real-time using deep learning, Medical Image Analysis 59, section 3.
    """

    constant: Tensor
    share: Tensor

    def __init__(
        self,
        scene: Scene,
        inputs: Inputs | None = None,
        *,
        channels: int = 16,
        steps: int | None = None,
        grid: int | None = None,
        smooth: bool = False,
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: The scene to predict.
            inputs: Its inputs; None for scaled forces.
            channels: Channels of the finest grid; each coarsening doubles them.
            steps: Number of coarsenings; None for as many as connect all points of the coarsest
                grid.
            grid: Points along the longest side of the bounding box, with about the same spacing on
                other sides; None for the nodes if they form a regular grid, otherwise for about as
                many points as nodes.
            smooth: Leave out the residual blocks of the finest grid, which suits displacements
                that vary little over an element.
            memory_limit: Memory for training on one sample [GB]; None for that of the machine.

        Raises:
            MemoryError: Parameters and one sample would not fit.
        """
        super().__init__()
        check_range(1, channels=channels)
        if grid is not None:
            check_range(2, grid=grid)
        inputs = inputs or Inputs.from_scene(scene)
        problem = scene.problem
        points, dim = problem.points, problem.shape[1]
        own = own_grid(points)
        shape = own if own and grid in (None, max(own)) else cubic_grid(points, grid)
        sizes = _sizes(shape, steps)
        widths = [channels * 2**level for level in range(len(sizes))]
        # per level: 2 convolutions down, 2 up, and one from and to a level of twice the channels
        parameters = sum(8 * 3**dim * width**2 for width in widths)
        values = sum(10 * wide * math.prod(size) for size, wide in zip(sizes, widths, strict=True))
        needed = 4 * (4 * parameters + values) / 1e9  # weights, gradients, two moments, 4 bytes
        what = f"about {parameters:,} parameters and a grid of {' x '.join(map(str, shape))} points"
        remedy = "take a smaller model.grid, model.channels or model.steps"
        refuse_beyond(needed, memory_limit, what, remedy)
        self.immersion = Immersion(points, shape)
        self.register_buffer("constant", self._constant(problem), persistent=False)
        self.averages = inputs.is_displacement  # forces are summed
        if self.averages:
            nodes = self.immersion.spread(torch.ones(1, len(points), 1))
            self.register_buffer("share", 1 / nodes.clamp(min=1e-6), persistent=False)
        self.smooth = smooth and len(sizes) > 1
        channels_in = dim + len(self.constant) + inputs.scalars
        self.net = UNet(channels_in, dim, sizes, widths, smooth=self.smooth)

    def _constant(self, problem: Problem) -> Tensor:
        """Return the constant channels that are not uniform, (C, *shape)."""
        fixed = (~problem.free).float()
        if (fixed == fixed[:, :1]).all():
            fixed = fixed[:, :1]
        ones = torch.ones(1, len(fixed), 1)
        share = self.immersion.spread(fixed[None])[0] / self.immersion.spread(ones)[0].clamp(1e-6)
        volume = problem.dV.expand(len(problem.cells), -1).sum()
        box = (problem.points.amax(0) - problem.points.amin(0)).prod()
        self.full = bool(volume > 0.999 * box)  # False for a grid of nodes with missing cells
        filled = [] if self.full else [filling(problem, self.immersion.shape).float()]
        varying = [channel for channel in (*share, *filled) if channel.min() < channel.max()]
        return torch.stack(varying) if varying else share[:0]

    def forward(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a field (B, N, D) and scalars (B, S)."""
        on_grid = self.immersion.spread(field)
        if self.averages:
            on_grid = on_grid * self.share
        batch, sides = field.shape[0], on_grid.shape[2:]
        uniform = scalars.view(*scalars.shape, *[1] * len(sides)).expand(-1, -1, *sides)
        channels = [on_grid, self.constant.expand(batch, *self.constant.shape), uniform]
        return self.immersion.read(self.net(torch.cat(channels, 1)))

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line each."""
        lines = []
        if self.immersion.corners.shape[1] == 1:
            size = " x ".join(map(str, self.immersion.shape))
            lines.append(f"no interpolation: the nodes lie on a grid of {size} points")
        if self.smooth:
            lines.append("no residual blocks on the finest grid: the displacement is smooth")
        if self.full:
            lines.append("no input for the volume fraction: the body fills the grid")
        return lines


class UNet(nn.Module):
    """Encoder and decoder on a hierarchy of grids, with the inputs and residual blocks on each.

    The means of the inputs around the points of a coarser grid are inputs there, so that global
    features need not pass the finer grids. The second convolution of each residual block is zero at
    first.

    Sources: Ronneberger, Fischer, Brox (2015), U-Net; He et al. (2016), Identity mappings in deep
    residual networks (order of rectifiers and convolutions). Unlike there, grids are coarsened by
    strided convolutions, parts are added instead of concatenated, and nothing is normalised.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        sizes: list[tuple[int, ...]],
        widths: list[int],
        *,
        smooth: bool = False,
    ) -> None:
        """Take numbers of channels, and points along each side of the grids, the finest first."""
        super().__init__()
        self.dim = len(sizes[0])
        self.strides = [
            tuple(1 + (n > m) for n, m in zip(*pair, strict=True)) for pair in pairwise(sizes)
        ]
        conv, transposed = CONVOLUTION[self.dim], TRANSPOSED[self.dim]
        self.inlets = nn.ModuleList(conv(inputs, width, 3, 1, 1) for width in widths)

        def blocks(widths: list[int]) -> nn.ModuleList:
            found = nn.ModuleList(Residual(width, self.dim) for width in widths)
            if smooth and widths:
                found[0] = nn.Identity()
            return found

        self.encoders, self.decoders = blocks(widths), blocks(widths[:-1])
        self.descents, self.ascents = nn.ModuleList(), nn.ModuleList()
        levels = zip(pairwise(sizes), pairwise(widths), self.strides, strict=True)
        for (fine, coarse), (few, many), stride in levels:
            left = tuple(n - s * (m - 1) - 1 for n, m, s in zip(fine, coarse, stride, strict=True))
            self.descents.append(conv(few, many, 3, stride, 1))
            self.ascents.append(transposed(many, few, 3, stride, 1, left))
        self.means = avg_pool3d if self.dim == 3 else avg_pool2d
        self.last = conv(widths[0], outputs, 1)
        self.rectify = nn.LeakyReLU(LEAK)
        self.apply(_initialise)

    def forward(self, field: Tensor) -> Tensor:
        """Return output fields (B, outputs, *sizes[0]) of input fields (B, inputs, *sizes[0])."""
        state = self.encoders[0](self.inlets[0](field))
        skipped = [state]
        levels = zip(self.strides, self.descents, self.inlets[1:], self.encoders[1:], strict=True)
        for stride, descent, inlet, encoder in levels:
            kernel, padding = [2 * step - 1 for step in stride], [step - 1 for step in stride]
            field = self.means(field, kernel, stride, padding, count_include_pad=False)
            state = encoder(_sum(descent(self.rectify(state)), inlet(field)))
            skipped.append(state)
        skipped.pop()
        for ascent, decoder in zip(reversed(self.ascents), reversed(self.decoders), strict=True):
            state = decoder(_sum(ascent(self.rectify(state)), skipped.pop()))
        return self.last(self.rectify(state))


class Residual(nn.Module):
    """Field plus two convolutions of it, each of a rectified field."""

    def __init__(self, width: int, dim: int) -> None:
        """Take the number of channels and the space dimension."""
        super().__init__()
        self.first = CONVOLUTION[dim](width, width, 3, 1, 1)
        self.second = CONVOLUTION[dim](width, width, 3, 1, 1)
        self.rectify = nn.LeakyReLU(LEAK)

    def forward(self, field: Tensor) -> Tensor:
        """Return a field of the same shape, (B, width, *shape)."""
        return field + self.second(self.rectify(self.first(self.rectify(field))))


def _sum(one: Tensor, other: Tensor) -> Tensor:
    """Return the sum of two fields of equal variance, which the sum keeps."""
    return (one + other) * math.sqrt(0.5)


def _sizes(shape: tuple[int, ...], steps: int | None) -> list[tuple[int, ...]]:
    """Return the sides of the grids, from the finest to the coarsest."""
    if steps is not None:
        check_range(0, steps=steps)
    sizes = [shape]
    while max(sizes[-1]) > COARSE if steps is None else len(sizes) <= steps:
        if max(sizes[-1]) == 2:
            raise ValueError(
                f"steps = {steps} must be {len(sizes) - 1} or less: "
                f"after them the grid of {' x '.join(map(str, shape))} points is one cell"
            )
        sizes.append(tuple((n + 1) // 2 if n > 2 else n for n in sizes[-1]))
    return sizes


def _initialise(module: nn.Module) -> None:
    """Draw weights of a convolution that preserve the variance of values (He et al. 2015)."""
    if isinstance(module, Residual):  # after its convolutions
        nn.init.zeros_(module.second.get_parameter("weight"))
    if not isinstance(module, nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d):
        return
    taps = float(module.in_channels * math.prod(module.kernel_size))
    if module.transposed:  # an output point has one tap per stride
        taps /= math.prod(module.stride)
    nn.init.normal_(module.weight, std=math.sqrt(2 / (1 + LEAK**2) / taps))
    assert module.bias is not None
    nn.init.zeros_(module.bias)
