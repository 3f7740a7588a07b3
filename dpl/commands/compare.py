"""The runs of a sweep side by side: python scripts/compare.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import run
from dpl.benchmarks.evaluation import compare
from dpl.commands.entry import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Print a table of all evaluated runs below a folder."""
    run.check(cfg)
    try:
        compare(Path(cfg.run))
    except FileNotFoundError as error:
        raise run.ConfigError(f"run: {error}") from error
