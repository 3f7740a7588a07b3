"""Material laws as arguments of compiled loops: numba selects the compiled law by its type."""

import hashlib
import inspect
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import NativeValue, models, overload, register_model, typeof_impl, unbox

from dpl.fem.materials.invariant_based import InvariantBasedMaterial


class _LawType(types.Type):
    """Type of a law in numba, whose name holds a digest of the sources of law and kernels.

    A kernel is compiled once per law. After a change of the sources numba's cache on disk does not
    return the old code.
    """


_COMPILED: dict[str, Any] = {}  # name of the type -> compiled invariant derivatives


@dataclass(frozen=True)
class Law:
    """A law as an argument of a kernel.

    Attributes:
        material: Class of the law.
        sources: Source code of the kernels, for the digest.
    """

    material: type[InvariantBasedMaterial]
    sources: str

    @cached_property
    def kind(self) -> _LawType:
        """The law's type in numba."""
        if (self.material, self.sources) not in _KINDS:
            _KINDS[self.material, self.sources] = _kind(self.material, self.sources)
        return _KINDS[self.material, self.sources]


_KINDS: dict[tuple[type[InvariantBasedMaterial], str], _LawType] = {}


def _kind(material: type[InvariantBasedMaterial], sources: str) -> _LawType:
    """Return the type of a law."""
    function = material.invariant_derivatives
    code = repr(_code_of(function)) + sources
    digest = hashlib.sha256(code.encode()).hexdigest()[:16]
    name = f"{material.__qualname__}{digest}"
    if name not in _COMPILED:
        _COMPILED[name] = _compile(function)
    return _LawType(name)


def required_terms(material: InvariantBasedMaterial) -> int:
    """Return the terms that a law needs: 0 no C^-1, 1 C^-1, 2 also ln J, 3 also J^(-2/3)."""

    def evaluate(**values: float) -> tuple[float, ...]:
        arguments = dict.fromkeys(("i1", "i2", "j", "log_j", "m1"), 0.0) | values
        return material.invariant_derivatives(material.constants, **arguments)

    if np.isnan(evaluate(m1=np.nan)).any():
        return 3
    if np.isnan(evaluate(log_j=np.nan)).any():
        return 2
    everything = evaluate(i1=np.nan, i2=np.nan, j=np.nan)
    return 0 if everything[2] == 0 and not np.any(everything[6:]) else 1


def _globals(function: Any) -> dict[str, Any]:
    """Return the globals of its module that a function uses, by name."""
    scope = function.__globals__
    return {name: scope[name] for name in function.__code__.co_names if name in scope}


def _code_of(function: Any) -> tuple[Any, ...]:
    """Return the code of a function and, recursively, of the globals that it uses."""
    code = function.__code__
    parts = [
        (name, _code_of(value) if inspect.isfunction(value) else repr(value))
        for name, value in sorted(_globals(function).items())
    ]
    return code.co_code, code.co_consts, code.co_names, parts


def _compile(function: Any) -> Any:
    """Return a function compiled together with the functions that it calls."""
    scope = dict(function.__globals__)
    for name, value in _globals(function).items():
        if inspect.isfunction(value):
            scope[name] = _compile(value)
    return njit(type(function)(function.__code__, scope, function.__name__))


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
    """Return the invariant derivatives of a law; callable in compiled code only."""
    raise NotImplementedError


@overload(derivatives_of)
def _overloaded(law, c, i1, i2, j, log_j, m1):
    function = _COMPILED[law.name]
    return lambda law, c, i1, i2, j, log_j, m1: function(c, i1, i2, j, log_j, m1)
