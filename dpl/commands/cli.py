"""How a command begins and ends: its configuration, one line for bad input, a word to sweeps."""

import contextlib
import errno
import functools
import importlib
import logging
import math
import os
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from dpl.commands import dry_run, help_text
from dpl.config import CONF, ConfigError
from dpl.system.files import DataSetError
from dpl.version import install

R = typing.TypeVar("R")

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # disk, quota, limit of the shell
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


def command(
    name: str, rehearse: Callable[[DictConfig], Any] | None = None, conf: Path = CONF
) -> Callable[[Callable[[DictConfig], R]], Callable[[], R]]:
    """Return what makes a command of a task: its configuration is `NAME.yaml`.

    Bad input ends it with one line and a status of 2, Ctrl-C with 130.

    Args:
        name: Name of the configuration.
        rehearse: Builds what a job needs before it computes, see `dpl.commands.dry_run.check`.
        conf: Folder of the configuration. It may name `${oc.env:DPL_CONF}`, the folder of the
            package's own configurations, in `hydra.searchpath`.
    """

    def decorate(task: Callable[[DictConfig], R]) -> Callable[[], R]:
        @functools.wraps(task)
        def guarded(cfg: DictConfig) -> R:
            with readable_errors():
                return task(cfg)

        started = hydra.main(version_base="1.3", config_path=str(conf), config_name=name)(guarded)

        @functools.wraps(task)
        def main() -> R:
            os.environ["DPL_CONF"] = str(CONF)
            check_sweep(sys.argv[1:])
            with readable_errors():
                if {"-h", "--help"} & set(sys.argv[1:]):
                    about = sys.modules[task.__module__].__doc__ or ""
                    print(help_text.page(name, conf, about, sys.argv[1:]))
                    sys.exit()
                dry_run.check(name, conf, sys.argv[1:], rehearse)
            return started()

        return main

    return decorate


@contextlib.contextmanager
def readable_errors() -> Iterator[None]:
    """End the process with one line where what is done in here cannot be."""
    logging.getLogger("skfem").setLevel(logging.WARNING)
    for name in ("lightning.pytorch", "lightning.fabric"):  # they print for themselves
        logging.getLogger(name).propagate = False
    try:
        yield
    except (ConfigError, DataSetError) as error:
        print(f"error: {error}", file=sys.stderr)
        if HydraConfig.initialized():
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
        sys.exit(2)
    except (OSError, RuntimeError) as error:
        cause = _failed_access(error)
        if cause is None:
            raise
        print(f"error: {_told(cause)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


def _failed_access(error: BaseException | None) -> OSError | None:
    """Return the failed access to a file that an error comes from; None if it does not.

    PyTorch's writer of archives and the loggers raise errors of their own after it.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error
        error = error.__cause__ or error.__context__
    return None


def _told(error: OSError) -> str:
    """Return in one line which access to a file failed, and what to do."""
    where = f" for {error.filename}" if error.filename else ""
    if error.errno in FULL:
        told, do = f"no space left{where}", "make room"
    elif error.errno in FORBIDDEN:
        told = f"no permission to write{where}"
        do = "choose another folder or change its rights"
    else:
        told = f"{error.strerror}{where}"
        do = "choose another folder or mend this one"
    return f"{told}; what was there is whole: {do} and run the same command again"


def _drop_empty(folder: Path) -> None:
    """Remove the folders that Hydra made below this one for a run that did not begin."""
    here = Path.cwd()
    with contextlib.suppress(OSError):  # not empty
        while here in folder.parents:
            folder.rmdir()
            folder = folder.parent


def check_sweep(arguments: Sequence[str]) -> None:
    """End a command that asks for Optuna where it cannot be used, with one line and a status of 2.

    Hydra itself would list the sweepers that it has, and not say how to get this one.

    Args:
        arguments: Of the command.
    """
    wanted = ("sweep=", "+sweep=", "hydra/sweeper=optuna")
    if not any(argument.startswith(wanted) for argument in arguments):
        return
    try:
        importlib.import_module("hydra_plugins.hydra_optuna_sweeper._impl")
    except ImportError as error:
        told = f"sweep: Optuna cannot be used ({error}): {install('sweep')}"
        print(f"error: {told}", file=sys.stderr)
        sys.exit(2)


def check_trainer(trainer: Any, cfg: DictConfig) -> None:
    """Refuse what a trainer cannot do with the rest of a configuration, before it begins.

    Raises:
        ConfigError: A schedule of the learning rate over a training without end, callbacks that
            keep no weights, or a sweep whose training starts further processes: each would start
            the sweep again.
    """
    from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

    from dpl.training import checkpoints

    if cfg.scheduler and trainer.max_epochs == -1 and trainer.max_steps == -1:
        raise ConfigError(
            "trainer.max_epochs = -1: the schedule of the learning rate needs an end; give it "
            "one, or trainer.max_steps, or set scheduler=null"
        )
    if not any(checkpoints.writes_loadable(one, trainer, cfg.folder) for one in trainer.callbacks):
        raise ConfigError(
            "trainer.callbacks keep no weights that the run can be loaded from; add "
            "{_target_: lightning.pytorch.callbacks.ModelCheckpoint, "
            "dirpath: ${folder}/checkpoints, filename: last, enable_version_counter: false}"
        )
    sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    launcher = getattr(trainer.strategy, "launcher", None)
    if not sweep or not isinstance(launcher, _SubprocessScriptLauncher):
        return
    if trainer.world_size > 1 and not launcher.cluster_environment.creates_processes_externally:
        raise ConfigError(
            "trainer.strategy: with -m, each process that DDP starts would run the whole sweep "
            "again; set trainer.strategy=ddp_spawn, or start each run by torchrun or on a cluster "
            "(hydra/launcher=submitit_slurm)"
        )


def failed(error: Exception) -> float:
    """Return infinity to a sweep, which goes on with its next run.

    Raises:
        ConfigError: There is no sweep: the error ends the command.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        raise ConfigError(str(error)) from error
    print(f"error: {error}", file=sys.stderr)
    return math.inf


def best_error(trainer: Any) -> float | None:
    """Return the smallest validation e_mean of a training [-], which a sweep minimises.

    Infinite where the training diverged before its first validation, None without validation.

    Raises:
        ConfigError: There is no validation, in a sweep that needs one.
    """
    for kept in trainer.checkpoint_callbacks:
        score = getattr(kept, "best_model_score", None)
        if getattr(kept, "monitor", None) == "val/e_mean" and score is not None:
            return float(score) if math.isfinite(score) else math.inf
    hydra_now = HydraConfig.get()
    if hydra_now.mode == RunMode.MULTIRUN and "direction" in hydra_now.sweeper:
        raise ConfigError(
            "trainer.check_val_every_n_epoch: no epoch was validated, so that there is nothing to "
            "minimise; validate more often or train longer"
        )
    return None
