"""A SIMD vector of doubles as a number type of numba.

LLVM does not vectorise the loops over cells by itself, because it cannot prove that the workspaces
do not overlap. A value of type `SIMDVector` is a vector register. `load` and `store` transfer rows
of arrays (rows, SIMD_WIDTH); the operators + - * / take vectors and numbers.
"""

import operator
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

from dpl.fem.materials import arithmetic

SIMD_WIDTH = 8 if llvm.get_host_cpu_features().get("avx512f") else 4
_VECTOR = ir.VectorType(ir.DoubleType(), SIMD_WIDTH)
_FLAGS = ("contract", "reassoc", "nsz")  # allow fused multiply-adds, preserve NaN and infinity


class SIMDVector(types.Type):
    """numba's type of a vector register."""


SIMD_VECTOR = SIMDVector(f"SIMDVector({SIMD_WIDTH})")  # the name that numba's cache uses


@register_model(SIMDVector)
class _SIMDVectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    row = context.cast(builder, args[1], signature.args[1], types.intp)
    first = builder.mul(row, ir.Constant(row.type, SIMD_WIDTH))
    return builder.bitcast(builder.gep(array.data, [first]), _VECTOR.as_pointer())


@intrinsic
def load(typing: Any, array: Any, row: Any) -> Any:
    """Return row `row` of a C-contiguous float64 array (rows, SIMD_WIDTH)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, signature, args))
        value.align = 8
        return value

    return SIMD_VECTOR(array, row), code


@intrinsic
def store(typing: Any, array: Any, row: Any, value: Any) -> Any:
    """Write a vector, or a number in every lane, to row `row` of an array (rows, SIMD_WIDTH)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = _vector(context, builder, args[2], signature.args[2])
        builder.store(vector, _pointer(context, builder, signature, args)).align = 8
        return context.get_dummy_value()

    return types.void(array, row, value), code


def _call(builder: Any, name: str, args: Any) -> Any:
    """Return the result of one of LLVM's functions of vectors."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    name = f"llvm.{name}.v{SIMD_WIDTH}f64"
    return builder.call(builder.module.declare_intrinsic(name, (), kind), args)


@intrinsic
def sqrt(typing: Any, x: Any) -> Any:
    """Return the square root of each lane."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "sqrt", args)

    return SIMD_VECTOR(x), code


@intrinsic
def _exp(typing: Any, x: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "exp", args)

    return SIMD_VECTOR(x), code


@intrinsic
def _positive_part(typing: Any, x: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        nothing = ir.Constant(_VECTOR, [0.0] * SIMD_WIDTH)
        negative = builder.fcmp_ordered("<", args[0], nothing)
        return builder.select(negative, nothing, args[0])  # NaN stays

    return SIMD_VECTOR(x), code


@intrinsic
def _step(typing: Any, x: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        zeros, ones = (ir.Constant(_VECTOR, [value] * SIMD_WIDTH) for value in (0.0, 1.0))
        return builder.select(builder.fcmp_ordered(">=", args[0], zeros), ones, zeros)

    return SIMD_VECTOR(x), code


@overload(arithmetic.exp)
def _overloaded_exp(x):
    return lambda x: _exp(x)


@overload(arithmetic.positive_part)
def _overloaded_positive_part(x):
    return lambda x: _positive_part(x)


@overload(arithmetic.step)
def _overloaded_step(x):
    return lambda x: _step(x)


def _vector(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    """Return a value as a vector, a number repeated in every lane."""
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
            vectors = [_vector(context, builder, value, kind) for value, kind in pair]
            return getattr(builder, instruction)(*vectors, flags=_FLAGS)

        return SIMD_VECTOR(x, y), code

    @overload(function)
    def of(x, y):
        kinds = (types.Float, types.Integer, SIMDVector)
        both = isinstance(x, kinds) and isinstance(y, kinds)
        if both and (isinstance(x, SIMDVector) or isinstance(y, SIMDVector)):
            return lambda x, y: apply(x, y)
        return None


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")
_operator(operator.truediv, "fdiv")


@overload(operator.neg)
def _negative(x):
    if isinstance(x, SIMDVector):
        return lambda x: 0.0 - x
    return None
