"""Table of evaluated runs, with a column for each option in which they differ."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpl import config
from dpl.evaluation.tables import (
    PREDICTION,
    SIMULATOR,
    TOLS,
    newton_row,
    power,
    share,
    show_cells,
    simulator_row,
)

WIDTH = 100  # columns of the terminal that the table fits
MIN_NAME = 16  # characters of the name of a run, beside which there is room for options
MAX_VALUE = 16  # characters of the value of an option
ERRORS = ("rel_L2_median", "rel_L2_worst", "e_mean")


def compare(folder: Path) -> None:
    """Print options, errors and times of all evaluated runs below a folder.

    Runs that differ only in `seed` form a group, for which medians are printed. The times are
    those of `sim(force, tol=...)` over those of Newton's method from rest to the same residual.

    Raises:
        FileNotFoundError: No run below the folder has been evaluated.
        ValueError: An evaluation has other rows.
    """
    if not (found := sorted(folder.rglob("evaluation.json"))):
        raise FileNotFoundError(f"{folder} contains no evaluated run")
    names = [str(path.parent.relative_to(folder)) for path in found]
    options = [config.options_of_run(path.parent) for path in found]
    numbers = [_numbers(path) for path in found]
    groups: dict[str, list[int]] = {}
    for k, (name, own) in enumerate(zip(names, options, strict=True)):
        kept = {key: value for key, value in own.items() if not key.endswith("seed")}
        key = json.dumps(kept, sort_keys=True, default=str) if kept else name
        groups.setdefault(key, []).append(k)
    several = [members for members in groups.values() if len(members) > 1]
    results = [_cells(own) for own in numbers]
    results += [_cells(np.median([numbers[k] for k in some], axis=0).tolist()) for some in several]

    times = [f"sim/ Newton tol={power(tol)}" for tol in TOLS]
    heads = ("median error", "worst error", "e_mean", "ms sim(force)", *times)
    room = WIDTH - sum(_width(*column) for column in zip(heads, *results, strict=True))
    shown = differing_options(names, options, room - MIN_NAME)
    room -= sum(_width(key, *values) for key, values in shown.items())
    rows = [
        [_short(name, room - 2), *values]
        for name, *values in zip(names, *shown.values(), strict=True)
    ]
    for some in several:
        cells = zip(*(rows[k][1:] for k in some), strict=True)
        same = [column[0] if len(set(column)) == 1 else "" for column in cells]
        rows.append([f"median of {len(some)}", *same])
    lines = [[*row, *result] for row, result in zip(rows, results, strict=True)]
    sections = [lines[: len(names)], lines[len(names) :]]
    show_cells(f"runs below {folder}", ("", *shown, *heads), *filter(None, sections))


def _numbers(path: Path) -> list[float]:
    """Return the numbers of a run from its evaluation; NaN if unknown."""
    rows = {row["solver"]: row for row in json.loads(path.read_text())}
    if PREDICTION not in rows:
        raise ValueError(f"{path} has no row {PREDICTION}; run evaluate.py run={path.parent}")
    prediction = rows[PREDICTION]
    latency = prediction["latency"].get(SIMULATOR, {}).get("p50", math.nan)
    times = {name: row.get("ms", math.nan) for name, row in rows.items()}
    names = [(simulator_row(tol), newton_row(tol)) for tol in TOLS]
    ratios = [times.get(ours, math.nan) / times.get(other, math.nan) for ours, other in names]
    return [*(prediction["errors"][name] for name in ERRORS), latency, *ratios]


def _cells(numbers: Sequence[float]) -> list[str]:
    middle, worst, e_mean, *times = numbers
    return [share(middle), share(worst), f"{e_mean:.1e}", *(f"{time:.2g}" for time in times)]


def differing_options(
    names: Sequence[str], options: Sequence[Mapping[str, Any]], room: int
) -> dict[str, list[str]]:
    """Return the values of the options in which runs differ, by the shortest unique ends of keys.

    The keys in the names of the runs, which are those of a sweep, come first. A key with the values
    of another key, from which it is interpolated, and keys for which a line of `room` characters
    has no place are left out. Options of a run are empty if they are unknown.
    """
    known = [one for one in options if one]
    shared = set.intersection(*(set(one) for one in known)) if known else set()
    values = {key: [str(one.get(key, "")) for one in options] for key in shared}
    differ = [key for key in values if len(set(values[key])) > 1]
    swept = {key: any(f"{key}-" in name for name in names) for key in differ}
    found: dict[str, list[str]] = {}
    for key in sorted(differ, key=lambda key: (not swept[key], key.count("."), key)):
        column = [_short(value, MAX_VALUE) for value in values[key]]
        if column in found.values():
            continue
        parts = key.split(".")
        ends = (".".join(parts[start:]) for start in reversed(range(len(parts))))
        counts = {end: sum(f".{one}".endswith(f".{end}") for one in differ) for end in ends}
        name = next((end for end, count in counts.items() if count == 1), key)
        if (room := room - _width(name, *column)) < 0:
            break
        found[name] = column
    return found


def _width(head: str, *cells: str) -> int:
    """Return the characters of a column, with the spaces beside it."""
    return 2 + max(map(len, (*head.split(), *cells)))


def _short(text: str, length: int) -> str:
    """Return a text without its middle part if it is longer than a length."""
    half = (length - 3) // 2
    return text if len(text) <= length else f"{text[:half]}...{text[-half:]}"
