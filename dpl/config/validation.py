"""Check configurations: keys, types, ranges, and the objects that they may call.

Signatures are the schema: the options of a call are the arguments of the class or function that its
`_target_` names.
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
from typing import Any

WHOLE, NAMES = Sequence[int], Sequence[str] | None
KEYS: dict[str, Any] = {  # types of the keys of all commands
    **dict.fromkeys(("mesh", "material", "loads", "solver"), dict),
    **dict.fromkeys(("fixed", "supports", "forces"), dict | None),
    **{"degree": int, "mean_dilatation": bool, "young": float | Sequence[float]},
    **dict.fromkeys(("data", "model", "loss", "optimizer", "trainer"), dict),
    **dict.fromkeys(("callbacks", "logger", "paths", "extras"), dict | None),
    **{"scheduler": dict | None, "seed": int, "ckpt_path": str | None, "tags": Sequence[str]},
    **{"run": str | None, "trust": bool, "folder": str, "tol": float},
    **{"action": str, "shard": int, "shards": int},
    **{"outputs": Sequence[str], "linear": Sequence[str], "reference_codes": dict},
    **dict.fromkeys(("repeats", "count", "workers", "samples", "n_far_loads"), int),
    **{"name": str, "galerkin": dict | None, "corrected": dict | None},
    **{"networks": NAMES, "tols": Sequence[float], "resume": bool, "cases": NAMES},
    **{"solve_reference": bool, "discretisation": str | None},
    **{"threads": Sequence[int | None], "cells_across": WHOLE, "budget": int},
    **{"minutes": float, "workloads": Sequence[str]},
    **{"host": str, "port": int, "allowed_hosts": Sequence[str]},
    **{"animation": str | None, "profile": bool, "galerkin_correction": bool},
}
RANGES = {  # smallest and largest values of keys
    **{"repeats": (1, 10**6), "samples": (1, 10**6), "shards": (1, math.inf)},
    **{
        "count": (0, 10**6),
        "n_far_loads": (0, 10**6),
        "workers": (0, 1024),
        "seed": (0, 2**32 - 1),
    },
    **{"budget": (1, 10**6), "minutes": (1e-2, 1e6), "port": (0, 65535)},
    **{"tol": (1e-15, 1), "tols": (1e-15, 1), "cells_across": (1, 10**3), "threads": (1, 10**4)},
    **{"young": (1e-30, 1e30)},  # [Pa]
}
TRAINING_RANGES = {  # the same for keys of a training; 1e-30 stands for "above 0"
    **{"data.train": (1, 10**7), "optimizer.lr": (1e-30, 1e6)},
    **{f"trainer.{key}": (1, 10**9) for key in ("max_epochs", "max_steps")},
    **{"trainer.check_val_every_n_epoch": (1, 10**9), "trainer.log_every_n_steps": (0, 10**9)},
    **{"trainer.limit_train_batches": (1e-30, 10**9)},
}
UNLIMITED = {"trainer.max_epochs", "trainer.max_steps"}  # keys for which -1 means no limit
EXPECTED_TYPES = {  # base classes of the object that the call under a key returns
    "mesh": {"skfem.mesh.mesh.Mesh"},
    "material": {"dpl.fem.materials.material.Material"},
    "fixed": {f"dpl.fem.mesh.regions.{n}" for n in ("Plane", "Box", "Sphere", "Cylinder", "Tag")},
    "supports": {
        "dpl.fem.assembly.boundary_conditions.DirichletBC",
        "dpl.fem.assembly.boundary_conditions.RobinBC",
    },
    "forces": {"dpl.fem.loads.forces.Traction", "dpl.fem.loads.forces.BodyForce"},
    "solver": {"dpl.fem.solvers.reference.ReferenceSolver"},
    "loads": {"dpl.fem.loads.family.LoadFamily"},
    "data": {"dpl.data.dataset.DataSet", "dpl.data.datamodule.OfflineData"},
    "model": {"torch.nn.modules.module.Module"},
    "loss": {"dpl.training.losses.loss.Loss"},
    "optimizer": {"torch.optim.optimizer.Optimizer"},
    "scheduler": {"torch.optim.lr_scheduler.LRScheduler"},
    "trainer": {"lightning.pytorch.trainer.trainer.Trainer"},
    "callbacks": {"lightning.pytorch.callbacks.callback.Callback"},
    "logger": {"lightning.pytorch.loggers.logger.Logger"},
}
SEVERAL = ("supports", "forces", "callbacks", "logger")  # keys with calls by name
PROTOCOLS = EXPECTED_TYPES["solver"] | EXPECTED_TYPES["loads"]  # a class needs their members only
TRUSTED_RESULTS = {  # of functions that a run may name: they compute and have no other effect
    "skfem.mesh.mesh.Mesh",
    "numpy.ndarray",
    "torch.optim.lr_scheduler.LRScheduler",
}
OWN_PACKAGES = ("dpl.", "torch.optim.")  # packages of these classes
HYDRA_KEYS = {"_target_", "_partial_", "_recursive_", "_convert_"}  # options of Hydra in a call

NOT_IDENTITY = {  # keys of the place and the monitoring of a run, not of its result
    *("run", "folder", "ckpt_path", "data.folder"),
    *("callbacks", "logger", "paths", "extras", "trainer.plugins"),
}
MAY_CHANGE_ON_RESUME = {  # keys of the length of a run and of the machine
    *(f"trainer.max_{unit}" for unit in ("epochs", "steps", "time")),
    *(f"trainer.{key}" for key in ("accelerator", "devices", "num_nodes", "strategy")),
    *("trainer.log_every_n_steps", "trainer.check_val_every_n_epoch", "trainer.profiler"),
    *("trainer.enable_progress_bar", "trainer.enable_model_summary"),
    *("data.workers", "data.timeout", "tags"),
}


class ConfigError(ValueError):
    """An invalid configuration; the message names key, problem and remedy in one line."""

    def __init__(self, message: str) -> None:
        """Join the lines of the message."""
        super().__init__(" ".join(filter(None, map(str.strip, message.splitlines()))))


def check(written: dict[str, Any], resolved: dict[str, Any], *, trust: bool = True) -> None:
    """Check a configuration against the signatures of its calls without calling anything.

    Args:
        written: The configuration with interpolations.
        resolved: The configuration without interpolations.
        trust: Allow calls of any object. Otherwise only classes of this package and of PyTorch's
            optimisers, and public functions of this package that return a mesh, an array or a
            scheduler.

    Raises:
        ConfigError: A key is unknown, a value has the wrong type, is not finite or is out of range,
            or an object does not exist or is not trusted.
    """
    if unknown := sorted({str(key) for key in resolved} - set(KEYS)):
        raise ConfigError(f"{unknown[0]}: there is no such key; {suggestion(unknown[0], KEYS)}")
    for node in (written, resolved):  # `written` first: it names the key that was set
        for path, value in iter_nodes(node):
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{path} = {value} is not a finite number")
            if isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise ConfigError(f"{path} = {value} does not fit into 64 bits")
    for key, value in resolved.items():
        _check_top(key, value)
    trained = TRAINING_RANGES if "trainer" in resolved else {}
    for path, node in iter_nodes(resolved):
        if path in trained and not (path in UNLIMITED and node == -1):
            least, most = trained[path]
            _check_range(path, node, least, most, " or be -1" * (path in UNLIMITED))
        if isinstance(node, dict) and "_target_" in node:
            _check_call(path, node, _target(path, node["_target_"], trust=trust))
        elif _is_call(path) and node is not None:
            raise ConfigError(f"{path} = {node!r} must be a call: its _target_ is missing")


def _is_call(path: str) -> bool:
    """Return True if the value at a path must be a mapping with `_target_`."""
    key, *below = path.split(".")
    return len(below) == (key in SEVERAL) and key in EXPECTED_TYPES


def _check_top(key: str, value: Any) -> None:
    """Check type and range of the value of a top-level key."""
    if key == "folder" and value is None:  # of commands that write nothing
        return
    plain = {} if isinstance(value, dict) else value  # calls are checked by their signatures
    if not matches_type(plain, KEYS[key]):
        raise ConfigError(f"{key} = {value!r} must be {_describe(KEYS[key])}")
    _check_range(key, value, *RANGES.get(key, (-math.inf, math.inf)))


def _check_range(key: str, value: Any, least: float, most: float, more: str = "") -> None:
    """Check a number, or each number of a list, against a range."""
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, int | float) and not least <= one <= most:
            span = f"between {least:g} and {most:.10g}"
            raise ConfigError(f"{key} = {value} must lie {span}{more}")


def _target(path: str, name: Any, *, trust: bool) -> Callable[..., Any]:
    """Return the class or function that a call names.

    Raises:
        ConfigError: It does not exist, cannot be called or is not trusted.
    """
    foreign = f"{path} names {name}, which is none of this package's; not called without trust=true"
    if not isinstance(name, str):
        raise ConfigError(f"{path}._target_ = {name!r} must be a text")
    if not trust and not name.startswith(OWN_PACKAGES):
        raise ConfigError(foreign)
    try:
        module, _, attribute = name.rpartition(".")
        target = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError):
        raise ConfigError(f"{path}._target_ = {name!r} does not exist") from None
    if not callable(target):
        raise ConfigError(f"{path}._target_ = {name!r} cannot be called")
    if not trust:
        if inspect.isclass(target):
            kinds = set().union(*EXPECTED_TYPES.values())
            ours = f"{target.__module__}.".startswith(OWN_PACKAGES) and is_instance_of(
                target, kinds
            )
        else:
            ours = _is_trusted_function(target)
        if not ours:
            raise ConfigError(foreign)
    return typing.cast("Callable[..., Any]", target)


def _is_trusted_function(target: Any) -> bool:
    """Return True for public functions of dpl whose annotated result is in `TRUSTED_RESULTS`.

    A function is public if the `__init__.py` of its folder lists it. A new mesh function, sampling
    distribution or schedule therefore needs no entry in a list of trusted functions.
    """
    module = getattr(target, "__module__", None) or ""
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
    return isinstance(result, type) and is_instance_of(result, TRUSTED_RESULTS)


def is_instance_of(kind: type, names: set[str]) -> bool:
    """Return True if a class, or one of its base classes, has one of these qualified names.

    It is also True for a class with all members of a named protocol. Classes are compared by name
    because the named modules need not be imported.
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
    for key, value in node.items():
        if key in HYDRA_KEYS:
            if key.endswith(("partial_", "recursive_")) and not isinstance(value, bool):
                raise ConfigError(f"{path}.{key} = {value!r} must be true or false")
            continue
        if key not in known:
            told = suggestion(str(key), known, f"{path}.")
            raise ConfigError(f"{path}.{key}: {node['_target_']} has no such option; {told}")
        if key in hints and not matches_type(value, hints[key]):
            raise ConfigError(f"{path}.{key} = {value!r} must be {_describe(hints[key])}")


