"""What grows, slows down or is left behind: python scripts/soak.py minutes=30; 1 if anything is.

Trains on an endless stream, solved by worker processes, then asks the simulator of what was
trained, each for so long; writes what they held, every few seconds, and a figure of it.
"""

import gc
import sys
import time
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands import cli

LOOKS = 360  # at each work
WORKS = ("training", "simulator")


@cli.command("soak", conf=CONF)
def main(cfg: DictConfig) -> None:
    """Train, simulate, and look at both."""
    # here and not above: worker processes import this file, and need none of it
    from benchmarks import soak
    from dpl.evaluation import tables as table
    from dpl.inference import Simulator

    config.check(cfg)
    if not cfg.minutes > 0:
        raise config.ConfigError(f"minutes = {cfg.minutes} must be above 0")
    if not cfg.works or not set(cfg.works) <= set(WORKS):
        raise config.ConfigError(f"works = {cfg.works} must be some of {', '.join(WORKS)}")
    folder, seconds = Path(cfg.folder), 60.0 * cfg.minutes
    rows: list = []
    wrong: list[str] = []

    def seen(work: list) -> None:
        rows.extend(work)
        wrong.extend(f"{work[-1].what}: {line}" for line in soak.flaws(work))
        table.write(rows, folder / "soak.csv")
        table.write_machine(folder / "machine.json")
        soak.draw(rows, folder / "soak.png")
        print(soak.told(work))

    if "training" in cfg.works:
        before = soak.vitals("before", 0.0, 0)
        seen(_trained(cfg, seconds))
        gc.collect()  # the last batches, in shared memory
        time.sleep(2.0)  # in which workers end
        after = soak.vitals("after", 0.0, 0)
        wrong += [f"after the training: {line}" for line in soak.left(before, after)]
    if "simulator" in cfg.works:
        _, surrogate = config.load_run(folder, trust=True)
        asked = []
        for row in soak.simulator(Simulator(surrogate), seconds, every=seconds / LOOKS):
            asked.append(row)
            print(
                f"{row.seconds / 60:.1f} min: {row.done:,} answers ...", end="\r", file=sys.stderr
            )
        seen(asked)
    print("\n".join(wrong) or "nothing grew, slowed down or was left behind")
    if wrong:
        sys.exit(1)


def _trained(cfg: DictConfig, seconds: float) -> list:
    """Train for so long and return what was seen."""
    from benchmarks import soak

    scene = config.build_scene(cfg)
    data = config.instantiate(cfg, "data", scene=scene)
    surrogate = config.build_surrogate(cfg, scene)
    trainer = config.instantiate(cfg, "trainer")
    cli.check_trainer(trainer, cfg)
    pulse = soak.Pulse(seconds, every=seconds / LOOKS)
    trainer.callbacks.append(pulse)
    config.save_config(cfg, Path(cfg.folder))
    try:
        trainer.fit(surrogate, datamodule=data)
    finally:
        data.teardown("fit")
    return pulse.rows
