"""Evaluate a trained surrogate: python scripts/evaluate.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import config, evaluation
from dpl.commands.cli import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Print and write the errors and run times of a surrogate on its test set."""
    config.files_of_run(cfg.run)  # refuses a missing run before torch is imported
    trained, surrogate = config.load_run(cfg.run, trust=cfg.trust)
    test = config.load_data(trained, surrogate.scene).samples("test")
    evaluation.evaluate(surrogate, test, Path(cfg.run), tols=cfg.tols, errors=cfg.errors)
