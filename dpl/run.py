"""Composition root: from a configuration to objects, from a run's folder back to its surrogate.

The only file of the package that knows Hydra.
"""

import contextlib
import errno
import functools
import importlib
import inspect
import logging
import math
import sys
import types
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from dpl.data.durable import DataSetError
from dpl.fem.linear import slow_blas
from dpl.fem.sparse import SingularMatrix
from dpl.scene import Scene

if typing.TYPE_CHECKING:
    from dpl.data.datamodule import OfflineData
    from dpl.fem.problem import Problem
    from dpl.module import Surrogate

R = typing.TypeVar("R")

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # disk, quota, limit of the shell
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
WHOLE, NAMES = Sequence[int], Sequence[str] | None
KEYS: dict[str, Any] = {  # what a configuration may hold at its top, and of which kind
    **dict.fromkeys(("mesh", "material", "loads", "solver"), dict),
    **dict.fromkeys(("clamped", "supports", "forces"), dict | None),
    **{"degree": int, "mean_dilatation": bool, "young": float | Sequence[float]},
    **dict.fromkeys(("data", "model", "loss", "optimizer", "trainer"), dict),
    **{"scheduler": dict | None, "seed": int, "ckpt_path": str | None},
    **{"run": str | None, "folder": str, "tol": float},
    **{"action": str, "shard": int, "shards": int},
    **{"parts": Sequence[str], "linear": Sequence[str], "peers": dict},
    **dict.fromkeys(("repeats", "count", "workers", "samples", "far"), int),
    **{"name": str, "galerkin": dict | None, "corrected": dict | None},
    **{"networks": NAMES, "tols": Sequence[float], "resume": bool, "cases": NAMES},
    **{"threads": Sequence[int | None], "across": WHOLE},
}
SPANS = {  # smallest and largest of them
    **{"repeats": (1, 10**6), "samples": (1, 10**6), "shards": (1, math.inf)},
    **{"count": (0, 10**6), "far": (0, 10**6), "workers": (0, 1024), "seed": (0, 2**32 - 1)},
    **{"tol": (1e-15, 1), "tols": (1e-15, 1), "across": (1, 10**3), "threads": (1, 10**4)},
}
SCENE = (  # keys that make a scene, and those that make a surrogate of it
    *("mesh", "degree", "mean_dilatation", "clamped", "supports", "forces"),
    *("material", "young", "loads", "solver"),
)
NETWORK = ("model", "loss", "optimizer", "scheduler", "seed")

KINDS = {  # what the call under a key must give: one of these, or of a class derived from them
    "mesh": {"skfem.mesh.mesh.Mesh"},
    "material": {"dpl.fem.law.Material"},
    "clamped": {f"dpl.fem.regions.{n}" for n in ("Plane", "Box", "Sphere", "Cylinder", "Tag")},
    "supports": {"dpl.fem.supports.Displacement", "dpl.fem.supports.Spring"},
    "forces": {"dpl.fem.forces.Traction", "dpl.fem.forces.BodyForce"},
    "solver": {"dpl.fem.newton.Newton"},
    "loads": {"dpl.fem.modes.ModalLoads"},
    "data": {"dpl.data.generate.DataSet", "dpl.data.datamodule.OfflineData"},
    "model": {"torch.nn.modules.module.Module"},
    "loss": {"dpl.losses.Loss"},
    "optimizer": {"torch.optim.optimizer.Optimizer"},
    "scheduler": {"torch.optim.lr_scheduler.LRScheduler"},
    "trainer": {"lightning.pytorch.trainer.trainer.Trainer"},
}
SEVERAL = ("supports", "forces")  # keys that hold calls by name
WATCHING = {  # what a trainer may be given besides
    "lightning.pytorch.callbacks.callback.Callback",
    "lightning.pytorch.loggers.logger.Logger",
    "lightning.fabric.plugins.io.checkpoint_io.CheckpointIO",
}
TRUSTED = {  # functions that a run's folder may name without being asked; classes are in KINDS
    *(f"dpl.fem.mesh.{name}" for name in ("box", "rectangle", "propeller", "load")),
    *(f"dpl.fem.sampling.{name}" for name in ("uniform", "normal", "even", "one")),
    *(f"dpl.fem.sampling.{name}" for name in ("logarithmic", "tail")),
    "dpl.module.warmup_cosine",
}
OURS = ("dpl.", "torch.optim.")  # where those classes are
OWN = {"_target_", "_partial_", "_recursive_", "_convert_"}  # Hydra's own options of a call

