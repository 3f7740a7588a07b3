"""Learning curve and ablation of `dpl.models.Unrolled`, and its errors on other loads."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks import paper_tables
from benchmarks.samples import first, solved
from dpl import Sample
from dpl.fem import Material, ModalLoads
from dpl.models import Unrolled
from dpl.models.unrolled.features import SampleCells
from dpl.system.threads import one_thread
from dpl.training import ErrorMetrics

Build = Callable[..., Unrolled]
OTHER_STREAM = 7  # of loads far out of range and of local loads
OTHER_SETS = {"small": "0.01 to 0.1 of the range", "twice": "1 to 2 times the range"}
LOCAL_RADIUS = 0.05  # largest radius of the area of local loads over L [-]
CURVE, ABLATION, OTHER_LOADS = PARTS = "learning curve", "ablation", "other loads"
STRESSES = {"R^T dP": 0, "dP": 1}  # position in the features


@dataclass(frozen=True)
class Variant:
    """A variant of the model.

    Attributes:
        name: Its name.
        options: Arguments of `Unrolled` that differ.
        change: Returns a context in which the variant is fitted and evaluated.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    change: Callable[[], AbstractContextManager[Any]] = nullcontext

    @property
    def is_whole(self) -> bool:
        """True if nothing differs from the configured model."""
        return self == WHOLE


WHOLE = Variant("all")


@dataclass(frozen=True)
class Row:
    """Errors of one variant on one set of loads.

    Attributes:
        part: "learning curve", "ablation" or "other loads".
        variant: Name of the variant or of the set of loads.
        samples: Number of loads that it was fitted to.
        count: Number of loads on which the errors were measured.
        e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst: See `dpl.training.metrics`.
        e_mean_corrected: e_mean after one step of Newton's method in the modes.
        rel_L2_worst_corrected: Largest relative error after this step.
        fit_seconds: Wall time of the fit on one thread [s].
        modes: Number of modes that the fit chose.
        data_seconds: Wall time in which the loads of the fit were solved [s]; None if not recorded.
    """

    part: str
    variant: str
    samples: int
    count: int
    e_mean: float
    e_max: float
    SNR_min: float
    rel_L2_median: float
    rel_L2_worst: float
    e_mean_corrected: float
    rel_L2_worst_corrected: float
    fit_seconds: float
    modes: int
    data_seconds: float | None = None


def variants(options: Mapping[str, Sequence[Any]]) -> list[Variant]:
    """Return the variants of the ablation.

    Args:
        options: Values of arguments of `Unrolled` that are tried, one variant each.
    """
    fixed = [
        WHOLE,
        Variant("without symmetry", {"symmetry": False}),
        Variant("H^T H / 2 in first map", change=quadratic_first_feature),
        *(Variant(f"{name} only", change=_OneStress(k)) for name, k in STRESSES.items()),
        Variant("float64, not rounded", change=without_rounding),
    ]
    sizes = [
        Variant(f"{name} = {value}", {name: value})
        for name, values in options.items()
        for value in values
    ]
    return fixed + sizes


def quadratic_first_feature() -> AbstractContextManager[Any]:
    """Return a context in which the first map takes H^T H / 2 instead of the rotated strain."""

    def first_features(cells: SampleCells, linear: Tensor) -> Tensor:
        D = cells.gradients.shape[-1]
        return (linear.mT @ linear / 2)[:, :, None, :D, :D]

    return mock.patch.object(SampleCells, "first_features", first_features)


@dataclass(frozen=True)
class _OneStress:
    """Context in which all features but one are zero, so that their maps are zero."""

    kept: int

    def __call__(self) -> AbstractContextManager[Any]:
        both = SampleCells.features

        def features(cells: SampleCells, law: Material, c: Tensor, linear: Tensor) -> Tensor:
            stress = both(cells, law, c, linear)
            one = torch.zeros_like(stress)
            one[:, :, self.kept] = stress[:, :, self.kept]
            return one

        return mock.patch.object(SampleCells, "features", features)


