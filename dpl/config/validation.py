"""Check keys, types and ranges of configurations, and the objects that they may call.

Signatures are the schema: the options of a call are the arguments of its `_target_`.
"""

import contextlib
import difflib
import importlib
import inspect
import math
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

Keys = Sequence[tuple[Any, ...]]  # rows of type, names, and smallest and largest value of keys
BELOW_1 = math.nextafter(1.0, 0.0)  # largest value of a key that must be below 1
KEYS: Keys = (  # of all commands
    (dict, "mesh material loads solver data model loss optimizer trainer"),
    (dict | str | None, "fixed"),
    (dict | None, "regions supports forces scheduler callbacks logger"),
    (Mapping[str, float | str | bool | None] | None, "paths extras"),
    (bool, "mean_dilatation trust resume solve_reference"),
    (str, "name host license"),
    (Literal["generate", "verify", "repair"], "action"),
    (Sequence[Literal["model", "results", "runtime", "dataset", "publish"]], "outputs"),
    (Sequence[Literal["error", "amplitude", "residual", "min_det_F"]], "numbers"),
    (Literal["float64", "float32"], "dtype"),
    (str | None, "run folder ckpt_path animation"),
    (Sequence[str], "tags allowed_hosts"),
    (Sequence[str] | None, "networks"),
    (int, "degree", 1, 2),
    (int, "shard"),
    (int, "repeats samples", 1, 10**6),
    (int, "count", 0, 10**6),
    (int, "shards", 1, math.inf),
    (int, "seed", 0, 2**32 - 1),
    (int, "port", 0, 65535),
    (float, "tol", 1e-15, 1),
    (Sequence[float], "tols", 1e-15, BELOW_1),
    (Sequence[float], "errors", 1e-15, 1),
    (Sequence[int | None], "threads", 1, 10**4),
    (float | Sequence[float] | Mapping[str, float | str] | None, "young", 1e-30, 1e30),  # [Pa]
    (float, "young.low young.high", 1e-30, 1e30),
    (Literal["uniform", "log"], "young.distribution"),
    # of a training; the types are those of signatures, 1e-30 stands for "above 0"
    (object, "data.train", 1, 10**7),
    (object, "optimizer.lr", 1e-30, 1e6),
    (object, "trainer.max_epochs trainer.max_steps trainer.check_val_every_n_epoch", 1, 10**9),
    (object, "trainer.log_every_n_steps", 0, 10**9),
    (object, "trainer.limit_train_batches", 1e-30, 10**9),
)
UNLIMITED = {"trainer.max_epochs", "trainer.max_steps"}  # keys for which -1 means no limit
NOT_EMPTY = {"tols", "threads", "outputs"}  # lists that must name a value
REGIONS = {  # a region is a call, or the name of a group of the mesh
    *(f"dpl.fem.mesh.regions.{name}" for name in ("Plane", "Box", "Sphere", "Cylinder", "Tag")),
    "builtins.str",
}
EXPECTED_TYPES = {  # base classes of the object that the call under a key returns
    "mesh": {"skfem.mesh.mesh.Mesh"},
    "material": {"dpl.fem.materials.material.Material"},
    "fixed": REGIONS,
    "regions": REGIONS,
    "supports": {
        "dpl.fem.assembly.boundary_conditions.DirichletBC",
        "dpl.fem.assembly.boundary_conditions.RobinBC",
    },
    "forces": {
        "dpl.fem.loads.forces.Traction",
        "dpl.fem.loads.forces.BodyForce",
        "dpl.fem.assembly.follower_pressure.FollowerPressure",
        "dpl.fem.assembly.active_stress.ActiveStress",
        "dpl.fem.assembly.follower_cable.FollowerCable",
    },
    "solver": {"dpl.fem.solvers.linear.ReferenceSolver"},
    "loads": {"dpl.fem.loads.family.LoadFamily"},
    "data": {"dpl.data.dataset.DataSet", "dpl.data.datamodule.DataModule"},
    "model": {"torch.nn.modules.module.Module"},
    "loss": {"dpl.training.losses.Loss"},
    "optimizer": {"torch.optim.optimizer.Optimizer"},
    "scheduler": {"torch.optim.lr_scheduler.LRScheduler"},
    "trainer": {"lightning.pytorch.trainer.trainer.Trainer"},
    "callbacks": {"lightning.pytorch.callbacks.callback.Callback"},
    "logger": {"lightning.pytorch.loggers.logger.Logger"},
}
CLASSES_OF_DATA = {  # base class of `data`, by a key of the commands that need it
    "action": "dpl.data.dataset.DataSet",
    "trainer": "dpl.data.datamodule.DataModule",
}
PARTS = {  # base classes of the objects that a call in the file of a run may contain
    *EXPECTED_TYPES["mesh"] | EXPECTED_TYPES["material"] | EXPECTED_TYPES["loads"] | REGIONS,
    "dpl.fem.materials.parameters.CellField",
    "dpl.fem.materials.fibres.energies.FibreEnergy",
    "dpl.fem.materials.fibres.reinforced.FibreDirections",
    "dpl.data.sources.Source",
    "dpl.training.losses.Loss",
    "lightning.fabric.plugins.io.checkpoint_io.CheckpointIO",
    "numpy.ndarray",
}
SEVERAL = ("regions", "supports", "forces", "callbacks", "logger")  # keys with calls by name
PROTOCOLS = EXPECTED_TYPES["solver"] | EXPECTED_TYPES["loads"]  # a class needs their members only
TRUSTED_RESULTS = {  # of functions that a run may name: they compute and have no other effect
    "skfem.mesh.mesh.Mesh",
    "numpy.ndarray",
    "torch.optim.lr_scheduler.LRScheduler",
}
OWN_PACKAGES = (  # packages whose classes the file of a run may name
    *("dpl.", "torch.optim.", "lightning.Trainer", "lightning.pytorch.trainer."),
    *("lightning.pytorch.callbacks.", "lightning.pytorch.loggers."),
)
VALUES = {  # type hints of values; others allow an object, which a call returns
    *(bool, int, float, str, types.NoneType, Path, Literal),
    *(Sequence, Iterable, list, tuple, Mapping, dict),
}
PREDICTOR = {"base": Literal["linear"] | None, "young": bool}  # of `Surrogate`, as keys of `model`
HYDRA_KEYS = {"_target_", "_partial_", "_recursive_", "_convert_"}  # options of Hydra in a call


