"""Errors of predicted displacements: the three measures of the paper and others.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 3.1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from dpl.fem import Problem
from dpl.scene import Sample

ORDINALS = {1: "largest", 2: "2nd largest", 3: "3rd largest"}


def median(values: Tensor) -> Tensor:
    """Return the median along the first axis of (S, ...): (...).

    The median of an even number of values is the mean of the middle two; `torch.median` returns the
    smaller one. The median is NaN where a value is NaN.
    """
    return (values.median(dim=0).values - (-values).median(dim=0).values) / 2


def relative_errors(prediction: Tensor, batch: Sample) -> Tensor:
    """Return ||u - v|| / ||v||, (B,) [-], of displacements u, (B, N, D)."""
    return _norm(prediction - batch.displacement) / _norm(batch.displacement)


def largest_errors(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the largest nodal error ||u - v|| over L, (B,) [-], of displacements u, (B, N, D)."""
    return (prediction - batch.displacement).norm(dim=2).amax(dim=1)


METRICS: dict[str, tuple[int, Callable[[Tensor], Tensor]]] = {  # column of a load, reduction
    # It decreases like the inverse root of the number of degrees of freedom under refinement.
    "e_mean": (0, torch.mean),
    "e_max": (1, torch.max),
    "SNR_min": (2, torch.min),
    # The formula in the paper has a factor of 10, its tables have 20.
    "SNR_min_printed": (2, lambda decibels: decibels.min() / 2),
    "rel_L2_median": (3, median),
    "rel_L2_worst": (3, torch.max),
    "residual": (4, median),  # ||R_free(u)|| / ||f||
    "min_det_F": (5, torch.min),  # 0 or less means an inverted element
}


class ErrorMetrics(Metric):
    """The errors `METRICS` of predictions, by name.

    It is updated with (prediction, batch): displacements over L, (B, N, D), and a `Sample`, on the
    device of its `problem`.
    """

    full_state_update = False
    values: list[Tensor]  # (B, 6) each

    def __init__(self, problem: Problem, **kwargs: Any) -> None:
        """Take the problem; the other arguments are those of `torchmetrics.Metric`."""
        super().__init__(**kwargs)
        self.problem = problem
        self.add_state("values", default=[], dist_reduce_fx="cat")

    def update(self, prediction: Tensor, batch: Sample) -> None:
        """Add the numbers of a batch, computed in double precision."""
        u, problem = prediction.double(), self.problem.with_parameters(batch.parameters)
        internal, volume_ratio = problem.evaluate(u)
        residual = problem.relative_residual_of(internal, batch.force)
        error = _norm(u - batch.displacement)
        columns = (
            error / u[0].numel(),
            largest_errors(u, batch),
            20 * (_norm(u) / error).log10(),
            relative_errors(u, batch),
            torch.nan_to_num(residual, nan=torch.inf if problem.material.is_known else torch.nan),
            volume_ratio,
        )
        self.values.append(torch.stack(columns, dim=1))

    def compute(self) -> dict[str, Tensor]:
        """Return the metrics over all loads by name, () each."""
        values = dim_zero_cat(self.values)
        return {name: reduce(values[:, column]) for name, (column, reduce) in METRICS.items()}


def errors_of(problem: Problem, prediction: Tensor, batch: Sample) -> dict[str, float]:
    """Return the metrics of displacements over L, (B, N, D), by name."""
    numbers = ErrorMetrics(problem)(prediction, batch)
    return {name: float(value) for name, value in numbers.items()}


def _norm(field: Tensor) -> Tensor:
    return field.flatten(1).norm(dim=1)


class PerLoadErrors(NamedTuple):
    """Errors of the predictions for some loads, (B,) each [-]."""

    relative: Tensor  # relative L2 errors
    largest: Tensor  # largest nodal errors over L
    size: Tensor  # largest nodal displacements of the reference over L

    def select(self, count: int) -> list[int]:
        """Return the loads to draw: 2 `count` with large errors and a typical one.

        These are `count` loads with the largest relative error, `count` others with the largest
        absolute error, and the load with the median relative error of the remaining ones.
        """
        relative, largest = self._order(self.relative), self._order(self.largest)
        selected = relative[:count]
        selected += [load for load in largest if load not in selected][:count]
        others = [load for load in relative if load not in selected]
        return [*selected, *others[len(others) // 2 :][:1]]

    def title(self, load: int) -> str:
        """Return the caption of a load: its errors and their ranks."""
        ranks = (self._order(errors).index(load) + 1 for errors in (self.relative, self.largest))
        count = len(self.relative)
        first, second = (ORDINALS.get(rank, f"rank {rank} of {count}") for rank in ranks)
        return (
            f"load {load}, max displacement {self.size[load]:.2g} L\n"
            f"relative L2 {100 * self.relative[load]:.3g} %: {first}\n"
            f"max error {self.largest[load]:.2g} L: {second}"
        )

    @staticmethod
    def _order(errors: Tensor) -> list[int]:
        """Return loads by descending error; NaN counts as infinite."""
        known = torch.nan_to_num(errors, nan=torch.inf)
        return known.argsort(descending=True, stable=True).tolist()
