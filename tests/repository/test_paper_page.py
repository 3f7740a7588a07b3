"""The pages about the paper: all of its experiments, and the displacements of the test loads."""

import csv
import re
import statistics
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAPER = (ROOT / "docs" / "paper.md").read_text()
MEASUREMENTS = (ROOT / "docs" / "measurements.md").read_text()


def section(page: str, heading: str) -> str:
    """Return the text below a heading."""
    return page.split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]


def test_all_four_experiments_stand_against_the_paper():
    named = re.findall(r"^\| \S+, `(\w+)` \| paper", section(PAPER, "Against the paper"), re.M)
    assert named == ["beam_svk", "propeller_nh", "beam_nh_loss", "beam_young"]


@pytest.mark.parametrize("body", ["beam_svk", "propeller_nh"])
def test_the_displacements_of_the_test_loads_are_those_of_the_results(body):
    with (ROOT / "benchmarks/results/deflections.csv").open(newline="") as file:
        rows = [float(row["deflection"]) for row in csv.DictReader(file) if row["body"] == body]
    assert len(rows) == 100
    text = section(MEASUREMENTS, "Displacements of the test loads")
    cells = re.search(rf"^\| `{body}` \| [\d.]+ \| (.*) \|$", text, re.M)[1].split(" | ")
    assert [float(cell) for cell in cells] == [
        float(f"{value:.2g}")
        for value in (
            min(rows),
            statistics.median(rows),
            max(rows),
            sum(row < 0.01 for row in rows),
            sum(row > 0.2 for row in rows),
        )
    ]
