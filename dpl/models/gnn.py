"""Graph network on the nodes of the mesh and a hierarchy of clusters."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import gelu

from dpl.models.graph import Floats, Graph, Integers, hierarchy, means
from dpl.models.interface import Inputs
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.memory import refuse_weights

MAX_WIDTH_RATIO = 4  # width of the coarsest level over the width of the nodes
MAX_PASSES = 1000
CACHE = 2**17  # numbers of a block of messages that fit into the cache of a processor


class GNN(nn.Module):
    """Encoder, multilevel processor and decoder on the mesh graph.

    The levels are the nodes, clusters of nodes, clusters of clusters and so on, down to a complete
    graph of a few clusters. The inputs of a level are the resultant forces and moments on its
    clusters, the fractions of free degrees of freedom and of boundary nodes, and relative
    positions. Absolute positions are no input, so the prediction is invariant under translations. A
    pass is a V-cycle over the levels and propagates information through the whole body. Coarser
    levels have more channels.

    Sources: Pfaff, Fortunato, Sanchez-Gonzalez, Battaglia (2021), MeshGraphNets (encoder, processor
    and decoder; relative positions on edges); Fortunato et al. (2022), MultiScale MeshGraphNets
    (levels); Schuett et al. (2017), SchNet (`Messages`). Unlike in MeshGraphNets, messages are
    products, edges have no state, and nothing is normalised.
    """

    def __init__(
        self,
        scene: Scene,
        inputs: Inputs | None = None,
        *,
        width: int = 32,
        levels: int | None = None,
        passes: int = 1,
    ) -> None:
        """Build the network.

        Args:
            scene: The scene to predict.
            inputs: Its inputs; None for scaled forces.
            width: Channels of the nodes; each coarser level has twice as many, at most
                `MAX_WIDTH_RATIO` times `width`.
            levels: Number of levels with that of the nodes; 1 for messages between neighbouring
                nodes only; None for clusters that are twice as wide from level to level.
            passes: Number of V-cycles.

        Raises:
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        check_range(1, width=width, levels=1 if levels is None else levels)
        check_range(1, MAX_PASSES, passes=passes)
        inputs = inputs or Inputs.from_scene(scene)
        problem = scene.problem
        nodes, dim = problem.shape
        graphs, clusters = hierarchy(problem, levels)
        widths = [width * min(2**k, MAX_WIDTH_RATIO) for k in range(len(graphs))]
        # a level and pass: 5 W^2 of messages, once or twice, 2 W^2 upwards, 2 or 3 W^2 downwards
        weights = passes * sum(9 * wide**2 for wide in widths)
        refuse_weights(weights, None, "take a smaller model.width or fewer model.passes")
        flags = np.column_stack([problem.free.numpy(), problem.boundary.numpy()]).astype(float)
        self.levels = nn.ModuleList()
        for k, graph in enumerate(graphs):
            kind = {"first": k == 0, "averages": inputs.is_displacement}
            self.levels.append(Level(graph, flags, nodes, widths[k], **kind))
            if k < len(clusters):
                flags = means(flags, clusters[k])
        self.steps = nn.ModuleList(
            Step(fine, coarse, cluster)
            for (fine, coarse), cluster in zip(pairwise(graphs), clusters, strict=True)
        )
        self.sizes = [len(graph.points) for graph in graphs]
        self.complete = graphs[-1].complete
        self.scalars = nn.ModuleList(
            nn.Linear(inputs.scalars, wide) for wide in widths if inputs.scalars
        )
        self.passes = nn.ModuleList(Pass(dim, widths) for _ in range(passes))
        self.decode = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, dim))

    def forward(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a field (B, N, D) and scalars (B, S)."""
        loads = self.resultants(field)
        states = [level(*load) for level, load in zip(self.levels, loads, strict=True)]
        if len(self.scalars) or scalars.shape[1]:  # both, or an error
            pairs = zip(states, self.scalars, strict=True)
            states = [state + encoder(scalars)[None] for state, encoder in pairs]
        for v_cycle in self.passes:
            states = v_cycle(states, self.levels, self.steps)
        return self.decode(states[0]).transpose(0, 1)

    def resultants(self, force: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the resultants of nodal forces f (B, N, D) on the clusters of each level.

        They are the sums of forces over the nodes of a cluster, (K, B, D), and the sums of first
        moments (x - centre) f^T, (K, B, D D) [-].
        """
        force = force.transpose(0, 1).contiguous()
        moment = force.new_zeros(*force.shape[:2], force.shape[2] ** 2)
        loads = [(force, moment)]
        for step in self.steps:
            loads.append(step(*loads[-1]))
        return loads

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line each."""
        nodes, *clusters = map(str, self.sizes)
        line = f"no clusters: {nodes} nodes with messages to neighbours only"
        if clusters:
            line = f"multigrid hierarchy: {nodes} nodes, {', '.join(clusters)} clusters"
        elif self.complete:
            line = f"no clusters: complete graph of {nodes} nodes"
        return ["no absolute positions: the prediction is invariant under translations", line]


class Level(nn.Module):
    """The graph of a level as tensors, and the encoder of its inputs."""

    receiver: Tensor
    sender: Tensor
    features: Tensor
    flags: Tensor

    def __init__(
        self, graph: Graph, flags: Floats, nodes: int, width: int, *, first: bool, averages: bool
    ) -> None:
        """Build the encoder of a graph of K members of a mesh with so many nodes.

        `flags` are fractions of free degrees of freedom and of boundary nodes, (K, D + 1). Members
        are the nodes of the mesh at the `first` level. If the input `averages`, it is a
        displacement, whose mean over a cluster has its scale, and no force, which is summed.
        """
        super().__init__()
        count, dim = graph.points.shape
        arrays = {"features": graph.features().astype("f4"), "flags": flags.astype("f4")}
        arrays |= {"receiver": graph.receiver, "sender": graph.sender}
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(array), persistent=False)
        self.complete, self.first, self.spacing = graph.complete, first, graph.spacing
        self.mean_degree = len(graph.sender) / count
        # of forces: geometric mean of the scales of a nodal force and of the sum over a cluster
        self.load_scale = count / nodes if averages else math.sqrt(count / nodes)
        self.load = nn.Linear(dim if first else dim + dim * dim, width, bias=False)
        self.place = nn.Sequential(nn.Linear(dim + 1, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, force: Tensor, moment: Tensor) -> Tensor:
        """Return the state (K, B, width) under forces (K, B, D) and moments (K, B, D D)."""
        if not self.first:
            force = torch.cat([force, moment / self.spacing], dim=-1)
        return self.load(force * self.load_scale) + self.place(self.flags)[:, None]


class Step(nn.Module):
    """Map from the members of a level to the clusters of the next level."""

    cluster: Tensor
    arm: Tensor
    share: Tensor

    def __init__(self, fine: Graph, coarse: Graph, cluster: Integers) -> None:
        """Take two graphs and the cluster of each member of the finer one, (K,)."""
        super().__init__()
        arm = fine.points - coarse.points[cluster]
        self.clusters, self.spacing = len(coarse.points), coarse.spacing
        arm, share = (arm / coarse.spacing).astype("f4"), (1 / np.bincount(cluster)).astype("f4")
        for name, array in {"cluster": cluster, "arm": arm, "share": share}.items():
            self.register_buffer(name, torch.from_numpy(array), persistent=False)

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


class Messages(nn.Module):
    """Residual update of nodes by the filtered sum of their neighbours' states.

    The filter, one number per channel, is a small network of the relative position and is the same
    for all loads. A message is therefore a product, and the nonlinearity acts at the receiver. On a
    complete graph the sum is a matrix product.

    Source: Schuett et al. (2017), SchNet.
    """

    def __init__(self, dim: int, width: int) -> None:
        """Take the space dimension and the width."""
        super().__init__()
        self.filter = nn.Sequential(nn.Linear(dim + 1, width), nn.GELU(), nn.Linear(width, width))
        self.enter = nn.Linear(width, 2 * width)
        self.aggregate = nn.Linear(width, width, bias=False)
        self.leave = nn.Linear(width, width)

    def forward(self, level: Level, state: Tensor) -> Tensor:
        """Return the updated state (K, B, width)."""
        weight = self.filter(level.features) / level.mean_degree  # (P, width)
        sent, own = self.enter(state).chunk(2, dim=-1)
        if level.complete:
            matrix = weight.unflatten(0, (len(sent), len(sent))).permute(2, 0, 1)
            received = (matrix @ sent.permute(2, 0, 1)).permute(1, 2, 0)
        elif torch.compiler.is_compiling():  # the compiler fuses one sum, but not blocks
            messages = sent.index_select(0, level.sender) * weight[:, None]
            received = torch.zeros_like(sent).index_add(0, level.receiver, messages)
        else:
            received = NeighbourSum.apply(sent.contiguous(), weight, level.receiver, level.sender)
        return state + self.leave(gelu(own + self.aggregate(received)))


class NeighbourSum(torch.autograd.Function):
    """Sums over neighbours j of i of w_ij x_j, computed in blocks of messages.

    All messages together would be by far the largest tensor of the network. Blocks fit into the
    cache and are recomputed in the backward pass.
    """

    @staticmethod
    def forward(ctx: Any, sent: Tensor, weight: Tensor, receiver: Tensor, sender: Tensor) -> Tensor:
        """Return sums (K, B, width) of states (K, B, width) with weights (P, width)."""
        ctx.save_for_backward(sent, weight, receiver, sender)
        received = torch.zeros_like(sent)
        for i, j, w in _blocks(sent, receiver, sender, weight):
            received.index_add_(0, i, sent.index_select(0, j).mul_(w[:, None]))
        return received

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Return the gradients with respect to states and weights."""
        sent, weight, receiver, sender = ctx.saved_tensors
        of_sent, of_weight = torch.zeros_like(sent), torch.empty_like(weight)
        gradient = gradient.contiguous()
        for i, j, w, out in _blocks(sent, receiver, sender, weight, of_weight):
            received = gradient.index_select(0, i)
            torch.sum(sent.index_select(0, j).mul_(received), dim=1, out=out)
            of_sent.index_add_(0, j, received.mul_(w[:, None]))
        return of_sent, of_weight, None, None


def _blocks(states: Tensor, *columns: Tensor) -> Any:
    """Return blocks of rows of the columns (P, ...) that fit into the cache."""
    rows = CACHE // states[0].numel() if states.device.type == "cpu" else len(columns[0])
    return zip(*(column.split(max(1, rows)) for column in columns), strict=True)


class Pass(nn.Module):
    """A V-cycle over the levels."""

    def __init__(self, dim: int, widths: list[int]) -> None:
        """Take the space dimension and the width of each level."""
        super().__init__()
        pairs = list(pairwise(widths))
        # no messages between nodes on the way down: they are the most expensive ones
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


class Restrict(nn.Module):
    """Update of clusters by the mean over their members."""

    def __init__(self, dim: int, fine: int, coarse: int) -> None:
        """Take the space dimension and the widths of two levels."""
        super().__init__()
        self.state, self.arm = nn.Linear(fine, fine), nn.Linear(dim, fine, bias=False)
        self.leave = nn.Linear(fine, coarse)

    def forward(self, step: Step, fine: Tensor) -> Tensor:
        """Return the update of clusters (K', B, coarse) from members (K, B, fine)."""
        return self.leave(step.mean(gelu(self.state(fine) + self.arm(step.arm)[:, None])))


class Prolong(nn.Module):
    """Update of members by their cluster and their position in it."""

    def __init__(self, dim: int, fine: int, coarse: int) -> None:
        """Take the space dimension and the widths of two levels."""
        super().__init__()
        self.own, self.arm = nn.Linear(fine, fine), nn.Linear(dim, fine, bias=False)
        self.cluster = nn.Linear(coarse, fine, bias=False)
        self.leave = nn.Linear(fine, fine)

    def forward(self, step: Step, fine: Tensor, coarse: Tensor) -> Tensor:
        """Return the update of members, (K, B, fine)."""
        above = self.cluster(coarse).index_select(0, step.cluster)
        return self.leave(gelu(self.own(fine) + above + self.arm(step.arm)[:, None]))
