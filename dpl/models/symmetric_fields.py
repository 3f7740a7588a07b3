"""Fields of a symmetric body, stored at one node of each orbit of its symmetry group."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from dpl.fem.symmetry import Symmetry


class Orbits(nn.Module):
    """One representative node of each orbit of a symmetry group.

    The values of all images of a field at the representatives determine the field. A linear map
    that commutes with the G symmetries therefore takes 1/G of the memory: if the image under
    symmetry g of the field c B is (c T_g) B, only the rows of B at the representatives are needed.

    Attributes:
        sources: Nodes from which the images take their values at the n representatives, image by
            image, (G n,).
        rotations: Transposed rotation of each symmetry, (G, D, D).
        weights: Weight of each value in sums over images, (n D,): 1/m at a node that m symmetries
            map onto itself.
        nodes: Nodes of all orbits, (P,).
        positions: Position of each of these nodes among the images, (P,).
    """

    sources: Tensor
    rotations: Tensor
    weights: Tensor
    nodes: Tensor
    positions: Tensor

    def __init__(self, group: Sequence[Symmetry], dofs: Tensor) -> None:
        """Find the orbits.

        Args:
            group: The symmetries, identity first; empty for the identity alone.
            dofs: Mask of degrees of freedom that every symmetry maps onto itself, (N, D).
        """
        super().__init__()
        dofs = dofs.cpu()
        count, dim = dofs.shape
        sources = torch.arange(count)[None]
        rotations = torch.eye(dim, dtype=torch.float64)[None]
        if group:
            sources = torch.stack([symmetry.source for symmetry in group]).cpu()
            rotations = torch.stack([symmetry.rotation for symmetry in group]).cpu().mT.double()
        nodes = dofs.any(dim=1).nonzero()[:, 0]
        first = nodes[sources.amin(dim=0)[nodes] == nodes]
        sources = sources[:, first]
        positions = torch.empty(count, dtype=torch.int64)
        positions[sources.flatten()] = torch.arange(sources.numel())
        weights = 1 / (sources == first).sum(dim=0).double()
        for name, buffer in {
            "sources": sources.flatten(),
            "rotations": rotations.contiguous(),
            "weights": weights.repeat_interleave(dim),
            "nodes": nodes,
            "positions": positions[nodes],
        }.items():
            self.register_buffer(name, buffer, persistent=False)

    def images(self, field: Tensor) -> Tensor:
        """Return all images of fields (B, N, D) at the representatives, (B, G, n D)."""
        values = field.index_select(1, self.sources).unflatten(1, (len(self.rotations), -1))
        return (values @ self.rotations.to(field)).flatten(2)

    def field(self, images: Tensor, like: Tensor) -> Tensor:
        """Return fields (B, N, D), shaped like `like`, from their images (B, G, n D)."""
        values = images.unflatten(2, (-1, like.shape[2])) @ self.rotations.mT.to(images)
        field = images.new_zeros(like.shape)
        selected = values.flatten(1, 2).index_select(1, self.positions)
        return field.index_copy(1, self.nodes, selected)

    def at_representatives(self, field: Tensor) -> Tensor:
        """Return fields (B, N, D) at the representatives, (B, n D)."""
        count = len(self.sources) // len(self.rotations)
        return field.index_select(1, self.sources[:count]).flatten(1)


def sum_over_images(coordinates: Tensor, inverse_actions: Tensor) -> Tensor:
    """Return sum_g c_g T_g^-1, (B, C).

    Args:
        coordinates: Coordinates c_g of each image, (B, G, C).
        inverse_actions: T_g^-1, (G, C, C).
    """
    return coordinates.flatten(1) @ inverse_actions.flatten(0, 1)


def coordinates_of_images(coordinates: Tensor, inverse_actions: Tensor) -> Tensor:
    """Return the coordinates c T_g of all images, (B, G, C), from c (B, C).

    Args:
        coordinates: Coordinates c, (B, C).
        inverse_actions: T_g^-1 with orthogonal T_g, (G, C, C).
    """
    every = nn.functional.linear(coordinates, inverse_actions.flatten(0, 1))
    return cast(Tensor, every.unflatten(1, (len(inverse_actions), -1)))
