"""Conversion of the arguments of a call to float64 tensors."""

from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_numbers(name: str, value: Any) -> Tensor:
    """Return a copy of an argument as a float64 tensor on the CPU.

    Raises:
        ValueError: It contains values that are no real numbers.
    """
    refused = f"{name} must be real numbers"
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_meta or value.is_quantized:
            raise ValueError(f"{refused}; this tensor has no dense values")
        if value.is_complex() or value.dtype == torch.bool:
            raise ValueError(f"{refused}, not {value.dtype}")
        return value.detach().to("cpu", torch.float64, copy=True)
    try:
        array = np.asarray(value)
        real = array.dtype.kind in "iuf" or (
            array.dtype.kind == "O" and all(map(_is_real, array.flat))
        )
        numbers = np.array(array, np.float64, order="C", subok=False) if real else None
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{refused}; {reason}") from error
    if numbers is None:
        raise ValueError(f"{refused}, not {array.dtype}")
    if np.ma.is_masked(value):
        raise ValueError(f"{refused}; masked entries have no value, fill them")
    return torch.from_numpy(numbers)


def _is_real(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def as_number(name: str, value: Any) -> float | None:
    """Return an argument as a number, None for None.

    Raises:
        ValueError: It is not one number.
    """
    if value is None:
        return None
    number = as_numbers(name, value)
    if number.ndim:
        raise ValueError(f"{name} must be one number; its shape is {tuple(number.shape)}")
    return float(number)


def per_load(name: str, value: Any, count: int) -> Tensor:
    """Return an argument that is one number or one for each load, (B,)."""
    column = as_numbers(name, value)
    if column.numel() not in (1, count) or column.ndim > 1:
        given = f"{column.numel()} numbers for {count} loads, of shape {tuple(column.shape)}"
        raise ValueError(f"{name}: {given}; give one number, or one for each load")
    if not column.isfinite().all():
        raise ValueError(f"{name}: a number is not finite")
    return column.reshape(-1).expand(count).clone()
