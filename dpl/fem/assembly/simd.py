"""A SIMD vector of doubles as a number type of numba.

The loops over cells process one cell in each lane. A value of type `SIMDVector` is a vector
register. `load` and `store` transfer rows of arrays (rows, SIMD_WIDTH); the operators + - * / take
vectors and numbers.
"""

import inspect
import math
import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model
from numba.np.arrayobj import populate_array

from dpl.fem.materials import arithmetic

SIMD_WIDTH = 8 if llvm.get_host_cpu_features().get("avx512f") else 4
_VECTOR = ir.VectorType(ir.DoubleType(), SIMD_WIDTH)
_INTEGERS = ir.VectorType(ir.IntType(64), SIMD_WIDTH)
inlined = njit(forceinline=True, error_model="numpy")  # a part of the loop that calls it
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


@intrinsic(prefer_literal=True)
def registers(typing: Any, count: Any) -> Any:
    """Return a workspace on the stack, (count, SIMD_WIDTH); the count must be a constant.

    LLVM knows that nothing else refers to it, and keeps rows with constant numbers in registers.
    """
    kind = types.Array(types.float64, 2, "C")

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        number = count.literal_value
        rows = cgutils.alloca_once(builder, ir.ArrayType(_VECTOR, number))
        array = context.make_array(kind)(context, builder)
        data, shape = builder.bitcast(rows, array.data.type), (number, SIMD_WIDTH)
        counts = [ir.Constant(ir.IntType(64), each) for each in (*shape, 8 * SIMD_WIDTH, 8)]
        populate_array(array, data, counts[:2], counts[2:], 8, None)
        return array._getvalue()

    return kind(count), code


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


def _vector(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    """Return a value as a vector, a number repeated in every lane."""
    if isinstance(kind, SIMDVector):
        return value
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    number = context.cast(builder, value, kind, types.float64)
    first = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    everywhere = ir.Constant(ir.VectorType(ir.IntType(32), SIMD_WIDTH), [0] * SIMD_WIDTH)
    return builder.shuffle_vector(first, nothing, everywhere)


def _integers(value: int) -> Any:
    """Return an integer in every lane."""
    return ir.Constant(_INTEGERS, [value] * SIMD_WIDTH)


def _lanewise(emit: Callable[..., Any]) -> Any:
    """Return an intrinsic of vectors, and numbers in every lane, from the code that it emits."""

    def apply(typing: Any, *kinds: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pairs = zip(args, signature.args, strict=True)
            return emit(builder, *(_vector(context, builder, *pair) for pair in pairs))

        return SIMD_VECTOR(*kinds), code

    apply.__signature__ = inspect.signature(emit)  # type: ignore[attr-defined]
    return intrinsic(apply)


def _call(builder: Any, name: str, *args: Any) -> Any:
    """Return the result of one of LLVM's functions of vectors."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    name = f"llvm.{name}.v{SIMD_WIDTH}f64"
    return builder.call(builder.module.declare_intrinsic(name, (), kind), args)


sqrt = _lanewise(lambda builder, x: _call(builder, "sqrt", x))
_exp = _lanewise(lambda builder, x: _call(builder, "exp", x))
_rint = _lanewise(lambda builder, x: _call(builder, "rint", x))
_fma = _lanewise(lambda builder, x, y, z: _call(builder, "fma", x, y, z))


@_lanewise
def _exponent(builder: Any, x: Any) -> Any:
    """Return the exponent of 2 of each lane, a positive number."""
    bits = builder.lshr(builder.bitcast(x, _INTEGERS), _integers(52))
    return builder.sitofp(builder.sub(bits, _integers(1023)), _VECTOR)


@_lanewise
def _power_of_two(builder: Any, x: Any) -> Any:
    """Return 2^x of each lane, a whole number above -1023 and below 1024."""
    whole = builder.add(builder.fptosi(x, _INTEGERS), _integers(1023))
    return builder.bitcast(builder.shl(whole, _integers(52)), _VECTOR)


@_lanewise
def choose(builder: Any, x: Any, y: Any, below: Any, other: Any) -> Any:
    """Return `below` in lanes with x < y, and `other` elsewhere, also where x or y is NaN."""
    return builder.select(builder.fcmp_ordered("<", x, y), below, other)


@inlined
def log1p(x):
    """Return ln(1 + x) of each lane to rounding; NaN unless x > -1.

    With 1 + x = 2^k (1 + f) it is k ln 2 + 2 artanh(s), s = f / (2 + f), |s| < 0.172.
    """
    k = _exponent(math.sqrt(2.0) * (1.0 + x))
    scale = _power_of_two(0.0 - k)
    f = _fma(scale, x, scale - 1.0)  # 1 + x is not rounded
    s = f / (2.0 + f)
    square = s * s
    fourth = square * square
    odd, even = fourth * (1 / 19), fourth * (1 / 21)  # independent sums
    for n in range(3, 0, -1):
        odd, even = (odd + 1 / (4 * n + 3)) * fourth, (even + 1 / (4 * n + 5)) * fourth
    series = square * (odd + 1 / 3) + fourth * (even + 1 / 5)
    return choose(-1.0, x, k * math.log(2.0) + (2.0 * s + 2.0 * s * series), math.nan)


@inlined
def expm1(x):
    """Return e^x - 1 of each lane to rounding, for |x| < 700."""
    n = _rint(x * (1 / math.log(2.0)))
    r = _fma(n, -2.3190468138462996e-17, _fma(n, -math.log(2.0), x))  # x - n ln 2, |r| < 0.347
    series = 1.0 + r * (1 / 14)
    for k in range(13, 1, -1):
        series = 1.0 + r * (1 / k) * series
    scale = _power_of_two(n)
    return _fma(scale, r * series, scale - 1.0)


def nonzero(x):
    """Return True for a vector and for numbers except 0.0; callable in compiled code only."""
    raise NotImplementedError


@overload(nonzero)
def _overloaded_nonzero(x):
    return (lambda x: True) if isinstance(x, SIMDVector) else (lambda x: x != 0.0)


overload(arithmetic.exp)(lambda x: lambda x: _exp(x))
overload(arithmetic.positive_part)(lambda x: lambda x: choose(x, 0.0, 0.0, x))  # NaN stays
overload(arithmetic.step)(lambda x: lambda x: choose(x, 0.0, 0.0, 1.0))


def _operator(function: Any, instruction: str) -> None:
    apply = _lanewise(lambda builder, x, y: getattr(builder, instruction)(x, y, flags=_FLAGS))

    @overload(function)
    def of(x, y):
        kinds = (types.Float, types.Integer, SIMDVector)
        both = isinstance(x, kinds) and isinstance(y, kinds)
        is_vector = isinstance(x, SIMDVector) or isinstance(y, SIMDVector)
        return (lambda x, y: apply(x, y)) if both and is_vector else None


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")
_operator(operator.truediv, "fdiv")
overload(operator.neg)(lambda x: (lambda x: 0.0 - x) if isinstance(x, SIMDVector) else None)
