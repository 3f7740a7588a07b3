"""Material laws as arguments of compiled loops: numba selects the compiled law by its type."""

import hashlib
import inspect
from dataclasses import dataclass
from functools import cache
from typing import Any

from numba import types
from numba.extending import NativeValue, models, overload, register_model, typeof_impl, unbox

from dpl.fem.assembly.simd import inlined, load, store
from dpl.fem.materials import arithmetic
from dpl.fem.materials.material import CompiledForm


class _LawType(types.Type):
    """Type of a law in numba, whose name is a digest of the sources of law and kernels.

    A kernel is compiled once for all laws with the same sources. After a change of the sources
    numba's cache on disk does not return the old code.
    """


# name of the type -> calls of the compiled derivatives by invariants and by strains of fibres
_COMPILED: dict[str, tuple[Any, Any]] = {}


@dataclass(frozen=True)
class Law:
    """A law as an argument of a kernel.

    Attributes:
        kind: Its type in numba. The constants of fibres follow those of the isotropic law, and the
            entries of the fibre frame, row by row, follow them.
    """

    kind: _LawType

    @classmethod
    def of(cls, form: CompiledForm, sources: str) -> "Law":
        """Return a law as an argument of the kernels with some source code."""
        parts = (form.isotropic, form.fibres) if form.fibres else (form.isotropic,)
        return _law(tuple((type(part), len(part.constants)) for part in parts), sources)


@cache
def _law(parts: tuple[tuple[type[Any], int], ...], sources: str) -> Law:
    (material, at), *fibres = parts
    functions: list[Any] = [material.invariant_derivatives]
    functions += [kind.strain_derivatives for kind, _ in fibres]
    code = repr([_code_of(function) for function in functions]) + sources
    code += repr([count for _, count in parts])  # of constants, whose places are compiled
    name = f"Law{hashlib.sha256(code.encode()).hexdigest()[:16]}"
    if name not in _COMPILED:
        invariants, *compiled = map(_compile, functions)
        calls = [_call_of_fibres(compiled[0], range(at, at + count)) for _, count in fibres]
        _COMPILED[name] = _call_of_invariants(invariants, at), calls[0] if calls else None
    return Law(_LawType(name))


def _call_of_invariants(function: Any, count: int) -> Any:
    """Return the call of a function whose constants are the first rows of vectors of an array.

    numba needs the length of the tuple of constants when it compiles.
    """
    constants = "".join(f"load(c, {k}), " for k in range(count))
    arguments = "i1, i2, j, log_j, m1"
    source = f"lambda law, c, {arguments}: function(({constants}), {arguments})"
    return eval(source, {"function": function, "load": load})  # of numbers only


def _call_of_fibres(function: Any, rows: range) -> Any:
    """Return the call of a function with constants in some rows that stores stress and moduli."""
    constants = "".join(f"load(c, {k}), " for k in rows)
    strain = "".join(f"load(e, {k}), " for k in range(6))
    lines = [
        "def call(law, c, e, out, moduli):",
        f"    S, D = function(({constants}), ({strain}))",
        *(f"    store(out, {k}, S[{k}])" for k in range(6)),
        "    if moduli:",
        *(f"        store(out, {6 + k}, D[{k}])" for k in range(21)),
    ]
    scope = {"function": function, "load": load, "store": store}
    exec("\n".join(lines), scope)  # of numbers only
    return scope["call"]


def _globals(function: Any) -> dict[str, Any]:
    """Return the globals of its module that a function uses, by name."""
    scope = function.__globals__
    return {name: scope[name] for name in function.__code__.co_names if name in scope}


def _is_source(value: Any) -> bool:
    """Return True for a function whose source is compiled, and which is not overloaded."""
    return inspect.isfunction(value) and value.__module__ != arithmetic.__name__


def _code_of(function: Any) -> tuple[Any, ...]:
    """Return the code of a function and, recursively, of the globals that it uses."""
    code = function.__code__
    parts = [
        (name, _code_of(value) if _is_source(value) else getattr(value, "__name__", repr(value)))
        for name, value in sorted(_globals(function).items())
    ]
    return code.co_code, code.co_consts, code.co_names, parts


def _compile(function: Any) -> Any:
    """Return a function compiled together with the functions that it calls."""
    scope = dict(function.__globals__)
    for name, value in _globals(function).items():
        if _is_source(value):
            scope[name] = _compile(value)
    return inlined(type(function)(function.__code__, scope, function.__name__))


@register_model(_LawType)
class _LawModel(models.OpaqueModel):
    pass


@typeof_impl.register(Law)
def _typeof_law(law: Law, context: Any) -> _LawType:
    return law.kind


@unbox(_LawType)
def _unbox_law(kind: Any, value: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())


def derivatives_of(law, c, i1, i2, j, log_j, m1):
    """Return the invariant derivatives of a law; callable in compiled code only.

    Its constants c are rows of vectors, (constants, SIMD_WIDTH).
    """
    raise NotImplementedError


@overload(derivatives_of, jit_options={"forceinline": True})
def _overloaded(law, c, i1, i2, j, log_j, m1):
    return _COMPILED[law.name][0]


def set_fibre_derivatives(law, c, e, out, moduli):
    """Set `out` (27, SIMD_WIDTH) to stress and, with `moduli`, moduli of the fibres of a law.

    Callable in compiled code only. The strains e are in the frame of the fibres, (6, SIMD_WIDTH).
    """
    raise NotImplementedError


@overload(set_fibre_derivatives, jit_options={"forceinline": True})
def _overloaded_fibres(law, c, e, out, moduli):
    # numba types the call for laws without fibres too; LLVM removes it
    return _COMPILED[law.name][1] or (lambda law, c, e, out, moduli: None)


def has_fibres(law):
    """Return True for a law with fibres, as a constant of compiled code."""
    raise NotImplementedError


@overload(has_fibres)
def _overloaded_has_fibres(law):
    found = _COMPILED[law.name][1] is not None
    return (lambda law: True) if found else (lambda law: False)
