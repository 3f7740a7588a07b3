"""Vectors of doubles as a number type for numba: one operation on WIDTH cells at once.

LLVM does not vectorise loops over cells by itself here: it cannot know that workspaces do not
overlap. A value of type `SIMDVector` is a vector register; `load` and `store` move rows of arrays
(rows, WIDTH), and + - * / work on lanes and on numbers.
"""

import operator
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

SIMD_WIDTH = 8 if llvm.get_host_cpu_features().get("avx512f") else 4
_VECTOR = ir.VectorType(ir.DoubleType(), SIMD_WIDTH)
_FLAGS = ("contract", "reassoc", "nsz")  # fused multiply-adds; NaN and infinity stay themselves


class SIMDVector(types.Type):
    """numba's type of a vector register."""

    def __init__(self) -> None:
        """Name it."""
        super().__init__(name=f"Lanes({SIMD_WIDTH})")


SIMD_VECTOR = SIMDVector()


@register_model(SIMDVector)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    row = context.cast(builder, args[1], signature.args[1], types.intp)
    first = builder.mul(row, ir.Constant(row.type, SIMD_WIDTH))
    return builder.bitcast(builder.gep(array.data, [first]), _VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, row: Any) -> Any:
    """Return row `row` of a C-contiguous float64 array (rows, WIDTH)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, signature, args))
        value.align = 8
        return value

    return SIMD_VECTOR(array, row), code


@intrinsic
def store(typing: Any, array: Any, row: Any, value: Any) -> Any:
    """Write lanes, or a number into each of them, to row `row` of an array (rows, WIDTH)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = _lanes(context, builder, args[2], signature.args[2])
        builder.store(lanes, _pointer(context, builder, signature, args)).align = 8
        return context.get_dummy_value()

    return types.void(array, row, value), code


@intrinsic
def sqrt(typing: Any, x: Any) -> Any:
    """Return the square roots of lanes."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        name = f"llvm.sqrt.v{SIMD_WIDTH}f64"
        return builder.call(builder.module.declare_intrinsic(name, (), kind), args)

    return SIMD_VECTOR(x), code


def _lanes(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    """Return a value as lanes; a number in each of them."""
    if isinstance(kind, SIMDVector):
        return value
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    number = context.cast(builder, value, kind, types.float64)
    first = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), SIMD_WIDTH), [0] * SIMD_WIDTH)
    return builder.shuffle_vector(first, nothing, everywhere)


def _operator(function: Any, instruction: str) -> None:
    @intrinsic
    def apply(typing: Any, x: Any, y: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pair = zip(args, signature.args, strict=True)
            lanes = [_lanes(context, builder, value, kind) for value, kind in pair]
            return getattr(builder, instruction)(*lanes, flags=_FLAGS)

        return SIMD_VECTOR(x, y), code

    @overload(function)
    def of(x, y):
        kinds = (types.Float, types.Integer, SIMDVector)
        both = isinstance(x, kinds) and isinstance(y, kinds)
        if both and (isinstance(x, SIMDVector) or isinstance(y, SIMDVector)):
            return lambda x, y: apply(x, y)
        return None


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operator(_function, _instruction)


@overload(operator.neg)
def _negative(x):
    if isinstance(x, SIMDVector):
        return lambda x: 0.0 - x
    return None
