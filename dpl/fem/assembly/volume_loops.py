"""Compiled loops of mean dilatation: pressures of cells and their part of the tangent.

See `dpl.fem.assembly.mean_dilatation`. Polynomials of the volume change are rows of vectors
(M, SIMD_WIDTH), their functions at the points (Q, M, SIMD_WIDTH).
"""

from dpl.fem.assembly import constitutive_kernels as point
from dpl.fem.assembly.lanes import first_row, gradient, keep_minimum
from dpl.fem.assembly.simd import inlined, load, registers, store


@inlined
def value_of(coefficients, functions):
    """Return the value of a polynomial (M,) at a point with function values (M,)."""
    value = load(coefficients, 0) * load(functions, 0)
    for m in range(1, coefficients.shape[0]):
        value = value + load(coefficients, m) * load(functions, m)
    return value


@inlined
def add_projected(value, functions, out):
    """Add a value times the functions of a point to coefficients."""
    for m in range(out.shape[0]):
        store(out, m, load(out, m) + value * load(functions, m))


@inlined
def pressures_of_cells(
    law, c, needs, finite, G, inverse, block, weights, functions, bulk, gap, j, out, low
):  # fmt: skip
    """Set the coefficients of the pressures of a block of cells and their derivatives.

    G (rows 9 q + 3 i + d) are the reference gradients of u. `functions` are those of the volume
    change, and `bulk` is the bulk modulus that stays at the points. `out` are the pressure p
    (M, lane) at the volume change of u minus `gap` (M, lane), or of u if there is none; its linear
    extrapolation to the volume change of u; and the derivative of p (M M, lane). With a gap `low`
    becomes its minimum with the volume changes.
    """
    p, ahead, D = out
    M, mixed, H = functions.shape[1], len(gap) > 0, registers(9)
    for part in out:
        part[:] = 0.0
    j[:] = 0.0
    for q in range(functions.shape[0]):
        gradient(G, q, inverse, first_row(inverse, block, q), H)
        add_projected(load(weights, q) * point.change_of_volume(H, finite), functions[q], j)
    if mixed:
        for m in range(M):
            store(j, m, load(j, m) - load(gap, m))
    for q in range(functions.shape[0]):
        change, psi, weight = value_of(j, functions[q]), functions[q], load(weights, q)
        if mixed:
            keep_minimum(change, low)
        pressure, modulus = point.dilatation(law, c, needs, finite, load(bulk, 0), change)
        add_projected(weight * pressure, psi, p)
        if mixed:
            pressure = pressure + modulus * value_of(gap, psi)
        add_projected(weight * pressure, psi, ahead)
        for m in range(M):
            add_projected(weight * modulus * load(psi, m), psi, D[m * M : (m + 1) * M])


@inlined
def add_volumetric_stiffness(slopes, D, dim, C, K):
    """Add slopes D slopes^T to K, see `stiffness_of_cell`."""
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