ASIDE = {  # where a run lies and how it is watched, not what it is
    *("run", "folder", "ckpt_path", "data.folder"),
    *("trainer.callbacks", "trainer.logger", "trainer.plugins"),
}


class ConfigError(ValueError):
    """A configuration that cannot work: which key, what is wrong, what to do, in one line."""

    def __init__(self, told: str) -> None:
        """Fold what is told into a line."""
        super().__init__(" ".join(filter(None, map(str.strip, told.splitlines()))))


def command(task: Callable[[DictConfig], R]) -> Callable[[DictConfig], R]:
    """Return a task that ends bad input with one line and a status of 2, Ctrl-C with 130."""

    @functools.wraps(task)
    def wrapped(cfg: DictConfig) -> R:
        logging.getLogger("skfem").setLevel(logging.WARNING)
        for name in ("lightning.pytorch", "lightning.fabric"):  # they print for themselves
            logging.getLogger(name).propagate = False
        try:
            return task(cfg)
        except (ConfigError, DataSetError) as error:
            print(f"error: {error}", file=sys.stderr)
            _drop_empty(Path(HydraConfig.get().runtime.output_dir))
            sys.exit(2)
        except OSError as error:
            if error.errno not in (*FULL, *FORBIDDEN):
                raise
            where = f" for {error.filename}" if error.filename else ""
            full = error.errno in FULL
            told = f"no space left{where}" if full else f"no permission to write{where}"
            do = "make room" if full else "choose another folder or change its rights"
            print(
                f"error: {told}; what was there is whole: {do} and run the same command again",
                file=sys.stderr,
            )
            sys.exit(2)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(130)

    return wrapped


def _drop_empty(folder: Path) -> None:
    """Remove the folders that Hydra made below this one for a run that did not begin."""
    here = Path.cwd()
    with contextlib.suppress(OSError):  # not empty
        while here in folder.parents:
            folder.rmdir()
            folder = folder.parent


def plain(cfg: DictConfig) -> dict[str, Any]:
    """Return a configuration as plain data, interpolations resolved.

    Raises:
        ConfigError: A value is missing.
    """
    try:
        return typing.cast(
            "dict[str, Any]", OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        )
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key} is missing; set it on the command line") from None
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key or 'config'}: {error.msg or error}") from None


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """Return what makes one run differ from another, flat: numbers, truth values and texts.

    Under the keys of the command line (`model.width`). A call stands under its own key by the name
    of what it calls (`model`: FCNN). Left out are null and `ASIDE`.

    Raises:
        ConfigError: A value is missing.
    """
    return dict(_columns(plain(cfg)))


