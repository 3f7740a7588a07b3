"""Compiled loops over dense blocks of condensed matrices, see `dpl.fem.linear.condensation`."""

import numpy as np
from numba import float32, float64, int16, int64, njit, void

LANES = 16  # entries of a row that a loop multiplies at once


@njit
def wide(count):  # type: ignore[no-untyped-def]
    """Return a multiple of `LANES` of at least `count`."""
    return (count + LANES - 1) // LANES * LANES


@njit(fastmath=True)
def add_product(x, A, y):  # type: ignore[no-untyped-def]
    """Add x A to y, (R,), for x (F,) and A (F, R); four rows where x is zero are not read."""
    n, number = A.shape[1], y.dtype.type
    i = 0
    while i + 4 <= len(x):
        a, b, c, d = x[i], x[i + 1], x[i + 2], x[i + 3]
        if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
            for j in range(n):
                upper = a * number(A[i, j]) + b * number(A[i + 1, j])
                y[j] += upper + c * number(A[i + 2, j]) + d * number(A[i + 3, j])
        i += 4
    while i < len(x):
        for j in range(n):
            y[j] += x[i] * number(A[i, j])
        i += 1


@njit(fastmath=True)
def subtract_product(A, x, y):  # type: ignore[no-untyped-def]
    """Subtract A x from y, (F,), for A (F, R) and x (R,); x is read once for four rows."""
    n, number = A.shape[1], y.dtype.type
    i = 0
    while i + 4 <= len(y):
        a = b = c = d = number(0)
        for j in range(n):
            a += number(A[i, j]) * x[j]
            b += number(A[i + 1, j]) * x[j]
            c += number(A[i + 2, j]) * x[j]
            d += number(A[i + 3, j]) * x[j]
        y[i] -= a
        y[i + 1] -= b
        y[i + 2] -= c
        y[i + 3] -= d
        i += 4
    while i < len(y):
        a = number(0)
        for j in range(n):
            a += number(A[i, j]) * x[j]
        y[i] -= a
        i += 1


@njit(
    [
        void(int64[:, ::1], int64[::1], A[:, ::1], x[:, :, ::1], x[:, ::1], x[:, ::1])
        for A, x in ((int16, float32), (float64, float64))
    ],
    nogil=True,
    cache=True,
)
def condensed_solves(table, unknowns, values, factors, forces, solutions):  # type: ignore[no-untyped-def]
    """Set `solutions` (P, n) to those of P matrices, one force (P, n) each, of one type.

    The forces are overwritten. See `Condensed` for the other arguments.
    """
    most = 0  # numba compiles the methods of arrays for a second
    for s in range(len(table)):
        most = max(most, wide(table[s, 2] - table[s, 0]))
    own, row = np.empty(most, forces.dtype), np.empty(most, forces.dtype)
    for p in range(len(values)):
        force, solution, is_loaded = forces[p], solutions[p], False
        for i in range(len(force)):
            is_loaded |= force[i] != 0.0
        if not is_loaded:
            solution[:] = 0.0
            continue
        of_inverse, of_coupling, columns = factors[p, 0], factors[p, 1], factors[p, 2]
        for s in range(len(table)):
            first, middle, last, place = table[s]
            count, is_loaded = middle - first, False
            for i in range(count):
                own[i] = force[unknowns[first + i]]
                is_loaded |= own[i] != 0.0
            if not is_loaded:
                for i in range(count):
                    solution[unknowns[first + i]] = 0.0
                continue
            start = place + count * wide(count)
            for n in range(2):  # F_II^-1 f, then X^T f
                begin, end = (middle, last) if n else (first, middle)
                width = wide(end - begin)
                here = start if n else place
                block = values[p, here : here + count * width].reshape((count, width))
                row[:width] = 0.0
                for i in range(count):
                    factor = of_coupling[first + i] if n else of_inverse[first + i]
                    own[i] = factor * force[unknowns[first + i]]
                add_product(own[:count], block, row[:width])
                if n:
                    for j in range(begin, end):
                        force[unknowns[j]] -= columns[j] * row[j - begin]
                else:
                    for j in range(begin, end):
                        solution[unknowns[j]] = columns[j] * row[j - begin]
        for s in range(len(table) - 1, -1, -1):
            first, middle, last, place = table[s]
            count, width = middle - first, wide(last - middle)
            start = place + count * wide(count)
            block = values[p, start : start + count * width].reshape((count, width))
            row[:width] = 0.0
            for j in range(middle, last):
                row[j - middle] = columns[j] * solution[unknowns[j]]
            own[:count] = 0.0
            subtract_product(block, row[:width], own[:count])
            for i in range(count):
                solution[unknowns[first + i]] += of_coupling[first + i] * own[i]


@njit(
    void(float64[:, ::1], float64[:, ::1], int64[::1], int16[:, ::1]),
    nogil=True,
    cache=True,
)
def round_rows(block, tests, order, out):  # type: ignore[no-untyped-def]
    """Set `out` (I, J or more) to the entries of a block (I, J) rounded up or down.

    The products of each row with tests (J, K) stay as they are as far as possible: each entry, in
    the given order, is rounded such that the products of the errors so far are smallest.
    """
    errors = np.empty(tests.shape[1])
    for i in range(len(block)):
        errors[:] = 0.0
        for j in order:
            low = np.floor(block[i, j])
            down = low - block[i, j]
            change = 0.0  # of the sum of squares by rounding up instead
            for k in range(len(errors)):
                change += (2.0 * (errors[k] + down * tests[j, k]) + tests[j, k]) * tests[j, k]
            up = 1.0 if change < 0.0 else 0.0
            out[i, j] = np.int16(low + up)
            for k in range(len(errors)):
                errors[k] += (down + up) * tests[j, k]
