"""Composition root: from a configuration to objects, from a run's folder back to its surrogate.

Above it only `commands` know Hydra, below it nothing does.
"""

import contextlib
import functools
import sys
import typing
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
import yaml
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from dpl import schema
from dpl.data.durable import whole_file
from dpl.fem.linear import slow_blas
from dpl.fem.memory import at_most
from dpl.fem.mesh import save_exactly
from dpl.fem.sparse import SingularMatrix
from dpl.scene import Scene
from dpl.schema import ConfigError

if typing.TYPE_CHECKING:
    from dpl.data.datamodule import OfflineData
    from dpl.fem.problem import Problem
    from dpl.module import Surrogate


SCENE = (  # keys that make a scene, and those that make a surrogate of it
    *("mesh", "degree", "mean_dilatation", "supports", "forces"),
    *("material", "young", "loads", "solver"),
)
NETWORK = ("model", "loss", "optimizer", "scheduler", "seed")
READ = "dpl.fem.mesh.load"  # of a mesh that is a file, of which a run keeps a copy:
MESH = "mesh.vtu"
LONGEST = 100_000  # bytes of a run's configuration


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
        told = str(error.msg or error).splitlines()[0]
        raise ConfigError(f"{error.full_key or 'config'}: {told}") from None


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """Return what makes one run differ from another, flat, see `dpl.schema.columns`.

    Raises:
        ConfigError: A value is missing.
    """
    return dict(schema.columns(plain(cfg)))


def check(cfg: DictConfig, *, trust: bool = True) -> None:
    """Hold a configuration against `dpl.schema`, before anything is called.

    Raises:
        ConfigError: See `dpl.schema.check`.
    """
    written = typing.cast("dict[str, Any]", OmegaConf.to_container(cfg))
    schema.check(written, plain(cfg), trust=trust)


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
    if key in schema.KINDS and not partial and not schema.is_a(type(made), schema.KINDS[key]):
        raise ConfigError(f"{key} gives {_a(made)}; it must give {_named(schema.KINDS[key])}")
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
    material = make(cfg, "material")
    with _shown_warnings():
        mesh = make(cfg, "mesh")
    clamped = make(cfg, "clamped") if cfg.get("clamped") is not None else None
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
    if loose := problem.loose_modes():
        raise ConfigError(
            f"clamped: {len(loose)} rigid modes are unconstrained: {', '.join(loose)}"
        )
    solver = make(cfg, "solver", problem=problem)
    young = OmegaConf.to_container(cfg.young) if isinstance(cfg.young, ListConfig) else cfg.young
    if not schema.fits(young, float | Sequence[float]):
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
        if not schema.is_a(type(part), schema.KINDS[key]):
            raise ConfigError(
                f"{key}.{name} gives {_a(part)}; it must give {_named(schema.KINDS[key])}"
            )
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


def show_plan(scene: Scene, *parts: Any) -> None:
    """Print the size of the body, and what a scene and the parts of a run do not need and skip."""
    lines = [line for part in (scene, *parts) for line in part.plan()]
    print(scene.body())
    print("plan: skipped, because this scene does not need it")
    print("\n".join(f"  - {line}" for line in lines), flush=True)
    if advice := slow_blas():
        print(f"warning: {advice}", file=sys.stderr)


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Write a configuration, resolved, into a run's folder, and a copy of the mesh file it names.

    Raises:
        ConfigError: The folder holds a run already, and this one does not resume it.
    """
    there = folder / "config.yaml"
    if (folder / "checkpoints" / "last.ckpt").exists() and not cfg.ckpt_path:
        raise ConfigError(
            f"run: {folder} holds a run; resume it with ckpt_path=last or name another"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _keep_mesh(cfg, folder)
    there.write_text(OmegaConf.to_yaml(OmegaConf.create(plain(cfg))))


def _keep_mesh(cfg: DictConfig, folder: Path) -> None:
    """Write the mesh file of a configuration into a run's folder, as `MESH`."""
    cfg = with_mesh_of_resumed(cfg)
    if cfg.mesh._target_ != READ or Path(cfg.mesh.path) == folder / MESH:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it was read before, and they were shown
        mesh = make(cfg, "mesh")
    with whole_file(folder / MESH) as file:
        save_exactly(Path(file.name), mesh)


def _with_mesh(cfg: DictConfig, path: Path) -> DictConfig:
    """Return a configuration that reads its mesh, if that is a file, from another one."""
    return OmegaConf.merge(cfg, {"mesh": {"path": str(path)}})


def _resumed(cfg: DictConfig) -> Path | None:
    """Return the checkpoint that a configuration resumes, None if it begins a run."""
    last = Path(cfg.folder) / "checkpoints" / "last.ckpt"
    if not cfg.ckpt_path or (cfg.ckpt_path == "last" and not last.exists()):
        return None
    return last if cfg.ckpt_path == "last" else Path(cfg.ckpt_path)


def with_mesh_of_resumed(cfg: DictConfig) -> DictConfig:
    """Return a configuration that reads its mesh file, if it names one, from the run it resumes.

    The original may have been moved or changed.
    """
    if cfg.mesh._target_ != READ or (checkpoint := _resumed(cfg)) is None:
        return cfg
    own = checkpoint.parent.parent / MESH
    return _with_mesh(cfg, own) if own.is_file() else cfg


