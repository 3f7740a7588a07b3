"""Compiled element loops: force, tangent and det F of a body under an isotropic law.

WIDTH cells are worked on at once, one in each lane of the processor's vectors. The loops say the
same as `TensorAssembly`'s tensor operations, which stay the reference; tests hold the two together.
What they do at a point is in `dpl.fem.assembly.constitutive_kernels`.
"""

import contextlib
import copy
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dpl.fem.assembly import constitutive_kernels, numba_laws, simd
from dpl.fem.assembly.numba_laws import Law, required_terms
from dpl.fem.assembly.simd import SIMD_WIDTH, load, sqrt, store
from dpl.fem.materials.material import InvariantBasedMaterial

Array = NDArray[np.float64]


_SOURCES = "".join(
    inspect.getsource(m) for m in (simd, numba_laws, constitutive_kernels, sys.modules[__name__])
)


@njit
def _gather(field, cells, start, count, out):
    """Copy a nodal field (N, D) to rows 3 a + i of `out`, a cell in each lane."""
    for lane in range(SIMD_WIDTH):
        cell = start + min(lane, count - 1)
        for a in range(cells.shape[1]):
            for i in range(field.shape[1]):
                out[3 * a + i, lane] = field[cells[cell, a], i]


@njit
def _shape(dN, dV, start, count, g, weight):
    """Copy gradients to g (Q, 3 a + j, lane) and volumes to weight, zero past the last cell.

    Equal cells share one set, which is copied for the first block and for one that is not full.
    """
    several = dN.shape[0] > 1
    if not several and start > 0 and count == SIMD_WIDTH:
        return
    for q in range(dN.shape[1]):
        for lane in range(SIMD_WIDTH):
            cell = start + min(lane, count - 1) if several else 0
            weight[q, lane] = dV[cell, q] if lane < count else 0.0
            for a in range(dN.shape[2]):
                for j in range(dN.shape[3]):
                    g[q, 3 * a + j, lane] = dN[cell, q, a, j]


@njit
def _gradient(ue, g, H):
    """Set H (rows 3 i + j) to sum_a u_a g_a^T."""
    for i in range(3):
        u = load(ue, i)
        h0, h1, h2 = u * load(g, 0), u * load(g, 1), u * load(g, 2)
        for r in range(3, g.shape[0], 3):
            u = load(ue, r + i)
            h0 = h0 + u * load(g, r)
            h1 = h1 + u * load(g, r + 1)
            h2 = h2 + u * load(g, r + 2)
        store(H, 3 * i, h0)
        store(H, 3 * i + 1, h1)
        store(H, 3 * i + 2, h2)


@njit
def _spread(F, S, weight, g, P, fe):
    """Add the nodal forces of stress F S at a point of volume `weight` to fe (rows 3 a + i)."""
    for i in range(3):
        for j in range(3):
            stress = load(F, 3 * i) * load(S, constitutive_kernels.VOIGT[0, j])
            stress = stress + load(F, 3 * i + 1) * load(S, constitutive_kernels.VOIGT[1, j])
            stress = stress + load(F, 3 * i + 2) * load(S, constitutive_kernels.VOIGT[2, j])
            store(P, 3 * i + j, weight * stress)
    for a in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
        for i in range(3):
            force = load(P, 3 * i) * g0 + load(P, 3 * i + 1) * g1 + load(P, 3 * i + 2) * g2
            store(fe, 3 * a + i, load(fe, 3 * a + i) + force)


@njit
def _stiffness(A, g, dim, C, K):
    """Add g_a A g_b to K for all pairs of nodes a <= b, rows (pair, i, k)."""
    first = 0
    for b in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * b), load(g, 3 * b + 1), load(g, 3 * b + 2)
        for r in range(27):
            store(C, r, load(A, 3 * r) * g0 + load(A, 3 * r + 1) * g1 + load(A, 3 * r + 2) * g2)
        for i in range(dim):
            r = 9 * i
            c0, c1, c2 = load(C, r), load(C, r + 1), load(C, r + 2)
            d0, d1, d2 = load(C, r + 3), load(C, r + 4), load(C, r + 5)
            e0, e1, e2 = load(C, r + 6), load(C, r + 7), load(C, r + 8)
            for a in range(b + 1):
                g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
                at = first + (a * dim + i) * dim
                store(K, at, load(K, at) + g0 * c0 + g1 * c1 + g2 * c2)
                store(K, at + 1, load(K, at + 1) + g0 * d0 + g1 * d1 + g2 * d2)
                if dim == 3:
                    store(K, at + 2, load(K, at + 2) + g0 * e0 + g1 * e1 + g2 * e2)
        first += (b + 1) * dim * dim


@njit
def _lowest(values, count, low):
    """Return the smallest of `low` and `count` values; what is no number counts as -inf."""
    for lane in range(count):
        value = values[0, lane]
        low = min(low, value if value == value else -np.inf)
    return low


@njit
def _scatter(fe, cells, start, count, force):
    for lane in range(count):
        for a in range(cells.shape[1]):
            for i in range(force.shape[1]):
                force[cells[start + lane, a], i] += fe[3 * a + i, lane]


