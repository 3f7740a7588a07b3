"""Irreducible representations of a symmetry group, and the isotypic components of fields.

Source: Serre (1977), Linear Representations of Finite Groups, sections 2.6 and 2.7.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem.symmetry import Symmetry

SAME = 1e-8  # difference below which eigenvalues, or mean products of characters, are equal


def products(group: Sequence[Symmetry]) -> Tensor:
    """Return the multiplication table (G, G) int64 of a group; (1, 1) for an empty group."""
    if not group:
        return torch.zeros(1, 1, dtype=torch.int64)
    Q = torch.stack([symmetry.rotation for symmetry in group]).cpu()
    every = Q[None] @ Q[:, None]  # first i, then j
    return (every[:, :, None] - Q).flatten(3).norm(dim=3).argmin(dim=2)


def irreducible_representations(table: Tensor) -> list[Tensor]:
    """Return one unitary representation of each class, (G, d, d) each.

    They are the subspaces on which a random symmetric matrix that commutes with the regular
    representation is constant. They are real; where a real one splits in two conjugate ones, which
    happens to rotations about one axis, one of these is returned, complex and with d = 1.

    Args:
        table: Multiplication table, (G, G), see `products`.
    """
    count = len(table)
    inverse = (table == 0).int().argmax(dim=1)  # the identity is the first member
    random = torch.rand(count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    random = random + random[inverse]
    values, vectors = torch.linalg.eigh(random[table[:, inverse].T])  # f(g_i^-1 g_j)
    ends = [0, *((values.diff() > SAME).nonzero()[:, 0] + 1).tolist(), count]
    found: list[Tensor] = []
    for start, end in pairwise(ends):
        U = vectors[:, start:end]
        # member j maps g_i to g_j g_i
        moved = torch.stack([torch.empty_like(U).index_copy_(0, column, U) for column in table.T])
        D = U.T @ moved
        character = _trace(D)
        if any(abs(float((character * _trace(one).real).mean())) > SAME for one in found):
            continue
        splits = float(character.square().mean()) > 1.5
        found.append(torch.complex(D[:, :1, :1], D[:, 1:2, :1]) if splits else D)
    return found


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=1, dim2=2).sum(dim=1)


class Component(NamedTuple):
    """An isotypic component: the parts of fields that a representation D (d, d) transforms.

    A field x has the parts E_kj x = d/G sum_g conj(D_kj(g)) g x. The parts E_1j x, ..., E_dj x are
    a multiplet, which the symmetries transform by D. A multiplet is stored by its values at the
    representatives of the orbits of the symmetries, (d m,), which determine it.

    Attributes:
        matrices: D, (G, d, d).
        weights: Weight of each value at a representative in sums over all images, (m,).
    """

    matrices: Tensor
    weights: Tensor

    @property
    def size(self) -> int:
        """Number d of fields of a multiplet."""
        return self.matrices.shape[1]

    @property
    def copies(self) -> int:
        """Number of real fields of each field of a multiplet: its real and imaginary part, or 1."""
        return 2 if self.matrices.is_complex() else 1

    def parts(self, images: Tensor) -> Tensor:
        """Return the multiplets of fields, (S, d, d m): row j is E_1j x, ..., E_dj x.

        The scalar products of the rows are those of the fields E_1j x.

        Args:
            images: Images of S fields at the representatives, (S, G, m).
        """
        D = self._scaled(images).conj().permute(2, 1, 0).flatten(0, 1)  # (d d, G), j before k
        weighted = images * self.weights.sqrt().to(images)
        return (D @ weighted.to(D.dtype)).unflatten(1, (self.size, self.size)).flatten(2)

    def images(self, multiplets: Tensor) -> Tensor:
        """Return the images (r, copies d, G, m) of orthonormal multiplets (r, d m).

        They are those of the real fields of unit norm.
        """
        some = multiplets.unflatten(1, (self.size, -1)) / self.weights.sqrt()
        D = self._scaled(multiplets)
        images = torch.einsum("glk,rlm->rkgm", D, some.to(D.dtype))
        if not images.is_complex():
            return images
        return 2**0.5 * torch.cat([images.real, images.imag], dim=1)

    def adjoint(self, multiplets: Tensor) -> Tensor:
        """Return the adjoint of `parts`, (r, d, G, m), of multiplets (r, d m).

        Row j of `parts` times a multiplet is the sum of the images times output j, not conjugated.
        """
        some = multiplets.unflatten(1, (self.size, -1)) * self.weights.sqrt()
        D = self._scaled(multiplets)
        return torch.einsum("gkj,rkm->rjgm", D.conj(), some.to(D.dtype))

    def coordinate_parts(self, actions: Tensor) -> Tensor:
        """Return the matrices M_j, (d, R, R): coordinates c of a field have those c M_j of E_1j x.

        Args:
            actions: T of each symmetry, (G, R, R): the image of c is c T.
        """
        D = self.size / len(self.matrices) * self.matrices[:, 0].conj()
        return torch.einsum("gj,gab->jab", D, actions.to(D.dtype))

    def dtype(self, real: torch.dtype) -> torch.dtype:
        """Return the type of multiplets of fields of a real type."""
        return real.to_complex() if self.matrices.is_complex() else real

    def _scaled(self, like: Tensor) -> Tensor:
        """Return sqrt(d / G) D in the precision of a tensor."""
        D = (self.size / len(self.matrices)) ** 0.5 * self.matrices
        return D.to(self.dtype(like.real.dtype))


def representations_of(group: Sequence[Symmetry]) -> list[Tensor]:
    """Return `irreducible_representations` of a group of symmetries."""
    return irreducible_representations(products(group))
