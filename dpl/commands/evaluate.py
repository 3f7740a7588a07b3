"""A trained surrogate against finite elements: python scripts/evaluate.py run=runs/..."""

from pathlib import Path

from omegaconf import DictConfig

from dpl import run
from dpl.benchmarks.evaluation import evaluate
from dpl.commands.entry import command


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Repeat the evaluation at the end of a training run."""
    run.check(cfg)
    trained, surrogate = run.load_run(cfg.run)
    test = run.load_data(trained, surrogate.scene).samples("test")
    evaluate(surrogate, test, Path(cfg.run), tol=cfg.tol)