@njit(error_model="numpy", cache=True)
def _force(law, c, needs, finite, u, cells, dN, dV, force):
    """Add the internal force of displacements u (N, D) to force (N, D); return min det F - 1."""
    rows, Q = 3 * cells.shape[1], dN.shape[1]
    ue, fe, g = (
        np.zeros((rows, SIMD_WIDTH)),
        np.zeros((rows, SIMD_WIDTH)),
        np.zeros((Q, rows, SIMD_WIDTH)),
    )
    H, P, D = np.zeros((9, SIMD_WIDTH)), np.zeros((9, SIMD_WIDTH)), np.zeros((36, SIMD_WIDTH))
    e, X, S = np.zeros((6, SIMD_WIDTH)), np.zeros((6, SIMD_WIDTH)), np.zeros((6, SIMD_WIDTH))
    weight, scratch, low = np.zeros((Q, SIMD_WIDTH)), np.zeros((26, SIMD_WIDTH)), np.inf
    for start in range(0, len(cells), SIMD_WIDTH):
        count = min(SIMD_WIDTH, len(cells) - start)
        _gather(u, cells, start, count, ue)
        _shape(dN, dV, start, count, g, weight)
        fe[:] = 0.0
        for q in range(Q):
            _gradient(ue, g[q], H)
            j = constitutive_kernels.volume_change(H)
            store(scratch, 0, j)
            low = _lowest(scratch, count, low)
            constitutive_kernels.strain(H, finite, e)
            constitutive_kernels.stress(law, c, needs, e, j, X, S, scratch, D, False)
            for r in range(9):
                store(H, r, finite * load(H, r) + (1.0 if r % 4 == 0 else 0.0))
            _spread(H, S, load(weight, q), g[q], P, fe)
        _scatter(fe, cells, start, count, force)
    return low


@njit(error_model="numpy", cache=True)
def _system(law, c, needs, finite, u, gap, cells, dN, dV, places, force, values):
    """Add force (N, D) and tangent (nnz + 1,) at displacements u (N, D).

    With `gap` (blocks, Q, 6, WIDTH) the stress is that at the strain of u less the gap, moved to
    the strain of u by the moduli there. Returns the smallest det C - 1 of such strains, infinity
    without a gap.
    """
    n, Q, dim = cells.shape[1], dN.shape[1], dN.shape[3]
    ue, fe, g = (
        np.zeros((3 * n, SIMD_WIDTH)),
        np.zeros((3 * n, SIMD_WIDTH)),
        np.zeros((Q, 3 * n, SIMD_WIDTH)),
    )
    H, P, D = np.zeros((9, SIMD_WIDTH)), np.zeros((9, SIMD_WIDTH)), np.zeros((36, SIMD_WIDTH))
    e, X, S, T = (
        np.zeros((6, SIMD_WIDTH)),
        np.zeros((6, SIMD_WIDTH)),
        np.zeros((6, SIMD_WIDTH)),
        np.zeros((6, SIMD_WIDTH)),
    )
    A, C, K = (
        np.zeros((81, SIMD_WIDTH)),
        np.zeros((27, SIMD_WIDTH)),
        np.zeros((places.shape[1], SIMD_WIDTH)),
    )
    weight, scratch, low = np.zeros((Q, SIMD_WIDTH)), np.zeros((26, SIMD_WIDTH)), np.inf
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        _gather(u, cells, start, count, ue)
        _shape(dN, dV, start, count, g, weight)
        fe[:] = 0.0
        K[:] = 0.0
        for q in range(Q):
            _gradient(ue, g[q], H)
            constitutive_kernels.strain(H, finite, e)
            mixed = len(gap) > 0
            j = constitutive_kernels.volume_change(H)
            if mixed:
                for v in range(6):
                    store(e, v, load(e, v) - load(gap[block, q], v))
                square = constitutive_kernels.square(e)
                store(scratch, 0, square)
                low = _lowest(scratch, count, low)
                j = square / (1.0 + sqrt(1.0 + square))
            constitutive_kernels.stress(law, c, needs, e, j, X, S, scratch, D, True)
            for r in range(9):
                store(H, r, finite * load(H, r) + (1.0 if r % 4 == 0 else 0.0))
            constitutive_kernels.push_forward(H, D, S, load(weight, q), finite, T, A)
            if mixed:
                for v in range(6):
                    stress = load(S, v)
                    for w in range(6):
                        half = 0.5 if w < 3 else 1.0
                        stress = stress + half * load(D, 6 * v + w) * load(gap[block, q], w)
                    store(S, v, stress)
            _spread(H, S, load(weight, q), g[q], P, fe)
            _stiffness(A, g[q], dim, C, K)
        _scatter(fe, cells, start, count, force)
        for r in range(places.shape[1]):
            for lane in range(count):
                values[places[block, r, lane]] += K[r, lane]
    return low


