"""One large load: errors of all networks beside those of the paper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.study import dots, method_colours, picture
from dpl import Sample
from dpl.inference.hybrid import Predict
from dpl.system.threads import one_thread
from dpl.training import metrics

# Odot, Haferssas, Cotin (2022), tables 2, 4 and 6: e_mean, e_max, SNR [dB]
PAPER: dict[str, dict[str, tuple[float, float, float]]] = {
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


@dataclass(frozen=True)
class SingleLoad:
    """Errors of one method for one load."""

    method: str  # name of the method
    load: int | None = None  # number of the test load; None for the loads of the paper
    deflection: float | None = None  # largest nodal displacement over L [-]
    e_mean: float | None = None  # norm of the error over the number of degrees of freedom [-]
    e_max: float | None = None  # largest nodal error over L [-]
    SNR: float | None = None  # signal-to-noise ratio [dB]
    rel_L2: float | None = None  # norm of the error over that of the displacement [-]


def largest_displacements(test: Sample) -> Tensor:
    """Return the largest nodal displacement of each load, (S,) [-]."""
    return test.displacement.norm(dim=2).amax(dim=1)


def choose(test: Sample, deflection: float) -> int:
    """Return the load whose largest nodal displacement over L is nearest to a deflection [-]."""
    return int((largest_displacements(test) - deflection).abs().argmin())


def measure(predictions: Mapping[str, Predict], test: Sample, load: int) -> list[SingleLoad]:
    """Return a row of each method for one load."""
    single = Sample(*(column[load : load + 1] for column in test))
    deflection = float(largest_displacements(single))
    errors = (
        metrics.mean_errors,
        metrics.largest_errors,
        metrics.signal_to_noise,
        metrics.relative_errors,
    )
    rows = []
    with one_thread(), torch.inference_mode():
        for name, predict in predictions.items():
            found = predict(single.load)
            numbers = (float(error(found, single)) for error in errors)
            rows.append(SingleLoad(name, load, deflection, *numbers))
    return rows


def paper(experiment: str) -> list[SingleLoad]:
    """Return the rows of the paper for an experiment; empty if the paper has none."""
    return [
        SingleLoad(name, e_mean=e_mean, e_max=e_max, SNR=snr, rel_L2=10 ** (-snr / 20))
        for name, (e_mean, e_max, snr) in PAPER.get(experiment, {}).items()
    ]


def draw(rows: Sequence[SingleLoad], path: Path) -> None:
    """Draw the signal-to-noise ratio of each method and of the loads of the paper."""
    with picture(path, 0.21 * len(rows) + 0.8) as figure:
        ax = figure.subplots()
        names = [row.method for row in rows]
        colours = list(method_colours(names).values())
        dots(ax, names, [row.SNR for row in rows], [None] * len(rows), colours)
        ax.set(xlabel="signal-to-noise ratio of one load [dB]", xlim=(0, None))