class ConfigError(ValueError):
    """An invalid configuration; the message names key, problem and remedy in one line."""

    def __init__(self, message: str) -> None:
        """Join the lines of the message."""
        super().__init__(" ".join(filter(None, map(str.strip, message.splitlines()))))


def check(
    written: dict[str, Any],
    resolved: dict[str, Any],
    *,
    trust: bool | Mapping[str, Any] = True,
    keys: Keys = (),
) -> None:
    """Check a configuration against the signatures of its calls without calling anything.

    Args:
        written: The configuration with interpolations.
        resolved: The configuration without interpolations.
        trust: Allow calls of any object, or only those of another configuration. Further calls must
            be of classes of `OWN_PACKAGES`, or of public functions of this package that return one
            of `TRUSTED_RESULTS`: of `EXPECTED_TYPES` under a key, and of `PARTS` within a call.
            Nothing else is imported.
        keys: Keys of the command besides `KEYS`, in the same form.
    """
    known = {
        name: (hint, *limits) for hint, names, *limits in (*KEYS, *keys) for name in names.split()
    }
    trusted = dict(iter_nodes(trust)) if isinstance(trust, Mapping) else {}
    refuse_unknown("", sorted(map(str, resolved)), known)
    for node in (written, resolved):  # `written` first: it names the key that was set
        for path, value in iter_nodes(node):
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{path} = {value} is not a finite number")
            if isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise ConfigError(f"{path} = {value} does not fit into 64 bits")
    for path, node in iter_nodes(resolved):
        if path in known:
            _check_value(path, node, *known[path])
            below = {key.rpartition(".")[2] for key in known if key.startswith(f"{path}.")}
            if below and isinstance(node, dict) and not _names_target(node):
                refuse_unknown(path, node, below)
        if _names_target(node):
            is_trusted = trust is True or node == trusted.get(path)
            target = _target(path, node["_target_"], None if is_trusted else _kinds(path, resolved))
            for key, kind in CLASSES_OF_DATA.items() if path == "data" else ():
                foreign = inspect.isclass(target) and not is_instance_of(target, {kind})
                if key in resolved and foreign:
                    must = f"must be dpl.data.{kind.rpartition('.')[2]} or a class derived from it"
                    raise ConfigError(f"data._target_ = {node['_target_']!r} {must}")
            _check_call(path, node, target)
        elif node is None or not _is_call(path, resolved):
            continue
        elif not is_instance_of(type(node), _kinds(path, resolved)):
            raise ConfigError(f"{path} = {node!r} must be a call: its _target_ is missing")


