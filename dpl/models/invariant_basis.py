"""POD bases that are invariant under the symmetries of a body.

Functions take fields as columns (S, n): their values at the n degrees of freedom of a mask (N, D).
An empty group stands for the identity alone.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dpl.fem.rom.pod import MIN_SKETCH_SIZE, orthonormal_fields, pod, scatter_fields
from dpl.fem.symmetry import Symmetry
from dpl.models.irreps import Component, representations_of
from dpl.models.symmetric_fields import Orbits

__all__ = ["orthonormal_fields", "scatter_fields"]

CHUNK = 256  # snapshots that are transformed at a time
MAX_BYTES = 2**31  # of snapshots from which a basis is computed, in float32
NOISE = 4.0  # singular value over the largest and eps below which a mode is rounding error


def pad_columns(basis: Tensor, rank: int) -> Tensor:
    """Return a basis (n, r) with zero columns appended, (n, rank)."""
    return nn.functional.pad(basis, (0, rank - basis.shape[1]))


def image_columns(columns: Tensor, dofs: Tensor, group: Sequence[Symmetry], k: int) -> Tensor:
    """Return the images (S, n) of fields (S, n) under symmetry k."""
    if k == 0:
        return columns
    return group[k].image(scatter_fields(columns, dofs))[:, dofs.to(columns.device)]


def group_actions(basis: Tensor, dofs: Tensor, group: Sequence[Symmetry]) -> Tensor:
    """Return the matrices T_g, (G, r, r), of a basis (n, r): images have coordinates c T_g."""
    members = range(max(1, len(group)))
    return torch.stack([image_columns(basis.T, dofs, group, k) @ basis for k in members])


class InvariantPOD:
    """POD of snapshots and their images, one isotypic component after the other.

    Fields of different components are orthogonal for all symmetries of the body, so that each
    component has a POD of its own: of one vector for each snapshot and each field of a multiplet,
    at the representatives of the orbits. The work is that of the snapshots without their images.
    """

    def __init__(self, dofs: Tensor, group: Sequence[Symmetry], count: int) -> None:
        """Allocate memory.

        Args:
            dofs: Mask of degrees of freedom, (N, D).
            group: Symmetries of the body.
            count: Number of snapshots.
        """
        self._dofs = dofs
        self._orbits = Orbits(group, dofs)
        weights = self._orbits.weights
        self._components = [Component(D, weights) for D in representations_of(group)]
        self._count = 0
        real = torch.float32 if count * max(1, len(group)) > MIN_SKETCH_SIZE else torch.float64
        self._noise = NOISE * torch.finfo(real).eps
        self._parts = []
        for one in self._components:
            shape = count, one.size, one.size * len(weights)
            self._parts.append(torch.zeros(shape, dtype=one.dtype(real)))

    def add(self, snapshots: Tensor) -> None:
        """Add snapshots (S, n)."""
        images = self._orbits.images(scatter_fields(snapshots, self._dofs))
        place = slice(self._count, self._count + len(snapshots))
        for component, parts in zip(self._components, self._parts, strict=True):
            parts[place] = component.parts(images.to(parts.real.dtype))
        self._count += len(snapshots)

    def modes(self, rank: int) -> Tensor:
        """Return the modes (n, r), largest first, and free the memory of the snapshots.

        Raises:
            ValueError: Every family of modes that symmetries mix is larger than `rank`.
        """
        families: list[tuple[float, Tensor]] = []
        while self._parts:
            families += self._families(
                self._components.pop(), self._parts.pop().flatten(0, 1), rank
            )
        families.sort(key=lambda family: -family[0])
        chosen: list[Tensor] = []
        left = rank
        for value, family in families:
            if len(family) <= left and value >= self._noise**2 * families[0][0]:
                chosen.append(family)
                left -= len(family)
        if not chosen:
            raise ValueError(
                f"rank = {rank} splits a family of modes that the symmetries of the body "
                "mix; increase model.rank and model.coordinates, or set model.symmetry=false"
            )
        return torch.cat(chosen).T.contiguous()

    def _families(
        self, component: Component, parts: Tensor, rank: int
    ) -> list[tuple[float, Tensor]]:
        """Return the mean square and the fields, (copies d, n), of families of modes."""
        count = min(rank // (component.copies * component.size), *parts.shape)
        if not count:
            return []
        vectors = pod(parts, count).vectors
        values = (parts @ vectors.to(parts.dtype)).norm(dim=0).double()  # more accurate than those
        vectors, values = (
            part[..., values >= self._noise * values.max()] for part in (vectors, values)
        )
        if not len(values):
            return []
        multiplets, kept = self._without_rounding(component, vectors.mH)
        fields, values = self._fields(component.images(multiplets))[..., self._dofs], values[kept]
        return [
            (float(value) ** 2 / component.size, family)
            for value, family in zip(values, fields, strict=True)
        ]

    def _without_rounding(self, component: Component, multiplets: Tensor) -> tuple[Tensor, Tensor]:
        """Return orthonormal multiplets (r, d m), float64, of the first fields of others.

        Values at nodes that symmetries map onto themselves then have these symmetries exactly.
        Rounding errors that are no multiplets are left out; the mask (r,) of the others comes with
        the multiplets.
        """
        wide = multiplets.to(component.dtype(torch.float64))
        fields = self._fields(component.images(wide)[:, :: component.size])
        parts = component.parts(self._orbits.images(fields.flatten(0, 1)))[:, 0]
        if component.copies == 2:  # a complex field from its real and imaginary part
            real, imaginary = parts.unflatten(0, (-1, 2)).unbind(dim=1)
            parts = real + 1j * imaginary
        sizes = parts.norm(dim=1)
        kept = sizes > 0.99 * sizes.max()  # the norms of multiplets remain
        return torch.linalg.qr(parts[kept].mT)[0].mT, kept

    def _fields(self, images: Tensor) -> Tensor:
        """Return fields (r, k, N, D) from their images at the representatives, (r, k, G, m)."""
        like = images.new_empty(1, 1, 1).expand(len(images) * images.shape[1], *self._dofs.shape)
        return self._orbits.field(images.flatten(0, 1), like).unflatten(0, images.shape[:2])


def invariant_pod(snapshots: Tensor, dofs: Tensor, group: Sequence[Symmetry], rank: int) -> Tensor:
    """Return POD modes (n, r), largest first, of snapshots (S, n) and their images.

    The span is invariant under the symmetries; r is at most `rank`.

    Raises:
        ValueError: No subspace of the modes is invariant.
    """
    some = snapshots[:: stride(len(snapshots), snapshots.shape[1])]
    basis = InvariantPOD(dofs, group, len(some))
    for part in some.split(CHUNK):
        basis.add(part)
    return basis.modes(rank)


def stride(count: int, size: int) -> int:
    """Return k; every k-th of `count` snapshots of `size` values fits into `MAX_BYTES`."""
    return max(1, -(-count * size * 4 // MAX_BYTES))
