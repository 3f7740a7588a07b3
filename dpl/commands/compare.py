"""Compare the runs below a folder: python scripts/compare.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import config, evaluation
from dpl.commands.cli import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Print a table of all evaluated runs below a folder."""
    with config.error_in("run", FileNotFoundError, ValueError):
        evaluation.compare(Path(cfg.run))
