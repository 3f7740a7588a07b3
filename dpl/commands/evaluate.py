"""A trained surrogate against finite elements: python scripts/evaluate.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl.commands.cli import command
from dpl.config import build, run_folder
from dpl.evaluation import evaluate


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Repeat the evaluation at the end of a training run."""
    build.check(cfg)
    trained, surrogate = run_folder.load_run(cfg.run)
    test = run_folder.load_data(trained, surrogate.scene).samples("test")
    evaluate(surrogate, test, Path(cfg.run), tol=cfg.tol)
