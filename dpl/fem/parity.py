"""Parities under the reflections of a body, by which the matrices of a reduced model are smaller.

Symmetries whose rotation matrix is diagonal, i.e. reflections of axes and half turns, commute and
are their own inverses. A basis can be chosen such that each field is multiplied by 1 or -1 under
each of them: by its parity. The values of such a field at one point of each orbit, i.e. set of
images, determine the others. With M symmetries a matrix between fields and coordinates therefore
has M times fewer independent entries.

Source: Bossavit (1986), Symmetry, groups, and boundary value problems, Comput. Methods Appl. Mech.
Eng. 56.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.symmetry import Symmetry


class Parities(NamedTuple):
    """Symmetries with diagonal rotation matrices, the identity first.

    Attributes:
        members: Their positions in the group, (M,).
        signs: Diagonals of their matrices, 1 or -1, (M, D).
        characters: Factor of the fields of each parity under each symmetry, 1 or -1, (M, M); the
            first parity is that of fields which all symmetries preserve.
    """

    members: Tensor
    signs: Tensor
    characters: Tensor

    @classmethod
    def of(cls, group: Sequence[Symmetry], dim: int) -> "Parities":
        """Return the symmetries of a group; an empty group stands for the identity alone."""
        rotations = torch.stack([one.rotation.cpu() for one in group] or [torch.eye(dim)]).double()
        diagonals = rotations.diagonal(dim1=1, dim2=2)
        diagonal = (torch.diag_embed(diagonals) == rotations).all(dim=2).all(dim=1)
        members = diagonal.nonzero()[:, 0]
        signs = diagonals[members]
        bits = (signs < 0).double()
        every = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * dim).double()
        rows = (1 - 2 * ((every @ bits.T) % 2)).tolist()
        characters = torch.tensor(list(dict.fromkeys(map(tuple, rows))), dtype=torch.float64)
        return cls(members, signs, characters)

    def adapted(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return an orthogonal matrix (R, R) to coordinates of definite parity, and parities (R,).

        The order of coordinates is kept as far as possible.

        Args:
            actions: Matrix T of each symmetry, (M, R, R): an image has coordinates c T.
        """
        rank = actions.shape[1]
        order = torch.arange(rank, 0, -1, dtype=torch.float64)
        invariant = ((actions.mT * order) @ actions).mean(dim=0)
        columns, values, parities = [], [], []
        for p, factors in enumerate(self.characters):
            projection = (factors[:, None, None] * actions).mean(dim=0)
            shares, vectors = torch.linalg.eigh((projection + projection.T) / 2)
            own = vectors[:, shares > 1 / 2]
            sizes, axes = torch.linalg.eigh(own.T @ invariant @ own)
            columns.append(own @ axes)
            values.append(sizes)
            parities.append(torch.full((own.shape[1],), p))
        place = torch.cat(values).argsort(descending=True, stable=True)
        return torch.cat(columns, dim=1)[:, place], torch.cat(parities)[place]