def _columns(node: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        place = f"{path}.{key}" if path else key
        if value is None or place in ASIDE:
            continue
        if isinstance(value, dict):
            yield from _columns(value, place)
        elif key == "_target_":
            yield path, value.rpartition(".")[2]
        elif not key.startswith("_"):
            yield place, str(value) if isinstance(value, list) else value


def check(cfg: DictConfig, *, trust: bool = True) -> None:
    """Hold a configuration against the signatures that it calls, before anything is called.

    Args:
        cfg: The configuration.
        trust: Whether it may name any object to call, or only what the keys of a run stand for:
            classes of this package and of PyTorch's optimisers, and the functions of `TRUSTED`.

    Raises:
        ConfigError: A key that its object does not know, a value of another type, a number that is
            not finite or out of range, or an object that does not exist or is not trusted.
    """
    resolved = plain(cfg)
    if unknown := sorted({str(key) for key in resolved} - set(KEYS)):
        raise ConfigError(f"{unknown[0]}: no such key; there are {', '.join(sorted(KEYS))}")
    for node in (OmegaConf.to_container(cfg), resolved):  # first where a value is written
        for path, value in _walk(node):
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{path} = {value} is not a finite number")
            if isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise ConfigError(f"{path} = {value} does not fit into 64 bits")
    for key, value in resolved.items():
        _check_top(key, value)
    for path, node in _walk(resolved):
        if isinstance(node, dict) and "_target_" in node:
            _check_call(path, node, _target(path, node["_target_"], trust=trust))
        elif _is_call(path) and node is not None:
            raise ConfigError(f"{path} = {node!r} must be a call: its _target_ is missing")


def _is_call(path: str) -> bool:
    """Return whether what lies at a path must be a call."""
    key, *below = path.split(".")
    return len(below) == (key in SEVERAL) and key in KINDS


def _check_top(key: str, value: Any) -> None:
    """Hold the value of a key against what it must be."""
    if key == "folder" and value is None:  # of scripts that write nothing
        return
    if not _fits(value, KEYS[key]):
        raise ConfigError(f"{key} = {value!r} must be {_words(KEYS[key])}")
    least, most = SPANS.get(key, (-math.inf, math.inf))
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, int | float) and not least <= one <= most:
            raise ConfigError(f"{key} = {value} must lie between {least:g} and {most:.10g}")


def _target(path: str, name: Any, *, trust: bool) -> Callable[..., Any]:
    """Return what a call names.

    Raises:
        ConfigError: It does not exist, cannot be called or is not trusted.
    """
    foreign = f"{path} names {name}, which is none of this package's; not called"
    watching = path.split(".")[0] == "trainer"
    ours = (*OURS, "lightning.") if watching else OURS
    if not isinstance(name, str):
        raise ConfigError(f"{path}._target_ = {name!r} must be a text")
    if not trust and not name.startswith(ours):
        raise ConfigError(foreign)
    try:
        module, _, attribute = name.rpartition(".")
        target = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError):
        raise ConfigError(f"{path}._target_ = {name!r} does not exist") from None
    if not callable(target):
        raise ConfigError(f"{path}._target_ = {name!r} cannot be called")
    if not trust and name not in TRUSTED:
        kinds = set().union(*KINDS.values(), WATCHING if watching else ())
        if not (inspect.isclass(target) and f"{target.__module__}.".startswith(ours)):
            raise ConfigError(foreign)
        if not _is_a(target, kinds):
            raise ConfigError(foreign)
    return typing.cast("Callable[..., Any]", target)


def _is_a(kind: type, names: set[str]) -> bool:
    """Return whether a class is one of these or derived from them, none of them imported."""
    return not names.isdisjoint(f"{base.__module__}.{base.__qualname__}" for base in kind.__mro__)


def _check_call(path: str, node: dict[str, Any], target: Callable[..., Any]) -> None:
    try:
        known, hints = _signature(target)
    except (TypeError, ValueError):  # of what is written in C
        raise ConfigError(f"{path}._target_ = {node['_target_']!r} has no known options") from None
    for key, value in node.items():
        if key in OWN:
            if key.endswith(("partial_", "recursive_")) and not isinstance(value, bool):
                raise ConfigError(f"{path}.{key} = {value!r} must be true or false")
            continue
        if key not in known:
            named = ", ".join(sorted(known))
            raise ConfigError(
                f"{path}.{key}: {node['_target_']} has no such option; it has {named}"
            )
        if key in hints and not _fits(value, hints[key]):
            raise ConfigError(f"{path}.{key} = {value!r} must be {_words(hints[key])}")


