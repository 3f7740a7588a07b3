"""Start and end of a command: configuration, checks, one line for invalid input."""

import atexit
import contextlib
import functools
import gc
import logging
import math
import os
import re
import signal
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from dpl import config
from dpl.commands import dry_run
from dpl.config import CONF, ConfigError, Keys
from dpl.system.files import DataSetError
from dpl.version import install

# turns overrides into the name of a folder that needs quotes in no command line
OmegaConf.register_new_resolver(
    "dpl.name", lambda text: re.sub(r"[^\w.]+", "-", text).strip("-"), replace=True
)
WIDTH = 100  # columns
FLAGS = """
Flags:

  -m                run a job for each combination of values: -m loss=mse,lr_star seed=0,1
  --cfg job         print the whole configuration with the values of this command line and exit
  --config-dir DIR  also search DIR for options of groups
  --hydra-help      print the other flags, which are those of Hydra"""


def command(
    name: str,
    rehearse: Callable[[DictConfig], Any] | None = None,
    conf: Path = CONF,
    keys: Keys = (),
    preload: Sequence[str] = (),
) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Return a decorator that turns a function of a configuration into a command.

    Hydra composes the configuration from `NAME.yaml` in the folder `conf` and the command line. Its
    `hydra.searchpath` may contain `${oc.env:DPL_CONF}`, the folder of the configurations of this
    package. All jobs are checked before the first one starts, see `dpl.commands.dry_run.check` for
    `rehearse`, `keys` and `preload`. Invalid input ends the command with one line and status 2,
    Ctrl-C with status 130, SIGTERM with status 143.
    """

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        guarded = functools.wraps(task)(readable_errors()(task))
        by_hydra = hydra.main(version_base="1.3", config_path=str(conf), config_name=name)(guarded)

        @functools.wraps(task)
        def main() -> None:
            os.environ["DPL_CONF"] = str(CONF)
            with readable_errors():
                args = dry_run.arguments_of(sys.argv[1:], name, conf)
                if args.hydra_help or args.shell_completion or args.experimental_rerun:
                    return by_hydra()
                with dry_run.initialized(args) as engine:
                    if args.help:
                        about = sys.modules[task.__module__].__doc__ or ""
                        page = help_page(args.config_name, about, args.overrides)
                        return print(page, flush=True)
                    with _no_collection():
                        cfg = dry_run.check(args, rehearse, keys, preload)
                    if not args.cfg and args.info is None:
                        return dry_run.run(engine, args, guarded, cfg)
            return by_hydra()

        return main

    return decorate


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage meanwhile, and none at the end of the interpreter.

    Imports make a million objects that live until then; to search them takes seconds.
    """
    atexit.register(gc.freeze)
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def help_page(name: str, about: str, lines: Sequence[str]) -> str:
    """Return the help of a command within `dry_run.initialized`.

    `name` is that of its configuration, `about` the docstring of its module. The files are those of
    the options that the overrides `lines` choose.
    """
    single = [line for line in lines if not dry_run.parsed(line).is_sweep_override()]
    cfg = dry_run.composed(name, single)
    chosen = {k: v for k, v in cfg.hydra.runtime.choices.items() if not k.startswith("hydra")}
    text = [*about.splitlines()]
    if chosen:
        text += ["", "GROUP=OPTION chooses an option of a group; * is chosen:", ""]
    for group, option in sorted(chosen.items()):
        names = (f"{one}*" if one == option else one for one in dry_run.options(name, group))
        text += textwrap.wrap(
            f"{group:14} {', '.join(names)}", WIDTH, initial_indent="  ",
            subsequent_indent=" " * 17, break_on_hyphens=False,
        )  # fmt: skip
    text += ["", "KEY=VALUE changes a value, +KEY=VALUE adds one, ~KEY removes one."]
    folders = [Path(s.path) for s in cfg.hydra.runtime.config_sources if s.schema == "file"]
    for part in dry_run.loader().compute_defaults_list(name, single, RunMode.RUN).defaults:
        paths = (folder / f"{part.config_path}.yaml" for folder in folders)
        if path := next(filter(Path.is_file, paths), None):
            place = f"keys of {part.package}" if part.package else "keys"
            text += ["", f"{place}, {part.config_path}.yaml:", ""]
            text += textwrap.indent(path.read_text(encoding="utf-8").rstrip(), "  ").splitlines()
    return "\n".join([*text, *FLAGS.splitlines()])


