"""Build scenes, surrogates and trainers from configurations.

All functions raise a `ConfigError` that names the invalid key. Only this folder and `dpl.commands`
import Hydra.
"""

import functools
import sys
import textwrap
import typing
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import hydra
import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from dpl import models, training
from dpl.config import validation
from dpl.config.plain import error_in, require_keys
from dpl.config.validation import ConfigError
from dpl.fem import Heterogeneous, Material, ParameterRange, Problem, SingularMatrix
from dpl.fem.assembly.follower_loads import FollowerLoad
from dpl.fem.units import Units
from dpl.scene import Scene
from dpl.system.threads import slow_blas

if typing.TYPE_CHECKING:
    import lightning as L

SCENE = (  # keys of a scene; those of a surrogate
    *("mesh", "degree", "mean_dilatation", "supports", "forces"),
    *("material", "young", "loads", "solver"),
)
NETWORK = ("model", "loss", "optimizer", "scheduler", "seed")
WIDTH = 100  # characters of a line of the plan
CANNOT_BE_MADE = (  # errors of a call with invalid arguments
    *(InstantiationException, ValueError, TypeError, ArithmeticError, LookupError),
    *(RuntimeError, MemoryError, OSError),
)


def instantiate(cfg: DictConfig, key: str, /, **more: Any) -> Any:
    """Return the object of the node under a key.

    `more` are arguments of the call; of a partial (`_partial_: true`), those of its call.
    """
    require_keys(cfg, key)
    made = _made(cfg[key], key, more)
    is_region = callable(made) and key == "fixed"  # a region may be any function of points
    is_partial = not more and isinstance(made, functools.partial)
    return made if is_region or is_partial else _of_kind(made, key, key)


def _made(node: Any, place: str, more: dict[str, Any]) -> Any:
    try:
        # the name of a group of the mesh is a value
        made = hydra.utils.instantiate(node, _convert_="all") if OmegaConf.is_config(node) else node
        return made(**more) if more else made
    except CANNOT_BE_MADE as error:
        wrapped = isinstance(error, InstantiationException) and error.__cause__
        cause = wrapped or error
        partial = "; set _partial_: true if the caller gives it" if "missing" in str(cause) else ""
        remedy = partial if isinstance(cause, TypeError) else ""
        raise ConfigError(f"{place}: {str(cause) or type(cause).__name__}{remedy}") from error


def _of_kind(made: Any, key: str, place: str) -> Any:
    """Return an object; raise a `ConfigError` if a key must give another type."""
    kinds = validation.EXPECTED_TYPES.get(key)
    if kinds is None or validation.is_instance_of(type(made), kinds):
        return made
    message = [" or ".join(sorted(kind.rpartition(".")[2] for kind in kinds))]
    for protocol in sorted(kinds & validation.PROTOCOLS):
        missing = ", ".join(sorted(validation.missing_members(type(made), protocol)))
        message.append(f"which has {missing}; see dpl.fem.{protocol.rpartition('.')[2]}")
    raise ConfigError(
        f"{place} gives an object of {type(made).__name__}; it must give {', '.join(message)}"
    )


def build_scene(cfg: DictConfig) -> Scene:
    """Return the scene of a configuration."""
    require_keys(cfg, *SCENE)
    law, ends = law_and_moduli(cfg)
    forces = _parts(cfg, "forces")
    follower = {name: f for name, f in forces.items() if isinstance(f, FollowerLoad)}
    problem = _problem(cfg, law, ends[0] if ends[0] == ends[1] else None, follower)
    dead: list[torch.Tensor] = []
    for name, force in forces.items():
        with error_in(f"forces.{name}"):
            dead += [] if name in follower else [force.on(problem)]
    always = torch.stack(dead).sum(dim=0) if dead else None  # (N, D) [-]
    solver = instantiate(cfg, "solver", problem=problem)
    linear = solver.linear_solver
    loads = instantiate(cfg, "loads", linear=linear, young=ends, constant_force=always)
    singular = "material, mesh, fixed or supports: K(0) cannot be used"
    with error_in("loads"), error_in(singular, SingularMatrix):
        loads.largest_force  # noqa: B018  # raises if the body does not allow these loads
    return Scene(problem, loads, solver)


def law_and_moduli(cfg: DictConfig) -> tuple[Material, ParameterRange]:
    """Return the law, its moduli over E, and the range of Young's moduli E of all loads [Pa].

    The moduli of a law have one unit, see `dpl.fem.materials.parameters.Scalable`:

    - `young: null`: the unit is Pa. E is Young's modulus at rest of the law; of several laws that
      of the softest one.
    - `young` is a number or a range: E is `young`. A single law with constants of its own
      (c10, ..., bulk) is scaled so that E is its modulus at rest. Moduli of regions and of laws
      with fibres are over E.

    Where constants have ranges, their middles decide.
    """
    regions = _parts(cfg, "regions")
    if validation.names_several("material", cfg.material):
        laws = _parts(cfg, "material")
        with error_in(""):
            law: Any = Heterogeneous(laws, regions)
    else:
        law = instantiate(cfg, "material")
    if regions and not isinstance(law, Heterogeneous):
        raise ConfigError("regions: the body has one law; give each region one, material.NAME")
    if cfg.young is None:
        with error_in("young = null: material"):
            young = law.young_at_rest
            return law.over(young), ParameterRange(young, young)
    given = OmegaConf.to_container(cfg.young) if OmegaConf.is_config(cfg.young) else cfg.young
    with error_in(""):
        moduli = ParameterRange.of("young", given, is_modulus=True)
    with error_in("material"):
        return law.normalised(), moduli