@njit(error_model="numpy", cache=True)
def _widen(law, gap, length, update, cells, dN, dV):
    """Return (1 - length) gap + length^2 dH^T dH, (blocks, Q, 6, WIDTH), of a step (N, D)."""
    rows, Q = 3 * cells.shape[1], dN.shape[1]
    wider = np.zeros((-(-len(cells) // SIMD_WIDTH), Q, 6, SIMD_WIDTH))
    ue, g = np.zeros((rows, SIMD_WIDTH)), np.zeros((Q, rows, SIMD_WIDTH))
    H, weight = np.zeros((9, SIMD_WIDTH)), np.zeros((Q, SIMD_WIDTH))
    for start in range(0, len(cells), SIMD_WIDTH):
        block, count = start // SIMD_WIDTH, min(SIMD_WIDTH, len(cells) - start)
        _gather(update, cells, start, count, ue)
        _shape(dN, dV, start, count, g, weight)
        for q in range(Q):
            _gradient(ue, g[q], H)
            if len(gap) > 0:
                for v in range(6):
                    store(wider[block, q], v, (1.0 - length) * load(gap[block, q], v))
            constitutive_kernels.quadratic(H, length * length, wider[block, q])
    return wider


class Kernels:
    """The compiled loops of one body.

    Attributes:
        material: The law.
        cells: (E, A).
        dN: (E or 1, Q, A, D).
        dV: (E or 1, Q).
        places: Where each entry of a cell's matrix goes among the nnz + 1 values (the last one for
            entries that are not kept), (blocks, A (A + 1)/2 D^2, WIDTH).
    """

    def __init__(
        self,
        material: InvariantBasedMaterial,
        cells: NDArray[np.int64],
        dN: Array,
        dV: Array,
        places: NDArray[np.int32],
    ) -> None:
        """Keep the arrays; compilation happens at the first call and is kept on disk."""
        self.cells, self.dN, self.dV = cells, dN, dV
        self.places = _in_blocks(places)
        self._law = (
            Law(type(material), _SOURCES),
            required_terms(material),
            float(material.finite),
        )
        self._constants = np.array([material.constants])  # (1 or B, constants)
        self._nothing = np.zeros((0, 0, 0, SIMD_WIDTH))

    def under(self, material: InvariantBasedMaterial) -> "Kernels":
        """Return the loops of the same body with other moduli of the same law."""
        twin = copy.copy(self)
        constants = np.broadcast_arrays(*(np.ravel(c) for c in material.constants))
        twin._constants = np.stack(constants, axis=1)
        return twin

    def force(self, u: Array, out: Array, member: int = 0) -> float:
        """Add the internal force (N, D) of u (N, D) to `out`; return min det F.

        Args:
            u: Displacement.
            out: Where to add.
            member: Whose moduli count, where each member of a batch has its own.
        """
        law, needs, finite = self._law
        moduli = self._constants[member if len(self._constants) > 1 else 0]
        arrays = (self.cells, self.dN, self.dV)
        return 1 + self._call(_force, law, moduli, needs, finite, u, *arrays, out)

    def system(self, u: Array, gap: Array | None, out: Array, values: Array) -> float:
        """Add force and tangent (nnz + 1,) at u; return the smallest det C of mixed points.

        Raises:
            ValueError: Each member of a batch has moduli of its own.
        """
        law, needs, finite = self._law
        if len(self._constants) > 1:
            raise ValueError("bodies of several Poisson's ratios are linearised one by one")
        gap = self._nothing if gap is None else gap
        arrays = (self.cells, self.dN, self.dV, self.places)
        moduli = self._constants[0]
        return 1 + self._call(_system, law, moduli, needs, finite, u, gap, *arrays, out, values)

    def update_strain_gap(self, gap: Array | None, length: float, update: Array) -> Array:
        """Return the gap between the strain of u and that of mixed points after a step."""
        gap = self._nothing if gap is None else gap
        law, *_ = self._law
        return self._call(_widen, law, gap, length, update, self.cells, self.dN, self.dV)

    def _call(self, kernel: Any, *arguments: Any) -> Any:
        """Return what a kernel returns, compiled or found on disk at its first call."""
        first = (kernel, arguments[0].kind.name)
        if first in _READY:
            return kernel(*arguments)
        with _alone(Path(kernel.stats.cache_path)):
            result = kernel(*arguments)
        _READY.add(first)
        return result


_READY: set[tuple[Any, str]] = set()  # kernels and laws that this process has compiled or loaded


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other processes from numba's cache meanwhile.

    Two that save kernels of different laws at the same time would give their files one name, and a
    law would be answered by the code of another. The second one of the same law finds it compiled.
    """
    try:
        import fcntl

        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / "kernels.lock").open("w")
    except (ImportError, OSError):  # no such locks here, or a folder that numba cannot write either
        yield
        return
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _in_blocks(places: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return (E, entries) as (blocks, entries, WIDTH)."""
    blocks = -(-len(places) // SIMD_WIDTH)
    padded = np.zeros((blocks * SIMD_WIDTH, places.shape[1]), dtype=np.int32)
    padded[: len(places)] = places
    return np.ascontiguousarray(padded.reshape(blocks, SIMD_WIDTH, -1).transpose(0, 2, 1))