def refuse_unknown(
    place: str,
    given: Iterable[Any],
    known: Collection[str],
    fault: str = "there is no such key",
) -> None:
    """Raise a `ConfigError` for a name that is unknown at a place, with the most similar or all."""
    above = f"{place}." if place else ""
    for name in map(str, given):
        if name not in known:
            advice = f"there are {', '.join(sorted(known))}"
            if near := difflib.get_close_matches(name, known, 1):
                advice = f"did you mean {above}{near[0]}?"
            raise ConfigError(f"{above}{name}: {fault}; {advice}")


def names_several(key: str, node: Any) -> bool:
    """Return True if a node has calls by name: `SEVERAL`, and `material` if its regions differ."""
    if key != "material" or not node or not isinstance(node, Mapping):
        return key in SEVERAL
    return "_target_" not in node and all(isinstance(law, Mapping) for law in node.values())


def _is_call(path: str, resolved: Mapping[str, Any]) -> bool:
    """Return True if the value at a path must be a mapping with `_target_`."""
    key, *below = path.split(".")
    return len(below) == names_several(key, resolved.get(key)) and key in EXPECTED_TYPES


def _kinds(path: str, resolved: Mapping[str, Any]) -> set[str]:
    """Return the base classes of the object that a call at a path may return."""
    return EXPECTED_TYPES[path.partition(".")[0]] if _is_call(path, resolved) else PARTS


def _check_value(
    key: str, value: Any, hint: Any, least: float = -math.inf, most: float = math.inf
) -> None:
    """Check the type of a value, and the range of a number or of each number of a list."""
    _check_type(key, value, hint)
    if value == [] and key in NOT_EMPTY:
        raise ConfigError(f"{key} = [] must name one value or more: {_describe(hint)}")
    for one in value if isinstance(value, list) else [value]:
        unlimited = key in UNLIMITED and one == -1
        if isinstance(one, int | float) and not least <= one <= most and not unlimited:
            more = " or be -1" if key in UNLIMITED else ", 1 excluded" if most == BELOW_1 else ""
            raise ConfigError(f"{key} = {value} must lie between {least:g} and {most:.10g}{more}")


def _check_type(path: str, value: Any, hint: Any) -> None:
    if not matches_type(value, hint):
        call = ", not a call" if _names_target(value) else ""
        raise ConfigError(f"{path} = {value!r} must be {_describe(hint)}{call}")


def _target(path: str, name: Any, kinds: set[str] | None = None) -> Callable[..., Any]:
    """Return the class or function that a call names; with `kinds`, a trusted one of them."""
    foreign = f"{path} names {name}, which this key does not allow; not called without trust=true"
    if not isinstance(name, str):
        raise ConfigError(f"{path}._target_ = {name!r} must be a text")
    if kinds is not None and not name.startswith(OWN_PACKAGES):
        raise ConfigError(foreign)
    try:
        module, _, attribute = name.rpartition(".")
        target: Callable[..., Any] = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError):
        raise ConfigError(
            f"{path}._target_ = {name!r} does not exist, or its folder is not in PYTHONPATH"
        ) from None
    if not callable(target):
        raise ConfigError(f"{path}._target_ = {name!r} cannot be called")
    if kinds is not None and not _is_trusted(target, kinds):
        raise ConfigError(foreign)
    return target


def _is_trusted(target: Any, kinds: set[str]) -> bool:
    """Return True for classes of these kinds, and functions that return one that is trusted.

    The functions are the public ones of dpl, which the `__init__.py` of their folder lists. A new
    mesh function, sampling distribution or schedule therefore needs no entry in a list.
    """
    module = getattr(target, "__module__", None) or ""
    if inspect.isclass(target):
        return f"{module}.".startswith(OWN_PACKAGES) and is_instance_of(target, kinds)
    if not inspect.isfunction(target) or not module.startswith("dpl."):
        return False
    folder = importlib.import_module(module.rpartition(".")[0])
    if target.__name__ not in getattr(folder, "__all__", ()):
        return False
    try:
        result = typing.get_type_hints(target).get("return")
    except NameError:  # an annotation that only type checkers resolve
        return False
    result = typing.get_origin(result) or result
    return isinstance(result, type) and is_instance_of(result, kinds & TRUSTED_RESULTS)


