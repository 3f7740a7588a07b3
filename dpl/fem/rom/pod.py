"""Proper orthogonal decomposition of snapshots."""

from typing import NamedTuple

import torch
from torch import Tensor

CHUNK = 512  # snapshots, or columns of them, in memory as float64 at a time
MIN_SKETCH_SIZE = 1000  # size of a Gram matrix above which a randomised SVD is faster
MAX_SKETCH_PART = 0.25  # largest part of that size for which it is
OVERSAMPLING = 32  # additional modes of the randomised SVD


class POD(NamedTuple):
    """A proper orthogonal decomposition.

    Attributes:
        vectors: Orthonormal, by falling singular value, (n, R).
        values: Singular values of the snapshots, descending: all, (min(S, n),), or where they are
            sketched the leading ones, (R,).
    """

    vectors: Tensor
    values: Tensor


def pod(snapshots: Tensor, rank: int) -> POD:
    """Return the basis of the subspace that is closest to snapshots in the mean square.

    The modes are eigenvectors of the smaller Gram matrix, computed in float64; singular values are
    accurate to about 1e-8 of the largest. If that matrix is large and few modes are requested, a
    randomised SVD in the precision of the snapshots, at least float32, is used instead: its last
    modes are mixed with omitted ones, and the projection error is larger by a part in a thousand.
    No mean is subtracted. The largest component of each mode is positive.

    Sources: Sirovich (1987), Quart. Appl. Math. 45 (method of snapshots); Halko, Martinsson, Tropp
    (2011), SIAM Rev. 53, algorithm 4.4 (randomised SVD).

    Args:
        snapshots: (S, n), of any floating type.
        rank: Number of modes R.
    """
    (count, size), smaller = snapshots.shape, min(snapshots.shape)
    if not 1 <= rank <= smaller:
        raise ValueError(
            f"rank = {rank} must lie between 1 and {smaller}, "
            f"the smaller of {count} snapshots and their {size} components"
        )
    few = rank + OVERSAMPLING <= MAX_SKETCH_PART * smaller
    sketched = smaller > MIN_SKETCH_SIZE and few
    vectors, values = (_sketched if sketched else _exact)(snapshots, rank)
    largest = vectors.gather(0, vectors.abs().argmax(dim=0, keepdim=True))
    return POD(vectors * largest.sign(), values)


def scatter_fields(columns: Tensor, dofs: Tensor) -> Tensor:
    """Return fields (S, N, D), zero outside a mask (N, D), from their n values in it, (S, n)."""
    dofs = dofs.to(columns.device)
    fields = columns.new_zeros(len(columns), *dofs.shape)
    fields[:, dofs] = columns
    return fields


def orthonormal_fields(columns: Tensor, dofs: Tensor) -> Tensor:
    """Return orthonormal fields (N, D, R), zero outside a mask (N, D), that span columns (n, R)."""
    orthonormal = torch.linalg.qr(columns.double().cpu())[0]
    return scatter_fields(orthonormal.T, dofs.cpu()).movedim(0, -1).contiguous()


def _exact(snapshots: Tensor, rank: int) -> POD:
    """Return the modes (n, R), of any sign, and all singular values from a Gram matrix."""
    count, size = snapshots.shape
    wide = count <= size
    gram = torch.zeros(min(count, size), min(count, size), dtype=torch.float64)
    for part in snapshots.split(CHUNK, dim=1 if wide else 0):
        part = part.double()
        gram.addmm_(part, part.mT) if wide else gram.addmm_(part.mT, part)
    if not gram.isfinite().all():
        raise ValueError("snapshots are not finite")
    squares, vectors = torch.linalg.eigh(gram)
    vectors = vectors.flip(1)[:, :rank]
    if wide:  # rounding errors of large modes make small ones lose orthogonality
        parts = [part.double().mT @ vectors for part in snapshots.split(CHUNK, dim=1)]
        vectors = torch.linalg.qr(torch.cat(parts))[0]
    return POD(vectors, squares.flip(0).clamp(min=0).sqrt())


def _sketched(snapshots: Tensor, rank: int) -> POD:
    """Return the modes (n, R), of any sign, and leading singular values by a randomised SVD."""
    if not all(part.isfinite().all() for part in snapshots.split(CHUNK)):
        raise ValueError("snapshots are not finite")
    some = snapshots if snapshots.dtype == torch.float64 else snapshots.float()
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(0)
        _, values, vectors = torch.svd_lowrank(some, q=rank + OVERSAMPLING, niter=3)
    return POD(torch.linalg.qr(vectors[:, :rank].double())[0], values[:rank].double())
