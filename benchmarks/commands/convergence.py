"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk."""

import math
from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from rich.progress import Progress

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.newton_starts import Trial
    from dpl.fem import Solver
    from dpl.inference.hybrid import Predict
    from dpl.scene import Scene

Task = tuple[str, ...]  # set of loads, and options of its solvers
KEYS = (
    (bool, "twice"),
    (Sequence[str] | None, "solvers"),
    (int, "n_far_loads", 0, 10**6),
    (int, "max_far_iterations", 1, 10**6),
    (int | None, "max_plain_iterations", 1, 10**6),
    (float, "step_tol", 0, math.inf),
)


@command("convergence", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all solvers on all loads; write rows, machine and figure."""
    from benchmarks import newton_figure, newton_starts
    from benchmarks.study import record

    runs = config.load_runs(cfg.run, cfg.networks, trust=cfg.trust)
    scene = next(iter(runs.values()))[1].scene
    networks = {name: surrogate.predict for name, (_, surrogate) in runs.items()}
    trials = measure(cfg, scene, networks)
    limit = cfg.max_plain_iterations
    within = [] if limit is None else newton_starts.limited(trials, limit)
    rows = newton_starts.PAPER + newton_starts.summary([*trials, *within])
    near = [trial for trial in trials if not trial.loads.endswith("times")]

    def draw(_: object, path: Path) -> None:
        newton_figure.draw(near, path, limit=limit)

    title = f"{cfg.name}, one load at a time, 1 thread"
    record(rows, Path(cfg.folder) / cfg.name, title, draw if near else None)


def measure(cfg: DictConfig, scene: "Scene", networks: "Mapping[str, Predict]") -> list["Trial"]:
    """Return the results of all requested tasks; measure those that the file in `run` lacks.

    A task is a set of loads with the options of its solvers. The file keeps the results of tasks
    that are not requested.
    """
    from benchmarks import newton_starts

    sets = newton_starts.load_sets(scene, cfg.count, cfg.n_far_loads, twice=cfg.twice)
    middle = sorted(cfg.tols)[len(cfg.tols) // 2]
    pairs = [(tol, name) for tol in cfg.tols for name in sets if not name.endswith("times")]
    pairs += [(middle, name) for name in sets if name.endswith("times")]
    raw = Path(cfg.run) / f"{cfg.name}.csv"
    known: dict[Task, list[Trial]] = {}
    for trial in _stored_trials(raw, list(networks)) if cfg.resume else []:
        task = _task(trial.loads, trial.tol, trial.step_tol, trial.max_total_iter)
        known.setdefault(task, []).append(trial)
    requested: dict[Task, list[Trial]] = {}
    with Progress() as progress:
        bar = progress.add_task("loads", total=sum(len(sets[name].force) for _, name in pairs))
        for tol, name in pairs:
            budget = cfg.max_far_iterations if name.endswith("times") else None
            solvers = _solvers(cfg, scene, networks, tol, budget)
            task, count = _task(name, tol, cfg.step_tol, budget), len(sets[name].force)
            last = {(t.solver, t.network): t.number for t in known.get(task, [])}
            if last == dict.fromkeys(solvers, count - 1):
                progress.advance(bar, count)
            else:
                tick = partial(progress.advance, bar)
                known[task] = newton_starts.measure(
                    solvers, name, sets[name], tol, tick,
                    step_tol=cfg.step_tol, max_total_iter=budget,
                )  # fmt: skip
                tables.write([*chain(*known.values())], raw)
            requested[task] = known[task]
    return [*chain(*requested.values())]


def _task(loads: str, tol: float, step_tol: float, max_total_iter: int | None) -> Task:
    """Return a set of loads and the options of its solvers as the file stores them."""
    return tuple(tables.text(value, 4) for value in (loads, tol, step_tol, max_total_iter))


def _solvers(
    cfg: DictConfig,
    scene: "Scene",
    networks: "Mapping[str, Predict]",
    tol: float,
    budget: int | None,
) -> "dict[tuple[str, str], Solver]":
    """Return the solvers that the configuration names, see `newton_starts.solvers_of`."""
    from benchmarks import newton_starts

    try:
        return newton_starts.solvers_of(
            scene, networks, tol, max_total_iter=budget, step_tol=cfg.step_tol, names=cfg.solvers
        )
    except ValueError as error:
        raise config.ConfigError(f"solvers: {error}") from error


def _stored_trials(raw: Path, names: list[str]) -> list["Trial"]:
    """Return the measurements in a file if it is newer than its networks and the named ones."""
    from benchmarks.newton_starts import Trial
    from benchmarks.tables import read

    if not raw.is_file():
        return []
    try:
        trials = read(Trial, raw)
    except ValueError as error:
        raise config.ConfigError(f"{error}; remove it, or set resume=false") from error
    folders = [raw.parent / name for name in {*names, *(trial.network for trial in trials)} if name]
    networks = [path for folder in folders for path in folder.glob("checkpoints/*")]
    if any(path.stat().st_mtime > raw.stat().st_mtime for path in networks):
        print(f"{raw} is older than a network: measuring everything again")
        return []
    print(
        f"{len(trials):,} measurements are in {raw}: those with the same options are kept; "
        "resume=false repeats them"
    )
    return trials