class SignedOrbits(NamedTuple):
    """Images of one value of each orbit of the values of a field or of tensors at cells.

    Attributes:
        images: Positions of the images among all values, (M, m); 0 where `weight` is 0.
        sign: Factors with which vectors or tensors are mapped, 1 or -1, (M, m).
        weight: One over the number of symmetries that map the value to itself, (m,); 0 for values
            that only fill a block.
    """

    images: Tensor
    sign: Tensor
    weight: Tensor

    @classmethod
    def of_field(
        cls, parities: Parities, group: Sequence[Symmetry], free: Tensor
    ) -> "SignedOrbits":
        """Return the orbits of the degrees of freedom of a mask (N, D), numbered in the mask."""
        nodes, dim = free.shape
        identity = torch.arange(nodes)
        sources = [group[k].source.cpu() if group else identity for k in parities.members.tolist()]
        source = torch.stack(sources)
        first = (source.amin(dim=0) == identity)[:, None] & free.cpu()
        node, axis = first.nonzero().T
        number = torch.cumsum(free.cpu().flatten(), 0).view(nodes, dim) - 1
        index = number[source[:, node], axis]
        stabiliser = (source[:, node] == node).sum(dim=0)
        return cls(index, parities.signs[:, axis], 1 / stabiliser.double())

    @classmethod
    def of_tensors(
        cls, parities: Parities, positions: Tensor, count: int, width: int
    ) -> "SignedOrbits":
        """Return the orbits of `count` tensors (D, D) at each of C cells, in SIMD order.

        The values of an orbit are ordered by block of `width` cells, tensor and entry of a 3 x 3
        matrix, lane. Cells that fill a block and entries outside the plane have weight 0.

        Args:
            parities: The symmetries.
            positions: Position to which each of them maps each cell, (M, C).
            count: Number of tensors.
            width: Cells of a block.
        """
        dim = parities.signs.shape[1]
        cells = (positions.amin(dim=0) == torch.arange(positions.shape[1])).nonzero()[:, 0]
        blocks = -(-len(cells) // width)
        shape = blocks, width, count, 3, 3
        lanes = torch.zeros(shape, dtype=torch.bool).flatten(0, 1)
        lanes[: len(cells), :, :dim, :dim] = True
        index = torch.zeros(len(parities.members), *lanes.shape, dtype=torch.int64)
        entry = torch.arange(count * dim * dim).view(count, dim, dim)
        image = positions[:, cells, None, None, None] * entry.numel() + entry
        index[:, : len(cells), :, :dim, :dim] = image
        weight = torch.zeros(lanes.shape, dtype=torch.float64)
        stabiliser = (positions[:, cells] == cells).sum(dim=0)
        weight[: len(cells), :, :dim, :dim] = (1 / stabiliser.double())[:, None, None, None]
        sign = torch.zeros(index.shape, dtype=torch.float64)
        outer = parities.signs[:, :, None] * parities.signs[:, None]
        sign[:, : len(cells), :, :dim, :dim] = outer[:, None, None]

        def in_blocks(values: Tensor) -> Tensor:
            split = values.unflatten(-4, (blocks, width))
            return split.movedim(-4, -1).flatten(-5)

        return cls(in_blocks(index), in_blocks(sign), in_blocks(weight))

    def without_filling(self) -> "SignedOrbits":
        """Return the orbits without the values that only fill a block."""
        used = self.weight > 0
        return SignedOrbits(self.images[:, used], self.sign[:, used], self.weight[used])

    def folded(self, values: Tensor, characters: Tensor) -> Tensor:
        """Return values (m, r) whose products with b equal those of x with `unfolded(b)`.

        Args:
            values: x, (n, r).
            characters: Factor of a parity under each symmetry, (M,).
        """
        result = torch.zeros(len(self.weight), values.shape[1]).to(values)
        for factor, sign, index in zip(characters, self.sign, self.images, strict=True):
            result += (factor * sign * self.weight)[:, None] * values[index]
        unchanged = characters[:, None] * self.sign > 0
        allowed = (unchanged | (self.images != self.images[0])).all(dim=0)
        return torch.where(allowed[:, None], result, 0.0)  # also against rounding

    def by_parity(self, force: Tensor, parities: Parities) -> Tensor:
        """Return the products (M, m) of a force (n,) with the field of each orbit and parity."""
        parts = [self.folded(force[:, None], characters) for characters in parities.characters]
        return torch.cat(parts, dim=1).T

    def unfolded(self, values: Tensor, characters: Tensor, count: int) -> Tensor:
        """Return columns (n, r) of a parity from one value of each orbit (m, r), n = `count`.

        Args:
            values: One value of each orbit; zero where the parity allows no other.
            characters: Factor of the parity under each symmetry, (M,).
            count: n.
        """
        result = values.new_zeros(count, values.shape[1])
        parts = [characters.flip(0), self.sign.flip(0), self.images.flip(0)]
        for factor, sign, index in zip(*parts, strict=True):
            result[index] = (factor * sign)[:, None] * values
        return result

    def symmetrised(self, matrix: Tensor, parity: Tensor, parities: Parities) -> Tensor:
        """Return a matrix (n, R) whose columns have exactly their parities.

        Args:
            matrix: Columns that have their parities up to rounding.
            parity: Parity of each column, (R,).
            parities: The symmetries.
        """
        result, used = torch.zeros_like(matrix), self.without_filling()
        for p, characters in enumerate(parities.characters):
            own = (parity == p).nonzero()[:, 0]
            mean = used.folded(matrix[:, own], characters) / used.weight[:, None]
            mean /= len(characters)
            result[:, own] = used.unfolded(mean, characters, len(matrix))
        return result

    def of_parity(self, matrix: Tensor, columns: Tensor) -> Tensor:
        """Return the rows of one value of each orbit in some columns, (m, r), of (n, R)."""
        rows = matrix[self.images[0]][:, columns]
        return torch.where(self.weight[:, None] > 0, rows, 0.0)
