"""What grows, slows down or is left behind: python scripts/soak.py minutes=30; 1 if anything is.

Trains on an endless stream, solved by worker processes, then asks the simulator of what was
trained, each for so long; writes what they held, every few seconds, and a figure of it.
"""

import gc
import sys
import time
from pathlib import Path

import hydra
from omegaconf import DictConfig

from dpl import run

LOOKS = 360  # at each work


@hydra.main(version_base="1.3", config_path="../conf", config_name="soak")
@run.command
def main(cfg: DictConfig) -> None:
    """Train, then simulate, and look at both."""
    # here and not above: worker processes import this file, and need none of it
    from dpl.benchmarks import rows as table
    from dpl.simulator import Simulator
    from dpl.stress import soak

    run.check(cfg)
    if not cfg.minutes > 0:
        raise run.ConfigError(f"minutes = {cfg.minutes} must be above 0")
    folder, seconds = Path(cfg.folder), 60.0 * cfg.minutes
    scene = run.build_scene(cfg)
    data = run.make(cfg, "data", scene=scene)
    surrogate = run.build_surrogate(cfg, scene)
    trainer = run.make(cfg, "trainer")
    run.check_trainer(trainer, cfg)
    pulse = soak.Pulse(seconds, every=seconds / LOOKS)
    trainer.callbacks.append(pulse)
    run.save_config(cfg, folder)
    before = soak.vitals("before", 0.0, 0)
    trainer.fit(surrogate, datamodule=data)
    data.teardown("fit")
    del trainer, data, surrogate  # and with them the last batches, in shared memory
    gc.collect()
    time.sleep(2.0)  # in which workers end
    after = soak.vitals("after", 0.0, 0)
    _, best = run.load_run(folder, trust=True, scene=scene)
    simulated = []
    for row in soak.simulator(Simulator(best), seconds, every=seconds / LOOKS):
        simulated.append(row)
        print(f"{row.seconds / 60:.1f} min: {row.done:,} answers ...", end="\r", file=sys.stderr)
    works = (pulse.rows, simulated)
    table.write([row for rows in works for row in rows], folder / "soak.csv")
    table.write_machine(folder / "machine.json")
    soak.draw([row for rows in works for row in rows], folder / "soak.png")
    wrong = [f"after the training: {line}" for line in soak.left(before, after)]
    for rows in works:
        print(soak.told(rows))
        wrong += [f"{rows[-1].what}: {line}" for line in soak.flaws(rows)]
    print("\n".join(wrong) or "nothing grew, slowed down or was left behind")
    if wrong:
        sys.exit(1)


if __name__ == "__main__":
    main()
