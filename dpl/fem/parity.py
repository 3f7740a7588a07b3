"""Parities under the reflections of a body, by which the matrices of a reduced model are smaller.

Symmetries whose rotation matrix is diagonal, i.e. reflections of axes and half turns, commute and
are their own inverses. A basis can be chosen such that each field is multiplied by 1 or -1 under
each of them: by its parity. The values of such a field at one point of each orbit, i.e. set of
images, determine the others. With M symmetries a matrix between fields and coordinates therefore
has M times fewer independent entries.

Source: Bossavit (1986), Symmetry, groups, and boundary value problems, Comput. Methods Appl. Mech.
Eng. 56.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from dpl.fem.symmetry import SymmetryGroup


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
    def of(cls, group: SymmetryGroup, dim: int) -> Self:
        """Return the symmetries of a group in D dimensions; an empty one is the identity alone."""
        members = group.diagonal if group else torch.zeros(1, dtype=torch.int64)
        rotations = group.rotations if group else torch.eye(dim, dtype=torch.float64)[None]
        signs = rotations.diagonal(dim1=1, dim2=2)[members]
        bits = (signs < 0).double()
        every = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * dim).double()
        rows = (1 - 2 * ((every @ bits.T) % 2)).tolist()
        characters = torch.tensor(list(dict.fromkeys(map(tuple, rows))), dtype=torch.float64)
        return cls(members, signs, characters)


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
    def of_field(cls, parities: Parities, group: SymmetryGroup, free: Tensor) -> Self:
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
    def of_tensors(cls, parities: Parities, positions: Tensor, count: int, width: int) -> Self:
        """Return the orbits of `count` tensors (D, D) at each of C cells, in SIMD order.

        `positions` (M, C) are those to which the symmetries map the cells. The values of an orbit
        are ordered by block of `width` cells, tensor and entry of a 3 x 3 matrix, lane. Cells that
        fill a block and entries outside the plane have weight 0.
        """
        dim = parities.signs.shape[1]
        cells = (positions.amin(dim=0) == torch.arange(positions.shape[1])).nonzero()[:, 0]
        entry = torch.arange(count * dim * dim).view(count, dim, dim)
        index = positions[:, cells, None, None, None] * entry.numel() + entry
        outer = parities.signs[:, :, None] * parities.signs[:, None]
        weight = 1 / (positions[:, cells] == cells).sum(dim=0).double()

        def in_blocks(values: Tensor) -> Tensor:
            missing = 0, 3 - dim, 0, 3 - dim, 0, 0, 0, -len(cells) % width
            blocks = torch.nn.functional.pad(values, missing).unflatten(-4, (-1, width))
            return blocks.movedim(-4, -1).flatten(-5)

        return cls(
            in_blocks(index),
            in_blocks(outer[:, None, None].expand_as(index)),
            in_blocks(weight[:, None, None, None].expand(-1, count, dim, dim)),
        )

    def coordinates(self, values: Tensor, characters: Tensor) -> Tensor:
        """Return coordinates (..., m) of the parts of fields (..., n) of one parity.

        The parity has the factors `characters` (M,). The basis is orthonormal. It has one field for
        each orbit, which is zero, as is its coordinate, where the parity allows no other value.
        """
        return self.products(values, characters) * self._scale(characters).to(values)

    def fields(self, coordinates: Tensor, characters: Tensor, count: int) -> Tensor:
        """Return fields (..., n) that have exactly one parity, n = `count`, see `coordinates`."""
        scaled = coordinates * self._scale(characters).to(coordinates)
        result = coordinates.new_zeros(*coordinates.shape[:-1], count)
        for factor, sign, index in zip(characters, self.sign, self.images, strict=True):
            result.index_add_(-1, index, scaled * (factor * sign * self.weight).to(scaled))
        return result

    def symmetrised(self, matrix: Tensor, parity: Tensor, parities: Parities) -> Tensor:
        """Return a matrix (n, R) whose columns have exactly their parities (R,).

        Those of the given matrix have them up to rounding.
        """
        result = torch.zeros_like(matrix)
        for p, characters in enumerate(parities.characters):
            coordinates = self.coordinates(matrix.T[parity == p], characters)
            result[:, parity == p] = self.fields(coordinates, characters, len(matrix)).T
        return result

    def products(self, values: Tensor, characters: Tensor) -> Tensor:
        """Return products (..., m) of values (..., n) with the field of a parity of each orbit."""
        rows = values.movedim(-1, 0).contiguous()  # selected in whole pieces of memory
        shape = -1, *(1 for _ in rows.shape[1:])
        products = rows.new_zeros(self.images.shape[1], *rows.shape[1:])
        for factor, sign, index in zip(characters, self.sign, self.images, strict=True):
            one = (factor * sign * self.weight).to(rows).view(shape)
            products.addcmul_(one, rows.index_select(0, index))
        allowed = self._allowed(characters).view(shape)
        return torch.where(allowed, products, 0.0).movedim(0, -1)  # also against rounding

    def _allowed(self, characters: Tensor) -> Tensor:
        """Return the mask (m,) of orbits whose values a parity allows to be other than zero."""
        unchanged = characters[:, None] * self.sign > 0
        return (unchanged | (self.images != self.images[0])).all(dim=0) & (self.weight > 0)

    def _scale(self, characters: Tensor) -> Tensor:
        """Return one over the norm of the field of a parity of each orbit, or 0, (m,)."""
        squares = len(characters) * self.weight
        return torch.where(self._allowed(characters), squares.rsqrt(), 0.0)
