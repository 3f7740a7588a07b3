"""Expected times of the runs of the paper's tables, from the times in published tables."""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from benchmarks.loss_table import LossRow
from benchmarks.paper_runs import Run
from benchmarks.paper_tables import Result
from benchmarks.tables import read

LOSSES = "losses"  # folder of runs, and stem of their table, whose rows are medians over seeds


def expected_minutes(runs: Sequence[Run], results: Path) -> dict[str, float]:
    """Return the minutes of training of runs by path; unknown ones are left out.

    They are those of the row of the same name in the table of its experiment. A run without such a
    row takes the mean over other experiments, if one of them has the name.

    Args:
        runs: The runs.
        results: Folder with tables `EXPERIMENT.csv`.
    """
    known: dict[str, float] = {}
    for folder in sorted({folder_of(run) for run in runs}):
        for row in _rows(folder, results):
            name = row.runs if isinstance(row, LossRow) else row.method
            if row.training_minutes is not None:
                known[f"{folder}/{name}"] = row.training_minutes
    found = {}
    for run in runs:
        path = run.path.rpartition("-")[0] if folder_of(run) == LOSSES else run.path
        name = path.rpartition("/")[2]
        others = [minutes for key, minutes in known.items() if key.rpartition("/")[2] == name]
        if others:
            found[run.path] = known.get(path, mean(others))
    return found


def data_minutes(runs: Sequence[Run], results: Path) -> float:
    """Return the minutes in which the data sets of runs were solved, each counted once."""
    tables = [_rows(folder, results) for folder in {folder_of(run) for run in runs}]
    minutes = [
        [row.generation_minutes or 0.0 for row in rows if isinstance(row, Result)]
        for rows in tables
    ]
    return sum(max(table, default=0.0) for table in minutes)


def folder_of(run: Run) -> str:
    """Return the first folder of the path of a run."""
    return run.path.partition("/")[0]


def _rows(folder: str, results: Path) -> Sequence[Result | LossRow]:
    """Return the rows of the table of a folder of runs; none without a table."""
    path = results / f"{folder}.csv"
    if not path.is_file():
        return []
    return read(LossRow, path) if folder == LOSSES else read(Result, path)