def is_instance_of(kind: type, names: set[str]) -> bool:
    """Return True if a class has a base class, or all members of a protocol, of one of the names.

    Classes are compared by qualified name because the named modules need not be imported.
    """
    if not names.isdisjoint(f"{base.__module__}.{base.__qualname__}" for base in kind.__mro__):
        return True
    return any(not missing_members(kind, name) for name in names & PROTOCOLS)


def missing_members(kind: type, protocol: str) -> set[str]:
    """Return the public members of a protocol that a class lacks."""
    module, _, name = protocol.rpartition(".")
    declared = vars(getattr(importlib.import_module(module), name))
    given = {*dir(kind), *getattr(kind, "__dataclass_fields__", ())}
    return {member for member in declared if member[0] != "_"} - given


def _check_call(path: str, node: dict[str, Any], target: Callable[..., Any]) -> None:
    try:
        known, hints = _signature(target)
    except (TypeError, ValueError):  # a class or function in C
        raise ConfigError(f"{path}._target_ = {node['_target_']!r} has no known options") from None
    if path == "model":
        known, hints = known | set(PREDICTOR), hints | PREDICTOR
    options = {key: value for key, value in node.items() if key not in HYDRA_KEYS}
    refuse_unknown(path, options, known, f"{node['_target_']} has no such option")
    for key, value in options.items():
        if key in hints:
            _check_type(f"{path}.{key}", value, hints[key])


def options_of(path: str, node: Mapping[str, Any]) -> tuple[set[str], dict[str, Any]]:
    """Return the names of the options of a call, and the types of those that have one."""
    return _signature(_target(path, node.get("_target_")))


def options_with_files(node: Any) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield key, call and option of each file that a checked node names: options of type `Path`."""
    for path, call in iter_nodes(node):
        if isinstance(call, dict) and "_target_" in call:
            hints = options_of(path, call)[1]
            for option, value in call.items():
                hint = hints.get(option)
                if isinstance(value, str) and Path in (hint, *typing.get_args(hint)):
                    yield f"{path}.{option}", call, option


def _signature(target: Callable[..., Any]) -> tuple[set[str], dict[str, Any]]:
    """Return the arguments of a call and their types; **kwargs adds those of the parent class."""
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


def matches_type(value: Any, hint: Any) -> bool:
    """Return True if a YAML value matches a type hint; a call does where it allows an object."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return any(matches_type(value, argument) for argument in arguments)
    if _names_target(value):
        return hint is dict or (origin or hint) not in VALUES
    if origin is Literal:
        return value in arguments
    if origin is tuple and Ellipsis not in arguments:
        many = isinstance(value, list) and len(value) == len(arguments)
        return many and all(map(matches_type, value, arguments))
    if origin in (Sequence, Iterable, list, tuple):
        return isinstance(value, list) and all(matches_type(item, arguments[0]) for item in value)
    if origin in (Mapping, dict):
        items = value.values() if isinstance(value, dict) else ()
        return isinstance(value, dict) and all(matches_type(item, arguments[1]) for item in items)
    kind = origin or hint
    kind = {float: (int, float), Path: str, Callable: (), Any: object}.get(kind, kind)
    if hint in (int, float) and isinstance(value, bool):
        return False
    return not isinstance(kind, type | tuple) or isinstance(value, kind)


def _describe(hint: Any) -> str:
    """Return a type hint in words."""
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    names |= {Path: "a path", types.NoneType: "null", dict: "a call or several by name"}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_describe, arguments))
    if origin is Callable:
        return "a call"
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin is Mapping:
        return f"a mapping, each {_describe(arguments[1])}"
    if origin is Sequence:
        return f"a list, each {_describe(arguments[0])}"
    if isinstance(hint, type) and hint not in names:
        return f"a call that returns a {hint.__name__}"
    return names.get(hint, str(hint))


def _names_target(node: Any) -> bool:
    return isinstance(node, dict) and "_target_" in node


def iter_nodes(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the paths and values of a node and of all nodes below it."""
    yield path, node
    entries: Any = ()
    if isinstance(node, dict):
        entries = node.items()
    elif isinstance(node, list):
        entries = enumerate(node)
    for key, value in entries:
        yield from iter_nodes(value, f"{path}.{key}" if path else str(key))
