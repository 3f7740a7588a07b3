"""Laws as arguments of compiled loops: slopes, compiled, chosen by the type of the law."""

import hashlib
import inspect
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import (
    NativeValue,
    models,
    overload,
    register_model,
    typeof_impl,
    unbox,
)

from dpl.fem.materials.material import InvariantBasedMaterial


class _LawType(types.Type):
    """Type of a law in numba: its name holds a digest of all code that a kernel is made of.

    So a kernel is compiled once per law, and one compiled from other sources is never taken from
    numba's cache on disk.
    """


_SLOPES: dict[str, Any] = {}  # name of the type -> compiled slopes


@dataclass(frozen=True)
class Law:
    """A law as an argument of a kernel.

    Attributes:
        material: Its class.
        sources: The code of the kernel, for the digest.
    """

    material: type[InvariantBasedMaterial]
    sources: str

    @cached_property
    def kind(self) -> _LawType:
        """The law's type in numba."""
        invariant_derivatives = self.material.invariant_derivatives
        code = repr(_read(invariant_derivatives)) + self.sources
        digest = hashlib.sha256(code.encode()).hexdigest()[:16]
        name = f"{self.material.__qualname__}{digest}"
        if name not in _SLOPES:
            _SLOPES[name] = _jitted(invariant_derivatives)
        return _LawType(name)


def required_terms(material: InvariantBasedMaterial) -> int:
    """Return what a law's slopes read: 0 nothing of C^-1, 1 no ln J, 2 ln J, 3 J^(-2/3) too."""

    def read(**values: float) -> tuple[float, ...]:
        arguments = dict.fromkeys(("i1", "i2", "j", "log_j", "m1"), 0.0) | values
        return material.invariant_derivatives(material.constants, **arguments)

    if np.isnan(read(m1=np.nan)).any():
        return 3
    if np.isnan(read(log_j=np.nan)).any():
        return 2
    everything = read(i1=np.nan, i2=np.nan, j=np.nan)
    return 0 if everything[2] == 0 and not np.any(everything[6:]) else 1


def _globals(function: Any) -> dict[str, Any]:
    """Return what a function reads of its module, by name."""
    scope = function.__globals__
    return {name: scope[name] for name in function.__code__.co_names if name in scope}


def _read(function: Any) -> tuple[Any, ...]:
    """Return all that decides what a function returns: its code, and what it reads, in depth."""
    code = function.__code__
    parts = [
        (name, _read(value) if inspect.isfunction(value) else repr(value))
        for name, value in sorted(_globals(function).items())
    ]
    return code.co_code, code.co_consts, code.co_names, parts


def _jitted(function: Any) -> Any:
    """Return a plain arithmetic function compiled, with the functions that it calls."""
    scope = dict(function.__globals__)
    for name, value in _globals(function).items():
        if inspect.isfunction(value):
            scope[name] = _jitted(value)
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
    raise NotImplementedError


@overload(derivatives_of)
def _overloaded(law, c, i1, i2, j, log_j, m1):
    function = _SLOPES[law.name]
    return lambda law, c, i1, i2, j, log_j, m1: function(c, i1, i2, j, log_j, m1)
