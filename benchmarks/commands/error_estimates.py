"""Calibrate the estimated errors of the simulator: python scripts/error_estimates.py.

Trains models on several bodies and compares the estimated with the true errors of their
predictions, in range and at twice the range. Writes the ratios of all loads, their quantiles and a
figure.
"""

import time
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

COUNTS = tuple((int, name, 1, 10**6) for name in ("train", "val", "test", "epochs"))
KEYS = ((Sequence[str], "bodies"), *COUNTS)


@command("error_estimates", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Compare the estimates on all bodies, print one table and write rows and a figure."""
    from benchmarks import error_estimate_figure, error_estimates
    from dpl.evaluation.tables import write, write_machine

    unknown = set(cfg.bodies) - set(error_estimates.BODIES)
    if unknown or not cfg.bodies:
        names = ", ".join(error_estimates.BODIES)
        raise config.ConfigError(f"bodies = {list(cfg.bodies)} must be some of {names}")
    folder = Path(cfg.folder)
    sizes = error_estimates.Sizes(cfg.train, cfg.val, cfg.test, cfg.epochs)
    found: list[error_estimates.Estimate] = []
    for body in cfg.bodies:
        start = time.perf_counter()
        scene = error_estimates.BODIES[body]()
        print(*scene.describe()[0], flush=True)
        found += error_estimates.estimates(body, scene, sizes, folder / "data" / body)
        print(f"{body}: {time.perf_counter() - start:.0f} s", flush=True)
    rows = error_estimates.summarised(found)
    write(found, folder / "estimates.csv")
    write(rows, folder / "error_estimates.csv")
    write_machine(folder / "error_estimates.json")
    error_estimate_figure.draw(found, folder / "error_estimates.png")
    error_estimate_figure.show(rows)
