"""Compose and check all jobs of a command line before Hydra starts the first one."""

import contextlib
import itertools
import logging
import tempfile
import typing
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl import config
from dpl.commands import overrides
from dpl.config import ConfigError

BASIC = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
REMOTE = "submitit"  # launchers on other machines, whose hardware may differ
SAME = ("seed", "run", "folder")  # keys on which the validity of a job does not depend


def check(
    name: str,
    conf: Path,
    arguments: Sequence[str],
    rehearse: Callable[[DictConfig], Any] | None = None,
) -> None:
    """Compose and check every job of a command line.

    Args:
        name: Name of the command's configuration.
        conf: Folder of the configurations.
        arguments: Command line without the name of the program.
        rehearse: Builds the objects of a job without computing. It is called for the jobs of a
            sweep on this machine; a single job builds its objects when it runs.

    Raises:
        ConfigError: An override, a job or its folder is invalid.
    """
    args = arguments_of(arguments)
    if args.help or args.hydra_help or args.shell_completion or args.experimental_rerun:
        return
    with initialized(args.config_path or conf, args.config_dir):
        first, jobs = _jobs(args.config_name or name, args.overrides, args.multirun)
        if args.cfg or args.info is not None:
            return
        sweep = jobs is not None
        place = _folder(first, "sweep" if sweep else "run")
        every = [_job(cfg) for cfg in jobs or [first]]
    for cfg in every:
        config.check(cfg)
    if sweep and rehearse is not None and REMOTE not in str(first.hydra.launcher):
        logging.disable(logging.INFO)  # trainers describe the machine again in each job
        try:
            for cfg in _different(every):
                rehearse(cfg)
        finally:
            logging.disable(logging.NOTSET)
    try_folder(place)


def arguments_of(line: Sequence[str]) -> Namespace:
    """Return the flags and overrides of a command line.

    Raises:
        ConfigError: A flag does not exist.
    """
    parser = get_args_parser()
    parser.error = _unreadable
    return parser.parse_args(line)


def _unreadable(message: str) -> NoReturn:
    raise ConfigError(
        f"{message}; flags such as -m stand before or after all KEY=VALUE, see --help"
    )


@contextlib.contextmanager
def initialized(conf: str | Path, config_dir: str | None) -> Iterator[None]:
    """Let Hydra search a folder of configurations and the folder of `--config-dir`.

    Raises:
        ConfigError: The second folder does not exist.
    """
    search = create_config_search_path(str(Path(conf).absolute()))
    if config_dir is not None:
        own = Path(config_dir).absolute()
        if not own.is_dir():
            raise ConfigError(f"--config-dir = {config_dir} must be an existing folder")
        search.prepend("command-line", f"file://{own}", SearchPathQuery(provider="schema"))
    Hydra.create_main_hydra2("check", search)
    try:
        yield
    finally:
        GlobalHydra.instance().clear()


def _jobs(
    name: str, lines: Sequence[str], multirun: bool
) -> tuple[DictConfig, Iterable[DictConfig] | None]:
    """Return the configuration without swept keys and the configurations of the jobs of a sweep.

    The jobs of a search are not known in advance. They are represented by one job for each end or
    option of each range, with the first values of the other ranges.

    Raises:
        ConfigError: An override is invalid, or a sweep has no value.
    """
    every = [overrides.parsed(line) for line in lines]
    fixed = [one.input_line for one in every if not one.is_sweep_override()]
    swept = [one for one in every if one.is_sweep_override()]
    first = overrides.composed(name, fixed)
    if not multirun and first.hydra.mode != RunMode.MULTIRUN:
        if swept:
            raise ConfigError(
                f"{swept[0].input_line} names several values; add -m to run them one after the "
                "other, or write a list as [a,b]"
            )
        return first, None
    given = {one.key_or_group for one in every}
    params = first.hydra.sweeper.get("params") or {}
    swept += [overrides.parsed(f"{k}={v}") for k, v in params.items() if k not in given]
    search = first.hydra.sweeper._target_ != BASIC
    values = [overrides.values(one, search=search) for one in swept]
    chosen = _one_by_one(values) if search else itertools.product(*values)
    return first, [overrides.composed(name, [*fixed, *job]) for job in chosen]


def _one_by_one(values: list[list[str]]) -> Iterator[tuple[str, ...]]:
    """Yield the first values of all keys, then each other value with the first of the others."""
    first = tuple(some[0] for some in values)
    yield first
    for place, some in enumerate(values):
        for value in some[1:]:
            yield (*first[:place], value, *first[place + 1 :])


def _job(cfg: DictConfig) -> DictConfig:
    """Return the configuration of a job without the node `hydra`, which sets `folder` later."""
    job = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    if "folder" in job and OmegaConf.is_interpolation(job, "folder"):
        job.folder = "."
    return job


def _different(jobs: Iterable[DictConfig]) -> Iterator[DictConfig]:
    """Yield the jobs that differ in more than seed and folder."""
    seen = set()
    for job in jobs:
        written = typing.cast("dict[str, Any]", OmegaConf.to_container(job, resolve=False))
        content = repr([(key, value) for key, value in written.items() if key not in SAME])
        if content not in seen:
            yield job
        seen.add(content)


def _folder(cfg: DictConfig, mode: str) -> Path:
    """Return the folder of a run or a sweep.

    Raises:
        ConfigError: `run` is not a text.
    """
    try:
        return Path(cfg.hydra[mode].dir)
    except OmegaConfBaseException:
        run = OmegaConf.to_container(cfg, resolve=False)["run"] or "null"
        raise ConfigError(f"run = {run} must be a text, the name of a folder") from None


def try_folder(folder: Path) -> None:
    """Create a folder and a file in it, and remove both again.

    Raises:
        ConfigError: The folder cannot be written.
    """
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(
            f"run = {folder} cannot be written: {error.strerror}; name another folder"
        ) from error
    finally:
        for path in new:
            if path.is_dir():
                path.rmdir()