def without_rounding() -> AbstractContextManager[Any]:
    """Return a context in which modes, gradients and maps remain float64."""
    return mock.patch.object(torch.Tensor, "float", lambda tensor: tensor)


def curve(
    build: Build, samples: Sample, held_out: Sample, test: Sample, counts: Sequence[int]
) -> Iterator[Row]:
    """Yield a row for each number of loads to which the model is fitted."""
    for count in counts:
        yield fitted(WHOLE, build, first(samples, count), held_out, test, CURVE)[0]


def fitted(
    variant: Variant, build: Build, samples: Sample, held_out: Sample, test: Sample, part: str
) -> tuple[Row, Unrolled]:
    """Fit a variant; return its row and the model.

    Args:
        variant: The variant.
        build: Returns a model of arguments of `Unrolled`.
        samples, held_out, test: Samples to fit to, to choose by, and for the errors.
        part: See `Row`.
    """
    # compiled loops have features and precision of their own, which no variant changes
    without_loops = mock.patch.object(Unrolled, "_is_compiled", return_value=False)
    with variant.change(), without_loops, one_thread():
        net = build(**variant.options)
        start = time.perf_counter()
        net.fit(samples, held_out)
        seconds = time.perf_counter() - start
        found = errors(net, test) | {"fit_seconds": seconds, "modes": net.modes.shape[1]}
        row = Row(part, variant.name, len(samples.force), **found)
    return row, net


def other_loads(net: Unrolled, row: Row, test: Sample, count: int) -> Iterator[Row]:
    """Yield the errors of a fitted model on loads of other sizes and on small areas.

    Args:
        net: The model.
        row: Its row in the ablation.
        test: Loads in range.
        count: Number of loads of each set.
    """
    scene, stream = net.scene, (0, OTHER_STREAM)
    sets = paper_tables.load_sets(scene, test, count)
    found = {title: sets[name] for name, title in OTHER_SETS.items()}
    drawn = scene.loads.sample(stream, range(count))
    found["3 times the range"] = solved(scene, drawn._replace(force=3 * drawn.force))
    if isinstance(scene.loads, ModalLoads):
        local = replace(scene.loads, patch_radius=(0.0, LOCAL_RADIUS))
        title = f"areas up to {LOCAL_RADIUS:g} L"
        found[title] = solved(scene, local.sample(stream, range(count)))
    for title, samples in found.items():
        if len(samples.force):
            with one_thread():
                yield replace(row, part=OTHER_LOADS, variant=title, **errors(net, samples))


def errors(net: Unrolled, samples: Sample) -> dict[str, Any]:
    """Return the errors of a model, before and after one step in its modes, by name of `Row`."""
    own = (samples.parameters,) if net.extra_inputs else ()
    with torch.inference_mode():
        predicted = net(samples.force, *own)
        solver = net.correction()
        corrected = predicted
        if solver is not None:
            pairs = zip(samples.load.unbatch(), predicted, strict=True)
            steps = [
                list(solver.states(load, guess=u[None], max_iter=1, error_tol=0.0))[-1]
                for load, u in pairs
            ]
            corrected = torch.stack([state.displacement[0] for state in steps])
    before, after = (_metrics(net, u, samples) for u in (predicted, corrected))
    known = {one.name for one in fields(Row)}
    return {
        "count": len(samples.force),
        **{name: value for name, value in before.items() if name in known},
        "e_mean_corrected": after["e_mean"],
        "rel_L2_worst_corrected": after["rel_L2_worst"],
    }


def _metrics(net: Unrolled, predicted: Tensor, samples: Sample) -> dict[str, float]:
    metrics = ErrorMetrics(net.scene.problem)
    metrics.update(predicted, samples)
    return {name: float(value) for name, value in metrics.compute().items()}
