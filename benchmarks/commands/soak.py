"""Run the soak test: python scripts/soak.py minutes=30.

Trains on a stream that worker processes solve, then evaluates the simulator of the trained run,
each for `minutes`. Writes the resources of both, every few seconds, and a figure. The exit status
is 1 if resources grow, the rate falls or processes are left over.
"""

import gc
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from omegaconf import DictConfig, OmegaConf

from benchmarks.commands import CONF
from dpl import config
from dpl.commands import cli

KEYS = ((float, "minutes", 1e-2, 1e6), (Sequence[Literal["training", "simulator"]], "workloads"))
RECORDS = 360  # of each workload


@cli.command("soak", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Train, simulate and record the resources of both."""
    # Worker processes import this file and need none of these imports.
    from benchmarks import soak
    from benchmarks.study import record
    from dpl.inference import Simulator

    if not cfg.workloads:
        raise config.ConfigError("workloads = [] must contain training, simulator or both")
    folder, seconds = Path(cfg.folder), 60.0 * cfg.minutes
    rows: list = []
    wrong: list[str] = []

    def report(work: list) -> None:
        rows.extend(work)
        wrong.extend(f"{work[-1].workload}: {line}" for line in soak.regressions(work))
        record(rows, folder / "soak", None, soak.draw)
        print(soak.summary(work))

    if "training" in cfg.workloads:
        before = soak.usage("before", 0.0, 0)
        report(_train(cfg, seconds))
        gc.collect()  # frees the last batches in shared memory
        time.sleep(2.0)  # workers end
        after = soak.usage("after", 0.0, 0)
        wrong += [f"after the training: {line}" for line in soak.leftovers(before, after)]
    if "simulator" in cfg.workloads:
        _, surrogate = config.load_run(folder, trust=True)
        records = []
        for row in soak.simulator(Simulator(surrogate), seconds, every=seconds / RECORDS):
            records.append(row)
            print(
                f"{row.seconds / 60:.1f} min: {row.steps:,} answers ...", end="\r", file=sys.stderr
            )
        report(records)
    print("\n".join(wrong) or "no growth, no loss of speed, nothing left over")
    if wrong:
        sys.exit(1)


def _train(cfg: DictConfig, seconds: float) -> list:
    """Train for a time [s] and return the records."""
    from benchmarks import soak

    scene, folder = config.build_scene(cfg), Path(cfg.folder)
    data = config.instantiate(cfg, "data", scene=scene)
    surrogate = config.build_surrogate(cfg, scene)
    trainer = config.build_trainer(cfg)
    cli.check_trainer(trainer, cfg)
    monitor = soak.UsageMonitor(seconds, every=seconds / RECORDS)
    trainer.callbacks.append(monitor)
    own = {name for _, name, *_ in KEYS}  # which a trained run has not
    config.save_config(OmegaConf.masked_copy(cfg, [key for key in cfg if key not in own]), folder)
    try:
        trainer.fit(surrogate, datamodule=data)
    finally:
        data.teardown("fit")
    return monitor.rows
