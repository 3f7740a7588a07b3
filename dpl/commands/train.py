"""Data set, training, evaluation: python scripts/train.py model=fcnn loss=lr_star."""

import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from dpl import run
from dpl.commands import entry
from dpl.data.durable import DataSetError

if TYPE_CHECKING:
    from dpl.module import Surrogate
    from dpl.scene import Scene


def parts(cfg: DictConfig) -> tuple["Scene", Any, "Surrogate", Any]:
    """Return scene, data, surrogate and trainer of a run; nothing is solved or written.

    Raises:
        ConfigError: One of them cannot be built, or the run cannot be resumed.
    """
    resumed = run.check_resumed(cfg)
    scene = run.build_scene(run.with_mesh_of_resumed(cfg))
    data = run.make(cfg, "data", scene=scene)
    surrogate = run.build_surrogate(cfg, scene)
    if resumed is not None:
        run.check_weights(surrogate, resumed)
    trainer = run.make(cfg, "trainer")
    entry.check_trainer(trainer, cfg)
    return scene, data, surrogate, trainer


@entry.command("train", rehearse=parts)
def main(cfg: DictConfig) -> float | None:
    """Train a surrogate and judge it; return its smallest validation e_mean [-] to a sweep."""
    # here and not above: worker processes import this file, and need none of it
    import torch

    from dpl import board
    from dpl.benchmarks.evaluation import evaluate
    from dpl.guard import Diverged

    run.check(cfg)
    folder = Path(cfg.folder)
    scene, data, surrogate, trainer = parts(cfg)
    session = board.Session(run.hyperparameters(cfg))
    trainer.callbacks.append(session)
    if trainer.is_global_zero:
        run.show_plan(scene, data, surrogate)
        run.save_config(cfg, folder)
    try:
        trainer.fit(surrogate, datamodule=data, ckpt_path=cfg.ckpt_path or None, weights_only=True)
    except Diverged as error:
        return entry.failed(error)
    except SystemExit as leaving:  # how Lightning passes Ctrl-C on
        if leaving.code == 128 + signal.SIGTERM:
            raise
        raise KeyboardInterrupt from leaving
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        if session.begun or not cfg.ckpt_path or isinstance(error, run.ConfigError | DataSetError):
            raise
        told = f"ckpt_path = {cfg.ckpt_path} cannot be resumed: {type(error).__name__}: {error}"
        raise run.ConfigError(told) from error
    finally:
        data.teardown("fit")  # which Lightning leaves out on Ctrl-C
    if torch.distributed.is_initialized():  # the judging is the first process's alone
        torch.distributed.destroy_process_group()
    if not trainer.is_global_zero:
        return None
    _, best = run.load_run(folder, trust=True, scene=scene)
    rows = evaluate(best, data.samples("test"), folder)
    network = next(row for row in rows if row.solver == "network")
    if not math.isfinite(network.errors["e_mean"]):
        told = f"training has diverged: the answers of the network in {folder} are not finite; "
        return entry.failed(Diverged(told + "lower optimizer.lr"))
    session.finish(trainer, network.errors)
    return entry.best_error(trainer)
