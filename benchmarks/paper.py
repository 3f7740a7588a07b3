"""Train all runs of the paper's tables and write the tables: python scripts/paper.py.

Prints the plan and trains the runs that are missing, one after the other. Finished runs are
skipped, interrupted ones resumed, data sets shared. The same command continues after Ctrl-C or a
failure. The plan is data, `benchmarks/conf/paper.yaml`; the folder of a run keeps the options of
its plan.
"""

import itertools
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from benchmarks import CONF
from benchmarks.subcommands import run_script
from dpl import config
from dpl.commands.cli import command
from dpl.config.run_folder import checked_config
from dpl.system.threads import available_cores

OPTIONS = "paper.json"  # file in the folder of a run
FULL = "full"  # name of the scale whose runs lie in the folder itself


class State(StrEnum):
    """State of a run, found in its folder."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    MISSING = "to do"
    OTHER_OPTIONS = "other options"


@dataclass(frozen=True)
class Run:
    """A training of the plan."""

    group: str  # group of the plan
    path: str  # its folder, relative to the folder of all runs
    options: tuple[str, ...]  # overrides of `scripts/train.py`, without folder


def planned(
    plan: Mapping[str, Any],
    groups: Sequence[str] | None,
    scale: Mapping[str, Any],
    more: Sequence[str] = (),
) -> list[Run]:
    """Return the runs of groups of a plan, see `benchmarks/conf/paper.yaml`; None: of all groups.

    `scale` has further options by experiment and by path, and those of "all" for each run.
    """
    names = list(plan) if groups is None else list(groups)
    if unknown := [name for name in names if name not in plan]:
        raise ValueError(f"groups = {unknown[0]!r} must be one of {', '.join(plan)}")
    runs = [run for name in names for run in _group(name, plan[name], scale, more)]
    paths = [run.path for run in runs]
    if double := {path for path in paths if paths.count(path) > 1}:
        raise ValueError(f"plan: two runs have the path {min(double)}")
    return runs


def _group(
    name: str, group: Mapping[str, Any], scale: Mapping[str, Any], more: Sequence[str]
) -> Iterator[Run]:
    """Yield the runs of a group."""
    sweep: Mapping[str, Sequence[Any]] = group.get("sweep", {})
    for experiment in group["experiments"]:
        sizes = [*scale.get("all", ()), *scale.get(experiment, ())]
        folder = group.get("folder", experiment)
        below: Mapping[str, Sequence[str]] = group.get("folders", {".": ()})
        for (inner, special), (own, options) in itertools.product(
            below.items(), group["runs"].items()
        ):
            for values in itertools.product(*sweep.values()):
                swept = [f"{key}={value}" for key, value in zip(sweep, values, strict=True)]
                path = Path(folder, inner, "-".join([own, *map(str, values)])).as_posix()
                own_sizes = [*sizes, *scale.get(path, ())]
                chosen = with_experiment(experiment, [*options, *special])
                # the last option of each key
                last = {one.partition("=")[0]: one for one in [*chosen, *swept, *own_sizes, *more]}
                yield Run(name, path, tuple(last.values()))


def with_experiment(experiment: str, options: Sequence[str]) -> list[str]:
    """Return options with an experiment, which is combined with the recipe that they name."""
    recipes = [one.partition("=")[2] for one in options if one.startswith("experiment=")]
    rest = [one for one in options if not one.startswith("experiment=")]
    choice = f"[{','.join([experiment, *recipes])}]" if recipes else experiment
    return [f"experiment={choice}", *rest]


def state(run: Run, root: Path) -> State:
    """Return the state of a run.

    The options of a run that was trained by hand, whose folder has no `OPTIONS`, are not compared.
    """
    folder = root / run.path
    if not (folder / "config.yaml").is_file():
        return State.MISSING
    own = folder / OPTIONS
    if own.is_file() and json.loads(own.read_text()) != list(run.options):
        return State.OTHER_OPTIONS
    finished = (folder / "evaluation.json").is_file()
    return State.FINISHED if finished else State.INTERRUPTED


def keep_options(run: Run, root: Path) -> None:
    """Write the options of a run to its folder, if its training has made the folder."""
    if (root / run.path).is_dir():
        (root / run.path / OPTIONS).write_text(json.dumps(run.options) + "\n")


def arguments(run: Run, root: Path, present: State) -> tuple[str, list[str]]:
    """Return the script that finishes a run, and its arguments.

    A fitted model whose evaluation was interrupted is evaluated. All other runs are trained, from
    their last checkpoint if there is one.
    """
    folder = root / run.path
    if present == State.INTERRUPTED and (folder / "checkpoints" / "last.ckpt").is_file():
        model = checked_config(folder / "config.yaml").get("model", {})
        if hasattr(get_object(model.get("_target_", "builtins.object")), "fit"):
            return "evaluate", [f"run={folder}"]
    return "train", [*run.options, f"run={folder}", "ckpt_path=last"]


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
    if cfg.scale not in cfg.scales:
        raise config.ConfigError(f"scale = {cfg.scale} must be one of {', '.join(cfg.scales)}")
    full = cfg.scale == FULL
    root = Path(cfg.runs) if full else Path(cfg.runs) / cfg.scale
    folder = Path(cfg.folder) if full else root / "results"
    scale = OmegaConf.to_container(cfg.scales[cfg.scale])
    assert isinstance(scale, dict)
    with config.error_in("plan", ValueError):
        runs = planned(
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
        inner = ",".join(f"'{option}'" for option in scale["convergence"])
        line = ["name=all", f"runs={root}", f"folder={folder}", f"convergence=[{inner}]"]
        print(f"\n[tables] results {' '.join(line)}", flush=True)
        if run_script("results", [*line, *scale["results"]]):
            failed.append("tables")
    if failed:
        print(f"failed: {', '.join(failed)}; run the same command again", file=sys.stderr)
        sys.exit(1)


def _plan(runs: Sequence[Run], root: Path, cores: int) -> list[State]:
    """Print the plan with the states of the runs, and return the states."""
    states = [state(run, root) for run in runs]
    for run, present in zip(runs, states, strict=True):
        line = f"{present:14} {root / run.path}: {' '.join(run.options)}"
        print(line if len(line) <= WIDTH else f"{line[: WIDTH - 4]} ...")
    counts = [f"{states.count(one)} {one}" for one in State if one in states]
    print(f"plan: {len(runs)} runs on {cores} cores, {', '.join(counts)}", flush=True)
    if State.OTHER_OPTIONS in states:
        path = root / runs[states.index(State.OTHER_OPTIONS)].path
        raise config.ConfigError(
            f"runs: {path} was trained with other options; remove it or choose another folder"
        )
    return states


def _train(runs: Sequence[Run], states: Sequence[State], root: Path) -> list[str]:
    """Finish the runs and return the paths of those that failed."""
    failed = []
    pairs = zip(runs, states, strict=True)
    missing = [pair for pair in pairs if pair[1] != State.FINISHED]
    begin = time.perf_counter()
    for number, (run, present) in enumerate(missing, 1):
        script, line = arguments(run, root, present)
        print(f"\n[{number}/{len(missing)}] {script} {' '.join(line)}", flush=True)
        try:
            status = run_script(script, line)
        finally:
            keep_options(run, root)
        if status:
            failed.append(run.path)
        minutes = (time.perf_counter() - begin) / 60
        left = f"{len(missing) - number} runs left, {minutes:.1f} min so far"
        print(f"{run.path}: {left}", flush=True)
    return failed
