"""Train and evaluate a surrogate: python scripts/train.py model=fcnn loss=lr_star."""

import math
import re
import shlex
import signal
import sys
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

import dpl
from dpl import config, data, evaluation, training
from dpl.commands import cli
from dpl.config.plain import OF_THE_SESSION
from dpl.system.files import DataSetError


def parts(cfg: DictConfig) -> tuple["dpl.Scene", "data.DataModule", "dpl.Surrogate", Any]:
    """Return scene, data, surrogate and trainer of a run without solving or writing."""
    resumed = config.check_resumed(cfg)
    scene = config.build_scene(config.with_files_of_resumed(cfg))
    module = config.instantiate(cfg, "data", scene=scene)
    surrogate = config.build_surrogate(cfg, scene)
    is_fitted, grows = surrogate.predictor.is_closed_form, isinstance(module.source, data.Growing)
    name = type(surrogate.net).__name__
    if grows and not is_fitted:
        raise config.ConfigError(
            f"data=growing needs a model that is fitted, such as unrolled; {name} is trained by "
            "gradient descent: set data.train to a number"
        )
    if is_fitted and isinstance(module.source, data.Stream):
        raise config.ConfigError(f"data: {name} is fitted to solved loads; set data=offline")
    if resumed is not None:
        config.check_weights(surrogate, resumed, grows=grows)
        if grows:
            with config.error_in("ckpt_path", LookupError, TypeError, ValueError):
                module.load_state_dict(resumed["DataModule"])
    trainer = config.build_trainer(cfg)
    if not is_fitted:
        cli.check_trainer(trainer, cfg)
        if resumed is not None:
            config.check_callbacks(trainer, resumed)
    return scene, module, surrogate, trainer


@cli.command("train", rehearse=parts, preload=["dpl.data.solving.worker_pool", "lightning"])
def main(cfg: DictConfig) -> float | None:
    """Train and evaluate a surrogate; return its smallest validation e_mean [-] to a search."""
    cfg = config.resumed_config(cfg, HydraConfig.get().overrides.task)
    config.check(cfg)
    is_sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    if cli.extra(cfg, "enforce_tags") and not cfg.tags:
        raise config.ConfigError(
            "tags = [] must name one tag or more; or set extras.enforce_tags=false"
        )
    if cli.extra(cfg, "view"):
        if is_sweep:
            raise config.ConfigError("extras.view = true needs one run; leave it out of a sweep")
        cli.require_viewer()
    try:
        return _train(cfg)
    except training.Diverged as error:
        if not is_sweep:
            raise config.ConfigError(str(error)) from error
        print(f"error: {error}", file=sys.stderr)
        return math.inf  # a sweep continues with its next run


def _train(cfg: DictConfig) -> float | None:
    # imported here, since worker processes import this module without needing it
    import torch

    from dpl.config.resume import OF_GRADIENT_DESCENT

    folder = Path(cfg.folder)
    scene, module, surrogate, trainer = parts(cfg)
    is_fitted, first = surrogate.predictor.is_closed_form, trainer.is_global_zero
    unused = OF_GRADIENT_DESCENT if is_fitted else ()
    session = training.LogHyperparameters(config.hyperparameters(cfg, without=unused))
    trainer.callbacks.append(session)
    if first:
        verbose = cli.extra(cfg, "verbose")
        config.show_plan(scene, module, surrogate, folder=_from_here(folder), verbose=verbose)
        _show_unused(surrogate, unused)
        if not trainer.fast_dev_run:
            config.save_config(cfg, folder, without=unused)
            _draw_data(module, trainer, folder)
    smallest: float | None = None
    try:
        if not is_fitted:
            path = cfg.ckpt_path or None
            trainer.fit(surrogate, datamodule=module, ckpt_path=path, weights_only=True)
        elif first:  # of several processes
            kept = None if trainer.fast_dev_run else folder
            smallest = training.fit(surrogate, module, trainer=trainer, folder=kept)
    except (SystemExit, KeyboardInterrupt) as leaving:
        # Lightning turns Ctrl-C and SIGTERM into SystemExit, without the status
        if first and session.begun:
            unsaved = OF_THE_SESSION - {"run", "folder", "ckpt_path"}
            typed = [
                shlex.quote(line)
                for line in HydraConfig.get().overrides.task
                if re.split(r"[.=]", line.lstrip("+~"))[0] in unsaved
            ]
            words = [_script("train"), _run_key(folder), "ckpt_path=last", *typed]
            print(f"to resume: {' '.join(words)}", file=sys.stderr)
        terminated = 128 + signal.SIGTERM
        if trainer.received_sigterm or getattr(leaving, "code", None) == terminated:
            sys.exit(terminated)
        raise KeyboardInterrupt from leaving
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        ours = isinstance(error, config.ConfigError | DataSetError | training.Diverged)
        if session.begun or not cfg.ckpt_path or ours:
            raise
        reason = f"cannot be resumed: {type(error).__name__}: {error}"
        raise config.ConfigError(f"ckpt_path = {cfg.ckpt_path} {reason}") from error
    finally:
        module.teardown("fit")  # Lightning does not call it after Ctrl-C
    if torch.distributed.is_initialized():  # only the first process evaluates
        torch.distributed.destroy_process_group()
    if not first or trainer.fast_dev_run:
        return None
    _evaluate(cfg, scene, trainer, session)
    return cli.best_error(trainer) if smallest is None else smallest


