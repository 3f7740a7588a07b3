"""Composition root: from a configuration to objects, from a run's folder back to its surrogate.

Above it only `commands` know Hydra, below it nothing does.
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
    from dpl.fem import Problem
    from dpl.training import Surrogate


SCENE = (  # keys that make a scene, and those that make a surrogate of it
    *("mesh", "degree", "mean_dilatation", "supports", "forces"),
    *("material", "young", "loads", "solver"),
)
NETWORK = ("model", "loss", "optimizer", "scheduler", "seed")


def to_container(cfg: DictConfig) -> dict[str, Any]:
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
        told = str(error.msg or error).splitlines()[0]
        raise ConfigError(f"{error.full_key or 'config'}: {told}") from None


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """Return what makes one run differ from another, flat, see `dpl.config.validation.columns`.

    Raises:
        ConfigError: A value is missing.
    """
    return dict(validation.columns(to_container(cfg)))


def check(cfg: DictConfig, *, trust: bool = True) -> None:
    """Hold a configuration against `dpl.config.validation`, before anything is called.

    Raises:
        ConfigError: See `dpl.config.validation.check`.
    """
    written = typing.cast("dict[str, Any]", OmegaConf.to_container(cfg))
    validation.check(written, to_container(cfg), trust=trust)


def instantiate(cfg: DictConfig, key: str, /, **more: Any) -> Any:
    """Return the object of one node; `more` goes into the call (of a partial: into the second).

    Raises:
        ConfigError: It is not there, its values are out of range, it gives another kind of object
            than the key stands for, or its file is not there.
    """
    _need(cfg, key)
    made = _made(cfg[key], key, more)
    own = callable(made) and key == "clamped"  # a region may be any function of points
    partial = own or (not more and isinstance(made, functools.partial))
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


def _need(cfg: DictConfig, *keys: str) -> None:
    """Raise where one of the keys is not there."""
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
        ConfigError: Something in it cannot work.
    """
    from dpl.fem import Problem

    _need(cfg, *SCENE)
    material = instantiate(cfg, "material")
    with _shown_warnings():
        mesh = instantiate(cfg, "mesh")
    clamped = instantiate(cfg, "clamped") if cfg.get("clamped") is not None else None
    if cfg.degree not in (1, 2):
        raise ConfigError(f"degree = {cfg.degree} must be 1 or 2")
    if not isinstance(cfg.mean_dilatation, bool):
        raise ConfigError(f"mean_dilatation = {cfg.mean_dilatation!r} must be true or false")
    with _shown_warnings():
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
    if not problem.free.any():
        raise ConfigError("clamped or supports: every node is held; hold fewer of them")
    if loose := problem.unconstrained_rigid_body_modes():
        raise ConfigError(
            f"clamped: {len(loose)} rigid modes are unconstrained: {', '.join(loose)}"
        )
    solver = instantiate(cfg, "solver", problem=problem)
    young = OmegaConf.to_container(cfg.young) if isinstance(cfg.young, ListConfig) else cfg.young
    if not validation.matches_type(young, float | Sequence[float]):
        raise ConfigError(f"young = {young!r} must be a modulus [Pa] or a range [low, high]")
    loads = instantiate(
        cfg, "loads", linear=solver.linear_solver, young=young, constant_force=_always(cfg, problem)
    )
    try:
        loads.largest_force  # noqa: B018  # which says whether the body allows these loads
    except ValueError as error:
        raise ConfigError(f"loads: {error}") from error
    except SingularMatrix as error:
        told = f"material, mesh, clamped or supports: K(0) cannot be used: {error}"
        raise ConfigError(told) from error
    return Scene(problem, loads, solver)


@contextlib.contextmanager
def _shown_warnings() -> Iterator[None]:
    """Print what is warned of in here, a line each, once."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        yield
    for line in {str(w.message): None for w in warned if w.category is UserWarning}:
        print(f"warning: {line}", file=sys.stderr)


def _parts(cfg: DictConfig, key: str) -> list[Any]:
    """Return the objects of a node that names several, {} or null for none."""
    node = cfg[key]
    if node is None:
        return []
    if not isinstance(node, DictConfig):
        raise ConfigError(f"{key} = {node!r} must name its parts: {key}: {{name: {{...}}}}")
    parts = {str(name): _made(node[name], f"{key}.{name}", {}) for name in node if node[name]}
    for name, part in parts.items():
        if not validation.is_instance_of(type(part), validation.EXPECTED_TYPES[key]):
            kinds = _expected(key, type(part))
            raise ConfigError(f"{key}.{name} gives {_a(part)}; it must give {kinds}")
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
    from dpl.training import Surrogate

    _need(cfg, *NETWORK)
    # both are tried on one number, so that their errors come before any solve
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


def show_skipped_work(scene: Scene, *parts: Any) -> None:
    """Print the size of the body, and what a scene and the parts of a run do not need and skip."""
    lines = [line for part in (scene, *parts) for line in part.skipped_work()]
    print(scene.body())
    print("plan: skipped, because this scene does not need it")
    print("\n".join(f"  - {line}" for line in lines), flush=True)
    if advice := slow_blas():
        print(f"warning: {advice}", file=sys.stderr)
