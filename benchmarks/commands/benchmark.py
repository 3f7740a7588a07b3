"""The mechanics against public codes: python scripts/benchmark.py.

Long parts on demand: parts=[large] (run alone, it reports its memory), parts=[robustness],
parts=[generation], parts=[sizes]; errors of other meshes: parts=[discretisation]; how far test
loads move the bodies: parts=[deflections] count=100.
"""

from omegaconf import DictConfig

from benchmarks.commands import CONF
from dpl import config
from dpl.commands.cli import command


@command("benchmark", conf=CONF)
def main(cfg: DictConfig) -> None:
    """Time the chosen parts, print tables and write the rows to a folder."""
    from benchmarks import mechanics

    config.check(cfg)
    mechanics.run(cfg)
