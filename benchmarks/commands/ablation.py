"""Learning curve and ablation of model=unrolled: python scripts/ablation.py [experiment=...].

Fits the model to 64, 128, ... loads, and variants of it to `ablation_loads` loads. Writes the rows,
a figure of them and a figure of the method.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.utils import get_object
from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from benchmarks.ablation import Row

KEYS = (
    (Sequence[int], "counts", 1, 10**7),
    (int, "ablation_loads", 1, 10**7),
    (dict, "options"),
)


@command("ablation", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Fit all variants, print one table and write rows and figures."""
    from benchmarks import ablation, ablation_figures
    from benchmarks.samples import first
    from benchmarks.study import record
    from dpl.models import Unrolled

    needed = max(cfg.ablation_loads, *cfg.counts)
    if cfg.data.train < needed:
        raise config.ConfigError(
            f"data.train = {cfg.data.train} must be {needed} or more, the largest of counts and "
            "ablation_loads"
        )
    scene = config.build_scene(cfg)
    build = partial(config.instantiate, cfg, "model", scene=scene)
    if get_object(cfg.model._target_) is not Unrolled:
        raise config.ConfigError("model must be unrolled; its parts are left out one by one")
    variants = ablation.variants(cfg.options)
    for variant in variants:  # invalid options are refused before loads are solved
        build(**variant.options)
    data = config.load_data(cfg, scene)
    samples, held_out, test = (data.samples(split) for split in ("train", "val", "test"))
    seconds = data.store.seconds_per_load()
    folder = Path(cfg.folder)

    def rows() -> "Iterator[Row]":
        yield from ablation.curve(build, samples, held_out, test, cfg.counts)
        some = first(samples, cfg.ablation_loads)
        for variant in variants:
            row, net = ablation.fitted(variant, build, some, held_out, test, ablation.ABLATION)
            yield row
            if variant.is_whole:
                ablation_figures.draw_method(net, test, folder / "unrolled_method.png")
                whole = net, row
        yield from ablation.other_loads(*whole, test, cfg.count)

    def timed() -> "Iterator[Row]":
        for row in rows():
            solved = None if seconds is None else seconds * (row.samples + len(held_out.force))
            yield replace(row, data_seconds=solved)
            print(f"{row.part}, {row.variant}, {row.samples} loads: e_mean {row.e_mean:.2g}")

    title = "unrolled: learning curve, ablation, other loads; 1 thread"
    record(timed(), folder / "unrolled", title, ablation_figures.draw)
