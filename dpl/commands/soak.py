"""What grows, slows down or is left behind: python scripts/soak.py minutes=30; 1 if anything is.

Trains on an endless stream, solved by worker processes, then asks the simulator of what was
trained, each for so long; writes what they held, every few seconds, and a figure of it.
"""

import gc
import sys
import time
from pathlib import Path

from omegaconf import DictConfig

from dpl import run
from dpl.commands import entry

LOOKS = 360  # at each work
WORKS = ("training", "simulator")


@entry.command("soak")
def main(cfg: DictConfig) -> None:
    """Train, simulate, and look at both."""
    # here and not above: worker processes import this file, and need none of it
    from dpl.benchmarks import rows as table
    from dpl.simulator import Simulator
    from dpl.stress import soak

    run.check(cfg)
    if not cfg.minutes > 0:
        raise run.ConfigError(f"minutes = {cfg.minutes} must be above 0")
    if not cfg.works or not set(cfg.works) <= set(WORKS):
        raise run.ConfigError(f"works = {cfg.works} must be some of {', '.join(WORKS)}")
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
        _, surrogate = run.load_run(folder, trust=True)
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
    from dpl.stress import soak

    scene = run.build_scene(cfg)
    data = run.make(cfg, "data", scene=scene)
    surrogate = run.build_surrogate(cfg, scene)
    trainer = run.make(cfg, "trainer")
    entry.check_trainer(trainer, cfg)
    pulse = soak.Pulse(seconds, every=seconds / LOOKS)
    trainer.callbacks.append(pulse)
    run.save_config(cfg, Path(cfg.folder))
    try:
        trainer.fit(surrogate, datamodule=data)
    finally:
        data.teardown("fit")
    return pulse.rows
