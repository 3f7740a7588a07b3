"""POD bases that are invariant under the symmetries of a body.

Functions take fields as columns (S, n): their values at the n degrees of freedom of a mask (N, D).
An empty group stands for the identity alone.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dpl.fem.rom.pod import MIN_SKETCH_SIZE, pod
from dpl.fem.symmetry import Symmetry, images

MAX_SNAPSHOTS = 16_000  # images of samples from which a basis is computed


def pad_columns(basis: Tensor, rank: int) -> Tensor:
    """Return a basis (n, r) with zero columns appended, (n, rank)."""
    return nn.functional.pad(basis, (0, rank - basis.shape[1]))


def scatter_fields(columns: Tensor, dofs: Tensor) -> Tensor:
    """Return fields (S, N, D), zero outside the mask, from their values (S, n)."""
    dofs = dofs.to(columns.device)
    fields = columns.new_zeros(len(columns), *dofs.shape)
    fields[:, dofs] = columns
    return fields


def image_columns(columns: Tensor, dofs: Tensor, group: Sequence[Symmetry], k: int) -> Tensor:
    """Return the images (S, n) of fields (S, n) under symmetry k."""
    if k == 0:
        return columns
    fields = scatter_fields(columns, dofs)
    return images(fields, group, torch.full((len(fields),), k))[:, dofs.to(columns.device)]


def group_actions(basis: Tensor, dofs: Tensor, group: Sequence[Symmetry]) -> Tensor:
    """Return the matrices T_g, (G, r, r), of a basis (n, r): images have coordinates c T_g."""
    members = range(max(1, len(group)))
    return torch.stack([image_columns(basis.T, dofs, group, k) @ basis for k in members])


def invariant_pod(snapshots: Tensor, dofs: Tensor, group: Sequence[Symmetry], rank: int) -> Tensor:
    """Return POD modes (n, r), largest first, of snapshots (S, n) and their images.

    The span is invariant under the symmetries; r is at most `rank` and the number of snapshots.

    Raises:
        ValueError: No subspace of the modes is invariant.
    """
    members = max(1, len(group))
    stride = -(-len(snapshots) * members // MAX_SNAPSHOTS)
    some = snapshots[::stride]
    some = some.float() if members * len(some) > MIN_SKETCH_SIZE else some
    every = torch.cat([image_columns(some, dofs, group, k) for k in range(members)])
    modes = pod(every, min(rank, *every.shape)).vectors.double()
    basis = _invariant_subspace(modes, dofs, group)
    coordinates = every @ basis.to(every.dtype)
    return basis @ torch.linalg.eigh((coordinates.T @ coordinates).double())[1].flip(1)


def _invariant_subspace(modes: Tensor, dofs: Tensor, group: Sequence[Symmetry]) -> Tensor:
    """Return an orthonormal basis (n, r) of the invariant part of the span of modes (n, rank).

    If the truncation splits a family of modes that symmetries mix, its modes are removed.
    """
    members = len(group)
    if members < 2:
        return modes
    every = torch.cat([image_columns(modes.T, dofs, group, k) for k in range(members)]).T
    q, r = torch.linalg.qr(every)
    shares, vectors = torch.linalg.eigh(r @ r.T / members)  # of images in each direction
    kept = vectors[:, shares > 3 / 4].flip(1)[:, : modes.shape[1]]
    if not kept.shape[1]:
        raise ValueError(
            f"rank = {modes.shape[1]} splits a family of modes that the symmetries of the body "
            "mix; increase model.rank and model.coordinates, or set model.symmetry=false"
        )
    return q @ kept
