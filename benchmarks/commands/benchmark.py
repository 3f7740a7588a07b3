"""Measure run times of the mechanics and of public codes: python scripts/benchmark.py.

Long cases on demand: cases=[large] (run alone, it reports its memory), cases=[robustness],
cases=[generation], cases=[sizes]; errors of other meshes: cases=[discretisation]; displacements of
the test loads: cases=[deflections] count=100; latency of a trained run:
cases=[latency] run=runs/mine; loads on small areas: cases=[local] run=runs/mine count=250.
"""

from collections.abc import Sequence

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl.commands.cli import command

KEYS = (
    (Sequence[str], "linear"),
    (Sequence[str] | None, "cases bodies"),
    (dict, "reference_codes"),
    (int, "workers", 0, 1024),
    (Sequence[int], "cells_across", 1, 1000),
)


@command("benchmark", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Time the chosen cases, print tables and write the rows to a folder."""
    from benchmarks import mechanics

    mechanics.run(cfg)
