"""Functions of tensors and numbers in laws; compiled loops overload them for SIMD vectors."""

import math
from typing import Any

import torch
from torch import Tensor


def exp(x: Any) -> Any:
    """Return e^x."""
    return torch.exp(x) if isinstance(x, Tensor) else math.exp(x)


def positive_part(x: Any) -> Any:
    """Return max(x, 0)."""
    return torch.clamp(x, min=0) if isinstance(x, Tensor) else max(x, 0.0)


def step(x: Any) -> Any:
    """Return 1 where x >= 0 and 0 elsewhere, the derivative of `positive_part`.

    It is 1 at 0: fibres without load have a stiffness.
    """
    return (x >= 0).to(x.dtype) if isinstance(x, Tensor) else float(x >= 0)
