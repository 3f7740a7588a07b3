"""Run the stress cases: python scripts/stress.py.

They are difficult and unsolvable tasks. Each case prints its task, its expected and its observed
outcome: as expected, reported (a failure that the package reports itself) or silently wrong. Only
the last is a defect; the exit status is then 1. An auditor checks every state of every solve.
Reference numbers stand beside the cases. Where no source is named, they were computed by an
independent finite-element program in NumPy.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from benchmarks import CONF
from benchmarks.stress import bodies, invalid_input, loads, networks, stability
from benchmarks.stress.case import (
    Case,
    CaseResult,
    Comparison,
    LoadLevel,
    Outcome,
    Verdict,
    run_case,
)
from benchmarks.study import write_machine
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables


def select_cases(wanted: Sequence[str] | None = None) -> list[Case]:
    """Return the cases of the mechanics and of predictors that stand for networks."""
    themes = loads, bodies, invalid_input, stability, networks
    every = [case for theme in themes for case in theme.cases()]
    found = sorted(every, key=lambda case: int(case.name[1:]) if case.name != "sweep" else 99)
    known = names(found)
    if unknown := [name for name in wanted or () if name not in known]:
        raise ValueError(f"{unknown[0]!r} is none of {', '.join(known)}")
    return [case for case in found if wanted is None or case.name in wanted]


def names(cases: Sequence[Case]) -> list[str]:
    """Return the distinct names of cases."""
    return list(dict.fromkeys(case.name for case in cases))


KEYS = ((Sequence[str] | None, "cases"),)
COLOURS = {"as expected": "green", "reported": "yellow", "silently wrong": "bold red"}


@command("stress", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Run the cases; rows are written after each case."""
    with config.error_in("cases"):
        cases = select_cases(cfg.cases)
    folder, console = Path(cfg.folder), Console(highlight=False)
    lines: list[CaseResult] = []
    numbers: list[Comparison] = []
    levels: list[LoadLevel] = []
    for k, case in enumerate(cases, 1):
        print(f"{k}/{len(cases)} {case.name}: {case.description} ...", end="\r", file=sys.stderr)
        line, outcome = run_case(case)
        lines.append(line)
        numbers += [
            Comparison(case.name, case.description, row.quantity, row.reference, row.value,
                       row.difference, row.holds)
            for row in outcome.rows
        ]  # fmt: skip
        levels += outcome.levels
        for rows, name in ((lines, "cases"), (numbers, "numbers"), (levels, "load_sweeps")):
            if rows:
                tables.write(rows, folder / f"{name}.csv")
        colour = COLOURS[line.verdict]
        console.print(
            f"[{colour}]{line.verdict:14}[/] {line.case:6} {line.description} "
            f"({line.seconds:.1f} s)\n"
            f"    expected: {line.expected}\n    observed: {line.observed}",
            soft_wrap=True,
        )
    write_machine(folder / "machine.json", threads=1)
    print(_summary(lines))
    if any(line.verdict == Verdict.WRONG for line in lines):
        sys.exit(1)


def _summary(lines: list) -> str:
    """Return the numbers of cases, verdicts, solves and states as text."""
    counts = [f"{sum(x.verdict == name for x in lines)} {name}" for name in COLOURS]
    min_detF = [line.min_detF for line in lines if line.min_detF == line.min_detF]
    lowest = f", smallest min det F {min(min_detF):.2g}" if min_detF else ""
    states = sum(line.states_checked for line in lines)
    seconds = sum(line.seconds for line in lines)
    return (
        f"{len(lines)} cases in {seconds:.0f} s: {', '.join(counts)}; "
        f"{sum(line.solves for line in lines)} solves, {states:,} states checked{lowest}"
    )
