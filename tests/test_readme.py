"""The tables of README are those of `results/`."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def table(heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading, without its first two lines."""
    below = README.split(f"## {heading}\n", 1)[1]
    lines = [line for line in below.split("\n## ", 1)[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def measured(experiment: str, method: str) -> dict[str, str]:
    """Return the row of a method on the loads in range."""
    with (ROOT / "results" / f"{experiment}.csv").open(newline="") as file:
        rows = {(row["method"], row["loads"]): row for row in csv.DictReader(file)}
    return rows[method, "in range"]


def paper_rows() -> list[tuple[str, list[str]]]:
    """Return the rows against the paper, each with its experiment."""
    rows, experiment = [], ""
    for cells in table("Against the paper"):
        named = re.search("`(.+)`", cells[0])
        experiment = named[1] if named else experiment
        rows.append((experiment, cells[1:]))
    return rows


@pytest.mark.parametrize(("experiment", "cells"), paper_rows())
def test_a_row_against_the_paper_is_that_of_the_results(experiment, cells):
    method, samples, weights, *errors = cells
    row = measured(experiment, method)
    assert samples == f"{int(row['samples']):,}"
    assert errors[:2] == [f"{float(row[name]):.1e}" for name in ("e_mean", "e_max")]
    assert errors[2] == f"{float(row['SNR_min']):.1f}"
    if method != "paper":
        assert weights == f"{int(row['parameters']) / 1e6:.2f} M"


def test_all_four_experiments_stand_against_the_paper():
    assert len({experiment for experiment, _ in paper_rows()}) == 4


def test_what_is_said_of_run_time_against_error_is_in_its_table():
    with (ROOT / "results/accuracy_beam_svk.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["threads"] == "1"]
    text = README.split("## Run time against error", 1)[1]
    hybrid, newton = re.search(
        r"an error of 1e-6 takes (\d+) ms, and Newton from rest (\d+) ms", text
    ).groups()

    def reached(solver: str) -> float:
        below = [row for row in rows if row["solver"] == solver and float(row["error"]) < 1e-6]
        return min(float(row["ms"]) for row in below)

    assert int(hybrid) == round(reached("latent, hybrid"))
    assert int(newton) == round(
        min(reached(f"Newton to {tol}") for tol in ("0.001", "1e-06", "1e-08"))
    )
