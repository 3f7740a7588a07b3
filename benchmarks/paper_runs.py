"""Runs that the tables of the paper need: their plan, their states and the times that they took.

The plan is data, `benchmarks/conf/paper.yaml`. A journal in the folder of the runs has a line for
each session of a run: its options, its end and its wall time.
"""

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from dpl.system.files import append_jsonl

JOURNAL = "paper.jsonl"
FULL = "full"  # name of the scale whose runs lie in the folder itself


class State(StrEnum):
    """State of a run, found in its folder and in the journal."""

    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    MISSING = "to do"
    OTHER_OPTIONS = "other options"


@dataclass(frozen=True)
class Run:
    """A training of the plan.

    Attributes:
        group: Group of the plan.
        path: Its folder, relative to the folder of all runs.
        options: Overrides of `scripts/train.py`, without folder.
    """

    group: str
    path: str
    options: tuple[str, ...]


@dataclass(frozen=True)
class Session:
    """A line of the journal.

    Attributes:
        run: Path of the run.
        options: Its options.
        end: "finished", "interrupted" or "failed".
        seconds: Wall time of the session with data, training and evaluation [s].
        cores: Number of cores of the process.
    """

    run: str
    options: tuple[str, ...]
    end: str
    seconds: float
    cores: int


@dataclass(frozen=True)
class RunTime:
    """Wall time of a run over all of its sessions.

    Attributes:
        run: Path of the run; "total" for the sum.
        sessions: Number of sessions.
        end: End of the last session.
        minutes: Wall time with data, training and evaluation [min].
        training_minutes: Part of it that is the training [min]; None if unknown.
        cores: Number of cores.
    """

    run: str
    sessions: int
    end: str
    minutes: float
    training_minutes: float | None
    cores: int


def planned(
    plan: Mapping[str, Any],
    groups: Sequence[str] | None,
    scale: Mapping[str, Any],
    more: Sequence[str] = (),
) -> list[Run]:
    """Return the runs of groups of a plan.

    Args:
        plan: Groups by name, see `benchmarks/conf/paper.yaml`.
        groups: Names of groups; None for all.
        scale: Further options by experiment, then by path; those of "all" are added to each run.
        more: Further options of all runs.

    Raises:
        ValueError: A group does not exist, or two runs have one path.
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
        for own, options in group["runs"].items():
            for values in itertools.product(*sweep.values()):
                swept = [f"{key}={value}" for key, value in zip(sweep, values, strict=True)]
                title = "-".join([own, *map(str, values)])
                path = f"{folder}/{title}"
                own_sizes = [*sizes, *scale.get(path, ())]
                every = [*with_experiment(experiment, options), *swept, *own_sizes, *more]
                yield Run(name, path, last_of_each_key(every))


def with_experiment(experiment: str, options: Sequence[str]) -> list[str]:
    """Return options with an experiment, which is combined with the recipe that they name."""
    recipes = [one.partition("=")[2] for one in options if one.startswith("experiment=")]
    rest = [one for one in options if not one.startswith("experiment=")]
    choice = f"[{','.join([experiment, *recipes])}]" if recipes else experiment
    return [f"experiment={choice}", *rest]


def last_of_each_key(options: Sequence[str]) -> tuple[str, ...]:
    """Return options without those that a later one of the same key replaces."""
    return tuple({option.partition("=")[0]: option for option in options}.values())


def state(run: Run, root: Path, sessions: Sequence[Session]) -> State:
    """Return the state of a run.

    A run that the journal does not contain was trained by hand, and its options are not compared.

    Args:
        run: The run.
        root: Folder of all runs.
        sessions: Lines of the journal.
    """
    folder = root / run.path
    if not (folder / "config.yaml").is_file():
        return State.MISSING
    own = [session for session in sessions if session.run == run.path]
    if own and own[-1].options != run.options:
        return State.OTHER_OPTIONS
    finished = (folder / "evaluation.json").is_file()
    return State.FINISHED if finished else State.INTERRUPTED


def read_journal(root: Path) -> list[Session]:
    """Return the lines of the journal; a line that a crash has torn is left out."""
    path = root / JOURNAL
    found = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
            found.append(Session(**{**row, "options": tuple(row["options"])}))
        except (ValueError, TypeError, KeyError):
            continue
    return found


def append(session: Session, root: Path) -> None:
    """Append a line to the journal."""
    root.mkdir(parents=True, exist_ok=True)
    line = {**vars(session), "options": list(session.options)}
    append_jsonl(root / JOURNAL, line)


def times(runs: Sequence[Run], root: Path, sessions: Sequence[Session]) -> list[RunTime]:
    """Return the wall times of the runs that the journal contains, and their sum."""
    from benchmarks.methods import training_minutes

    rows = []
    for run in runs:
        own = [one for one in sessions if one.run == run.path and one.options == run.options]
        if own:
            minutes = sum(one.seconds for one in own) / 60
            training = training_minutes(root / run.path)
            last = own[-1]
            rows.append(RunTime(run.path, len(own), last.end, minutes, training, last.cores))
    if rows:
        ends = {row.end for row in rows}
        finished = len(rows) == len(runs) and ends == {State.FINISHED.value}
        known = [row.training_minutes for row in rows if row.training_minutes is not None]
        rows.append(
            RunTime(
                "total",
                sum(row.sessions for row in rows),
                State.FINISHED if finished else State.INTERRUPTED,
                sum(row.minutes for row in rows),
                sum(known),
                rows[-1].cores,
            )
        )
    return rows


def fits_in_one_step(folder: Path) -> bool:
    """Return True if the model of a run is fitted, so that its training cannot be resumed."""
    from hydra.utils import get_object

    from dpl.config.run_folder import checked_config

    model = checked_config(folder / "config.yaml").get("model", {})
    return callable(getattr(get_object(model.get("_target_", "builtins.object")), "fit", None))


def arguments(run: Run, root: Path, present: State) -> tuple[str, list[str]]:
    """Return the script that finishes a run, and its arguments.

    A fitted model whose evaluation was interrupted is evaluated. All other runs are trained, from
    their last checkpoint if there is one.
    """
    folder = root / run.path
    fitted = (folder / "checkpoints" / "last.ckpt").is_file()
    if present == State.INTERRUPTED and fitted and fits_in_one_step(folder):
        return "evaluate", [f"run={folder}"]
    return "train", [*run.options, f"run={folder}", "ckpt_path=last"]
