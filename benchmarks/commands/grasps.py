"""Measure random grasps of a trained run: python scripts/grasps.py run=runs/beam."""

from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl.commands.cli import command

KEYS = (
    (str, "name"),
    (int, "count", 1, 10**6),
    (int, "seed", 0, 10**9),
    (int, "amplitudes", 1, 10**4),
    (int, "hands", 1, 10**4),
    (int, "frames", 10, 10**6),
)


@command("grasps", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure random grasps: motion, displacement, reactions, estimated error and times."""
    from benchmarks import grasps
    from benchmarks.study import record
    from dpl import config
    from dpl.inference import Gripper
    from dpl.models.unrolled.correction import MAX_STEPS
    from dpl.system.threads import one_thread

    _, surrogate = config.load_run(cfg.run)
    if surrogate.scene.problem.shape[1] != 3:
        raise config.ConfigError(f"run = {cfg.run} must have a body in 3D")
    gripper, stem = Gripper(surrogate, steps=MAX_STEPS), Path(cfg.folder) / cfg.name
    every = list(grasps.random_grasps(surrogate.scene, cfg.count, cfg.seed))

    def say(number: int) -> None:
        if number % 50 == 0:
            print(f"{number} of {cfg.count} grasps", flush=True)

    with one_thread():
        rows, unknown = grasps.measure(gripper, every, say)
        amplitudes = grasps.against_amplitude(gripper, every[: cfg.amplitudes])
        hands = [
            grasps.moving_hand(
                surrogate, every[: cfg.hands], budget, steps=MAX_STEPS, frames=cfg.frames
            )
            for budget in grasps.BUDGETS
        ]
    title = f"{cfg.count - unknown} random grasps, 1 thread"
    record(rows, stem, title)
    record(hands, stem.with_name(f"{cfg.name}_hand"), f"{cfg.hands} grasps as motions of a hand")
    record(amplitudes, stem.with_name(f"{cfg.name}_amplitude"), None, grasps.draw)
    print(f"without a solution by Newton's method from rest, left out: {unknown}")
    print(f"slope of the error of the network in the amplitude: {grasps.slope(amplitudes):.2f}")
