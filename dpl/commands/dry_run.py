"""Compose and check all jobs of a command line before Hydra starts the first one."""

import contextlib
import difflib
import importlib
import logging
import re
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import configure_log
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dpl import config
from dpl.config import ConfigError, validation
from dpl.system.processes import workers_with
from dpl.version import install

REMOTE = "submitit"  # launchers on other machines, whose hardware may differ
SAME = ("seed", "run", "folder")  # keys on which the validity of a job does not depend
EXTRAS = {"hydra/launcher": "launch", "hydra/sweeper": "sweep"}  # groups with options of plugins
SIMILAR = 0.8  # ratio of `difflib` from which a key is taken for a misspelt one
GROUP = re.compile(r"fixed=([\w.:][\w .:+-]*)")  # an option, or a name that needs no quotes
REFUSED = (HydraException, OmegaConfBaseException, ValueError, AssertionError, TypeError)


def arguments_of(line: Sequence[str], name: str, conf: Path) -> Namespace:
    """Return the flags and overrides of a command line without the name of the program.

    The flags `--config-name` and `--config-path` replace the name and the folder of the command's
    configuration.
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

    The override `fixed=GROUP` of a group of the mesh becomes `fixed=tag fixed.name=GROUP`.
    """
    search = create_config_search_path(str(Path(args.config_path).absolute()))
    if args.config_dir is not None:
        own = Path(args.config_dir).absolute()
        if not own.is_dir():
            raise ConfigError(f"--config-dir = {args.config_dir} must be an existing folder")
        search.prepend("command-line", f"file://{own}", SearchPathQuery(provider="schema"))
    try:
        engine = Hydra.create_main_hydra2(args.config_name, search)
        for k, line in reversed([*enumerate(args.overrides)]):
            if not (named := GROUP.fullmatch(line)):
                continue
            if named[1] not in ("null", *options(args.config_name, "fixed")):
                args.overrides[k : k + 1] = ["fixed=tag", f"fixed.name={named[1]}"]
        yield engine
    finally:
        GlobalHydra.instance().clear()
        HydraConfig.instance().cfg = None  # set by a job whose folder cannot be made


def check(
    args: Namespace,
    rehearse: Callable[[DictConfig], Any] | None = None,
    keys: config.Keys = (),
    preload: Sequence[str] = (),
) -> DictConfig | None:
    """Compose and check every job of a command line; return a single one, None for a sweep.

    The configuration of a single job has the node `hydra`. `rehearse` builds the objects of a job
    without computing. It is called for the jobs of a sweep on this machine; a single job builds its
    objects when it runs. For `keys` see `dpl.config.validation.check`.

    Once the command line is composed, the server of worker processes imports the first module of
    `preload`, whose kernels may have to be compiled, while this process imports the others.
    """
    first, jobs = _jobs(args)
    if args.cfg or args.info is not None:
        return None
    if preload:
        workers_with(preload[0])
    for module in preload[1:]:
        importlib.import_module(module)
    with config.error_in("run", OmegaConfBaseException):
        first.hydra.run.dir  # noqa: B018  # raises if `run` is no text
    different: dict[str, DictConfig] = {}
    for job in jobs or [first]:
        cfg = OmegaConf.masked_copy(job, [key for key in job if key != "hydra"])
        if "folder" in cfg and OmegaConf.is_interpolation(cfg, "folder"):
            cfg.folder = "."  # the node `hydra` sets it later
        config.check(cfg, keys=keys)
        node: Any = OmegaConf.to_container(cfg)
        different[str({key: node[key] for key in node if key not in SAME})] = cfg
    if jobs is None:
        return first
    if rehearse is not None and REMOTE not in str(first.hydra.launcher):
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
        every = map(parsed, args.overrides)
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
    every = [parsed(line) for line in args.overrides]
    fixed = [one.input_line for one in every if not one.is_sweep_override()]
    swept = [one for one in every if one.is_sweep_override()]
    first = composed(args.config_name, fixed)
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
    swept += [parsed(f"{k}={v}") for k, v in params.items() if k not in given]
    with config.error_in("hydra/sweeper", HydraException):
        (jobs,) = BasicSweeper.split_arguments(swept, None)
    return first, [composed(args.config_name, [*fixed, *job]) for job in jobs]


def loader() -> Any:
    """Return Hydra's loader of configurations, which is there while it is initialized."""
    return GlobalHydra.instance().config_loader()


def options(name: str, group: str) -> list[str]:
    """Return the options of a group of a command; none if the group does not exist."""
    path = group.partition("@")[0]
    return sorted(loader().get_group_options(path, ObjectType.CONFIG, config_name=name))


def parsed(line: str) -> Override:
    """Return an override; raise a `ConfigError` if it cannot be parsed."""
    try:
        return OverridesParser.create(config_loader=loader()).parse_override(line)
    except HydraException as error:
        if "=" not in line:
            raise ConfigError(f"{line} must be written as KEY=VALUE") from error
        key = line.partition("=")[0]
        raise ConfigError(f"{line} cannot be read; quote the value: '{key}=\"...\"'") from error


def composed(name: str, lines: Sequence[str]) -> DictConfig:
    """Return the configuration of a command with overrides, including the node `hydra`.

    Raises a `ConfigError` if an override cannot be applied: with the most similar key of the same
    node if there is one, else with the message of Hydra.
    """
    try:
        cfg = hydra.compose(name, overrides=list(lines), return_hydra_config=True)
    except REFUSED as error:
        _check_spelling(name, lines, str(error))
        message = str(error).partition("Config search path")[0].splitlines()
        text = " ".join(line.strip() for line in message if line and "full_key" not in line)
        for group, extra in EXTRAS.items():
            text += f"; more come with {install(extra)}" if f"'{group}/" in text else ""
        raise ConfigError(text) from error
    keys = {line[1:].lstrip("+").partition("=")[0] for line in lines if line[0] == "+"}
    if new := {key for key in keys if "." not in key and not options(name, key)}:
        known = {str(key) for key in hydra.compose(name)}
        validation.refuse_unknown("", sorted(new), known, "this command has no such key")
    return cfg


def _check_spelling(name: str, lines: Sequence[str], message: str) -> None:
    """Raise a `ConfigError` if the key that Hydra refuses resembles a key of the same node."""
    if found := re.match(r"Could not override '((?:([\w.]+)\.)?(\w+))'", message):
        others = [line for line in lines if not line.startswith(f"{found[1]}=")]
        try:
            cfg = hydra.compose(name, overrides=others)
        except REFUSED:  # its message names the first of several
            return
        node = OmegaConf.select(cfg, found[2]) if found[2] else cfg
        known = [*map(str, node)] if isinstance(node, DictConfig) else []
        if near := difflib.get_close_matches(found[3], known, 1, SIMILAR):
            place = ".".join(filter(None, (found[2], near[0])))
            raise ConfigError(f"{found[1]}: there is no such key; did you mean {place}?")
