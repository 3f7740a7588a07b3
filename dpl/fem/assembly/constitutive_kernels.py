"""Strain, stress and moduli at `SIMD_WIDTH` quadrature points, in Voigt notation.

Strains and stresses are 6 numbers in the order 11 22 33 12 23 13; strains are e = 2 E. The
functions are compiled into the loops of `dpl.fem.assembly.element_loops`.
"""

import numpy as np
from numpy.typing import NDArray

from dpl.fem.assembly.numba_laws import derivatives_of, has_fibres, set_fibre_derivatives
from dpl.fem.assembly.simd import expm1, inlined, load, log1p, nonzero, registers, sqrt, store

VOIGT = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]])
FIRST = np.array([0, 1, 2, 0, 1, 0])  # the two indices of each Voigt index
SECOND = np.array([0, 1, 2, 1, 2, 2])


def _upper_triangle(size: int) -> NDArray[np.int64]:
    """Return the number of each entry (size, size) in the upper triangle of a symmetric matrix."""
    numbers = np.zeros((size, size), dtype=np.int64)
    numbers[np.triu_indices(size)] = np.arange(size * (size + 1) // 2)
    return np.maximum(numbers, numbers.T)


UPPER = _upper_triangle(6)  # of the moduli
PAIR = _upper_triangle(9)  # of the moduli between components and directions 3 i + j
PAIRS = 45  # their number


@inlined
def quadratic(H, scale, e):
    """Add scale * H^T H to e."""
    for v in range(6):
        i, j = FIRST[v], SECOND[v]
        square = (
            load(H, i) * load(H, j)
            + load(H, 3 + i) * load(H, 3 + j)
            + load(H, 6 + i) * load(H, 6 + j)
        )
        store(e, v, load(e, v) + scale * square)


@inlined
def strain(H, finite, e):
    """Set e to 2 E = H + H^T + finite * H^T H."""
    for v in range(6):
        store(e, v, load(H, 3 * FIRST[v] + SECOND[v]) + load(H, 3 * SECOND[v] + FIRST[v]))
    quadratic(H, finite, e)


@inlined
def volume_change(H):
    """Return det(I + H) - 1."""
    a, b, c = load(H, 0), load(H, 1), load(H, 2)
    d, e, f = load(H, 3), load(H, 4), load(H, 5)
    g, h, i = load(H, 6), load(H, 7), load(H, 8)
    minors = a * e - b * d + e * i - f * h + a * i - c * g
    return a + e + i + minors + a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


@inlined
def change_of_volume(H, finite):
    """Return det(I + H) - 1, for a law of small strains tr H."""
    if finite == 0.0:
        return load(H, 0) + load(H, 4) + load(H, 8)
    return volume_change(H)


@inlined
def square(e):
    """Return det C - 1, where C = I + e."""
    e0, e1, e2 = load(e, 0), load(e, 1), load(e, 2)
    e3, e4, e5 = load(e, 3), load(e, 4), load(e, 5)
    m0, m1, m2 = e1 * e2 - e4 * e4, e0 * e2 - e5 * e5, e0 * e1 - e3 * e3
    third = e0 * m0 - e3 * (e3 * e2 - e4 * e5) + e5 * (e3 * e4 - e1 * e5)
    return e0 + e1 + e2 + m0 + m1 + m2 + third


@inlined
def extrapolate(D, gap, S):
    """Add the stress D gap / 2 to S."""
    for v in range(6):
        stress = load(S, v)
        for w in range(6):
            half = 0.5 if w < 3 else 1.0
            stress = stress + half * load(D, 6 * v + w) * load(gap, w)
        store(S, v, stress)


@inlined
def invert(e, X, Y):
    """Set X to C^-1 and Y to I - C^-1, where C = I + e; Y keeps the digits of small strains."""
    e0, e1, e2 = load(e, 0), load(e, 1), load(e, 2)
    e3, e4, e5 = load(e, 3), load(e, 4), load(e, 5)
    m0, m1, m2 = e1 * e2 - e4 * e4, e0 * e2 - e5 * e5, e0 * e1 - e3 * e3
    third = e0 * m0 - e3 * (e3 * e2 - e4 * e5) + e5 * (e3 * e4 - e1 * e5)
    inverse = 1.0 / (1.0 + (e0 + e1 + e2 + (m0 + m1 + m2 + third)))
    store(X, 0, (1.0 + (e1 + e2 + m0)) * inverse)
    store(X, 1, (1.0 + (e0 + e2 + m1)) * inverse)
    store(X, 2, (1.0 + (e0 + e1 + m2)) * inverse)
    store(Y, 0, (e0 + (m1 + m2 + third)) * inverse)
    store(Y, 1, (e1 + (m0 + m2 + third)) * inverse)
    store(Y, 2, (e2 + (m0 + m1 + third)) * inverse)
    store(Y, 3, (e3 + e3 * e2 - e4 * e5) * inverse)
    store(Y, 4, (e4 + e0 * e4 - e3 * e5) * inverse)
    store(Y, 5, (e5 + e1 * e5 - e3 * e4) * inverse)
    for v in range(3, 6):
        store(X, v, -load(Y, v))


@inlined
def derivatives_at(law, c, i1, e, j):
    """Return the invariant derivatives of a law at e with I1 - 3 = i1 and det F = 1 + j."""
    e0, e1, e2 = load(e, 0), load(e, 1), load(e, 2)
    e3, e4, e5 = load(e, 3), load(e, 4), load(e, 5)
    i2 = 2.0 * i1 + (e1 * e2 - e4 * e4 + (e0 * e2 - e5 * e5) + (e0 * e1 - e3 * e3))
    log_j = log1p(j)  # LLVM removes what the law does not use
    return derivatives_of(law, c, i1, i2, j, log_j, expm1(-2 / 3 * log_j))


@inlined
def stress(law, c, e, j, X, S, D, moduli):
    """Set S, with `moduli` also D = dS/dE (rows 6 I + J), at e with det F = 1 + j.

    The constants c are rows of vectors. X becomes C^-1, or 0 for a law without it. The stress of
    laws with ln J is NaN where det F is negative.
    """
    Y = registers(6)
    i1 = load(e, 0) + load(e, 1) + load(e, 2)
    derivatives = derivatives_at(law, c, i1, e, j)
    rest, W2, p, _, _, _, W1J, W2J, pJ = derivatives
    if nonzero(p) or nonzero(W1J) or nonzero(W2J) or nonzero(pJ):
        invert(e, X, Y)
    else:
        for v in range(6):
            store(X, v, 0.0)
    pressure = rest + 2.0 * W2 * i1
    for v in range(6):
        stress = pressure if v < 3 else 0.0 * pressure
        if nonzero(W2):
            stress = stress - 2.0 * W2 * load(e, v)
        if nonzero(p):
            stress = stress - p * load(Y, v)
        store(S, v, stress)
    if moduli:
        differentiate(derivatives, i1, e, X, D)
    if has_fibres(law):
        add_fibres(law, c, e, S, D, moduli)


@inlined
def dilatation(law, c, finite, bulk, j):
    """Return dU/dJ and d2U/dJ2 at J = 1 + j of the energy U that mean dilatation projects.

    `bulk` is the bulk modulus that stays at the points. See `dpl.fem.assembly.mean_dilatation`.
    """
    log_j = log1p(j)
    e = expm1(2 / 3 * log_j)  # normal components of 2 E
    if finite == 0.0:
        e = 2 / 3 * j  # of small strains with tr H = j
    i1 = 3.0 * e
    i2 = 2.0 * i1 + 3.0 * e * e
    found = derivatives_of(law, c, i1, i2, j, log_j, expm1(-2 / 3 * log_j))
    rest, W2, pressure, W11, W12, W22, W1J, W2J, pJ = found
    x = 1.0 / (1.0 + e)
    S = rest + 2.0 * W2 * i1 - 2.0 * W2 * e - pressure * e * x
    t2 = 2.0 * (2.0 + i1) - 2.0 * e
    D = 2.0 * (2.0 * W11 + W12 * t2 + W1J * x) + t2 * (2.0 * W12 + W22 * t2 + W2J * x)
    D = 3.0 * (D + x * (2.0 * W1J + W2J * t2 + pJ * x)) - 2.0 * pressure * x * x + 8.0 * W2
    squared = 1.0 + finite * e  # of the stretch
    p, modulus = S / sqrt(squared), (D - finite * S / squared) / (3.0 * squared)
    if finite == 0.0:
        return p - bulk * j, modulus - bulk
    inverse = 1.0 / (1.0 + j)
    half = 0.5 * bulk
    return p - half * j * (2.0 + j) * inverse, modulus - half - half * inverse * inverse


@inlined
def add_pressure(p, modulus, J, X, finite, S, D, moduli):
    """Add the stress p J X and, with `moduli`, its moduli for dp/dJ = modulus to S and D."""
    for v in range(6):
        store(S, v, load(S, v) + p * J * load(X, v))
    if moduli:
        own = finite * p * J
        both = own + modulus * J * J
        for v in range(6):
            i, k = FIRST[v], SECOND[v]
            for w in range(v, 6):
                m, n = FIRST[w], SECOND[w]
                pair = load(X, VOIGT[i, m]) * load(X, VOIGT[k, n])
                pair = pair + load(X, VOIGT[i, n]) * load(X, VOIGT[k, m])
                d = load(D, 6 * v + w) + both * load(X, v) * load(X, w) - own * pair
                store(D, 6 * v + w, d)
                store(D, 6 * w + v, d)


@inlined
def second_volume_change(H, step):
    """Return J(F) - J(F - A) - cof(F - A) : A of F = I + H and the step A."""
    double, third = 0.0 * load(H, 0), 0.0 * load(H, 0)
    for i in range(3):
        for c in range(3):
            minor = cofactor(step, i, c)
            double = double + minor * (load(H, 3 * i + c) + (1.0 if i == c else 0.0))
            if i == 0:
                third = third + minor * load(step, c)
    return double - 2.0 * third


@inlined
def add_fibres(law, c, e, S, D, moduli):
    """Add stress and, with `moduli`, moduli of fibres to S and D at e.

    T has the rows 6 I + K: the factors from a component K of a stress in the fibre frame to the
    component I. It transforms strains as well.
    """
    first = c.shape[0] - 9  # of the frame
    T, M = registers(36), registers(36)
    for v in range(6):
        i, j = FIRST[v], SECOND[v]
        for w in range(6):
            a, b = FIRST[w], SECOND[w]
            factor = load(c, first + 3 * i + a) * load(c, first + 3 * j + b)
            if w > 2:
                factor = factor + load(c, first + 3 * i + b) * load(c, first + 3 * j + a)
            store(T, 6 * v + w, factor)
    local, found = registers(6), registers(27)
    for w in range(6):
        total = load(T, w) * load(e, 0)
        for v in range(1, 6):
            twice = 1.0 if v < 3 else 2.0
            total = total + twice * load(T, 6 * v + w) * load(e, v)
        store(local, w, total if w < 3 else 0.5 * total)
    set_fibre_derivatives(law, c, local, found, moduli)
    for v in range(6):
        total = load(S, v)
        for w in range(6):
            total = total + load(T, 6 * v + w) * load(found, w)
        store(S, v, total)
    if moduli:
        for v in range(6):
            for w in range(6):
                total = 0.0 * load(T, 0)
                for k in range(6):
                    total = total + load(T, 6 * v + k) * load(found, 6 + UPPER[k, w])
                store(M, 6 * v + w, total)
        for v in range(6):
            for w in range(v, 6):
                total = load(D, 6 * v + w)
                for k in range(6):
                    total = total + load(M, 6 * v + k) * load(T, 6 * w + k)
                store(D, 6 * v + w, total)
                store(D, 6 * w + v, total)


@inlined
def differentiate(derivatives, i1, e, X, D):
    """Set D to dS/dE, from the invariant derivatives."""
    _, W2, p, W11, W12, W22, W1J, W2J, pJ = derivatives
    slopes, first, second, third = registers(6), registers(6), registers(6), registers(6)
    for v in range(6):
        normal = 2.0 if v < 3 else 0.0
        t2 = normal * (2.0 + i1) - 2.0 * load(e, v)
        x = load(X, v)
        store(slopes, v, t2)
        store(first, v, W11 * normal + W12 * t2 + W1J * x)
        store(second, v, W12 * normal + W22 * t2 + W2J * x)
        store(third, v, W1J * normal + W2J * t2 + pJ * x)
    for v in range(6):
        i, k = FIRST[v], SECOND[v]
        for w in range(v, 6):
            m, n = FIRST[w], SECOND[w]
            d = load(first, v) * (2.0 if w < 3 else 0.0)
            d = d + load(second, v) * load(slopes, w)
            d = d + load(third, v) * load(X, w)
            both = load(X, VOIGT[i, m]) * load(X, VOIGT[k, n])
            d = d - p * (both + load(X, VOIGT[i, n]) * load(X, VOIGT[k, m]))
            if v == w and v > 2:
                d = d - 2.0 * W2
            if v != w and w < 3:
                d = d + 4.0 * W2
            store(D, 6 * v + w, d)
            store(D, 6 * w + v, d)


@inlined
def along(P, directions, first, out, at):
    """Set the rows 3 i + d of `out` from `at` to the sum over j of P_ij n_dj.

    The directions n_dj are the rows 3 d + j of `directions` from `first`.
    """
    for i in range(3):
        p0, p1, p2 = load(P, 3 * i), load(P, 3 * i + 1), load(P, 3 * i + 2)
        for d in range(3):
            n = first + 3 * d
            n0, n1, n2 = load(directions, n), load(directions, n + 1), load(directions, n + 2)
            store(out, at + 3 * i + d, p0 * n0 + p1 * n1 + p2 * n2)


@inlined
def cofactor(H, i, j):
    """Return the entry i, j of the cofactors of H."""
    k, m, a, b = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
    minor = load(H, 3 * k + a) * load(H, 3 * m + b)
    return minor - load(H, 3 * k + b) * load(H, 3 * m + a)


@inlined
def isotropic_stress(law, c, finite, H, j, weight, P):
    """Set P to what `stress` and `nominal_stress` give for a law without fibres, with fewer terms.

    F C^-1 is the transposed inverse of F, and F minus it is made of H without rounding 1 + H.
    """
    e = registers(6)
    strain(H, finite, e)  # only of laws with I2 or W2; LLVM removes it for others
    trace, square = load(H, 0) + load(H, 4) + load(H, 8), load(H, 0) * load(H, 0)
    for r in range(1, 9):
        square = square + load(H, r) * load(H, r)
    i1 = 2.0 * trace + finite * square
    rest, W2, p = derivatives_at(law, c, i1, e, j)[:3]
    pressure = weight * (rest + 2.0 * W2 * i1)
    for r in range(9):
        store(P, r, finite * pressure * load(H, r) + (1.0 if r % 4 == 0 else 0.0) * pressure)
    if nonzero(W2):
        factor = 2.0 * weight * W2
        for i in range(3):
            h0, h1 = finite * load(H, 3 * i), finite * load(H, 3 * i + 1)
            h2 = finite * load(H, 3 * i + 2)
            for k in range(3):
                v0, v1, v2 = VOIGT[0, k], VOIGT[1, k], VOIGT[2, k]
                product = h0 * load(e, v0) + h1 * load(e, v1) + h2 * load(e, v2)
                product = product + load(e, VOIGT[i, k])
                store(P, 3 * i + k, load(P, 3 * i + k) - factor * product)
    if nonzero(p):
        factor = weight * p / (1.0 + j)
        for i in range(3):
            for k in range(3):
                change = load(H, 3 * i + k) * (1.0 + j) + load(H, 3 * k + i) - cofactor(H, i, k)
                if i == k:
                    change = change + (j - trace)
                store(P, 3 * i + k, load(P, 3 * i + k) - factor * change)


@inlined
def nominal_stress(F, S, weight, P):
    """Set P (rows 3 i + j) to the first Piola-Kirchhoff stress F S times `weight`."""
    for j in range(3):
        s0, s1 = weight * load(S, VOIGT[0, j]), weight * load(S, VOIGT[1, j])
        s2 = weight * load(S, VOIGT[2, j])
        for i in range(3):
            stress = load(F, 3 * i) * s0 + load(F, 3 * i + 1) * s1 + load(F, 3 * i + 2) * s2
            store(P, 3 * i + j, stress)


@inlined
def nominal_moduli(F, directions, first, D, S, weight, finite, A, q, Q):
    """Set the rows Q pair + q of A to dP/dF times `weight` between directions, see `along`.

    The pair PAIR[3 i + d, 3 k + e] belongs to changes of F in component i along the direction d and
    in component k along e.
    """
    B, T = registers(54), registers(6)  # B: the changes of E, shear doubled, rows 6 (3 i + d) + v
    for i in range(3):
        for d in range(3):
            n = first + 3 * d
            for v in range(6):
                a, b = FIRST[v], SECOND[v]
                change = load(F, 3 * i + a) * load(directions, n + b)
                if v > 2:
                    change = change + load(F, 3 * i + b) * load(directions, n + a)
                store(B, 6 * (3 * i + d) + v, change)
    row = q
    for r in range(9):
        for v in range(6):
            total = load(D, 6 * v) * load(B, 6 * r)
            for w in range(1, 6):
                total = total + load(D, 6 * v + w) * load(B, 6 * r + w)
            store(T, v, weight * total)
        for s in range(r, 9):
            total = load(T, 0) * load(B, 6 * s)
            for v in range(1, 6):
                total = total + load(T, v) * load(B, 6 * s + v)
            store(A, row, total)
            row += Q
    for d in range(3):
        for j in range(3):
            total = load(S, VOIGT[j, 0]) * load(directions, first + 3 * d)
            total = total + load(S, VOIGT[j, 1]) * load(directions, first + 3 * d + 1)
            total = total + load(S, VOIGT[j, 2]) * load(directions, first + 3 * d + 2)
            store(T, j, finite * weight * total)
        for e in range(d, 3):
            total = load(T, 0) * load(directions, first + 3 * e)
            total = total + load(T, 1) * load(directions, first + 3 * e + 1)
            total = total + load(T, 2) * load(directions, first + 3 * e + 2)
            for i in range(3):
                row = Q * PAIR[3 * i + d, 3 * i + e] + q
                store(A, row, load(A, row) + total)
