"""Compare the runs below a folder: python scripts/compare.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import config, evaluation
from dpl.commands.cli import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Print a table of all evaluated runs below a folder."""
    config.check(cfg)
    try:
        evaluation.compare(Path(cfg.run))
    except FileNotFoundError as error:
        raise config.ConfigError(f"run: {error}") from error
