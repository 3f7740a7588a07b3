"""What the package does where it is hard: python scripts/stress.py, or with run=runs/... besides.

One line per case: what was asked, what came of it. Ends with 1 if anything was silently wrong.
"""

import sys
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables as table

COLOURS = {"as expected": "green", "reported": "yellow", "silently wrong": "bold red"}


@command("stress", conf=CONF)
def main(cfg: DictConfig) -> None:
    """Run the matrix; rows are written after each case, the figure at the end."""
    from benchmarks import stress
    from benchmarks.stress.drawing import draw

    config.check(cfg)
    try:
        cases = stress.matrix(cfg.cases)
    except ValueError as error:
        raise config.ConfigError(f"cases: {error}") from error
    if cfg.run is not None:
        _, surrogate = config.load_run(cfg.run)
        cases += stress.trained_run.cases(surrogate)
    folder, console = Path(cfg.folder), Console(highlight=False)
    lines: list[stress.Line] = []
    numbers: list[stress.Number] = []
    rungs: list[stress.LoadLevel] = []
    for k, case in enumerate(cases, 1):
        print(f"{k}/{len(cases)} {case.name}: {case.what} ...", end="\r", file=sys.stderr)
        line, outcome = stress.perform(case)
        lines.append(line)
        numbers += stress.numbers(case, outcome)
        rungs += outcome.rungs
        for rows, name in ((lines, "cases"), (numbers, "numbers"), (rungs, "ladders")):
            if rows:
                table.write(rows, folder / f"{name}.csv")
        colour = COLOURS[line.verdict]
        console.print(
            f"[{colour}]{line.verdict:14}[/] {line.case:6} {line.what} ({line.seconds:.1f} s)\n"
            f"    expected: {line.expected}\n    happened: {line.happened}",
            soft_wrap=True,
        )
    table.write_machine(folder / "machine.json")
    if rungs:
        draw(rungs, folder / "ladders.png")
    print(_summary(lines))
    if any(line.verdict == stress.Verdict.WRONG for line in lines):
        sys.exit(1)


def _summary(lines: list) -> str:
    """Return how many cases, solves and states there were, and what came of them."""
    counts = [f"{sum(x.verdict == name for x in lines)} {name}" for name in COLOURS]
    smallest = [line.smallest for line in lines if line.smallest == line.smallest]
    lowest = f", smallest min det F {min(smallest):.2g}" if smallest else ""
    states = sum(line.iterates for line in lines)
    seconds = sum(line.seconds for line in lines)
    return (
        f"{len(lines)} cases in {seconds:.0f} s: {', '.join(counts)}; "
        f"{sum(line.solves for line in lines)} solves, {states:,} states watched{lowest}"
    )
