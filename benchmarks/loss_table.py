"""Table of losses: errors of runs that differ in their loss, medians over their seeds."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.methods import training_minutes
from dpl.evaluation.tables import PREDICTION
from dpl.training.metrics import median

METRICS = ("e_mean", "e_max", "SNR_min", "rel_L2_median", "rel_L2_worst", "residual")
HYBRID = "paper's hybrid"  # begins the name of its row in an evaluation


@dataclass(frozen=True)
class LossRow:
    """Medians over the runs of a loss with different seeds."""

    runs: str  # common name of the runs, network and loss
    seeds: int  # number of runs
    # e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst, residual: See `dpl.training.metrics`; of
    # the test loads
    e_mean: float
    e_max: float
    SNR_min: float
    rel_L2_median: float
    rel_L2_worst: float
    residual: float
    hybrid_iterations: float  # mean iterations of the paper's hybrid from the predictions
    training_minutes: float  # wall time of a training [min]


def numbers(folder: Path) -> list[float]:
    """Return the numbers of a run in the order of `LossRow`; NaN where one is unknown."""
    rows = {row["solver"]: row for row in json.loads((folder / "evaluation.json").read_text())}
    errors = rows[PREDICTION]["errors"]
    hybrids = [row["iterations"] for name, row in rows.items() if name.startswith(HYBRID)]
    minutes = training_minutes(folder)
    return [
        *(float(errors.get(name, math.nan)) for name in METRICS),
        float(hybrids[0]) if hybrids else math.nan,
        math.nan if minutes is None else minutes,
    ]


def summaries(runs: Mapping[str, Sequence[float]]) -> list[LossRow]:
    """Return a row for each group of runs whose names differ only in the seed at their end."""
    groups: dict[str, list[Sequence[float]]] = {}
    for name, values in runs.items():
        stem, _, seed = name.rpartition("-")
        groups.setdefault(stem if stem and seed.isdigit() else name, []).append(values)
    return [
        LossRow(name, len(members), *median(torch.tensor(members, dtype=torch.float64)).tolist())
        for name, members in groups.items()
    ]