def _signature(target: Callable[..., Any]) -> tuple[set[str], dict[str, Any]]:
    """Return the keywords of a call and their types; **kwargs stand for those of the parents."""
    classes = inspect.getmro(target) if inspect.isclass(target) else ()
    levels = [vars(c)["__init__"] for c in classes if "__init__" in vars(c)]
    known: set[str] = set()
    hints: dict[str, Any] = {}
    for level in levels or [target]:
        parameters = inspect.signature(level).parameters
        known |= set(parameters)
        with contextlib.suppress(NameError, TypeError):
            hints = typing.get_type_hints(level) | hints
        if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            break
    return known - {"self", "args", "kwargs"}, hints


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a plain value can be what a type hint says; hints of objects accept all."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return any(_fits(value, argument) for argument in arguments)
    if isinstance(value, dict) and "_target_" in value:
        return True  # another call
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if origin is typing.Literal:
        return value in arguments
    if origin is tuple and Ellipsis not in arguments:
        many = isinstance(value, list) and len(value) == len(arguments)
        return many and all(map(_fits, value, arguments))
    if origin in (Sequence, Iterable, list, tuple):
        return isinstance(value, list) and all(_fits(item, arguments[0]) for item in value)
    if origin is Callable:
        return False
    if hint is Path:
        return isinstance(value, str)
    if isinstance(origin or hint, type) and hint is not object:
        return isinstance(value, origin or hint)
    return True


def _words(hint: Any) -> str:
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    names |= {Path: "a path", types.NoneType: "null", dict: "a call or several by name"}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_words(argument) for argument in arguments)
    if origin is Sequence:
        return f"a list, each {_words(arguments[0])}"
    return names.get(hint, str(hint))


