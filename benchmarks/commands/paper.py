"""Train all runs of the paper's tables and write the tables: python scripts/paper.py.

Prints the plan and trains the runs that are missing, one after the other. Finished runs are
skipped, interrupted ones resumed, data sets shared. The same command continues after Ctrl-C or a
failure.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from benchmarks.paper_runs import Run, State

KEYS = (
    (str, "runs scale"),
    (Sequence[str] | None, "groups"),
    (Sequence[str], "options"),
    (dict, "plan scales"),
    (bool, "only_plan tables"),
)
WIDTH = 100  # of printed lines


@command("paper", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Train the runs that are missing; write tables and figures."""
    from benchmarks import paper_runs
    from dpl.system.threads import available_cores

    if cfg.scale not in cfg.scales:
        raise config.ConfigError(f"scale = {cfg.scale} must be one of {', '.join(cfg.scales)}")
    full = cfg.scale == paper_runs.FULL
    root = Path(cfg.runs) if full else Path(cfg.runs) / cfg.scale
    folder = Path(cfg.folder) if full else root / "results"
    scale = OmegaConf.to_container(cfg.scales[cfg.scale])
    assert isinstance(scale, dict)
    with config.error_in("plan", ValueError):
        runs = paper_runs.planned(
            OmegaConf.to_container(cfg.plan),
            cfg.groups,
            scale["train"],
            list(cfg.options),
        )
    states = _plan(runs, root, available_cores())
    if cfg.only_plan:
        return
    failed = _train(runs, states, root)
    if cfg.tables:
        failed += _write_tables(root, folder, scale)
    if failed:
        print(f"failed: {', '.join(failed)}; run the same command again", file=sys.stderr)
        sys.exit(1)


def _plan(runs: "Sequence[Run]", root: Path, cores: int) -> "list[State]":
    """Print the plan with the states of the runs, and return the states."""
    from benchmarks import paper_runs
    from benchmarks.paper_runs import State

    states = [paper_runs.state(run, root) for run in runs]
    for run, state in zip(runs, states, strict=True):
        line = f"{state:14} {root / run.path}: {' '.join(run.options)}"
        print(line if len(line) <= WIDTH else f"{line[: WIDTH - 4]} ...")
    counts = [f"{states.count(one)} {one}" for one in State if one in states]
    print(f"plan: {len(runs)} runs on {cores} cores, {', '.join(counts)}", flush=True)
    if State.OTHER_OPTIONS in states:
        path = root / runs[states.index(State.OTHER_OPTIONS)].path
        raise config.ConfigError(
            f"runs: {path} was trained with other options; remove it or choose another folder"
        )
    return states


def _train(runs: "Sequence[Run]", states: "Sequence[State]", root: Path) -> list[str]:
    """Finish the runs and return the paths of those that failed."""
    from benchmarks import paper_runs, subcommands

    failed = []
    pairs = zip(runs, states, strict=True)
    missing = [pair for pair in pairs if pair[1] != paper_runs.State.FINISHED]
    begin = time.perf_counter()
    for number, (run, state) in enumerate(missing, 1):
        script, arguments = paper_runs.arguments(run, root, state)
        print(f"\n[{number}/{len(missing)}] {script} {' '.join(arguments)}", flush=True)
        try:
            status = subcommands.run_script(script, arguments)
        finally:
            paper_runs.keep_options(run, root)
        if status:
            failed.append(run.path)
        minutes = (time.perf_counter() - begin) / 60
        left = f"{len(missing) - number} runs left, {minutes:.1f} min so far"
        print(f"{run.path}: {left}", flush=True)
    return failed


def _write_tables(root: Path, folder: Path, scale: dict[str, list[str]]) -> list[str]:
    """Write tables and figures of all experiments; return the name of the script if it failed."""
    from benchmarks import subcommands

    inner = ",".join(f"'{option}'" for option in scale["convergence"])
    arguments = ["name=all", f"runs={root}", f"folder={folder}", f"convergence=[{inner}]"]
    print(f"\n[tables] results {' '.join(arguments)}", flush=True)
    status = subcommands.run_script("results", [*arguments, *scale["results"]])
    return ["tables"] if status else []
