"""How wrong a batch of displacements is: the paper's three numbers and those that explain them.

Every metric is updated with (prediction, batch): displacements over L, (B, N, D), and the `Sample`.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 3.1.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchmetrics import Metric, MetricCollection
from torchmetrics.utilities import dim_zero_cat

from dpl.fem import Problem
from dpl.scene import Sample

ORDINALS = {1: "worst", 2: "2nd worst", 3: "3rd worst"}


def median(values: Tensor) -> Tensor:
    """Return the median along the first axis of (S, ...): (...).

    Of an even number of values it is the mean of the two in the middle, where `torch.median` gives
    the smaller one. It is NaN where a value is NaN.
    """
    return (values.median(dim=0).values - (-values).median(dim=0).values) / 2


class _PerLoad(Metric):
    """Keeps one number a load and reduces them in the end."""

    full_state_update = False
    values: list[Tensor]

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("values", default=[], dist_reduce_fx="cat")

    def update(self, prediction: Tensor, batch: Sample) -> None:
        """Take in a batch."""
        self.values.append(self.measure(prediction.double(), batch))

    def compute(self) -> Tensor:
        """Return the number over all loads."""
        return self.reduce(dim_zero_cat(self.values))

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return a number for each load, (B,)."""
        raise NotImplementedError

    def reduce(self, values: Tensor) -> Tensor:
        """Return the number over all loads of (S,)."""
        raise NotImplementedError


class MeanError(_PerLoad):
    """e_mean = 1/(N S) sum_s ||u_s - v_s||, N degrees of freedom.

    It shrinks like 1/sqrt(N) under refinement: never compare it across meshes.
    """

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        return _error(prediction, batch).norm(dim=1) / prediction[0].numel()

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return values.mean()


class MaxError(_PerLoad):
    """e_max: the largest distance of a node from where it should be, over L."""

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        return (prediction - batch.displacement).norm(dim=2).amax(dim=1)

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return values.max()


class MinSNR(_PerLoad):
    """SNR_min in dB: 20 log10 of ||u||/||u - v|| of the worst load.

    The paper prints 10 log10, half of it, but its tables are in power dB; `printed` gives the
    formula as it stands there.
    """

    def __init__(self, *, printed: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.factor = 10 if printed else 20

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        ratio = prediction.flatten(1).norm(dim=1) / _error(prediction, batch).norm(dim=1)
        return self.factor * ratio.log10()

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return values.min()


class RelativeL2(_PerLoad):
    """||u - v|| / ||v||: median over loads, or the worst."""

    def __init__(self, *, worst: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.worst = worst

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        return _error(prediction, batch).norm(dim=1) / batch.displacement.flatten(1).norm(dim=1)

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return values.max() if self.worst else median(values)


class ResidualRatio(_PerLoad):
    """Median of ||R_free(u)|| / ||f||: how far from equilibrium."""

    def __init__(self, problem: Problem, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.problem = problem

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        ratio = self.problem.at(batch.poisson).relative_residual(prediction, batch.force)
        return torch.nan_to_num(ratio, nan=torch.inf)

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return median(values)


class MinVolumeRatio(_PerLoad):
    """min det F over quadrature points and loads; not above 0: something is inverted."""

    def __init__(self, problem: Problem, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.problem = problem

    def measure(self, prediction: Tensor, batch: Sample) -> Tensor:
        """See `_PerLoad`."""
        return self.problem.volume_ratio(prediction)

    def reduce(self, values: Tensor) -> Tensor:
        """See `_PerLoad`."""
        return values.min()


def default_metrics(problem: Problem) -> MetricCollection:
    """Return all of them, named as in the tables."""
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
        compute_groups=False,
    )


def _error(prediction: Tensor, batch: Sample) -> Tensor:
    return (prediction - batch.displacement).flatten(1)


class PerLoadErrors(NamedTuple):
    """How wrong the answers to some loads are.

    Attributes:
        relative: Relative L2 errors, (B,) [-].
        largest: Largest distance of a node from where it should be, over L, (B,) [-].
        size: Largest true displacement over L, (B,) [-].
    """

    relative: Tensor
    largest: Tensor
    size: Tensor

    def chosen(self, loads: int) -> list[int]:
        """Return so many with the largest relative error, so many others with the largest absolute.

        And a typical one, the median of the rest.
        """
        relative, largest = self._order(self.relative), self._order(self.largest)
        most = relative[:loads]
        most += [load for load in largest if load not in most][:loads]
        rest = [load for load in relative if load not in most]
        return [*most, *rest[len(rest) // 2 :][:1]]

    @property
    def farthest(self) -> int:
        """The load with the largest absolute error."""
        return self._order(self.largest)[0]

    def title(self, load: int) -> str:
        """Return what is said of a load, and how many are worse."""
        orders = self._order(self.relative), self._order(self.largest)
        first, second = (_rank(order.index(load) + 1, len(order)) for order in orders)
        return (
            f"load {load}, moved by {self.size[load]:.2g} L\n"
            f"relative L2 {100 * self.relative[load]:.3g} %: {first}\n"
            f"largest error {self.largest[load]:.2g} L: {second}"
        )

    @staticmethod
    def _order(errors: Tensor) -> list[int]:
        """Return loads, the worst first; what is no number is worst of all."""
        known = torch.nan_to_num(errors, nan=torch.inf)
        return known.argsort(descending=True, stable=True).tolist()


def _rank(place: int, count: int) -> str:
    return ORDINALS.get(place, f"{place - 1} of {count} are worse")
