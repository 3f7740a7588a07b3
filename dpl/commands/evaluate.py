"""A trained surrogate against finite elements: python scripts/evaluate.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import config, evaluation
from dpl.commands.cli import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Repeat the evaluation at the end of a training run."""
    config.check(cfg)
    trained, surrogate = config.load_run(cfg.run)
    test = config.load_data(trained, surrogate.scene).samples("test")
    evaluation.evaluate(surrogate, test, Path(cfg.run), tol=cfg.tol)
