"""Error metrics of predicted displacements: the three of the paper and five others.

Every metric is updated with (prediction, batch): displacements over L, (B, N, D), and a `Sample`.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 3.1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchmetrics import Metric, MetricCollection
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


class _PerLoad(Metric):
    """Base class: stores one number per load and reduces them in `compute`.

    Attributes:
        reduce: From the numbers of all loads (S,) to the metric ().
    """

    full_state_update = False
    values: list[Tensor]
    reduce: Callable[[Tensor], Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("values", default=[], dist_reduce_fx="cat")

    def update(self, prediction: Tensor, batch: Sample) -> None:
        """Add the numbers of a batch."""
        self.values.append(self.measure(prediction.double(), batch))

    def compute(self) -> Tensor:
        """Return the metric over all loads, ()."""
        return self.reduce(dim_zero_cat(self.values))

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return one number per load, (B,)."""
        raise NotImplementedError


class _OfProblem(_PerLoad):
    """Base class of the metrics that one evaluation of the body gives.

    Each of them stores the relative residual and min det F of each load, (B, 2). A compute group of
    `MetricCollection` therefore evaluates the body once for all of them.

    Attributes:
        column: Column of the metric.
    """

    column: int

    def __init__(self, problem: Problem, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.problem = problem

    def update(self, prediction: Tensor, batch: Sample) -> None:
        """Add the numbers of a batch."""
        self.values.append(self._evaluate(prediction.double(), batch))

    def compute(self) -> Tensor:
        """Return the metric over all loads, ()."""
        return self.reduce(dim_zero_cat(self.values)[:, self.column])

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        return self._evaluate(prediction, batch)[:, self.column]

    def _evaluate(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return the relative residual and min det F of each load, (B, 2)."""
        problem = self.problem.with_parameters(batch.parameters)
        internal, volume_ratio = problem.evaluate(prediction)
        residual = problem.relative_residual_of(internal, batch.force)
        return torch.stack([torch.nan_to_num(residual, nan=torch.inf), volume_ratio], dim=1)


class MeanError(_PerLoad):
    """e_mean = 1/(N S) sum_s ||u_s - v_s||, with N degrees of freedom and S loads.

    It decreases like 1/sqrt(N) under refinement and must not be compared across meshes.
    """

    reduce = staticmethod(torch.mean)

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        return _error(prediction, batch) / prediction[0].numel()


class MaxError(_PerLoad):
    """e_max: the largest nodal error ||u - v|| over all nodes and loads, over L."""

    reduce = staticmethod(torch.max)

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        return (prediction - batch.displacement).norm(dim=2).amax(dim=1)


class MinSNR(_PerLoad):
    """SNR_min: the minimum of 20 log10(||u|| / ||u - v||) over loads [dB].

    The formula in the paper has a factor of 10, its tables have 20; `printed` selects 10.
    """

    reduce = staticmethod(torch.min)

    def __init__(self, *, printed: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.factor = 10 if printed else 20

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        ratio = prediction.flatten(1).norm(dim=1) / _error(prediction, batch)
        return self.factor * ratio.log10()


class RelativeL2(_PerLoad):
    """||u - v|| / ||v||: median over loads, or maximum if `worst`."""

    def __init__(self, *, worst: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.reduce = torch.max if worst else median

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        return _error(prediction, batch) / batch.displacement.flatten(1).norm(dim=1)


class ResidualRatio(_OfProblem):
    """Median over loads of the relative residual ||R_free(u)|| / ||f||."""

    reduce = staticmethod(median)
    column = 0


class MinVolumeRatio(_OfProblem):
    """min det F over quadrature points and loads; 0 or less means an inverted element."""

    reduce = staticmethod(torch.min)
    column = 1


def default_metrics(problem: Problem) -> MetricCollection:
    """Return all metrics, named as in the tables."""
    return MetricCollection(
        {
            "e_mean": MeanError(),
            "e_max": MaxError(),
            "SNR_min": MinSNR(),
            "SNR_min_printed": MinSNR(printed=True),
            "rel_L2_median": RelativeL2(),
            "rel_L2_worst": RelativeL2(worst=True),
            "residual": ResidualRatio(problem),
            "min_det_F": MinVolumeRatio(problem),
        },
        # in alphabetical order: with another one `forward` loses the numbers of earlier batches
        compute_groups=[["min_det_F", "residual"]],
    )


def _error(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the norms of the errors, (B,)."""
    return (prediction - batch.displacement).flatten(1).norm(dim=1)


class PerLoadErrors(NamedTuple):
    """Errors of the predictions for some loads.

    Attributes:
        relative: Relative L2 errors, (B,) [-].
        largest: Largest nodal errors over L, (B,) [-].
        size: Largest nodal displacements of the reference over L, (B,) [-].
    """

    relative: Tensor
    largest: Tensor
    size: Tensor

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

    @property
    def largest_absolute(self) -> int:
        """The load with the largest absolute error."""
        return self._order(self.largest)[0]

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