def _walk(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a node and all below it with their paths."""
    yield path, node
    entries: Any = ()
    if isinstance(node, dict):
        entries = node.items()
    elif isinstance(node, list):
        entries = enumerate(node)
    for key, value in entries:
        yield from _walk(value, f"{path}.{key}" if path else str(key))


def make(cfg: DictConfig, key: str, /, **more: Any) -> Any:
    """Return the object of one node; `more` goes into the call (of a partial: into the second).

    Raises:
        ConfigError: It is not there, its values are out of range, it gives another kind of object
            than the key stands for, or its file is not there.
    """
    _need(cfg, key)
    made = _made(cfg[key], key, more)
    own = callable(made) and key == "clamped"  # a region may be any function of points
    partial = own or (not more and isinstance(made, functools.partial))
    if key in KINDS and not partial and not _is_a(type(made), KINDS[key]):
        raise ConfigError(f"{key} gives {_a(made)}; it must give {_named(KINDS[key])}")
    return made


def _made(node: Any, key: str, more: dict[str, Any]) -> Any:
    try:
        made = hydra.utils.instantiate(node, _convert_="all")
        return made(**more) if more else made
    except InstantiationException as error:
        cause = error.__cause__ or error
        raise ConfigError(f"{key}: {cause or type(cause).__name__}") from error
    except (ValueError, TypeError, ArithmeticError, LookupError) as error:
        raise ConfigError(f"{key}: {error}") from error
    except (RuntimeError, MemoryError, OSError) as error:
        raise ConfigError(f"{key}: {error or type(error).__name__}") from error


def _need(cfg: DictConfig, *keys: str) -> None:
    """Raise where one of the keys is not there."""
    for key in keys:
        if key not in cfg:
            raise ConfigError(f"{key} is missing")


def _a(made: Any) -> str:
    return f"an object of {type(made).__name__}"


def _named(kinds: set[str]) -> str:
    return " or ".join(sorted(kind.rpartition(".")[2] for kind in kinds))


def build_scene(cfg: DictConfig) -> Scene:
    """Return the scene of a configuration.

    Raises:
        ConfigError: Something in it cannot work.
    """
    from dpl.fem.problem import Problem

    _need(cfg, *SCENE)
    material, mesh = make(cfg, "material"), make(cfg, "mesh")
    clamped = make(cfg, "clamped") if cfg.get("clamped") is not None else None
    if cfg.degree not in (1, 2):
        raise ConfigError(f"degree = {cfg.degree} must be 1 or 2")
    if not isinstance(cfg.mean_dilatation, bool):
        raise ConfigError(f"mean_dilatation = {cfg.mean_dilatation!r} must be true or false")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        try:
            problem = Problem.build(
                mesh,
                material,
                fixed=clamped,
                supports=_parts(cfg, "supports"),
                degree=cfg.degree,
                mean_dilatation=cfg.mean_dilatation,
            )
        except ValueError as error:
            key = "clamped or supports" if cfg.supports else "clamped"
            told = str(error)
            key = "mean_dilatation" if told.startswith("mean_dilatation") else key
            raise ConfigError(f"{key}: {told.removeprefix('mean_dilatation: ')}") from error
    for line in {str(w.message): None for w in warned if w.category is UserWarning}:
        print(f"warning: {line}", file=sys.stderr)
    if not problem.free.any():
        raise ConfigError("clamped or supports: every node is held; hold fewer of them")
    if loose := problem.loose_modes():
        raise ConfigError(
            f"clamped: {len(loose)} rigid modes are unconstrained: {', '.join(loose)}"
        )
    solver = make(cfg, "solver", problem=problem)
    young = OmegaConf.to_container(cfg.young) if isinstance(cfg.young, ListConfig) else cfg.young
    if not _fits(young, float | Sequence[float]):
        raise ConfigError(f"young = {young!r} must be a modulus [Pa] or a range [low, high]")
    loads = make(cfg, "loads", linear=solver.rest, young=young, always=_always(cfg, problem))
    try:
        loads.modes  # noqa: B018  # which says whether there are so many
    except ValueError as error:
        raise ConfigError(f"loads: {error}") from error
    except SingularMatrix as error:
        told = f"material, mesh, clamped or supports: K(0) cannot be used: {error}"
        raise ConfigError(told) from error
    return Scene(problem, loads, solver)


def _parts(cfg: DictConfig, key: str) -> list[Any]:
    """Return the objects of a node that names several, {} or null for none."""
    node = cfg[key]
    if node is None:
        return []
    if not isinstance(node, DictConfig):
        raise ConfigError(f"{key} = {node!r} must name its parts: {key}: {{name: {{...}}}}")
    parts = {str(name): _made(node[name], f"{key}.{name}", {}) for name in node if node[name]}
    for name, part in parts.items():
        if not _is_a(type(part), KINDS[key]):
            raise ConfigError(f"{key}.{name} gives {_a(part)}; it must give {_named(KINDS[key])}")
    return list(parts.values())


def _always(cfg: DictConfig, problem: "Problem") -> torch.Tensor | None:
    """Return the force that every load holds, (N, D) [-]; None if there is none."""
    try:
        forces = [part.on(problem) for part in _parts(cfg, "forces")]
    except ValueError as error:
        raise ConfigError(f"forces: {error}") from error
    return torch.stack(forces).sum(dim=0) if forces else None


def build_surrogate(cfg: DictConfig, scene: Scene) -> "Surrogate":
    """Return the untrained surrogate of a configuration; its weights are a function of `seed`.

    Raises:
        ConfigError: Something in it cannot work.
    """
    from dpl.module import Surrogate

    _need(cfg, *NETWORK)
    # both are tried on one number, so that their errors come before any solve
    trial = make(cfg, "optimizer", params=[torch.nn.Parameter(torch.zeros(1))])
    if cfg.scheduler:
        make(cfg, "scheduler", optimizer=trial, total_steps=1)
    torch.manual_seed(cfg.seed)
    parts = make(cfg, "model", scene=scene), make(cfg, "loss")
    optimizer = make(cfg, "optimizer")
    scheduler = make(cfg, "scheduler") if cfg.scheduler else None
    try:
        return Surrogate(*parts, scene, optimizer=optimizer, scheduler=scheduler)
    except ValueError as error:
        raise ConfigError(f"model: {error}") from error


def check_processes(trainer: Any) -> None:
    """Refuse the sweep whose training starts further processes: each would start the sweep again.

    Raises:
        ConfigError: It is one.
    """
    from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

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
        do = "pip install -c constraints.txt -e '.[sweep]'"
        print(f"error: sweep: Optuna cannot be used ({error}): {do}", file=sys.stderr)
        sys.exit(2)


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


def show_plan(*parts: Any) -> None:
    """Print what the parts of a run do not need and skip."""
    lines = [line for part in parts for line in part.plan()]
    print("plan: skipped, because this scene does not need it")
    print("\n".join(f"  - {line}" for line in lines), flush=True)
    if advice := slow_blas():
        print(f"warning: {advice}", file=sys.stderr)


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write a configuration, resolved, into a run's folder.

    Raises:
        ConfigError: The folder holds a run already, and this one does not resume it.
    """
    there = folder / "config.yaml"
    if (folder / "checkpoints" / "last.ckpt").exists() and not cfg.ckpt_path:
        raise ConfigError(
            f"run: {folder} holds a run; resume it with ckpt_path=last or name another"
        )
    folder.mkdir(parents=True, exist_ok=True)
    there.write_text(OmegaConf.to_yaml(OmegaConf.create(plain(cfg))))


def load_run(
    folder: str | Path, *, trust: bool = False, scene: Scene | None = None
) -> tuple[DictConfig, "Surrogate"]:
    """Return the configuration and the best surrogate of a training run.

    Args:
        folder: The run's.
        scene: Its scene, where that is there already; built anew if left out.
        trust: Whether its configuration may name objects outside this package, such as your own
            law: they are imported and called.

    Raises:
        ConfigError: There is no finished run, or it names what is not trusted.
    """
    config, best = Path(folder) / "config.yaml", Path(folder) / "checkpoints" / "best.ckpt"
    if not best.exists():  # a run too short to be validated
        best = best.with_name("last.ckpt")
    for path in (config, best):
        if not path.is_file():
            raise ConfigError(f"run = {folder} has no {path.relative_to(folder)}; train it first")
    cfg = typing.cast(DictConfig, OmegaConf.load(config))
    check(cfg, trust=trust)
    surrogate = build_surrogate(cfg, build_scene(cfg) if scene is None else scene)
    try:
        checkpoint = torch.load(best, map_location="cpu", weights_only=True)
        surrogate.on_load_checkpoint(checkpoint)
        surrogate.load_state_dict(checkpoint["state_dict"])
    except (OSError, ValueError, KeyError, RuntimeError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{best} cannot be used: {reason}") from error
    return cfg, surrogate.eval()


def load_runs(
    folder: str | Path, names: Sequence[str] | None = None
) -> dict[str, tuple[DictConfig, "Surrogate"]]:
    """Return the configurations and surrogates of the runs in a folder; they share one scene.

    Args:
        folder: That holds the folders of runs.
        names: Of those; all if left out.

    Raises:
        ConfigError: There are none, or one cannot be used or belongs to another scene.
    """
    if names is None:
        names = sorted(path.parent.name for path in Path(folder).glob("*/config.yaml"))
    if not names:
        raise ConfigError(f"run: {folder} holds no runs; train some with run={folder}/NAME")
    runs: dict[str, tuple[DictConfig, Surrogate]] = {}
    scene = None
    for name in names:
        runs[name] = load_run(Path(folder) / name, scene=scene)
        scene = runs[name][1].scene
    return runs


def load_data(cfg: DictConfig, scene: Scene) -> "OfflineData":
    """Return the data set of a training run, made where it is missing.

    Args:
        cfg: The run's configuration.
        scene: Its scene.

    Raises:
        ConfigError: It cannot be made.
    """
    data = make(cfg, "data", scene=scene)
    data.prepare_data()
    return data
