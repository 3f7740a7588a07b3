"""Measure networks on the GPU or the processor: python scripts/devices.py device=auto.

Writes training steps and predictions per second, latencies, parameters and peak memory of each
network to devices_DEVICE.csv, and the machine to devices_DEVICE.json.
"""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

KEYS = (
    (str, "device"),
    (Sequence[int], "batches predictions", 1, 10**6),
    (int, "threads", 1, 10**4),
    (float, "seconds", 1e-3, 1e6),
)


@command("devices", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure the chosen networks; rows are written after each network."""
    from benchmarks import devices
    from benchmarks.study import record
    from dpl.system.threads import limited_threads

    names = list(devices.NETWORKS) if cfg.networks is None else list(cfg.networks)
    if unknown := [name for name in names if name not in devices.NETWORKS]:
        known = ", ".join(devices.NETWORKS)
        raise config.ConfigError(f"networks = {unknown[0]!r} must be one of {known}")
    with config.error_in("device", ValueError):
        device = devices.select_device(cfg.device)
    scene = config.build_scene(cfg)
    print(*scene.describe()[0], flush=True)
    with limited_threads(cfg.threads):
        clock = devices.Clock(device, cfg.repeats, cfg.seconds)
        samples, calls = devices.samples_of(scene, cfg.samples), (cfg.batches, cfg.predictions)
        times = (
            row for name in names for row in devices.measure(name, scene, samples, clock, *calls)
        )
        stem, facts = Path(cfg.folder) / f"devices_{device.type}", devices.facts(device)
        rows = record(
            times, stem, "training steps and predictions", threads=cfg.threads, facts=facts
        )
    if not rows:
        raise config.ConfigError("networks: none fits into the memory")
