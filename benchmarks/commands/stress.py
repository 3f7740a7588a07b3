"""Run the stress cases: python scripts/stress.py.

Each case prints its task, its expected and its observed outcome. The exit status is 1 if an
outcome is silently wrong.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables as table

KEYS = ((Sequence[str] | None, "cases"),)
COLOURS = {"as expected": "green", "reported": "yellow", "silently wrong": "bold red"}


@command("stress", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Run the cases; rows are written after each case."""
    from benchmarks import stress
    from benchmarks.study import write_machine

    try:
        cases = stress.select_cases(cfg.cases)
    except ValueError as error:
        raise config.ConfigError(f"cases: {error}") from error
    folder, console = Path(cfg.folder), Console(highlight=False)
    lines: list[stress.CaseResult] = []
    comparisons: list[stress.Comparison] = []
    levels: list[stress.LoadLevel] = []
    for k, case in enumerate(cases, 1):
        print(f"{k}/{len(cases)} {case.name}: {case.description} ...", end="\r", file=sys.stderr)
        line, outcome = stress.run_case(case)
        lines.append(line)
        comparisons += stress.comparisons(case, outcome)
        levels += outcome.levels
        for rows, name in ((lines, "cases"), (comparisons, "numbers"), (levels, "load_sweeps")):
            if rows:
                table.write(rows, folder / f"{name}.csv")
        colour = COLOURS[line.verdict]
        console.print(
            f"[{colour}]{line.verdict:14}[/] {line.case:6} {line.description} "
            f"({line.seconds:.1f} s)\n"
            f"    expected: {line.expected}\n    observed: {line.observed}",
            soft_wrap=True,
        )
    write_machine(folder / "machine.json", threads=1)
    print(_summary(lines))
    if any(line.verdict == stress.Verdict.WRONG for line in lines):
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
