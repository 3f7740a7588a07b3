"""Measure run times of the mechanics and of public codes: python scripts/benchmark.py.

Long cases on demand: cases=[large] (run alone, it reports its memory), cases=[robustness],
cases=[generation], cases=[sizes]; errors of other meshes: cases=[discretisation];
displacements of the test loads: cases=[deflections] count=100.
"""

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command


@command("benchmark", conf=CONF)
def main(cfg: DictConfig) -> None:
    """Time the chosen cases, print tables and write the rows to a folder."""
    from benchmarks import mechanics

    config.check(cfg)
    mechanics.run(cfg)