def _draw_data(module: "data.DataModule", trainer: Any, folder: Path) -> None:
    """Draw the figure of the data, if it has one, for the folder of the run and TensorBoard."""
    from dpl.training.callbacks.tensorboard import tensorboard_writers

    if (figure := module.figure()) is not None:
        figure.savefig(folder / "pairs.png")
        for writer in tensorboard_writers(trainer):
            writer.add_figure("data/pairs", figure)


def _show_unused(surrogate: "dpl.Surrogate", unused: tuple[str, ...]) -> None:
    """Print which overrides have no effect on a model that is fitted."""
    lines = [line.lstrip("+") for line in HydraConfig.get().overrides.task]
    others = "trainer=", "trainer.accelerator", "trainer.fast_dev_run"  # hardware, rehearsals
    given = [one for one in lines if one.startswith(unused) and not one.startswith(others)]
    if given:
        name = type(surrogate.net).__name__
        why = f"{name} is fitted by regression; choose a network, for example model=fcnn"
        print(f"note: {', '.join(given)}: no effect, since {why}", file=sys.stderr)


def _evaluate(cfg: DictConfig, scene: "dpl.Scene", trainer: Any, session: Any) -> None:
    """Evaluate the best weights of a run on its test set, and show what to do with the run."""
    from lightning.pytorch.loggers import TensorBoardLogger

    folder = Path(cfg.folder)
    try:
        _, best = config.load_run(folder, trust=True, scene=scene)
    except config.ConfigError as error:  # its weights or answers are not finite
        raise training.Diverged(f"training has diverged: {error}; lower optimizer.lr") from error
    rows = evaluation.evaluate(best, config.load_data(cfg, scene).samples("test"), folder)
    prediction = next(row for row in rows if row.solver == evaluation.PREDICTION)
    if not math.isfinite(prediction.errors["e_mean"]):
        message = f"training has diverged: the answers of the network in {folder} are not finite; "
        raise training.Diverged(message + "lower optimizer.lr")
    session.finish(trainer, prediction.errors)
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        print(f"\nwritten to {_from_here(folder)}; next:")
        print(f"  {_script('view')} {_run_key(folder)}      # in the browser")
        print(f"  {_script('evaluate')} {_run_key(folder)}  # this table", flush=True)
        if any(isinstance(one, TensorBoardLogger) for one in trainer.loggers):
            logs = shlex.quote(_from_here(folder))
            print(f"  {_program('tensorboard')} --logdir {logs}", flush=True)
    if cli.extra(cfg, "view"):
        from dpl import viewer
        from dpl.commands.view import serve

        policy = viewer.AccessPolicy.bind("127.0.0.1", 0, [])  # any free port
        body = viewer.Body(dpl.Simulator(best))
        serve(body, policy, title=_from_here(folder), folder=folder / "view")


def _from_here(folder: Path) -> str:
    """Return a folder as a path from the working directory if it lies inside."""
    inside = Path.cwd() in folder.absolute().parents
    return str(folder.absolute().relative_to(Path.cwd()) if inside else folder)


def _run_key(folder: Path) -> str:
    """Return the key `run` of a folder as it is typed, in quotes where Hydra needs them."""
    here = _from_here(folder)
    return f"run={here}" if re.fullmatch(r"[\w./-]+", here) else shlex.quote(f"run='{here}'")


def _program(name: str) -> str:
    """Return the text that calls a program of this interpreter's environment."""
    own = Path(sys.executable).with_name(name)
    return str(own.relative_to(Path.cwd())) if Path.cwd() in own.parents else name


def _script(name: str) -> str:
    """Return the text that calls a command, a script of a checkout or an installed program."""
    script = Path(sys.argv[0])
    if script.suffix != ".py":
        return _program(f"dpl-{name}")
    return f"{_program('python')} {_from_here(script.with_name(f'{name}.py'))}"
