"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from rich.progress import Progress

from dpl import config
from dpl.commands.cli import command
from dpl.evaluation import tables

if TYPE_CHECKING:
    from collections.abc import Mapping

    from dpl.evaluation.newton_starts import Trial
    from dpl.fem import Solver
    from dpl.inference.hybrid import Predict
    from dpl.scene import Scene


@command("convergence")
def main(cfg: DictConfig) -> None:
    """Measure all solvers on all loads; write rows, machine and figure."""
    from dpl.evaluation import newton_figure, newton_starts

    runs = config.load_runs(cfg.run, cfg.networks, trust=cfg.trust)
    scene = next(iter(runs.values()))[1].scene
    networks = {name: surrogate.predict for name, (_, surrogate) in runs.items()}
    sets = newton_starts.load_sets(scene, cfg.count, cfg.n_far_loads, twice=cfg.twice)
    middle = sorted(cfg.tols)[len(cfg.tols) // 2]
    tasks = [(tol, name) for tol in cfg.tols for name in sets if not name.endswith("times")]
    tasks += [(middle, name) for name in sets if name.endswith("times")]
    raw = Path(cfg.run) / f"{cfg.name}.csv"
    trials = _measured(raw, list(runs)) if cfg.resume else []
    with Progress() as progress:
        bar = progress.add_task("loads", total=sum(len(sets[name].force) for _, name in tasks))
        for tol, name in tasks:
            budget = cfg.max_far_iterations if name.endswith("times") else None
            solvers = _solvers(cfg, scene, networks, tol, budget)
            known = {(t.solver, t.network): t for t in trials if (t.tol, t.loads) == (tol, name)}
            count = len(sets[name].force)
            if set(known) == set(solvers) and all(t.number == count - 1 for t in known.values()):
                progress.advance(bar, count)
                continue
            trials = [t for t in trials if (t.tol, t.loads) != (tol, name)]
            tick = partial(progress.advance, bar)
            trials += newton_starts.measure(solvers, name, sets[name], tol, tick)
            tables.write(trials, raw)
    limit = cfg.max_plain_iterations
    within = [] if limit is None else newton_starts.limited(trials, limit)
    rows = newton_starts.PAPER + newton_starts.summary([*trials, *within])
    stem = Path(cfg.folder) / cfg.name
    tables.show(rows, f"{cfg.name}, one load at a time, 1 thread")
    tables.write(rows, stem.with_suffix(".csv"))
    tables.write_machine(stem.with_suffix(".json"))
    near = [trial for trial in trials if not trial.loads.endswith("times")]
    if near:
        newton_figure.draw(near, stem.with_suffix(".png"), limit=limit)


def _solvers(
    cfg: DictConfig,
    scene: "Scene",
    networks: "Mapping[str, Predict]",
    tol: float,
    budget: int | None,
) -> "dict[tuple[str, str], Solver]":
    """Return the solvers that the configuration names, see `newton_starts.solvers_of`."""
    from dpl.evaluation import newton_starts

    try:
        return newton_starts.solvers_of(
            scene, networks, tol, max_total_iter=budget, step_tol=cfg.step_tol, names=cfg.solvers
        )
    except ValueError as error:
        raise config.ConfigError(f"solvers: {error}") from error


def _measured(raw: Path, names: list[str]) -> list["Trial"]:
    """Return the measurements of an interrupted run if they are newer than the networks."""
    from dpl.evaluation.newton_starts import Trial

    if not raw.is_file():
        return []
    networks = [path for name in names for path in (raw.parent / name).glob("checkpoints/*")]
    if any(path.stat().st_mtime > raw.stat().st_mtime for path in networks):
        print(f"{raw} is older than a network: measuring everything again")
        return []
    try:
        trials = tables.read(Trial, raw)
    except ValueError as error:
        raise config.ConfigError(f"{error}; remove it, or set resume=false") from error
    print(f"{len(trials):,} measurements are in {raw}; resume=false repeats them")
    return trials
