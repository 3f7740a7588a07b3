"""Fields of a body with symmetries, by what their images are at a few of its nodes."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from dpl.fem.symmetry import Symmetry


class Orbits(nn.Module):
    """One node of each orbit: what all images of a field are there is the field.

    So linear maps that commute with the symmetries cost the G-th part of the memory: of fields c B
    whose images under symmetry g are (c T_g) B, the rows of B are wanted at those nodes only.

    Attributes:
        sources: Nodes that the G images take their values from, G after one another, (G n,).
        turns: Q of each symmetry, transposed, (G, D, D).
        share: Part in which a value counts, D for each node, (n D,): a node that m symmetries leave
            in place is seen m times.
        nodes: Nodes that the orbits reach, (P,).
        places: Where among the images these stand, (P,).
    """

    sources: Tensor
    turns: Tensor
    share: Tensor
    nodes: Tensor
    places: Tensor

    def __init__(self, group: Sequence[Symmetry], where: Tensor) -> None:
        """Find the orbits.

        Args:
            group: Symmetries, the identity first; none: the identity alone.
            where: Degrees of freedom that count, which every symmetry maps onto themselves, (N, D).
        """
        super().__init__()
        where = where.cpu()
        count, dim = where.shape
        every = torch.arange(count)
        sources, turns = every[None], torch.eye(dim, dtype=torch.float64)[None]
        if group:
            sources = torch.stack([symmetry.source for symmetry in group]).cpu()
            turns = torch.stack([symmetry.rotation for symmetry in group]).cpu().mT.double()
        nodes = where.any(dim=1).nonzero()[:, 0]
        first = nodes[sources.amin(dim=0)[nodes] == nodes]
        sources = sources[:, first]
        places = torch.empty(count, dtype=torch.int64)
        places[sources.flatten()] = torch.arange(sources.numel())
        share = 1 / (sources == first).sum(dim=0).double()
        for name, buffer in {
            "sources": sources.flatten(),
            "turns": turns.contiguous(),
            "share": share.repeat_interleave(dim),
            "nodes": nodes,
            "places": places[nodes],
        }.items():
            self.register_buffer(name, buffer, persistent=False)

    def seen(self, field: Tensor) -> Tensor:
        """Return all images of fields (B, N, D) at one node of each orbit, (B, G, n D)."""
        taken = field.index_select(1, self.sources).unflatten(1, (len(self.turns), -1))
        return (taken @ self.turns.to(field)).flatten(2)

    def whole(self, images: Tensor, like: Tensor) -> Tensor:
        """Return fields (B, N, D), shaped like others, of their images (B, G, n D)."""
        values = images.unflatten(2, (-1, like.shape[2])) @ self.turns.mT.to(images)
        field = images.new_zeros(like.shape)
        return field.index_copy(1, self.nodes, values.flatten(1, 2).index_select(1, self.places))

    def first(self, field: Tensor) -> Tensor:
        """Return fields (B, N, D) at one node of each orbit, (B, n D)."""
        count = len(self.sources) // len(self.turns)
        return field.index_select(1, self.sources[:count]).flatten(1)


def turned_back(answers: Tensor, returns: Tensor) -> Tensor:
    """Return the sum over images of their coordinates (B, G, C), each turned back, (B, C).

    Args:
        answers: Coordinates of images.
        returns: What turns those of each image back, c -> c T_g^-1, (G, C, C).
    """
    return answers.flatten(1) @ returns.flatten(0, 1)


def turned(coordinates: Tensor, returns: Tensor) -> Tensor:
    """Return coordinates (B, C) of all images, (B, G, C); T_g is orthogonal, see `turned_back`."""
    every = nn.functional.linear(coordinates, returns.flatten(0, 1))
    return cast(Tensor, every.unflatten(1, (len(returns), -1)))
