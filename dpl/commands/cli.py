"""Start and end of a command: configuration, checks, one line for invalid input."""

import contextlib
import errno
import functools
import importlib
import logging
import math
import os
import sys
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

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
    """Return a decorator that turns a function of a configuration into a command.

    The configuration is `NAME.yaml`, composed by Hydra from the command line. All jobs are checked
    before the first one starts. Invalid input ends the command with one line and status 2, Ctrl-C
    with status 130.

    Args:
        name: Name of the configuration.
        rehearse: Builds the objects of a job without computing, see `dpl.commands.dry_run.check`.
        conf: Folder of the configuration. Its `hydra.searchpath` may contain `${oc.env:DPL_CONF}`,
            the folder of the configurations of this package.
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
    """Turn errors of the configuration and of files into one line and exit status 2."""
    logging.getLogger("skfem").setLevel(logging.WARNING)
    for name in ("lightning.pytorch", "lightning.fabric"):  # they print without it
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
        print(f"error: {_describe(cause)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


def _failed_access(error: BaseException | None) -> OSError | None:
    """Return the failed file access that caused an error, None for other causes.

    PyTorch's archive writer and the loggers raise other errors after it.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None:
            return error
        error = error.__cause__ or error.__context__
    return None


def _describe(error: OSError) -> str:
    """Return one line with the failed file access and the remedy."""
    where = f" for {error.filename}" if error.filename else ""
    if error.errno in FULL:
        problem, remedy = f"no space left{where}", "free some space"
    elif error.errno in FORBIDDEN:
        problem = f"no permission to write{where}"
        remedy = "choose another folder or change its permissions"
    else:
        problem = f"{error.strerror}{where}"
        remedy = "choose another folder or repair this one"
    return f"{problem}; existing files are intact: {remedy} and run the same command again"


def _drop_empty(folder: Path) -> None:
    """Remove the empty folders that Hydra created for a run that did not start."""
    here = Path.cwd()
    with contextlib.suppress(OSError):  # not empty
        while here in folder.parents:
            folder.rmdir()
            folder = folder.parent


def check_sweep(arguments: Sequence[str]) -> None:
    """Exit with one line and status 2 if a command line needs Optuna and it is not installed.

    Hydra would list the installed sweepers without saying how to install this one.
    """
    needs = ("hparams_search=", "+hparams_search=", "hydra/sweeper=optuna")
    if not any(argument.startswith(needs) for argument in arguments):
        return
    try:
        importlib.import_module("hydra_plugins.hydra_optuna_sweeper._impl")
    except ImportError as error:
        reason = f"Optuna cannot be used ({error}): {install('sweep')}"
        print(f"error: hparams_search: {reason}", file=sys.stderr)
        sys.exit(2)


def apply_extras(cfg: DictConfig) -> None:
    """Apply the group `extras`: print the configuration, ask for tags, silence warnings.

    Raises:
        ConfigError: A run without tags, and `extras.enforce_tags`.
    """
    extras = cfg.get("extras") or {}
    if extras.get("ignore_warnings"):
        warnings.filterwarnings("ignore")
    if extras.get("enforce_tags") and not cfg.tags:
        raise ConfigError("tags = [] must name one tag or more; or set extras.enforce_tags=false")
    if extras.get("print_config"):
        print(OmegaConf.to_yaml(cfg, resolve=True))


def check_trainer(trainer: Any, cfg: DictConfig) -> None:
    """Check a trainer against the rest of a configuration before the training.

    Raises:
        ConfigError: A learning-rate schedule over an unlimited training, callbacks that write no
            weights, or a sweep whose training starts processes that would run the sweep again.
    """
    from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

    from dpl.training import checkpoints

    if cfg.scheduler and trainer.max_epochs == -1 and trainer.max_steps == -1:
        raise ConfigError(
            "trainer.max_epochs = -1: the schedule of the learning rate needs an end; set "
            "trainer.max_epochs or trainer.max_steps, or scheduler=null"
        )
    if not trainer.fast_dev_run and not any(
        checkpoints.writes_loadable(one, trainer, cfg.folder) for one in trainer.callbacks
    ):
        raise ConfigError(
            "callbacks must write weights from which the run can be loaded; add "
            "+callbacks.last={_target_: lightning.pytorch.callbacks.ModelCheckpoint, "
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
    """Print an error and return infinity to a sweep, which continues with its next run.

    Raises:
        ConfigError: Outside a sweep.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        raise ConfigError(str(error)) from error
    print(f"error: {error}", file=sys.stderr)
    return math.inf


def best_error(trainer: Any) -> float | None:
    """Return the smallest validation e_mean of a training [-], which a search minimises.

    It is infinite if the training diverged before its first validation, None without validation.

    Raises:
        ConfigError: A search has no validation.
    """
    for kept in trainer.checkpoint_callbacks:
        score = getattr(kept, "best_model_score", None)
        if getattr(kept, "monitor", None) == "val/e_mean" and score is not None:
            return float(score) if math.isfinite(score) else math.inf
    hydra_now = HydraConfig.get()
    if hydra_now.mode == RunMode.MULTIRUN and "direction" in hydra_now.sweeper:
        raise ConfigError(
            "trainer.check_val_every_n_epoch: no epoch was validated, and the search has no value "
            "to minimise; validate more often or train longer"
        )
    return None
