"""Compiled loops over dense blocks of condensed matrices, see `dpl.fem.linear.condensation`.

Blocks are stored in tiles of `ROWS` rows and `LANES` columns in the order in which products read
them, so that they are read from memory as one stream.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import float32, float64, int16, int64, njit, types, uint32, void
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16  # entries of a row that a loop multiplies at once
ROWS = 4  # rows that it multiplies at once
FLAGS = ("contract", "reassoc", "nsz")  # fused multiply-adds and sums in any order


@njit
def wide(count):  # type: ignore[no-untyped-def]
    """Return a multiple of `LANES` of at least `count`."""
    return (count + LANES - 1) // LANES * LANES


@njit
def high(count):  # type: ignore[no-untyped-def]
    """Return a multiple of `ROWS` of at least `count`."""
    return (count + ROWS - 1) // ROWS * ROWS


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


def _vectors(
    context: Any, builder: Any, kinds: Any, values: Any, place: Any
) -> tuple[Any, Callable[[Any, Any, Any], Any], Callable[[Any], list[Any]]]:
    """Return the type of `LANES` sums, and functions that point to sums and read rows of a tile."""
    sums = ir.VectorType(context.get_value_type(kinds[1].dtype), LANES)
    numbers = ir.VectorType(context.get_value_type(kinds[0].dtype), LANES)
    convert = builder.sitofp if kinds[0].dtype == int16 else builder.bitcast

    def pointer(kind: Any, array: Any, position: Any, vector: Any = sums) -> Any:
        data = context.make_array(kind)(context, builder, array).data
        return builder.bitcast(builder.gep(data, [position]), vector.as_pointer())

    def tile(column: Any) -> list[Any]:
        first = builder.add(place, builder.mul(column, column.type(ROWS)))
        offsets = (builder.add(first, first.type(LANES * k)) for k in range(ROWS))
        pointers = [pointer(kinds[0], values, one, numbers) for one in offsets]
        width = kinds[0].dtype.bitwidth // 8
        return [convert(builder.load(one, align=width), sums) for one in pointers]

    return sums, pointer, tile


@intrinsic
def add_tiles(typing: Any, values: Any, place: Any, x: Any, first: Any, y: Any, width: Any) -> Any:
    """Add x A to y[:width] for `ROWS` rows A of tiles and as many entries x from `first`."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args[0], signature.args[2]
        sums, pointer, tile = _vectors(context, builder, kinds, *args[:2])
        align, lanes, factors = kinds[1].dtype.bitwidth // 8, ir.IntType(32), []
        for k in range(ROWS):
            at = builder.add(args[3], args[3].type(k))
            number = builder.load(pointer(kinds[1], args[2], at, sums.element))
            one = builder.insert_element(sums(ir.Undefined), number, lanes(0))
            everywhere = ir.VectorType(lanes, LANES)([0] * LANES)
            factors.append(builder.shuffle_vector(one, one, everywhere))
        zero, step = args[5].type(0), args[5].type(LANES)
        with cgutils.for_range_slice(builder, zero, args[5], step, intp=zero.type) as (column, _):
            place = pointer(kinds[1], args[4], column)
            total = builder.load(place, align=align)
            for factor, row in zip(factors, tile(column), strict=True):
                total = builder.fadd(total, builder.fmul(row, factor, flags=FLAGS), flags=FLAGS)
            builder.store(total, place, align=align)
        return context.get_dummy_value()

    return types.void(values, types.intp, x, types.intp, y, types.intp), code


@intrinsic
def subtract_tiles(
    typing: Any, values: Any, place: Any, x: Any, width: Any, y: Any, first: Any
) -> Any:
    """Subtract A x[:width] from `ROWS` entries of y from `first` for as many rows A of tiles."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args[0], signature.args[2]
        sums, pointer, tile = _vectors(context, builder, kinds, *args[:2])
        align, nothing = kinds[1].dtype.bitwidth // 8, sums([0.0] * LANES)
        totals = [cgutils.alloca_once_value(builder, nothing) for _ in range(ROWS)]
        for total in totals:
            builder.store(nothing, total)
        zero, step = args[3].type(0), args[3].type(LANES)
        with cgutils.for_range_slice(builder, zero, args[3], step, intp=zero.type) as (column, _):
            factor = builder.load(pointer(kinds[1], args[2], column), align=align)
            for total, row in zip(totals, tile(column), strict=True):
                product = builder.fmul(row, factor, flags=FLAGS)
                builder.store(builder.fadd(builder.load(total), product, flags=FLAGS), total)
        kind, name = sums.element, f"llvm.vector.reduce.fadd.v{LANES}f{8 * align}"
        whole = builder.module.declare_intrinsic(name, (), ir.FunctionType(kind, [kind, sums]))
        for k, total in enumerate(totals):
            at = builder.add(args[5], args[5].type(k))
            place = pointer(kinds[1], args[4], at, kind)
            found = builder.call(whole, [kind(0.0), builder.load(total)], fastmath=FLAGS)
            builder.store(builder.fsub(builder.load(place), found), place)
        return context.get_dummy_value()

    return types.void(values, types.intp, x, types.intp, y, types.intp), code


@njit(
    [
        void(int64[:, ::1], uint32[::1], uint32[::1], A[:, ::1], x[:, :, ::1], x[:, ::1], x[:, ::1])
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
        for i in range(len(order)):
            force[i] = forces[p, order[i]]
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