def check_resumed(cfg: DictConfig) -> dict[str, Any] | None:
    """Return the checkpoint that a run resumes; None if it begins anew.

    `ckpt_path=last` of a run that has not begun begins it: a job has one command line.

    Raises:
        ConfigError: There is no such checkpoint, it cannot be resumed, or its run differs in what
            makes the run what it is.
    """
    if (path := _resumed(cfg)) is None:
        return None
    if not path.is_file():
        raise ConfigError(f"ckpt_path: there is no {path} to resume; leave it out to begin anew")
    before = path.parent.parent / "config.yaml"
    if before.is_file() and (changed := schema.changes(_read_config(before), plain(cfg))):
        raise ConfigError(
            f"ckpt_path: {path} is of another configuration: {'; '.join(changed)}; "
            "set them back, or begin a run of another name"
        )
    from dpl import checkpoints

    try:
        found = checkpoints.read(path)
        done = checkpoints.epochs(found)
    except (OSError, ValueError) as error:
        raise ConfigError(f"ckpt_path = {path} cannot be resumed: it {error}") from error
    most = cfg.trainer.get("max_epochs")
    if most is not None and 0 <= most < done:
        raise ConfigError(
            f"trainer.max_epochs = {most} must be {done} or more; the run in ckpt_path = {path} "
            "has done as many"
        )
    return found


def check_weights(surrogate: "Surrogate", checkpoint: dict[str, Any]) -> None:
    """Hold the checkpoint that a run resumes against its untrained surrogate.

    Raises:
        ConfigError: It is of another scene or of another network.
    """
    try:
        surrogate.on_load_checkpoint(checkpoint)
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(f"ckpt_path: {error}") from error
    ours, theirs = (
        {name: tuple(t.shape) for name, t in state.items() if isinstance(t, torch.Tensor)}
        for state in (surrogate.state_dict(), checkpoint["state_dict"])
    )
    if differing := sorted(dict(ours.items() ^ theirs.items())):
        raise ConfigError(
            f"ckpt_path: the checkpoint is of another network: {differing[0]} has shape "
            f"{theirs.get(differing[0])} there, {ours.get(differing[0])} here"
        )


def _read_config(path: Path) -> dict[str, Any]:
    """Return the configuration of a run, plain data: nothing in it is called or looked up.

    Raises:
        ConfigError: It is none.
    """
    try:
        if path.stat().st_size > LONGEST:
            raise ValueError(f"has {path.stat().st_size:,} bytes, of {LONGEST:,} at most")
        text = path.read_text()
        marks = yaml.AnchorToken, yaml.AliasToken  # a few lines of which unfold to gigabytes
        if any(isinstance(token, marks) for token in yaml.scan(text, yaml.SafeLoader)):
            raise ValueError("refers to parts of itself")
        found: Any = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
        if not isinstance(found, dict):
            raise ValueError("is no list of keys and values")
        if any(isinstance(value, str) and "${" in value for _, value in schema.walk(found)):
            raise ValueError("holds an interpolation, which no saved run does")
    except (ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path} is not the configuration of a run: {reason}") from error
    return found


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
    from dpl import checkpoints  # which imports Lightning

    config = Path(folder) / "config.yaml"
    kept = [Path(folder) / "checkpoints" / name for name in checkpoints.KEPT]
    best = next((path for path in kept if path.exists()), kept[-1])
    for path in (config, best):
        if not path.is_file():
            raise ConfigError(f"run = {folder} has no {path.relative_to(folder)}; train it first")
    found = _read_config(config)
    found.pop("trainer", None)  # of which nothing is called
    cfg = OmegaConf.create(found)
    check(cfg, trust=trust)
    try:
        checkpoint = checkpoints.read(best)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        raise _unusable(best, error) from error
    if scene is None:
        scene = _scene_of_run(cfg, best, checkpoint, trust=trust)
    surrogate = build_surrogate(cfg, scene)
    try:
        surrogate.on_load_checkpoint(checkpoint)
        surrogate.load_state_dict(checkpoint["state_dict"])
    except (ValueError, TypeError, KeyError, RuntimeError) as error:
        raise _unusable(best, error) from error
    return cfg, surrogate.eval()


def _unusable(checkpoint: Path, error: Exception) -> ConfigError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return ConfigError(f"{checkpoint} cannot be used: {reason}")


def _scene_of_run(
    cfg: DictConfig, weights: Path, checkpoint: dict[str, Any], *, trust: bool
) -> Scene:
    """Return the scene of a run, its mesh read from its folder and held to its weights.

    Args:
        cfg: Its configuration.
        weights: The file of its weights, in its folder.
        checkpoint: What is in it. A body has no more nodes than weights have numbers, of any
            network.
        trust: Whether the mesh may have more nodes, and lie elsewhere if the run has no copy.

    Raises:
        ConfigError: The run has no copy of its mesh file, or the mesh has too many nodes.
    """
    _need(cfg, *SCENE)
    if cfg.mesh._target_ == READ:
        folder = weights.parent.parent
        own = folder / MESH
        if own.resolve().parent == folder.resolve() and own.is_file():
            cfg = _with_mesh(cfg, own)
        elif not trust:
            raise ConfigError(
                f"mesh.path = {cfg.mesh.path} must be kept in the run's folder as {own}; write it "
                "there (dpl.fem.mesh.save_exactly), or load the run with trust=True"
            )
    if trust:
        return build_scene(cfg)
    values = sum(t.numel() for t in checkpoint["state_dict"].values() if torch.is_tensor(t))
    nodes = checkpoint.get("nodes")
    most = min(nodes, values) if isinstance(nodes, int) else values
    with at_most(most, f"{weights} is of no larger body"):
        return build_scene(cfg)


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
