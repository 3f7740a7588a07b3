"""Train and evaluate a surrogate: python scripts/train.py model=fcnn loss=lr_star."""

import math
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dpl import config
from dpl.commands import cli
from dpl.system.files import DataSetError

if TYPE_CHECKING:
    from dpl.scene import Scene
    from dpl.training import Surrogate


def parts(cfg: DictConfig) -> tuple["Scene", Any, "Surrogate", Any]:
    """Return scene, data, surrogate and trainer of a run without solving or writing.

    Raises:
        ConfigError: One of them cannot be built, or the run cannot be resumed.
    """
    resumed = config.check_resumed(cfg)
    scene = config.build_scene(config.with_mesh_of_resumed(cfg))
    data = config.instantiate(cfg, "data", scene=scene)
    surrogate = config.build_surrogate(cfg, scene)
    if resumed is not None:
        config.check_weights(surrogate, resumed)
    trainer = config.build_trainer(cfg)
    cli.check_trainer(trainer, cfg)
    return scene, data, surrogate, trainer


@cli.command("train", rehearse=parts)
def main(cfg: DictConfig) -> float | None:
    """Train and evaluate a surrogate; return its smallest validation e_mean [-] to a search."""
    # imported here, since worker processes import this module without needing them
    import torch

    from dpl.evaluation import evaluate
    from dpl.training import Diverged, LogHyperparameters

    cfg = config.resumed_config(cfg, HydraConfig.get().overrides.task)
    config.check(cfg)
    cli.apply_extras(cfg)
    folder = Path(cfg.folder)
    scene, data, surrogate, trainer = parts(cfg)
    session = LogHyperparameters(config.hyperparameters(cfg))
    trainer.callbacks.append(session)
    if trainer.is_global_zero:
        config.show_skipped_work(scene, data, surrogate)
        if not trainer.fast_dev_run:
            config.save_config(cfg, folder)
    try:
        trainer.fit(surrogate, datamodule=data, ckpt_path=cfg.ckpt_path or None, weights_only=True)
    except Diverged as error:
        return cli.failed(error)
    except SystemExit as leaving:  # Lightning turns Ctrl-C into it
        if leaving.code == 128 + signal.SIGTERM:
            raise
        raise KeyboardInterrupt from leaving
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        if (
            session.begun
            or not cfg.ckpt_path
            or isinstance(error, config.ConfigError | DataSetError)
        ):
            raise
        reason = f"{type(error).__name__}: {error}"
        raise config.ConfigError(
            f"ckpt_path = {cfg.ckpt_path} cannot be resumed: {reason}"
        ) from error
    finally:
        data.teardown("fit")  # Lightning does not call it after Ctrl-C
    if torch.distributed.is_initialized():  # only the first process evaluates
        torch.distributed.destroy_process_group()
    if not trainer.is_global_zero or trainer.fast_dev_run:
        return None
    _, best = config.load_run(folder, trust=True, scene=scene)
    rows = evaluate(best, data.samples("test"), folder)
    network = next(row for row in rows if row.solver == "network")
    if not math.isfinite(network.errors["e_mean"]):
        told = f"training has diverged: the answers of the network in {folder} are not finite; "
        return cli.failed(Diverged(told + "lower optimizer.lr"))
    session.finish(trainer, network.errors)
    return cli.best_error(trainer)