@contextlib.contextmanager
def readable_errors() -> Iterator[None]:
    """Turn errors of the configuration and of files into one line and exit status 2."""
    _quieten()
    try:
        yield
    except BrokenPipeError:  # the reader of the output has ended, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the exit flushes it again
        sys.exit(128 + signal.SIGPIPE)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except (ConfigError, DataSetError, YAMLError, OSError, RuntimeError) as error:
        line = " ".join(str(error).split())
        if isinstance(error, OSError | RuntimeError):
            cause: BaseException | None = error  # after which PyTorch or a logger raised this one
            while cause is not None and getattr(cause, "errno", None) is None:
                cause = cause.__cause__ or cause.__context__
            if not isinstance(cause, OSError):
                raise
            where = f" for {cause.filename}" if cause.filename else ""
            remedy = "free some space, change permissions, or choose another folder"
            line = f"{cause.strerror}{where}; existing files are intact; {remedy}, and try again"
        print(f"error: {line}", file=sys.stderr)
        if HydraConfig.initialized():  # remove the empty folders of a run that did not start
            folder = Path(HydraConfig.get().runtime.output_dir)
            with contextlib.suppress(OSError):  # not empty
                while Path.cwd() in folder.parents:
                    folder.rmdir()
                    folder = folder.parent
        sys.exit(2)


def _quieten() -> None:
    """Silence messages and warnings that a user of a command cannot act on."""
    logging.getLogger("skfem").setLevel(logging.WARNING)
    for name in ("lightning.pytorch", "lightning.fabric"):  # they print without it
        logging.getLogger(name).propagate = False
        logging.getLogger(f"{name}.utilities.rank_zero").setLevel(logging.WARNING)
    for message in (
        ".*LeafSpec",
        "The number of training batches",
        "Checkpoint directory .* exists",
        "The dirpath has changed",
    ):
        warnings.filterwarnings("ignore", message)


def extra(cfg: DictConfig, name: str) -> bool:
    """Return an option of `extras`; False if it is absent."""
    return bool((cfg.get("extras") or {}).get(name))


def require_viewer() -> None:
    """Raise a `ConfigError` unless the packages of the viewer are installed."""
    try:
        import dpl.viewer.page  # noqa: F401
    except ImportError as error:
        reason = f"the viewer cannot be imported ({error}): {install('viewer')}"
        raise ConfigError(reason) from error


def check_trainer(trainer: Any, cfg: DictConfig) -> None:
    """Check a trainer against the rest of a configuration before the training.

    Refuses a learning-rate schedule over an unlimited training, callbacks that write no weights,
    and a sweep whose training starts processes that would run the sweep again.
    """
    import torch
    from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

    from dpl.training import writes_loadable

    if cfg.scheduler and trainer.max_epochs == -1 and trainer.max_steps == -1:
        trial = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        schedule = config.instantiate(cfg, "scheduler", optimizer=trial, total_steps=1)
        limited = cfg.trainer.get("max_time") is not None
        if not limited or not isinstance(schedule, torch.optim.lr_scheduler.LambdaLR):
            why = f", and {type(schedule).__name__} does not follow trainer.max_time" * limited
            raise ConfigError(
                f"trainer.max_epochs = -1: the schedule of the learning rate needs an end{why}; "
                "set trainer.max_epochs or trainer.max_steps, or scheduler=null"
            )
    if not trainer.fast_dev_run and not any(
        writes_loadable(one, trainer, cfg.folder) for one in trainer.callbacks
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


def best_error(trainer: Any) -> float | None:
    """Return the smallest validation e_mean of a training [-], which a search minimises.

    It is infinite if the training diverged before its first validation, None without validation,
    which is a `ConfigError` in a search.
    """
    for kept in trainer.checkpoint_callbacks:
        score = getattr(kept, "best_model_score", None)
        if getattr(kept, "monitor", None) == "val/e_mean" and score is not None:
            return float(score) if math.isfinite(score) else math.inf
    if HydraConfig.get().mode == RunMode.MULTIRUN and "direction" in HydraConfig.get().sweeper:
        raise ConfigError(
            "trainer.limit_val_batches: no validation error is stored, and the search has no value "
            "to minimise; set it above 0 and keep callbacks.best_weights"
        )
    return None
