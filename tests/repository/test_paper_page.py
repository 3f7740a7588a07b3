"""The numbers against the paper are those of `benchmarks/results/`."""

import csv
import re
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "paper.md").read_text()


def table(heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading, without its first two lines."""
    below = PAGE.split(f"## {heading}\n", 1)[1]
    lines = [line for line in below.split("\n## ", 1)[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def measured(experiment: str, method: str) -> dict[str, str]:
    """Return the row of a method on the loads in range."""
    with (ROOT / "benchmarks/results" / f"{experiment}.csv").open(newline="") as file:
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
    title, samples, weights, *errors = cells
    method = title.partition(", ")[0]
    row = measured(experiment, method)
    assert samples == f"{int(row['samples']):,}"
    assert errors[:2] == [f"{float(row[name]):.1e}" for name in ("e_mean", "e_max")]
    assert errors[2] == f"{float(row['SNR_min']):.1f}"
    if method != "paper":
        count = int(row["parameters"])
        assert weights == (f"{count / 1e6:.2f} M" if count else "none")


def test_all_four_experiments_stand_against_the_paper():
    assert len({experiment for experiment, _ in paper_rows()}) == 4


def test_a_row_that_is_worse_than_the_network_alone_says_why():
    rows = {(experiment, cells[0].partition(", ")[0]): cells for experiment, cells in paper_rows()}
    for (experiment, method), cells in rows.items():
        if not method.endswith(" corrected"):
            continue
        alone = rows[experiment, method.removesuffix(" corrected")]
        assert ("too few modes: see below" in cells[0]) == (float(cells[3]) > float(alone[3]))


def test_what_is_said_of_experiment_4_is_in_its_table():
    with (ROOT / "benchmarks/results/hybrid_newton.csv").open(newline="") as file:
        rows = {
            (row["solver"], row["network"], row["loads"]): row
            for row in csv.DictReader(file)
            if row["tol"] in ("", "1e-06")
        }
    (text,) = (part for part in PAGE.split("\n\n") if part.startswith("Experiment 4"))
    found = re.search(
        r"plain Newton converges on (\d+) and its hybrid on (\d+) of its (\d+) loads; on\sour "
        r"(\d+) loads our hybrid converges on (\d+), and plain Newton converges on (\d+) as well",
        text,
    )
    both = "in range and twice"
    expected = [
        rows["paper: Newton", "", both]["converged"],
        rows["paper: hybrid Newton", "", both]["converged"],
        rows["paper: Newton", "", both]["count"],
        rows["plain Newton", "", both]["count"],
        rows["hybrid, best rule", "fcnn", both]["converged"],
        rows["plain Newton", "", both]["converged"],
    ]
    assert list(found.groups()) == expected


def test_what_is_said_of_deflections_is_in_their_table():
    with (ROOT / "benchmarks/results/deflections.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = re.findall(r"median of (\S+) L and a maximum of (\S+) L on the (beam|propeller)", PAGE)
    assert [body for *_, body in found] == ["beam", "propeller"]
    for middle, largest, body in found:
        values = [float(row["deflection"]) for row in rows if row["body"].startswith(body)]
        assert len(values) == 100
        assert (middle, largest) == (f"{statistics.median(values):.2g}", f"{max(values):.2g}")
