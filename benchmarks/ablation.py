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
    """A variant of the model."""

    name: str  # its name
    options: Mapping[str, Any] = field(default_factory=dict)  # arguments of `Unrolled` that differ
    # returns a context in which the variant is fitted and evaluated
    change: Callable[[], AbstractContextManager[Any]] = nullcontext

    @property
    def is_whole(self) -> bool:
        """True if nothing differs from the configured model."""
        return self == WHOLE


WHOLE = Variant("all")


@dataclass(frozen=True)
class Row:
    """Errors of one variant on one set of loads."""

    part: str  # "learning curve", "ablation" or "other loads"
    variant: str  # name of the variant or of the set of loads
    samples: int  # number of loads that it was fitted to
    count: int  # number of loads on which the errors were measured
    # e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst: See `dpl.training.metrics`
    e_mean: float
    e_max: float
    SNR_min: float
    rel_L2_median: float
    rel_L2_worst: float
    e_mean_corrected: float  # e_mean after one step of Newton's method in the modes
    rel_L2_worst_corrected: float  # largest relative error after this step
    fit_seconds: float  # wall time of the fit on one thread [s]
    modes: int  # number of modes that the fit chose
    # wall time in which the loads of the fit were solved [s]; None if not recorded
    data_seconds: float | None = None


def variants(options: Mapping[str, Sequence[Any]]) -> list[Variant]:
    """Return the variants of the ablation."""
    fixed = [
        WHOLE,
        Variant("without symmetry", {"symmetry": False}),
        *(Variant(f"{name} only", change=_OneStress(k)) for name, k in STRESSES.items()),
    ]
    sizes = [
        Variant(f"{name} = {value}", {name: value})
        for name, values in options.items()
        for value in values
    ]
    return fixed + sizes


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


def curve(
    build: Build, samples: Sample, held_out: Sample, test: Sample, counts: Sequence[int]
) -> Iterator[Row]:
    """Yield a row for each number of loads to which the model is fitted."""
    for count in counts:
        yield fitted(WHOLE, build, first(samples, count), held_out, test, CURVE)[0]


def fitted(
    variant: Variant, build: Build, samples: Sample, held_out: Sample, test: Sample, part: str
) -> tuple[Row, Unrolled]:
    """Fit a variant; return its row and the model."""
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
    """Yield the errors of a fitted model on loads of other sizes and on small areas."""
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
