"""Build scenes, surrogates and trainers from configurations.

Only this folder and `dpl.commands` import Hydra.
"""

import contextlib
import functools
import sys
import typing
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import hydra
import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from dpl.config import validation
from dpl.config.validation import ConfigError
from dpl.fem import SingularMatrix
from dpl.scene import Scene
from dpl.system.blas import slow_blas

if typing.TYPE_CHECKING:
    import lightning as L

    from dpl.fem import Problem
    from dpl.training import Surrogate


SCENE = (  # keys of a scene; those of a surrogate
    *("mesh", "degree", "mean_dilatation", "supports", "forces"),
    *("material", "young", "loads", "solver"),
)
NETWORK = ("model", "loss", "optimizer", "scheduler", "seed")


def to_container(cfg: DictConfig) -> dict[str, Any]:
    """Return a configuration as a dictionary without interpolations.

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
        message = str(error.msg or error).splitlines()[0]
        raise ConfigError(f"{error.full_key or 'config'}: {message}") from None


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """Return the hyperparameters of a run, flat, see `dpl.config.validation.columns`.

    Raises:
        ConfigError: A value is missing.
    """
    return dict(validation.columns(to_container(cfg)))


def check(cfg: DictConfig, *, trust: bool = True) -> None:
    """Check a configuration without calling anything, see `dpl.config.validation.check`.

    Raises:
        ConfigError: A key, a type, a range or a called object is invalid.
    """
    written = typing.cast("dict[str, Any]", OmegaConf.to_container(cfg))
    validation.check(written, to_container(cfg), trust=trust)


def instantiate(cfg: DictConfig, key: str, /, **more: Any) -> Any:
    """Return the object of a node.

    Args:
        cfg: The configuration.
        key: Key of the node.
        **more: Arguments of the call; of a partial (`_partial_: true`), those of its call.

    Raises:
        ConfigError: The node or its file does not exist, an argument is out of range, or the object
            has another type than the key requires.
    """
    require_keys(cfg, key)
    made = _made(cfg[key], key, more)
    is_region = callable(made) and key == "fixed"  # a region may be any function of points
    partial = is_region or (not more and isinstance(made, functools.partial))
    if (
        key in validation.EXPECTED_TYPES
        and not partial
        and not validation.is_instance_of(type(made), validation.EXPECTED_TYPES[key])
    ):
        raise ConfigError(f"{key} gives {_a(made)}; it must give {_expected(key, type(made))}")
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


def require_keys(cfg: DictConfig, *keys: str) -> None:
    """Raise a `ConfigError` if a key does not exist."""
    for key in keys:
        if key not in cfg:
            raise ConfigError(f"{key} is missing")


def _a(made: Any) -> str:
    return f"an object of {type(made).__name__}"


def _expected(key: str, found: type) -> str:
    """Return the types that a key stands for, and which members of a protocol a class lacks."""
    kinds = validation.EXPECTED_TYPES[key]
    lines = [" or ".join(sorted(kind.rpartition(".")[2] for kind in kinds))]
    for protocol in sorted(kinds & validation.PROTOCOLS):
        missing = sorted(validation.missing_members(found, protocol))
        lines.append(f"which has {', '.join(missing)}; see dpl.fem.{protocol.rpartition('.')[2]}")
    return ", ".join(lines)


def build_scene(cfg: DictConfig) -> Scene:
    """Return the scene of a configuration.

    Raises:
        ConfigError: The scene cannot be built; the message names the key.
    """
    from dpl.fem import Problem

    require_keys(cfg, *SCENE)
    material = instantiate(cfg, "material")
    with _shown_warnings():
        mesh = instantiate(cfg, "mesh")
    fixed = instantiate(cfg, "fixed") if cfg.get("fixed") is not None else None
    if cfg.degree not in (1, 2):
        raise ConfigError(f"degree = {cfg.degree} must be 1 or 2")
    if not isinstance(cfg.mean_dilatation, bool):
        raise ConfigError(f"mean_dilatation = {cfg.mean_dilatation!r} must be true or false")
    with _shown_warnings():
        try:
            problem = Problem.build(
                mesh,
                material,
                fixed=fixed,
                supports=_parts(cfg, "supports"),
                degree=cfg.degree,
                mean_dilatation=cfg.mean_dilatation,
            )
        except ValueError as error:
            key = "fixed or supports" if cfg.supports else "fixed"
            message = str(error)
            key = "mean_dilatation" if message.startswith("mean_dilatation") else key
            raise ConfigError(f"{key}: {message.removeprefix('mean_dilatation: ')}") from error
    if not problem.free.any():
        raise ConfigError("fixed or supports: all nodes are fixed; fix fewer nodes")
    if loose := problem.unconstrained_rigid_body_modes():
        raise ConfigError(f"fixed: {len(loose)} rigid modes are unconstrained: {', '.join(loose)}")
    solver = instantiate(cfg, "solver", problem=problem)
    young = OmegaConf.to_container(cfg.young) if isinstance(cfg.young, ListConfig) else cfg.young
    if not validation.matches_type(young, float | Sequence[float]):
        raise ConfigError(f"young = {young!r} must be a modulus [Pa] or a range [low, high]")
    loads = instantiate(
        cfg,
        "loads",
        linear=solver.linear_solver,
        young=young,
        constant_force=_constant_force(cfg, problem),
    )
    try:
        loads.largest_force  # noqa: B018  # raises if the body does not allow these loads
    except ValueError as error:
        raise ConfigError(f"loads: {error}") from error
    except SingularMatrix as error:
        message = f"material, mesh, fixed or supports: K(0) cannot be used: {error}"
        raise ConfigError(message) from error
    return Scene(problem, loads, solver)


@contextlib.contextmanager
def _shown_warnings() -> Iterator[None]:
    """Print the warnings of the block to stderr, each once and in one line."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        yield
    for line in {str(w.message): None for w in warned if w.category is UserWarning}:
        print(f"warning: {line}", file=sys.stderr)


