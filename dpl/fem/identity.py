"""Plain data that identify an object: what two equal objects write down alike."""

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


def identity_of(value: object, *, exclude: Collection[str] = ()) -> dict[str, Any]:
    """Return the class name and the options of an object as plain data.

    The options are the fields of a dataclass, or the attributes of any other object, without those
    to `exclude`. A field with the metadata `optional` is left out where it has its default.
    """
    names = list(vars(value))
    if is_dataclass(value):
        names = [
            field.name
            for field in fields(value)
            if not (field.metadata.get("optional") and getattr(value, field.name) is field.default)
        ]
    options = {name: plain(getattr(value, name)) for name in names if name not in exclude}
    for name, option in options.items():
        if option is not None and not isinstance(option, bool | float | str | list | dict):
            raise TypeError(
                f"{type(value).__name__}.{name} is a {type(option).__name__}, which is no plain "
                "data; define identity()"
            )
    kind = "class" if "name" in options else "name"
    return {kind: type(value).__name__, **options}


def plain(value: Any) -> Any:
    """Return a value as plain data: real numbers as floats, so that 1 and 1.0 are equal, arrays as
    their SHA-256, dataclasses by name and options, functions by name.
    """
    if getattr(value, "is_log", False):  # a range with another distribution
        return {"low": float(value[0]), "high": float(value[1]), "distribution": "log"}
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, Tensor):
        return sha256_of(value.detach().cpu().numpy())
    if isinstance(value, np.ndarray):
        return sha256_of(value)
    if isinstance(value, Real) and not isinstance(value, bool):
        return float(value)
    if is_dataclass(value) and not isinstance(value, type):
        return identity_of(value)
    return function_name(value) if callable(value) else value


def function_name(function: Callable[..., object]) -> str:
    """Return the name of a function, or of a partial with its arguments."""
    if isinstance(function, partial):
        keywords = plain(dict(sorted(function.keywords.items())))
        arguments = plain(function.args)
        return f"{function_name(function.func)}{arguments or ''}{keywords or ''}"
    return getattr(function, "__name__", repr(function))


def sha256_of(array: NDArray[Any]) -> str:
    """Return the SHA-256 of type, shape and bytes of an array, in hexadecimal."""
    contiguous = np.ascontiguousarray(array)
    return hashlib.sha256(
        f"{contiguous.dtype}{contiguous.shape}".encode() + contiguous.tobytes()
    ).hexdigest()
