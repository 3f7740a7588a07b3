"""Table of evaluated runs, named by the options in which they differ."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from dpl import config
from dpl.evaluation.report import PREDICTION, TOLS, newton_row, simulator_row
from dpl.evaluation.tables import power, share, show_cells
from dpl.evaluation.timing import SIMULATOR
from dpl.training.metrics import median

SEED = re.compile(r",?\s*seed=\d+")
MAX_NAME = 34  # characters of the name of a run
ERRORS = ("rel_L2_median", "rel_L2_worst", "e_mean")


def compare(folder: Path) -> None:
    """Print errors and times of all evaluated runs below a folder.

    Runs that differ only in `seed` form a group, for which medians are printed. The times are
    those of `sim(force, tol=...)` over those of Newton's method from rest to the same residual.

    Raises:
        FileNotFoundError: No run below the folder has been evaluated.
        ValueError: An evaluation has other rows.
    """
    found = sorted(folder.rglob("evaluation.json"))
    if not found:
        raise FileNotFoundError(f"{folder} contains no evaluated run")
    options = [config.options_of_run(path.parent) for path in found]
    names = run_names([str(path.parent.relative_to(folder)) for path in found], options)
    runs: list[list[str]] = []
    groups: dict[str, list[tuple[str, list[float]]]] = {}
    for path, name, own in zip(found, names, options, strict=True):
        rows = {row["solver"]: row for row in json.loads(path.read_text())}
        if PREDICTION not in rows:
            raise ValueError(f"{path} has no row {PREDICTION}; run evaluate.py run={path.parent}")
        numbers = _numbers(rows)
        runs.append([_short(name), *_cells(numbers)])
        groups.setdefault(_group(name, own), []).append((name, numbers))
    medians = []
    for members in groups.values():
        if len(members) > 1:
            name = SEED.sub("", members[0][0]).strip(", :")
            middle = median(torch.tensor([numbers for _, numbers in members])).tolist()
            medians.append([_short(f"median of {len(members)}: {name}"), *_cells(middle)])
    times = [f"sim/Newton tol={power(tol)}" for tol in TOLS]
    columns = ("", "median error", "worst error", "e_mean", "ms sim(force)", *times)
    show_cells(f"runs below {folder}", columns, runs, *([medians] if medians else []))


def _numbers(rows: Mapping[str, Any]) -> list[float]:
    """Return the numbers of a run from the rows of its evaluation by solver; NaN if unknown."""
    prediction = rows[PREDICTION]
    latency = prediction["latency"].get(SIMULATOR, {}).get("p50", math.nan)
    ratios = []
    for tol in TOLS:
        times = [rows.get(row(tol), {}).get("ms", math.nan) for row in (simulator_row, newton_row)]
        ratios.append(times[0] / times[1])
    return [*(prediction["errors"][name] for name in ERRORS), latency, *ratios]


def _cells(numbers: list[float]) -> list[str]:
    middle, worst, e_mean, *times = numbers
    return [share(middle), share(worst), f"{e_mean:.1e}", *(f"{time:.2g}" for time in times)]


def run_names(folders: Sequence[str], options: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return names of runs: their folders, and as many options in which they differ as fit.

    The folder of a job of a sweep names these options already.

    Args:
        folders: Folders of the runs.
        options: Hyperparameters of each run.
    """
    if all("=" in folder for folder in folders) or len(folders) < 2:
        return list(folders)
    shared = set.intersection(*(set(one) for one in options))
    order = sorted((key for key in options[0] if key in shared), key=lambda key: key.count("."))
    differ = [key for key in order if len({str(one[key]) for one in options}) > 1]
    return [
        _with_options(folder, [f"{key}={one[key]}" for key in differ])
        for folder, one in zip(folders, options, strict=True)
    ]


def _with_options(folder: str, options: list[str]) -> str:
    """Return the name of a run with as many options as fit."""
    name = folder
    for number, option in enumerate(options):
        longer = f"{name}{', ' if number else ': '}{option}"
        if len(longer) > MAX_NAME:
            break
        name = longer
    return name


def _group(name: str, options: Mapping[str, Any]) -> str:
    """Return a text that is equal for runs that differ only in seeds.

    It contains the options of a run, or its name if these are unknown.
    """
    kept = {key: value for key, value in options.items() if not key.endswith("seed")}
    return json.dumps(kept, sort_keys=True, default=str) if kept else SEED.sub("", name)


def _short(name: str) -> str:
    """Return a name without its middle part if it is long."""
    half = MAX_NAME // 2 - 1
    return name if len(name) <= MAX_NAME else f"{name[:half]}...{name[-half:]}"
