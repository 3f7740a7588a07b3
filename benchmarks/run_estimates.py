"""Expected times of the runs of the paper's tables, from the times in published tables."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean

from benchmarks.paper_runs import Run

LOSSES = "losses"  # table of the runs of that folder; its rows are means over seeds


def estimates(runs: Sequence[Run], results: Path) -> dict[str, float]:
    """Return the expected minutes of training of runs by path; unknown ones are left out.

    They are those of the row of the same name in the table of its experiment. A run without such a
    row takes the mean over other experiments, if one of them has the name.

    Args:
        runs: The runs.
        results: Folder with tables `EXPERIMENT.csv`.
    """
    folders = {folder_of(run) for run in runs}
    known = {
        f"{folder}/{name}": minutes
        for folder in folders
        for name, minutes in _training_minutes(results / f"{folder}.csv")
    }
    found = {}
    for run in runs:
        path = run.path.rpartition("-")[0] if folder_of(run) == LOSSES else run.path
        name = path.rpartition("/")[2]
        others = [minutes for key, minutes in known.items() if key.rpartition("/")[2] == name]
        if path in known or others:
            found[run.path] = known.get(path) or mean(others)
    return found


def data_minutes(runs: Sequence[Run], results: Path) -> float:
    """Return the minutes that the data sets of runs took, each counted once."""
    folders = {folder_of(run) for run in runs}
    return sum(max(_generation_minutes(results / f"{name}.csv"), default=0) for name in folders)


def folder_of(run: Run) -> str:
    """Return the first folder of the path of a run."""
    return run.path.partition("/")[0]


def _training_minutes(path: Path) -> Iterator[tuple[str, float]]:
    for row in _rows(path):
        if minutes := row.get("training_minutes"):
            yield row.get("method") or row["runs"], float(minutes)


def _generation_minutes(path: Path) -> Iterator[float]:
    return (
        float(row["generation_minutes"]) for row in _rows(path) if row.get("generation_minutes")
    )


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
