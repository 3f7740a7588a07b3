"""Errors, run times and sizes of all methods on one scene and three sets of loads."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.methods import Method
from benchmarks.samples import scaled, solved
from benchmarks.study import dots, dots_legend, method_colours, picture, read
from dpl import Sample, Scene
from dpl.evaluation import latency
from dpl.fem import Newton
from dpl.system.threads import one_thread
from dpl.training.metrics import errors_of

# Odot, Haferssas, Cotin (2022), tables 1 to 3: e_mean, e_max, SNR_min [dB], samples. Experiments 3
# and 3b differ in the range of Young's modulus, on which only networks with E as an input depend.
PAPER: dict[str, dict[str, tuple[float, float | None, float | None, int | None]]] = {
    "beam_svk": {"paper": (8.0e-6, 0.03, 8.4, 4095)},
    "propeller_nh": {"paper": (2.7e-6, 0.01, 18.9, 4095)},
    "beam_nh_loss": {
        "paper": (7.7e-6, 0.03, 2.7, 4095),  # with L_r^*
        "paper, mse": (5.2e-5, 0.05, -5.1, 4095),
    },
    "beam_young": {"paper": (4.6e-5, 0.09, -2.6, 10650), "paper, 3b": (1e-4, None, None, None)},
    "beam_young_wide": {"paper": (1e-4, None, None, None)},  # "at best"
}
# Odot, Haferssas, Cotin (2022), tables 2, 4 and 6: e_mean, e_max, SNR [dB] of one load
PAPER_SINGLE: dict[str, dict[str, tuple[float, float, float]]] = {
    "beam_svk": {
        "paper, beam (a)": (5.4e-5, 0.037, 22.2),
        "paper, beam (b)": (6.6e-6, 0.0050, 40.2),
    },
    "propeller_nh": {
        "paper, propeller (c)": (2.82e-6, 0.0036, 33.9),
        "paper, propeller (d)": (8.2e-7, 0.0008, 42.3),
    },
    "beam_nh_loss": {
        "paper, L_r^* (a)": (6.1e-6, 0.027, 38.21),
        "paper, L_r^* (b)": (1.5e-5, 0.034, 34.7),
        "paper, MSE (c)": (5.3e-5, 0.034, 25.42),
        "paper, MSE (d)": (5.5e-5, 0.037, 24.9),
    },
    "beam_young": {
        "paper, beam (a)": (3.9e-5, 0.028, 25.66),
        "paper, beam (b)": (4.8e-5, 0.038, 25.42),
        "paper, beam (c)": (4.1e-5, 0.034, 24.25),
        "paper, beam (d)": (6.8e-5, 0.060, 23.73),
    },
}
ONE = "one load"  # name of the set of a single test load
STREAMS = {"twice": 4, "small": 5}  # of loads; those of samples and scales are below
CORRECTED = " corrected"  # ends the name of a network that is corrected
PLAIN = "_plain"  # ends the name of a network without the linear solution
TITLES = {
    "in range": "loads in range",
    "twice": "one to two times the range",
    "small": "1 to 10 % of the range",
}


@dataclass(frozen=True)
class Result:
    """One method on one set of loads."""

    method: str  # its name
    # name of the set: "in range", "twice" (one to two times the amplitude) or "small" (1 to 10 % of
    # it)
    loads: str
    count: int  # loads in the set
    samples: int | None = None  # solved loads that it learnt from
    generation_minutes: float | None = None  # wall time in which those were solved
    training_minutes: float | None = None  # wall time of the training, or of the making of a basis
    parameters: int | None = None  # numbers that were trained
    # e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst, residual, min_det_F: See
    # `dpl.training.metrics`
    e_mean: float | None = None
    e_max: float | None = None
    SNR_min: float | None = None
    rel_L2_median: float | None = None
    rel_L2_worst: float | None = None
    residual: float | None = None
    min_det_F: float | None = None
    # median latency of the bare network, see `dpl.evaluation.timing`: force in, displacement out,
    # nothing checked [ms]
    ms: float | None = None
    ms_p99: float | None = None  # 99th percentile of the same [ms]
    # mean iterations of Newton from it to the scene's tolerance, in range
    newton_iterations: float | None = None


def one_load(test: Sample, deflection: float) -> dict[str, Sample]:
    """Return the test load whose largest nodal displacement over L is nearest to a number [-]."""
    largest = test.displacement.norm(dim=2).amax(dim=1)
    k = int((largest - deflection).abs().argmin())
    print(f"test load {k}: largest nodal displacement {float(largest[k]):.4g} L")
    return {ONE: Sample(*(column[k : k + 1] for column in test))}


def load_sets(scene: Scene, test: Sample, count: int = 50) -> dict[str, Sample]:
    """Return the test loads in range and further solved loads out of range.

    Loads that have no stable answer are left out.
    """
    part = torch.linspace(0, 1, count, dtype=torch.float64)
    factors = {"twice": 1 + part, "small": 10.0 ** (part - 2)}
    sets = {name: solved(scene, scaled(scene, STREAMS[name], f)) for name, f in factors.items()}
    return {"in range": test, **sets}


def measure(
    methods: Mapping[str, Method],
    sets: Mapping[str, Sample],
    newton: Newton,
    *,
    generation_minutes: float | None = None,
    repeats: int = 3,
) -> Iterator[Result]:
    """Yield a row for each method and set of loads.

    Loads are predicted one at a time on one thread. Each method predicts all loads of a set in
    succession, as in use, so that its weights stay in the cache.
    """
    for title, batch in sets.items():
        singles = batch.load.unbatch()
        with one_thread(), torch.inference_mode():
            for name, method in methods.items():
                answer = torch.cat([method.predict(load) for load in singles])
                taken = latency(method.predict, singles, repeats=repeats)
                iterations = None
                if title not in STREAMS:
                    pairs = zip(singles, answer, strict=True)
                    ends = [list(newton.iterate(load, guess=u[None]))[-1] for load, u in pairs]
                    iterations = sum(int(end.iterations[0]) for end in ends) / len(ends)
                errors = errors_of(newton.problem, answer, batch)
                known = {field.name for field in fields(Result)}
                numbers = {name: error for name, error in errors.items() if name in known}
                yield Result(
                    method=name,
                    loads=title,
                    count=len(singles),
                    samples=method.samples,
                    generation_minutes=generation_minutes if method.samples else None,
                    training_minutes=method.training_minutes,
                    parameters=method.parameters,
                    ms=taken.p50,
                    ms_p99=taken.p99,
                    newton_iterations=iterations,
                    **numbers,
                )


def paper(experiment: str, *, single: bool = False) -> list[Result]:
    """Return the rows of the paper for an experiment, or for its single loads, if it has any."""
    known: Mapping[str, Mapping[str, tuple[Any, ...]]] = PAPER_SINGLE if single else PAPER
    title, count = (ONE, 1) if single else ("in range", 100)
    rows = []
    for name, (e_mean, e_max, snr, *samples) in known.get(experiment, {}).items():
        error = None if snr is None else 10 ** (-snr / 20)
        learnt = next(iter(samples), None)
        row = Result(name, title, count, learnt, e_mean=e_mean, e_max=e_max, SNR_min=snr)
        middle = error if single else None
        rows.append(replace(row, rel_L2_median=middle, rel_L2_worst=error))
    return rows


def with_kept_rows(rows: Sequence[Result], path: Path) -> list[Result]:
    """Return rows with those of other methods that a file has, ordered by the sets of loads."""
    measured = {row.method for row in rows}
    earlier = read(Result, path) if path.is_file() else []
    kept = [row for row in earlier if row.method not in measured]
    order = list(dict.fromkeys(row.loads for row in [*rows, *kept]))
    return sorted([*rows, *kept], key=lambda row: order.index(row.loads))


def draw(rows: Sequence[Result], path: Path) -> None:
    """Draw median and largest error of each method, a panel for each set of loads."""
    methods = [name for name in dict.fromkeys(row.method for row in rows)]
    known = {(row.method, row.loads): row for row in rows}
    sets = list(dict.fromkeys(row.loads for row in rows))
    colours = list(method_colours(methods).values())
    with picture(path, 0.21 * len(methods) + 1.1) as figure:
        axes = figure.subplots(1, len(sets), sharey=True, squeeze=False)[0]
        for ax, title in zip(axes, sets, strict=True):
            own = [known.get((method, title)) for method in methods]
            dots(
                ax,
                methods,
                [row.rel_L2_median if row else None for row in own],
                [row.rel_L2_worst if row else None for row in own],
                colours,
            )
            ax.set(xscale="log", xlabel="relative L2 error")
            low, high = np.log10(ax.get_xlim())
            ax.set_xlim(10 ** np.floor(low), 10 ** np.ceil(high))  # whole decades have labels
            ax.xaxis.set_minor_formatter("")
            ax.set_title(TITLES.get(title, title))
        dots_legend(figure, "median of the loads", "largest")
