"""Levels of a multigrid graph and the messages between their nodes: continuous filters."""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import gelu

from dpl.models.graph import Floats, Graph
from dpl.models.stored_buffers import StoredBuffers, check_indices

CACHE = 2**17  # numbers of a block of messages that fit into the cache of a processor


class Level(StoredBuffers):
    """The graph of a level as tensors, and the encoder of its inputs."""

    receiver: Tensor
    sender: Tensor
    features: Tensor
    flags: Tensor

    def __init__(
        self, graph: Graph, flags: Floats, nodes: int, width: int, *, first: bool, averages: bool
    ) -> None:
        """Build the encoder.

        Args:
            graph: The graph of K members.
            flags: Fractions of free degrees of freedom and of boundary nodes, (K, D + 1).
            nodes: Number of nodes of the mesh.
            width: Channels of the state.
            first: Members are the nodes of the mesh.
            averages: The input is a displacement, whose mean over a cluster has its scale, and not
                a force, whose sum is the resultant.
        """
        super().__init__()
        count, dim = graph.points.shape
        self.register_buffer("receiver", torch.from_numpy(graph.receiver))
        self.register_buffer("sender", torch.from_numpy(graph.sender))
        self.register_buffer("features", torch.from_numpy(graph.features()).float())
        self.register_buffer("flags", torch.from_numpy(flags).float())
        self.complete = graph.complete
        self.first = first
        self.spacing = graph.spacing
        self.mean_degree = len(graph.sender) / count
        # of forces: geometric mean of the scales of a nodal force and of the sum over a cluster
        self.load_scale = count / nodes if averages else math.sqrt(count / nodes)
        self.load = nn.Linear(dim if first else dim + dim * dim, width, bias=False)
        self.place = nn.Sequential(nn.Linear(dim + 1, width), nn.GELU(), nn.Linear(width, width))

    def check_buffers(self) -> None:
        check_indices(len(self.flags), receiver=self.receiver, sender=self.sender)

    def forward(self, force: Tensor, moment: Tensor) -> Tensor:
        """Return the state (K, B, width) under forces (K, B, D) and moments (K, B, D D)."""
        if not self.first:
            force = torch.cat([force, moment / self.spacing], dim=-1)
        return self.load(force * self.load_scale) + self.place(self.flags)[:, None]


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
