"""Message passing on the nodes of the mesh and on coarser and coarser clusters of them."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import gelu

from dpl.models.graph import Floats, Graph, Integers, hierarchy, means
from dpl.models.poisson_interpolation import normalise_poisson
from dpl.scene import Scene
from dpl.system.memory import refuse_weights

WIDEST = 4  # largest width of a level over that of the nodes
DEEPEST = 1000  # passes
CACHE = 2**17  # numbers of a block of messages that stay in a processor's cache


class GNN(nn.Module):
    """Encode, process on several levels of the mesh, decode.

    The levels are the nodes and clusters of clusters of them, down to few that all hear each other.
    Each level sees the loads on its clusters, the parts of them that are held and that are
    boundary, and relative positions, never positions: moving the body changes nothing. A pass
    goes down the levels and up again, so that what happens at one end of the body is known at
    the other after one pass. Coarser levels have more channels, and most of the work is there.

    Sources: Pfaff, Fortunato, Sanchez-Gonzalez, Battaglia (2021), MeshGraphNets: encode, process,
    decode, and relative positions on edges; Fortunato et al. (2022), MultiScale MeshGraphNets:
    levels; Schuett et al. (2017), SchNet: filters as functions of relative positions, see
    `Messages`. Unlike in the first, messages are no networks of their own, edges have no state,
    and nothing is normalised.
    """

    def __init__(
        self, scene: Scene, *, width: int = 32, levels: int | None = None, passes: int = 1
    ) -> None:
        """Build the network.

        Args:
            scene: What it is to answer.
            width: Channels of the nodes; each coarser level has twice as many, `WIDEST` times
                `width` at most.
            levels: Of which the first is the nodes; 1 means that information goes from node to
                node only. Left out, as many as make clusters twice as wide from level to level.
            passes: Ways down the levels and up again.

        Raises:
            ValueError: `width`, `levels` or `passes` is out of range.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        if width < 1:
            raise ValueError(f"width = {width} must be 1 or more")
        if levels is not None and levels < 1:
            raise ValueError(f"levels = {levels} must be 1 or more")
        if not 1 <= passes <= DEEPEST:
            raise ValueError(f"passes = {passes} must be 1 or more and at most {DEEPEST}")
        problem = scene.problem
        nodes, dim = problem.shape
        graphs, clusters = hierarchy(problem, levels)
        widths = [width * min(2**k, WIDEST) for k in range(len(graphs))]
        # a level and pass: 5 W^2 of messages, once or twice, 2 W^2 upwards, 2 or 3 W^2 downwards
        weights = passes * sum(9 * wide**2 for wide in widths)
        refuse_weights(weights, None, "take a smaller model.width or fewer model.passes")
        flags = np.column_stack([problem.free.numpy(), problem.boundary.numpy()]).astype(float)
        self.levels = nn.ModuleList()
        for k, graph in enumerate(graphs):
            self.levels.append(Level(graph, flags, nodes, widths[k], first=k == 0))
            if k < len(clusters):
                flags = means(flags, clusters[k])
        self.steps = nn.ModuleList(
            Step(fine, coarse, cluster)
            for (fine, coarse), cluster in zip(pairwise(graphs), clusters, strict=True)
        )
        self.sizes = [len(graph.points) for graph in graphs]
        self.whole = graphs[-1].whole
        self.poisson_range = scene.loads.poisson_range
        self.extra_inputs = () if self.poisson_range is None else ("poisson",)
        self.moduli = nn.ModuleList(nn.Linear(1, wide) for wide in widths if self.extra_inputs)
        self.passes = nn.ModuleList(Pass(dim, widths) for _ in range(passes))
        self.decode = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, dim))

    def forward(self, force: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: What acts.
            poisson: Poisson's ratios, (B, 1) [-]; wanted where the law has a range of them.
        """
        states = [
            level(*load) for level, load in zip(self.levels, self.resultants(force), strict=True)
        ]
        if self.poisson_range is not None:
            place = normalise_poisson(poisson, self.poisson_range, force)
            pairs = zip(states, self.moduli, strict=True)
            states = [state + encoder(place)[None] for state, encoder in pairs]
        for one in self.passes:
            states = one(states, self.levels, self.steps)
        return self.decode(states[0]).transpose(0, 1)

    def resultants(self, force: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return what a force (B, N, D) is on the clusters of each level, as sums over nodes.

        Forces (K, B, D) and their first moments about the cluster's centre, (K, B, D D): the sums
        of (x - centre) f^T [-], without which a cluster would not know how it is twisted.
        """
        force = force.transpose(0, 1).contiguous()
        moment = force.new_zeros(*force.shape[:2], force.shape[2] ** 2)
        loads = [(force, moment)]
        for step in self.steps:
            loads.append(step(*loads[-1]))
        return loads

    def skipped_work(self) -> list[str]:
        """Return what the network leaves out, a line each."""
        lines = ["no positions, only relative ones: the answer moves with the body"]
        if len(self.sizes) > 1:
            nodes, *clusters = map(str, self.sizes)
            lines.append(f"no long ways over {nodes} nodes: clusters, {' then '.join(clusters)}")
        elif self.whole:
            lines.append(f"no clusters: {self.sizes[0]} nodes all hear each other")
        else:
            lines.append(f"no clusters: {self.sizes[0]} nodes hear their neighbours only")
        return lines


class Level(nn.Module):
    """A graph as tensors, and the encoder of what is known there."""

    receiver: Tensor
    sender: Tensor
    features: Tensor
    flags: Tensor

    def __init__(self, graph: Graph, flags: Floats, nodes: int, width: int, *, first: bool) -> None:
        """Take a graph, the flags of its members (K, D + 1) and the number of nodes of the mesh."""
        super().__init__()
        count, dim = graph.points.shape
        self.register_buffer("receiver", torch.from_numpy(graph.receiver))
        self.register_buffer("sender", torch.from_numpy(graph.sender))
        self.register_buffer("features", torch.from_numpy(graph.features()).float())
        self.register_buffer("flags", torch.from_numpy(flags).float())
        self.whole, self.first, self.spacing = graph.whole, first, graph.spacing
        self.mean_degree = len(graph.sender) / count
        # half-way between the load on a node and that on all of a cluster's
        self.load_scale = math.sqrt(count / nodes)
        self.load = nn.Linear(dim if first else dim + dim * dim, width, bias=False)
        self.place = nn.Sequential(nn.Linear(dim + 1, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, force: Tensor, moment: Tensor) -> Tensor:
        """Return the state (K, B, width) under forces (K, B, D) and moments (K, B, D D)."""
        if not self.first:
            force = torch.cat([force, moment / self.spacing], dim=-1)
        return self.load(force * self.load_scale) + self.place(self.flags)[:, None]


class Step(nn.Module):
    """Which cluster of the next level each member of a level belongs to."""

    cluster: Tensor
    arm: Tensor
    share: Tensor

    def __init__(self, fine: Graph, coarse: Graph, cluster: Integers) -> None:
        """Take two graphs and the cluster of each member of the first, (K,)."""
        super().__init__()
        arm = fine.points - coarse.points[cluster]
        self.clusters, self.spacing = len(coarse.points), coarse.spacing
        self.register_buffer("cluster", torch.from_numpy(cluster))
        self.register_buffer("arm", torch.from_numpy(arm / coarse.spacing).float())
        self.register_buffer("share", torch.from_numpy(1 / np.bincount(cluster)).float())

    def sum(self, values: Tensor) -> Tensor:
        """Return the sums over members (K, B, ...) of each cluster."""
        total = values.new_zeros(self.clusters, *values.shape[1:])
        return total.index_add(0, self.cluster, values)

    def forward(self, force: Tensor, moment: Tensor) -> tuple[Tensor, Tensor]:
        """Return forces (K, B, D) and moments (K, B, D D) of the clusters."""
        lever = self.spacing * self.arm[:, None, :, None] * force[:, :, None, :]
        return self.sum(force), self.sum(moment + lever.flatten(-2))

    def mean(self, values: Tensor) -> Tensor:
        """Return the means over members (K, B, ...) of each cluster."""
        return self.sum(values) * self.share[:, None, None]


class Pass(nn.Module):
    """One way down the levels and up again, a V-cycle."""

    def __init__(self, dim: int, widths: list[int]) -> None:
        """Take the space dimension and the width of each level."""
        super().__init__()
        pairs = list(pairwise(widths))
        # none on the nodes before the first way down: the most expensive place
        self.down = nn.ModuleList(Messages(dim, width) for width in widths[1:-1])
        self.bottom = nn.ModuleList(Messages(dim, widths[-1]) for _ in range(2))
        self.up = nn.ModuleList(Messages(dim, width) for width in widths[:-1])
        self.restrict = nn.ModuleList(Restrict(dim, *pair) for pair in pairs)
        self.prolong = nn.ModuleList(Prolong(dim, *pair) for pair in pairs)

    def forward(
        self, states: list[Tensor], levels: nn.ModuleList, steps: nn.ModuleList
    ) -> list[Tensor]:
        """Return the states (K, B, width) of all levels after the pass."""
        states = list(states)
        for k, (step, restrict) in enumerate(zip(steps, self.restrict, strict=True)):
            if k > 0:
                states[k] = self.down[k - 1](levels[k], states[k])
            states[k + 1] = states[k + 1] + restrict(step, states[k])
        for messages in self.bottom:
            states[-1] = messages(levels[-1], states[-1])
        for k in reversed(range(len(steps))):
            states[k] = states[k] + self.prolong[k](steps[k], states[k], states[k + 1])
            states[k] = self.up[k](levels[k], states[k])
        return states


class Messages(nn.Module):
    """Each member hears its neighbours: a sum of their states, filtered by where they are.

    The filter, a number per channel, is a small network of the relative position, the same for all
    loads; so a message is one product and not a network of its own, and what is not linear in
    the states happens at the receiver. Where all hear all the sum is a matrix product.
    """

    def __init__(self, dim: int, width: int) -> None:
        """Take the space dimension and the width."""
        super().__init__()
        self.filter = nn.Sequential(nn.Linear(dim + 1, width), nn.GELU(), nn.Linear(width, width))
        self.enter = nn.Linear(width, 2 * width)
        self.hear = nn.Linear(width, width, bias=False)
        self.leave = nn.Linear(width, width)

    def forward(self, level: Level, state: Tensor) -> Tensor:
        """Return the state (K, B, width) after hearing."""
        weight = self.filter(level.features) / level.mean_degree  # (P, width)
        said, own = self.enter(state).chunk(2, dim=-1)
        if level.whole:
            matrix = weight.unflatten(0, (len(said), len(said))).permute(2, 0, 1)
            heard = (matrix @ said.permute(2, 0, 1)).permute(1, 2, 0)
        elif torch.compiler.is_compiling():  # which sees through one sum, and not through blocks
            messages = said.index_select(0, level.sender) * weight[:, None]
            heard = torch.zeros_like(said).index_add(0, level.receiver, messages)
        else:
            heard = Filtered.apply(said.contiguous(), weight, level.receiver, level.sender)
        return state + self.leave(gelu(own + self.hear(heard)))


class Filtered(torch.autograd.Function):
    """Sums over neighbours j of i of w_ij x_j, a block of messages at a time.

    All messages at once are the largest tensor of the network, several times over; blocks stay in
    the cache and are not kept for the way back.
    """

    @staticmethod
    def forward(ctx: Any, said: Tensor, weight: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """Return (K, B, width) from states (K, B, width) and weights (P, width)."""
        ctx.save_for_backward(said, weight, receiver, sender)
        heard = torch.zeros_like(said)
        for i, j, w in _blocks(said, receiver, sender, weight):
            heard.index_add_(0, i, said.index_select(0, j).mul_(w[:, None]))
        return heard

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Return the slopes with respect to states and weights."""
        said, weight, receiver, sender = ctx.saved_tensors
        of_said, of_weight = torch.zeros_like(said), torch.empty_like(weight)
        slope = slope.contiguous()
        for i, j, w, out in _blocks(said, receiver, sender, weight, of_weight):
            heard = slope.index_select(0, i)
            torch.sum(said.index_select(0, j).mul_(heard), dim=1, out=out)
            of_said.index_add_(0, j, heard.mul_(w[:, None]))
        return of_said, of_weight, None, None


def _blocks(states: Tensor, *columns: Tensor) -> Any:
    """Return rows of the columns (P, ...), as many at a time as stay in the cache."""
    rows = CACHE // states[0].numel() if states.device.type == "cpu" else len(columns[0])
    return zip(*(column.split(max(1, rows)) for column in columns), strict=True)


class Restrict(nn.Module):
    """What clusters learn from their members: a mean."""

    def __init__(self, dim: int, fine: int, coarse: int) -> None:
        """Take the space dimension and the widths of two levels."""
        super().__init__()
        self.state, self.arm = nn.Linear(fine, fine), nn.Linear(dim, fine, bias=False)
        self.leave = nn.Linear(fine, coarse)

    def forward(self, step: Step, fine: Tensor) -> Tensor:
        """Return what is added to clusters, (K', B, coarse), from members (K, B, fine)."""
        return self.leave(step.mean(gelu(self.state(fine) + self.arm(step.arm)[:, None])))


class Prolong(nn.Module):
    """What members learn from their cluster, by where in it they are."""

    def __init__(self, dim: int, fine: int, coarse: int) -> None:
        """Take the space dimension and the widths of two levels."""
        super().__init__()
        self.own, self.arm = nn.Linear(fine, fine), nn.Linear(dim, fine, bias=False)
        self.cluster = nn.Linear(coarse, fine, bias=False)
        self.leave = nn.Linear(fine, fine)

    def forward(self, step: Step, fine: Tensor, coarse: Tensor) -> Tensor:
        """Return what is added to members, (K, B, fine)."""
        above = self.cluster(coarse).index_select(0, step.cluster)
        return self.leave(gelu(self.own(fine) + above + self.arm(step.arm)[:, None]))
