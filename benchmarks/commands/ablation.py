"""Learning curve and ablation of model=unrolled: python scripts/ablation.py [experiment=...].

Fits the model to 64, 128, ... loads, and variants of it to `ablation_loads` loads. Writes the rows,
a figure of them and a figure of the method.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

KEYS = (
    (Sequence[int], "counts", 1, 10**7),
    (int, "ablation_loads", 1, 10**7),
    (dict, "options"),
)


@command("ablation", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Fit all variants, print one table and write rows and figures."""
    from benchmarks import ablation, ablation_figures
    from dpl.evaluation.tables import write, write_machine
    from dpl.models import Unrolled

    needed = max(cfg.ablation_loads, *cfg.counts)
    if cfg.data.train < needed:
        raise config.ConfigError(
            f"data.train = {cfg.data.train} must be {needed} or more, the largest of counts and "
            "ablation_loads"
        )
    scene = config.build_scene(cfg)
    build = partial(config.instantiate, cfg, "model", scene=scene)
    if not isinstance(build(), Unrolled):
        raise config.ConfigError("model must be unrolled; its parts are left out one by one")
    variants = ablation.variants(cfg.options)
    for variant in variants:  # invalid options are refused before loads are solved
        build(**variant.options)
    data = config.load_data(cfg, scene)
    samples, held_out, test = (data.samples(split) for split in ("train", "val", "test"))
    seconds = data.store.seconds_per_load()
    folder = Path(cfg.folder)
    rows: list[ablation.Row] = []

    def record(row: ablation.Row) -> None:
        solved = None if seconds is None else seconds * (row.samples + len(held_out.force))
        rows.append(replace(row, data_seconds=solved))
        write(rows, folder / "unrolled.csv")
        print(f"{row.part}, {row.variant}, {row.samples} loads: e_mean {row.e_mean:.2g}")

    for row in ablation.curve(build, samples, held_out, test, cfg.counts):
        record(row)
    some = ablation.first(samples, cfg.ablation_loads)
    for variant in variants:
        row, net = ablation.fitted(variant, build, some, held_out, test, ablation.ABLATION)
        record(row)
        if variant.is_whole:
            for other in ablation.other_loads(net, row, test, cfg.count):
                record(other)
            ablation_figures.draw_method(net, test, folder / "unrolled_method.png")
    rows.sort(key=lambda row: ablation.PARTS.index(row.part))
    write(rows, folder / "unrolled.csv")
    write_machine(folder / "unrolled.json")
    ablation_figures.draw(rows, folder / "unrolled.png")
    ablation_figures.show(rows)
