"""Compiled loops of mean dilatation: pressures of cells and their part of the tangent.

See `dpl.fem.assembly.mean_dilatation`. Polynomials of the volume change are rows of vectors
(M, SIMD_WIDTH), their functions at the points (Q, M, SIMD_WIDTH).
"""

from numba import njit

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly.lanes import gradient, minimum
from dpl.fem.assembly.simd import load, store


@njit
def value_of(coefficients, functions):
    """Return the value of a polynomial (M,) at a point with function values (M,)."""
    value = load(coefficients, 0) * load(functions, 0)
    for m in range(1, coefficients.shape[0]):
        value = value + load(coefficients, m) * load(functions, m)
    return value


@njit
def add_projected(value, functions, out):
    """Add a value times the functions of a point to coefficients."""
    for m in range(out.shape[0]):
        store(out, m, load(out, m) + value * load(functions, m))


@njit
def pressures_of_cells(law, c, needs, finite, points, functions, gap, work, out, count, low):
    """Set the coefficients of the pressures of a block of cells and their derivatives.

    `points` are displacements, gradients and volumes, and `functions` those of the volume change
    and the bulk modulus that stays at the points. `out` are the pressure p (M, lane) at the volume
    change of u minus `gap` (M, lane), or of u if there is none; its linear extrapolation to the
    volume change of u; and the derivative of p (M M, lane). Returns the minimum of `low` and the
    volume changes.
    """
    ue, g, weight = points
    psi, bulk = functions
    H, j, scratch = work
    p, ahead, D = out
    M, mixed = psi.shape[1], len(gap) > 0
    for part in out:
        part[:] = 0.0
    j[:] = 0.0
    for q in range(psi.shape[0]):
        gradient(ue, g[q], H)
        add_projected(load(weight, q) * point.change_of_volume(H, finite), psi[q], j)
    if mixed:
        for m in range(M):
            store(j, m, load(j, m) - load(gap, m))
    for q in range(psi.shape[0]):
        change = value_of(j, psi[q])
        store(scratch, 0, change)
        if mixed:
            low = minimum(scratch, count, low)
        pressure, modulus = point.dilatation(law, c, needs, finite, load(bulk, 0), change, scratch)
        add_projected(load(weight, q) * pressure, psi[q], p)
        if mixed:
            pressure = pressure + modulus * value_of(gap, psi[q])
        add_projected(load(weight, q) * pressure, psi[q], ahead)
        for m in range(M):
            factor = load(weight, q) * modulus * load(psi[q], m)
            add_projected(factor, psi[q], D[m * M : (m + 1) * M])
    return low


@njit
def add_slopes(F, X, J, finite, weight, psi, g, P, slopes):
    """Add the nodal forces of dJ/dF times each function of a point to slopes (M, 3 a + i)."""
    point.volume_slope(F, X, J, finite, P)
    for a in range(g.shape[0] // 3):
        g0, g1, g2 = load(g, 3 * a), load(g, 3 * a + 1), load(g, 3 * a + 2)
        for i in range(3):
            force = load(P, 3 * i) * g0 + load(P, 3 * i + 1) * g1 + load(P, 3 * i + 2) * g2
            for m in range(slopes.shape[0]):
                at = slopes[m]
                store(at, 3 * a + i, load(at, 3 * a + i) + weight * load(psi, m) * force)


@njit
def add_volumetric_stiffness(slopes, D, dim, C, K):
    """Add slopes D slopes^T to K, see `add_stiffness`."""
    M = slopes.shape[0]
    for m in range(M):
        for r in range(slopes.shape[1]):
            total = load(D, m * M) * load(slopes[0], r)
            for n in range(1, M):
                total = total + load(D, m * M + n) * load(slopes[n], r)
            store(C, r, total)
        first = 0
        for b in range(slopes.shape[1] // 3):
            for i in range(dim):
                for a in range(b + 1):
                    at = first + (a * dim + i) * dim
                    left = load(slopes[m], 3 * a + i)
                    for k in range(dim):
                        store(K, at + k, load(K, at + k) + left * load(C, 3 * b + k))
            first += (b + 1) * dim * dim