def options_of(node: Mapping[str, Any]) -> set[str]:
    """Return the options of a call; none if it is not a call or names nothing that exists."""
    with contextlib.suppress(ConfigError, TypeError, ValueError):
        return _signature(_target("", node.get("_target_"), trust=True))[0]
    return set()


def nearest_name(name: str, known: Collection[str]) -> str | None:
    """Return the most similar known name, None if none is similar."""
    return next(iter(difflib.get_close_matches(name, known, 1)), None)


def suggestion(name: str, known: Collection[str], place: str = "") -> str:
    """Return an advice for an unknown name: the most similar known name, or all of them.

    Args:
        name: The unknown name.
        known: The known names.
        place: Prefix of the advised name.
    """
    if found := nearest_name(name, known):
        return f"did you mean {place}{found}?"
    return f"there are {', '.join(sorted(known))}"


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
    """Return True if a YAML value matches a type hint; a mapping with `_target_` always does."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return any(matches_type(value, argument) for argument in arguments)
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
        return many and all(map(matches_type, value, arguments))
    if origin in (Sequence, Iterable, list, tuple):
        return isinstance(value, list) and all(matches_type(item, arguments[0]) for item in value)
    if origin is Callable:
        return False
    if hint is Path:
        return isinstance(value, str)
    if isinstance(origin or hint, type) and hint is not object:
        return isinstance(value, origin or hint)
    return True


def _describe(hint: Any) -> str:
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    names |= {Path: "a path", types.NoneType: "null", dict: "a call or several by name"}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_describe(argument) for argument in arguments)
    if origin is Sequence:
        return f"a list, each {_describe(arguments[0])}"
    return names.get(hint, str(hint))


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


def columns(node: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the hyperparameters of a run, flat: keys of the command line and their values.

    A call has the key of its node and the name of its class (`model`: FCNN). Null, empty lists and
    `NOT_IDENTITY` are left out.
    """
    for key, value in node.items():
        place = f"{path}.{key}" if path else key
        if value in (None, []) or place in NOT_IDENTITY:
            continue
        if isinstance(value, dict):
            yield from columns(value, place)
        elif key == "_target_":
            yield path, value.rpartition(".")[2]
        elif not key.startswith("_"):
            yield place, str(value) if isinstance(value, list) else value


def changes(theirs: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """Return the differences that a resumed run must not have from its configuration, as lines."""
    before, now = dict(_leaves(theirs)), dict(_leaves(ours))
    free = tuple(f"{key}." for key in (*NOT_IDENTITY, *MAY_CHANGE_ON_RESUME))
    return [
        f"{key} was {before.get(key)}, is {now.get(key)}"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key) and not f"{key}.".startswith(free)
    ]


def _leaves(node: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the paths and values of a node that are neither mappings nor lists."""
    for path, value in iter_nodes(node):
        if not isinstance(value, dict | list):
            yield path, value
