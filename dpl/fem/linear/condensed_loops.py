"""Compiled loops over dense blocks of condensed matrices, see `dpl.fem.linear.condensation`."""

import numpy as np
from numba import float32, float64, int16, int64, njit, uint32, void
from numba.types import Array

from dpl.fem.linear.tiles import FLAGS, ROWS, add_tiles, high, subtract_tiles, wide

TABLE, NUMBERS = int64[:, ::1], uint32[::1]


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
        void(TABLE, *[NUMBERS] * 2, A[:, ::1], x[:, :, ::1], Array(x, 2, "C", True), x[:, ::1])
        for A, x in ((int16, float32), (float64, float64))
    ],
    fastmath=set(FLAGS),
    nogil=True,
    cache=True,
)
def condensed_solves(table, order, unknowns, values, factors, forces, solutions):  # type: ignore[no-untyped-def]
    """Set `solutions` (P, n) to those of P matrices, one force (P, n) each, of one type.

    See `Condensed` for the other arguments.
    """
    most = 0  # numba compiles the methods of arrays for a second
    for s in range(len(table)):
        most = max(most, wide(table[s, 2] - table[s, 0]))
    own, row = np.empty(most, forces.dtype), np.empty(most, forces.dtype)
    force, solution = np.empty(len(order), forces.dtype), np.empty(len(order), forces.dtype)
    for p in range(len(values)):
        is_loaded = False
        for i in range(len(order)):
            force[i] = forces[p, order[i]]
            is_loaded |= force[i] != 0.0
        if not is_loaded:
            for i in range(len(order)):
                solutions[p, i] = 0.0
            continue
        blocks, first_pivot = values[p], 0
        for s in range(len(table)):
            first, middle, last, place = table[s]
            count, is_loaded = middle - first, False
            acting = force[first_pivot : first_pivot + count]
            found = solution[first_pivot : first_pivot + count]
            first_pivot += count
            for i in range(count):
                is_loaded |= acting[i] != 0.0
            if not is_loaded:
                for i in range(count):
                    found[i] = 0.0
                continue
            for n in range(2):  # F_II^-1 f, then X^T f
                begin, end = (middle, last) if n else (first, middle)
                scales, columns = factors[p, n, first:middle], factors[p, 2, begin:end]
                width = wide(end - begin)
                for i in range(count):
                    own[i] = scales[i] * acting[i]
                for i in range(count, high(count)):
                    own[i] = 0.0
                for j in range(width):
                    row[j] = 0.0
                for i in range(0, count, ROWS):
                    add_tiles(blocks, place, own, i, row, width)
                    place += ROWS * width
                if n:
                    boundary = unknowns[begin:end]
                    for j in range(len(boundary)):
                        force[boundary[j]] -= columns[j] * row[j]
                else:
                    for i in range(count):
                        found[i] = columns[i] * row[i]
        for s in range(len(table) - 1, -1, -1):
            first, middle, last, place = table[s]
            count, width = middle - first, wide(last - middle)
            first_pivot -= count
            place += high(count) * wide(count)
            boundary, columns = unknowns[middle:last], factors[p, 2, middle:last]
            for j in range(len(boundary)):
                row[j] = columns[j] * solution[boundary[j]]
            for j in range(len(boundary), width):
                row[j] = 0.0
            for i in range(high(count)):
                own[i] = 0.0
            for i in range(0, count, ROWS):
                subtract_tiles(blocks, place, row, width, own, i)
                place += ROWS * width
            scales, found = factors[p, 1, first:middle], solution[first_pivot:]
            for i in range(count):
                found[i] += scales[i] * own[i]
        for i in range(len(order)):
            solutions[p, order[i]] = solution[i]


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