def _parts(cfg: DictConfig, key: str) -> list[Any]:
    """Return the objects of a node that names several; none for {} or null."""
    node = cfg.get(key)
    if node is None:
        return []
    if not isinstance(node, DictConfig):
        raise ConfigError(
            f"{key} = {node!r} must be a mapping of names to calls: {key}: {{name: {{...}}}}"
        )
    parts = {str(name): _made(node[name], f"{key}.{name}", {}) for name in node if node[name]}
    for name, part in parts.items():
        if not validation.is_instance_of(type(part), validation.EXPECTED_TYPES[key]):
            kinds = _expected(key, type(part))
            raise ConfigError(f"{key}.{name} gives {_a(part)}; it must give {kinds}")
    return list(parts.values())


def _constant_force(cfg: DictConfig, problem: "Problem") -> torch.Tensor | None:
    """Return the force that is part of every load, (N, D) [-]; None without `forces`."""
    try:
        forces = [part.on(problem) for part in _parts(cfg, "forces")]
    except ValueError as error:
        raise ConfigError(f"forces: {error}") from error
    return torch.stack(forces).sum(dim=0) if forces else None


def build_surrogate(cfg: DictConfig, scene: Scene) -> "Surrogate":
    """Return the untrained surrogate of a configuration; its weights are a function of `seed`.

    Raises:
        ConfigError: The surrogate cannot be built; the message names the key.
    """
    from dpl.training import Surrogate

    require_keys(cfg, *NETWORK)
    # optimiser and schedule are built once for one number: they fail before any solve
    trial = instantiate(cfg, "optimizer", params=[torch.nn.Parameter(torch.zeros(1))])
    if cfg.scheduler:
        instantiate(cfg, "scheduler", optimizer=trial, total_steps=1)
    torch.manual_seed(cfg.seed)
    parts = instantiate(cfg, "model", scene=scene), instantiate(cfg, "loss")
    optimizer = instantiate(cfg, "optimizer")
    scheduler = instantiate(cfg, "scheduler") if cfg.scheduler else None
    try:
        return Surrogate(*parts, scene, optimizer=optimizer, scheduler=scheduler)
    except ValueError as error:
        raise ConfigError(f"model: {error}") from error


def build_trainer(cfg: DictConfig) -> "L.Trainer":
    """Return the trainer of a configuration with its callbacks and loggers.

    Raises:
        ConfigError: One of them cannot be built.
    """
    require_keys(cfg, "trainer")
    callbacks, loggers = (_parts(cfg, key) for key in ("callbacks", "logger"))
    return typing.cast(
        "L.Trainer", instantiate(cfg, "trainer", callbacks=callbacks, logger=loggers or False)
    )


def show_skipped_work(scene: Scene, *parts: Any) -> None:
    """Print the size of the body and the work that the scene and the parts of a run skip."""
    lines = [line for part in (scene, *parts) for line in part.skipped_work()]
    print(scene.body())
    print("plan: skipped, because this scene does not need it")
    print("\n".join(f"  - {line}" for line in lines), flush=True)
    if advice := slow_blas():
        print(f"warning: {advice}", file=sys.stderr)
