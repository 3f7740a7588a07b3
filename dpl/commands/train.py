"""Data set, training, evaluation: python scripts/train.py model=fcnn loss=lr_star."""

import signal
from pathlib import Path

from omegaconf import DictConfig

from dpl import run
from dpl.commands import entry


@entry.command("train")
def main(cfg: DictConfig) -> float | None:
    """Train a surrogate and judge it; return its smallest validation e_mean [-] to a sweep."""
    # here and not above: worker processes import this file, and need none of it
    import lightning as L
    import torch
    from torch.utils.tensorboard.summary import hparams

    from dpl.benchmarks.evaluation import evaluate
    from dpl.guard import Diverged

    run.check(cfg)
    run.check_resumed(cfg)
    folder = Path(cfg.folder)
    scene = run.build_scene(cfg)
    data = run.make(cfg, "data", scene=scene)
    surrogate = run.build_surrogate(cfg, scene)
    trainer = run.make(cfg, "trainer")
    entry.check_trainer(trainer, cfg)
    if trainer.is_global_zero:
        run.show_plan(scene, data, surrogate)
        run.save_config(cfg, folder)
    try:
        trainer.fit(surrogate, datamodule=data, ckpt_path=cfg.ckpt_path, weights_only=True)
    except Diverged as error:
        return entry.failed(error)
    except SystemExit as leaving:  # how Lightning passes Ctrl-C on
        if leaving.code == 128 + signal.SIGTERM:
            raise
        raise KeyboardInterrupt from leaving
    finally:
        data.teardown("fit")  # which Lightning leaves out on Ctrl-C
    if torch.distributed.is_initialized():  # the judging is the first process's alone
        torch.distributed.destroy_process_group()
    if not trainer.is_global_zero:
        return None
    _, best = run.load_run(folder, trust=True, scene=scene)
    rows = evaluate(best, data.samples("test"), folder)
    network = next(row for row in rows if row.solver == "network")
    if isinstance(trainer.logger, L.pytorch.loggers.TensorBoardLogger):
        trainer.logger.log_metrics(network.errors)
        # not the list of columns, which Lightning would write: it hides those of other runs
        _, *session = hparams(run.hyperparameters(cfg), network.errors)
        for part in session:
            trainer.logger.experiment.file_writer.add_summary(part)
        trainer.logger.save()
        trainer.logger.finalize("success")
    return entry.best_error(trainer)
