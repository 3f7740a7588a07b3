"""Products with dense matrices whose entries are stored in tiles, read from memory as one stream.

A tile has `ROWS` rows and `LANES` columns of a matrix. Rows that are stored one after the other are
read by several short streams, for which processors do not read ahead.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import int16, njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

# numba's cache knows the file of a loop only: with these change `condensed_loops`, which calls them
LANES = 16  # columns of a tile
ROWS = 4  # rows of a tile
FLAGS = ("contract", "reassoc", "nsz")  # fused multiply-adds and sums in any order


@njit
def wide(count):  # type: ignore[no-untyped-def]
    """Return a multiple of `LANES` of at least `count`."""
    return (count + LANES - 1) // LANES * LANES


@njit
def high(count):  # type: ignore[no-untyped-def]
    """Return a multiple of `ROWS` of at least `count`."""
    return (count + ROWS - 1) // ROWS * ROWS


def tiled(block: NDArray[Any]) -> NDArray[Any]:
    """Return the entries of blocks (..., I, J) in the order in which loops read them, (..., V).

    Tiles of `ROWS` rows and `LANES` columns follow each other, those of the same rows first.
    """
    *batch, count, length = block.shape
    tall, long = high(count), wide(length)
    filled = np.zeros((*batch, tall, long), block.dtype)
    filled[..., :count, :length] = block
    tiles = filled.reshape(*batch, tall // ROWS, ROWS, long // LANES, LANES).swapaxes(-3, -2)
    return tiles.reshape(*batch, tall * long)


def untiled(values: NDArray[Any], count: int, length: int) -> NDArray[Any]:
    """Return the block (I, J) of values of `tiled`, (V,)."""
    tall, long = high(count), wide(length)
    tiles = values.reshape(tall // ROWS, long // LANES, ROWS, LANES).swapaxes(1, 2)
    return tiles.reshape(tall, long)[:count, :length]


def _vectors(
    context: Any, builder: Any, kinds: Any, values: Any, place: Any
) -> tuple[Any, Callable[..., Any], Callable[[Any], list[Any]]]:
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
