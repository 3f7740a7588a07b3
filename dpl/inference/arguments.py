"""Conversion of the arguments of a call to float64 tensors and to a load."""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Load
from dpl.fem.assembly.equilibrium import FAINT
from dpl.scene import Scene

Array = NDArray[np.float64]


def as_numbers(name: str, value: Any) -> Tensor:
    """Return a copy of real numbers as a float64 tensor on the CPU."""
    refused = f"{name} must be real numbers"
    try:
        given = value
        if isinstance(value, Tensor):  # NumPy does not know all of its dtypes, such as bfloat16
            given = value.detach().to("cpu", torch.float64 if value.is_floating_point() else None)
            given = given.numpy()
        array = np.asarray(given)
        real = array.dtype.kind in "iuf" or (
            array.dtype.kind == "O"
            and all(isinstance(x, Real) and not isinstance(x, bool) for x in array.flat)
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


def as_number(name: str, value: Any) -> float | None:
    """Return an argument as a number, None for None."""
    if value is None or type(value) is float:
        return value
    number = as_numbers(name, value)
    if number.ndim:
        raise ValueError(f"{name} must be one number; its shape is {tuple(number.shape)}")
    return float(number)


def per_load(name: str, value: Any, count: int) -> Array:
    """Return an argument that is one number or one for each load, (B,)."""
    column = as_numbers(name, value).numpy()
    if column.size not in (1, count) or column.ndim > 1:
        given = f"{column.size} numbers for {count} loads, of shape {column.shape}"
        raise ValueError(f"{name}: {given}; give one number, or one for each load")
    if not np.isfinite(column).all():
        raise ValueError(f"{name}: a number is not finite")
    return column.reshape(-1) if column.size == count else np.full(count, column)


def named_columns(name: str, value: Any, names: Sequence[str], count: int) -> Array:
    """Return values as columns (B, P) of P names, from a mapping, an array (B, P) or None.

    B is `count`; a value of a mapping is one number or (B,).
    """
    table = np.zeros((count, 0))
    if isinstance(value, Mapping):
        if set(value) != set(names):
            raise ValueError(f"{name} = {dict(value)} must be one value for each of {list(names)}")
        columns = [per_load(f"{name}.{key}", value[key], count)[:, None] for key in names]
        return np.concatenate([table, *columns], axis=1)
    table = table if value is None else as_numbers(name, value).numpy()
    if table.shape != (count, len(names)):
        found = "missing" if value is None else f"of shape {table.shape}"
        raise ValueError(
            f"{name} must be one value for each of {list(names)}, by name or as an array "
            f"({count}, {len(names)}); it is {found}"
        )
    return table


def as_load(scene: Scene, force: Tensor, young: Any, parameters: Any) -> Load:
    """Return the arguments of a call, see `Simulator.__call__`, as a dimensionless load.

    `force` has been converted by `as_numbers`, (N, D) or (B, N, D).
    """
    shape = scene.problem.shape
    if force.shape[-2:] != shape or force.ndim not in (2, 3) or not force.numel():
        words = f"({shape[0]}, {shape[1]}) or (B, {shape[0]}, {shape[1]})"
        raise ValueError(f"force: its shape is {tuple(force.shape)} and must be {words}")
    force = scene.problem.acting(force.reshape(-1, *shape))
    rows = force.flatten(1).numpy()
    largest = np.maximum(rows.max(axis=1), -rows.min(axis=1))
    if not np.isfinite(largest).all():  # NaN if an entry is, also at fixed degrees of freedom
        raise ValueError("force: a number is not finite")
    low, high = scene.loads.moduli
    if young is None and low < high:
        raise ValueError(f"young: the scene has a range, {low:g} to {high:g} Pa; say which")
    if young is None:
        moduli = np.full(len(force), low)
    elif not ((moduli := per_load("young", young, len(force))) > 0).all():
        raise ValueError("young: a modulus is not above 0 Pa")
    for modulus in moduli.tolist():
        scene.problem.check_modulus(modulus)
    names = list(scene.loads.parameter_ranges)
    values = torch.from_numpy(named_columns("parameters", parameters, names, len(force)))
    if scene.problem.material.parameter_ranges:  # it refuses values that it does not allow
        scene.problem.material.with_parameters(scene.problem.law_parameters(values))
    with np.errstate(all="ignore"):
        sizes = largest / (moduli * scene.force_unit)
    is_lost = (sizes < FAINT) & (largest > 0)
    if is_lost.any() or not np.isfinite(sizes).all():
        unit = "E L^2" if shape[1] == 3 else "E L"
        raise ValueError(
            f"force: its largest entry over {unit} must be 0, or a number from {FAINT:g} that "
            "float64 holds; check the units of force and young"
        )
    return scene.load_of(force, torch.from_numpy(moduli), values)
