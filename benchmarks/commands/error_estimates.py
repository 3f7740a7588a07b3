"""Calibrate the estimated errors of the simulator: python scripts/error_estimates.py.

Compares the estimated with the true errors of answers of the simulator: in range, at twice the
range, and under loads that compress, twist and pinch the body. Trains models on several bodies, or
takes those of a folder of runs (run=runs/beam_nh_loss), which get no loads of the latter kind.
Writes the errors of all answers, quantiles of their ratios and a figure.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from benchmarks.error_estimates import Estimate

COUNTS = tuple((int, name, 1, 10**6) for name in ("train", "val", "test", "epochs", "softened"))
KEYS = ((Sequence[str], "bodies"), (str, "name"), *COUNTS)


@command("error_estimates", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Compare the estimates on all bodies, print one table and write rows and a figure."""
    from benchmarks import error_estimates
    from benchmarks.study import record

    unknown = set(cfg.bodies) - set(error_estimates.BODIES)
    if unknown or not cfg.bodies:
        names = ", ".join(error_estimates.BODIES)
        raise config.ConfigError(f"bodies = {list(cfg.bodies)} must be some of {names}")
    folder = Path(cfg.folder)
    found = list(_of_runs(cfg) if cfg.run else _of_bodies(cfg, folder))
    rows = error_estimates.summarised(found)
    record(found, folder / f"{cfg.name}_loads", None, error_estimates.draw)
    record(rows, folder / cfg.name, "estimated over true error of all answers, 1 thread")
    error_estimates.conclude(found)


def _of_bodies(cfg: DictConfig, folder: Path) -> Iterator["Estimate"]:
    """Yield the estimates of models that are trained on each body."""
    from benchmarks import error_estimates
    from benchmarks.samples import first

    for body in cfg.bodies:
        start = time.perf_counter()
        scene = error_estimates.BODIES[body]()
        print(*scene.describe()[0], flush=True)
        data = error_estimates.solved_data(
            scene, folder / "data" / body, cfg.train, cfg.val, cfg.test
        )
        simulators = error_estimates.trained(scene, data, cfg.epochs)
        test = first(data.samples("test"), cfg.test)
        more = error_estimates.softened(scene, cfg.softened)
        yield from error_estimates.estimates(body, scene, test, simulators, more)
        print(f"{body}: {time.perf_counter() - start:.0f} s", flush=True)


def _of_runs(cfg: DictConfig) -> Iterator["Estimate"]:
    """Yield the estimates of all runs in a folder."""
    from benchmarks import error_estimates
    from benchmarks.samples import first
    from dpl.inference import Simulator

    runs = config.load_runs(cfg.run)
    run, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(run, scene)
    simulators = {name: Simulator(surrogate) for name, (_, surrogate) in runs.items()}
    test = first(data.samples("test"), cfg.test)
    yield from error_estimates.estimates(Path(cfg.run).name, scene, test, simulators)
