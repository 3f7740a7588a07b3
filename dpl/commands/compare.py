"""The runs of a sweep side by side: python scripts/compare.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl.commands.cli import command
from dpl.config import build
from dpl.evaluation import compare


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Print a table of all evaluated runs below a folder."""
    build.check(cfg)
    try:
        compare(Path(cfg.run))
    except FileNotFoundError as error:
        raise build.ConfigError(f"run: {error}") from error
