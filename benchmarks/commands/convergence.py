"""Newton from zero and from predictions: python scripts/convergence.py run=runs/beam_svk."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from rich.progress import Progress

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.newton_starts import Trial
    from dpl.inference.hybrid import Predict
    from dpl.scene import Scene

KEYS = (
    (bool, "twice"),
    (Sequence[str] | None, "solvers"),
    (int | None, "max_plain_iterations", 1, 10**6),
)


@command("convergence", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all solvers on all loads; write rows, machine and figure."""
    from benchmarks import newton_starts
    from benchmarks.study import record

    runs = config.load_runs(cfg.run, cfg.networks, trust=cfg.trust)
    scene = next(iter(runs.values()))[1].scene
    trials = measure(cfg, scene, {name: surrogate.predict for name, (_, surrogate) in runs.items()})
    limit = cfg.max_plain_iterations
    within = [] if limit is None else newton_starts.limited(trials, limit)
    rows = newton_starts.PAPER + newton_starts.summary([*trials, *within])
    title = f"{cfg.name}, one load at a time, 1 thread"
    record(rows, Path(cfg.folder) / cfg.name, title, newton_starts.draw)


def measure(cfg: DictConfig, scene: "Scene", networks: "Mapping[str, Predict]") -> list["Trial"]:
    """Return the results of all solvers on all sets of loads."""
    from benchmarks import newton_starts

    sets = newton_starts.load_sets(scene, cfg.count, twice=cfg.twice)
    trials: list[Trial] = []
    with Progress() as progress:
        bar = progress.add_task("loads", total=len(cfg.tols) * len(sets) * cfg.count)
        tick = partial(progress.advance, bar)
        for tol in cfg.tols:
            with config.error_in("solvers", ValueError):
                solvers = newton_starts.solvers_of(scene, networks, tol, names=cfg.solvers)
            for name, load in sets.items():
                trials += newton_starts.measure(solvers, name, load, tol, tick)
    return trials
