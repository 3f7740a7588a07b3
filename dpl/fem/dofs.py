"""Nodal fields (N, D) and their components that are free to move, (n,)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.problem import Problem


def gather(field: Tensor, problem: Problem) -> NDArray[np.float64]:
    """Return the free components, (n,), of a nodal field (N, D)."""
    return field[problem.free].numpy()


def scatter(values: NDArray[np.float64], problem: Problem) -> Tensor:
    """Return the nodal field (N, D) with these free components (n,), zero where held."""
    field = torch.zeros(problem.shape, dtype=torch.float64)
    field[problem.free] = torch.from_numpy(values)
    return field
