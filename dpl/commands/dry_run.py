"""Compose and check all jobs of a command line before Hydra starts the first one."""

import contextlib
import logging
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import configure_log
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl import config
from dpl.commands import overrides
from dpl.config import ConfigError

REMOTE = "submitit"  # launchers on other machines, whose hardware may differ
SAME = ("seed", "run", "folder")  # keys on which the validity of a job does not depend


def arguments_of(line: Sequence[str], name: str, conf: Path) -> Namespace:
    """Return the flags and overrides of a command line.

    Args:
        line: The command line without the name of the program.
        name: Name of the command's configuration; `--config-name` replaces it.
        conf: Folder of the configurations; `--config-path` replaces it.

    Raises:
        ConfigError: A flag does not exist.
    """

    def refuse(message: str) -> NoReturn:
        raise ConfigError(
            f"{message}; flags such as -m stand before or after all KEY=VALUE, see --help"
        )

    parser = get_args_parser()
    parser.error = refuse
    parser.set_defaults(config_name=name, config_path=str(conf))
    return parser.parse_args(line)


@contextlib.contextmanager
def initialized(args: Namespace) -> Iterator[Hydra]:
    """Let Hydra search the folder of the configurations and that of `--config-dir`.

    Replaces the override `fixed=GROUP` of a group of the mesh.
    """
    search = create_config_search_path(str(Path(args.config_path).absolute()))
    if args.config_dir is not None:
        own = Path(args.config_dir).absolute()
        if not own.is_dir():
            raise ConfigError(f"--config-dir = {args.config_dir} must be an existing folder")
        search.prepend("command-line", f"file://{own}", SearchPathQuery(provider="schema"))
    try:
        engine = Hydra.create_main_hydra2(args.config_name, search)
        args.overrides = overrides.with_named_region(args.config_name, args.overrides)
        yield engine
    finally:
        GlobalHydra.instance().clear()
        HydraConfig.instance().cfg = None  # set by a job whose folder cannot be made


def check(
    args: Namespace,
    rehearse: Callable[[DictConfig], Any] | None = None,
    keys: config.Keys = (),
) -> DictConfig | None:
    """Compose and check every job of a command line.

    Args:
        args: Flags and overrides.
        rehearse: Builds the objects of a job without computing. It is called for the jobs of a
            sweep on this machine; a single job builds its objects when it runs.
        keys: Keys of the command, see `dpl.config.validation.check`.

    Returns:
        The configuration of a single job with the node `hydra`, None for a sweep.

    Raises:
        ConfigError: An override or a job is invalid.
    """
    first, jobs = _jobs(args)
    if args.cfg or args.info is not None:
        return None
    with config.error_in("run", OmegaConfBaseException):
        first.hydra.run.dir  # noqa: B018  # raises if `run` is no text
    every = [overrides.job(cfg) for cfg in jobs or [first]]
    for cfg in every:
        config.check(cfg, keys=keys)
    if jobs is None:
        return first
    if rehearse is not None and REMOTE not in str(first.hydra.launcher):
        different = {
            str({k: v for k, v in OmegaConf.to_container(cfg).items() if k not in SAME}): cfg
            for cfg in every
        }
        logging.disable(logging.INFO)  # trainers describe the machine again in each job
        try:
            for cfg in different.values():
                rehearse(cfg)
        finally:
            logging.disable(logging.NOTSET)
    return None


def run(
    engine: Hydra, args: Namespace, task: Callable[[DictConfig], Any], cfg: DictConfig | None
) -> None:
    """Run the jobs of a command line; `cfg` is the result of `check`.

    The folders of the jobs of a sweep are named by the keys that are swept.
    """
    if cfg is None:
        every = map(overrides.parsed, args.overrides)
        fixed = [f"'{one.key_or_group}'" for one in every if not one.is_sweep_override()]
        names = f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]"
        engine.multirun(args.config_name, task, [*args.overrides, "hydra.mode=MULTIRUN", names])
    else:
        configure_log(cfg.hydra.hydra_logging, cfg.hydra.verbose)
        engine.compose_config = lambda **_: cfg
        engine.run(args.config_name, task, args.overrides)


def _jobs(args: Namespace) -> tuple[DictConfig, list[DictConfig] | None]:
    """Return the configuration without swept keys and the configurations of the jobs of a sweep.

    The jobs of a search are not known in advance: one without the searched keys represents them.
    """
    every = [overrides.parsed(line) for line in args.overrides]
    fixed = [one.input_line for one in every if not one.is_sweep_override()]
    swept = [one for one in every if one.is_sweep_override()]
    first = overrides.composed(args.config_name, fixed)
    if not args.multirun and first.hydra.mode != RunMode.MULTIRUN:
        if swept:
            raise ConfigError(
                f"{swept[0].input_line} names several values; add -m to run them one after the "
                "other, or write a list as [a,b]"
            )
        return first, None
    if first.hydra.sweeper._target_ != f"{BasicSweeper.__module__}.{BasicSweeper.__name__}":
        return first, [first]
    given = {one.key_or_group for one in every}
    params = first.hydra.sweeper.get("params") or {}
    swept += [overrides.parsed(f"{k}={v}") for k, v in params.items() if k not in given]
    with config.error_in("hydra/sweeper", HydraException):
        (jobs,) = BasicSweeper.split_arguments(swept, None)
    return first, [overrides.composed(args.config_name, [*fixed, *job]) for job in jobs]
