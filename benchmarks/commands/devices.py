"""Measure networks on the GPU or the processor: python scripts/devices.py device=auto.

Writes training steps and predictions per second, latencies, parameters and peak memory of each
network to devices_DEVICE.csv, and the machine to devices_DEVICE.json.
"""

import json
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
    from benchmarks import device_facts, devices
    from dpl.evaluation import tables
    from dpl.evaluation.tables import show
    from dpl.system.threads import limited_threads

    names = list(devices.NETWORKS) if cfg.networks is None else list(cfg.networks)
    if unknown := [name for name in names if name not in devices.NETWORKS]:
        known = ", ".join(devices.NETWORKS)
        raise config.ConfigError(f"networks = {unknown[0]!r} must be one of {known}")
    with config.error_in("device", ValueError):
        device = device_facts.select_device(cfg.device)
    stem = Path(cfg.folder) / f"devices_{device.type}"
    scene = config.build_scene(cfg)
    print(*scene.describe()[0], flush=True)
    rows: list[devices.DeviceTime] = []
    with limited_threads(cfg.threads):
        plan = devices.Plan(
            cfg.batches, cfg.predictions, devices.Clock(device, cfg.repeats, cfg.seconds)
        )
        samples = devices.samples_of(scene, cfg.samples)
        for name in names:
            for row in devices.measure(name, scene, samples, plan):
                if isinstance(row, str):
                    print(f"left out: {row}", flush=True)
                    continue
                rows.append(row)
                print(
                    f"{row.network}, {row.task}, batch {row.batch}: {row.ms:.3g} ms, "
                    f"{row.loads_per_second:.4g} loads/s, {row.peak_memory_mb:,.0f} MB",
                    flush=True,
                )
            if rows:
                tables.write(rows, stem.with_suffix(".csv"))
    if not rows:
        raise config.ConfigError("networks: none fits into the memory")
    facts = device_facts.facts(device, cfg.threads)
    stem.with_suffix(".json").write_text(json.dumps(facts) + "\n")
    show(rows, ", ".join(f"{name} {value}" for name, value in facts.items()))
    print(f"written to {stem}.csv")