def _problem(
    cfg: DictConfig, law: Material, young: float | None, follower: Mapping[str, FollowerLoad]
) -> Problem:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        mesh = instantiate(cfg, "mesh")
        fixed = instantiate(cfg, "fixed") if cfg.get("fixed") is not None else None
        supports = _parts(cfg, "supports")
        for name, support in supports.items():
            with error_in(f"supports.{name}"):
                support.dimensionless(mesh.dim(), Units(1.0, young))
        options = {key: cfg[key] for key in ("degree", "mean_dilatation")} | {"young": young}
        options["follower_loads"] = [
            replace(typing.cast("Any", load), name=load.name or name)
            for name, load in follower.items()
        ]
        try:
            problem = Problem.build(
                mesh, law, fixed=fixed, supports=list(supports.values()), **options
            )
        except ValueError as error:
            message = str(error).replace("follower_loads", "forces", 1)
            key = "fixed or supports: " if supports else "fixed: "
            named = message.startswith((*options, "regions", "material", "forces"))
            raise ConfigError(message if named else key + message) from error
    for line in {str(w.message): None for w in warned if w.category is UserWarning}:
        print(f"warning: {line}", file=sys.stderr)
    if not problem.free.any():
        raise ConfigError("fixed or supports: all nodes are fixed; fix fewer nodes")
    if loose := problem.unconstrained_rigid_body_modes():
        raise ConfigError(f"fixed: {len(loose)} rigid modes are unconstrained: {', '.join(loose)}")
    return problem


def _parts(cfg: DictConfig, key: str) -> dict[str, Any]:
    """Return the objects of a node that names several, by name; none for {} or null."""
    node = cfg.get(key)
    if node is None:
        return {}
    if not isinstance(node, DictConfig):
        raise ConfigError(
            f"{key} = {node!r} must be a mapping of names to calls: {key}: {{name: {{...}}}}"
        )
    return {
        str(name): _of_kind(_made(node[name], f"{key}.{name}", {}), key, f"{key}.{name}")
        for name in node
        if node[name]
    }


def build_surrogate(cfg: DictConfig, scene: Scene) -> "training.Surrogate":
    """Return the untrained surrogate of a configuration; its weights are a function of `seed`."""
    require_keys(cfg, *NETWORK)
    # optimiser and schedule are built once for one number: they fail before any solve
    trial = instantiate(cfg, "optimizer", params=[torch.nn.Parameter(torch.zeros(1))])
    if cfg.scheduler:
        instantiate(cfg, "scheduler", optimizer=trial, total_steps=1)
    torch.manual_seed(cfg.seed)
    options: dict[str, Any] = {
        "optimizer": instantiate(cfg, "optimizer"),
        "scheduler": instantiate(cfg, "scheduler") if cfg.scheduler else None,
    }
    net, predictor = _network(cfg, scene)
    loss = instantiate(cfg, "loss")
    with error_in("model"):
        return training.Surrogate(net, loss, scene, **predictor, **options)


def build_trained(cfg: DictConfig, scene: Scene) -> "training.TrainedSurrogate":
    """Return the surrogate of a configuration without its training, for weights that are loaded."""
    torch.manual_seed(cfg.get("seed", 0))
    net, predictor = _network(cfg, scene)
    with error_in("model"):
        return training.TrainedSurrogate(net, scene, **predictor)


def _network(cfg: DictConfig, scene: Scene) -> tuple[Any, dict[str, Any]]:
    """Return the network of `model`, and those of its keys that are options of the surrogate."""
    require_keys(cfg, "model")
    node = typing.cast("dict[str, Any]", OmegaConf.to_container(cfg.model, resolve=True))
    given = {key: node.pop(key) for key in validation.PREDICTOR if key in node}
    predictor = {"base": "linear", **given}
    with error_in("model"):
        inputs = models.Inputs.from_scene(scene, **predictor)
    more = {"inputs": inputs} if "inputs" in validation.options_of("model", node)[0] else {}
    return instantiate(OmegaConf.create({"model": node}), "model", scene=scene, **more), predictor


def build_trainer(cfg: DictConfig) -> "L.Trainer":
    """Return the trainer of a configuration with its callbacks and loggers."""
    from lightning.fabric.utilities.exceptions import MisconfigurationException

    require_keys(cfg, "trainer")
    callbacks, loggers = (list(_parts(cfg, key).values()) for key in ("callbacks", "logger"))
    more: dict[str, Any] = {"callbacks": callbacks, "logger": loggers or False}
    limit = cfg.trainer.get("max_time")
    if isinstance(limit, str) and limit.count(":") == 2:  # Lightning knows DD:HH:MM:SS alone
        more["max_time"] = f"00:{limit}"
    with error_in("trainer", MisconfigurationException):
        return typing.cast("L.Trainer", instantiate(cfg, "trainer", **more))


def show_plan(scene: Scene, *parts: Any, folder: str | None = None, verbose: bool = False) -> None:
    """Print what a run computes and where it is written.

    The work of `parts`, such as data and surrogate, is described as that of the scene is. `verbose`
    lists the computations that are skipped instead of counting them.
    """
    described = [pair for part in (scene, *parts) for pair in getattr(part, "describe", list)()]
    if folder is not None:
        described.append(("run", folder))
    lines = [line for part in (scene, *parts) for line in part.skipped_work()]
    how = "" if verbose else "; extras.verbose=true lists them"
    described.append(("skipped", f"{len(lines)} computations that this scene does not need{how}"))
    for name, text in described:
        print(f"{name:<9} {text}")
    for line in lines if verbose else ():
        print(textwrap.fill(line, WIDTH, initial_indent="  - ", subsequent_indent="    "))
    sys.stdout.flush()
    if advice := slow_blas():
        print(f"warning: {advice}", file=sys.stderr)
