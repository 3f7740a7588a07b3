"""Laws of configurations with anything in them: refused in a line that names the key, or work."""

import importlib
import inspect
import sys
import types
import warnings
from collections.abc import Iterator
from contextlib import suppress
from copy import deepcopy
from functools import cache, reduce
from operator import getitem
from pathlib import Path

import hydra
import lightning as L
import pytest
import torch
from bounds import at_most, bounded
from hydra.core.global_hydra import GlobalHydra
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from dpl import DataSetError
from dpl.config import build, plain
from dpl.fem import solve

CONF = Path(__file__).parents[2] / "conf"
TINY = ["mesh.nodes=[5,3,3]", "loads.n_modes=3", "solver.linear=superlu"]
FLAT = ["mesh=rectangle", "mesh.nodes=[9,3]", "loads.n_modes=3", "solver.linear=superlu"]
BLADES = ["mesh=propeller", "mesh.cells=[1,1,1,2,3]", "fixed=cylinder", "fixed.radius=0.05"]
SMALL = ["data.train=4", "data.val=2", "data.test=2", "data.batch_size=2", "data.workers=0"]
DRAWN = ["loads=modal_small", "loads.radius.low=0.1"]
HELD = [
    "+supports.end={_target_: dpl.fem.DirichletBC, value: [0.0, null, null], "
    "region: {_target_: dpl.fem.Plane, axis: 0, at: max}}",
    "+supports.soil={_target_: dpl.fem.RobinBC, stiffness: 45.0, "
    "region: {_target_: dpl.fem.Box, lower: [0, 0, 0], upper: [50, 25, 0]}}",
    "+forces.weight={_target_: dpl.fem.BodyForce, value: [0.0, 0.0, -0.045]}",
]
SCENES = {  # overrides of conf/generate.yaml
    "beam": TINY,
    "rectangle": FLAT,
    "propeller": [*BLADES, "solver.linear=superlu", "loads.n_modes=3"],
    "drawn": [*TINY, *DRAWN, "young=[1e9,2e11]", "material.poisson=[0.2,0.4]"],
    "held": [*TINY, *HELD, "degree=1", "material=stable_neo_hookean"],
    "ogden": [*TINY, "material=ogden_k2"],
    "yeoh": [*TINY, "material=yeoh_k2", "+mesh.cell=tetra"],
}
NETWORKS = {  # of conf/train.yaml
    "fcnn": ["model=fcnn", "model.width=8"],
    "pod": ["model=pod", "model.width=8", "model.rank=10", "model.coordinates=9"],
    "cnn": ["model=cnn", "model.channels=2", "loss=lr_plus"],
    "gnn": ["model=gnn", "model.width=4", "loss=energy"],
    "online": ["model=fcnn", "data=online", "model.width=8", "loss=blended"],
}
OTHERS = ("evaluate", "benchmark", "convergence", "pareto", "results", "verify", "stress")

TEXTS = ("no such thing", "", "1e30", "-", "a\nb")
OTHER_KINDS = (None, True, False, [], [None], ["a", {}], {}, {"a": 1}, [[1.0]], *TEXTS)
NUMBERS = (
    *(1, 2, 3, 7, 0.1, 0.5, 1e-3, 1e3, 1e6, 20),
    *(-1, 0, -0.5, 2.5, 1e30, -1e30, 1e-300, 5e-324, 1e300),
    *(10**9, 10**12, -(10**12), 10**30, 2**31, 2**63),
)
ENDLESS = (float("nan"), float("inf"), float("-inf"))
UNFINISHED = ("???", "${nowhere.at.all}", "${no_such_resolver:1}", "${oc.env:NO_SUCH_VARIABLE}")
FREE = {  # keys of any text, or of one that the script looks at
    *("folder", "run", "ckpt_path", "name", "save_dir", "version", "dirpath", "filename"),
    *("monitor", "action", "parts", "linear", "cases"),
}
SHARED = {  # keys that others refer to
    "seed": ("shuffle_seed",),
    "max_epochs": ("epochs",),
    "folder": ("dirpath", "save_dir"),
    "name": ("run",),
    "size": ("holds no",),
}


# ------------------------------------------------------------------ what is tried


def composed(command: str, *overrides: str) -> dict:
    """Return a configuration as plain data, its interpolations as they are."""
    GlobalHydra.instance().clear()
    folders = CONF, CONF.parent / "benchmarks" / "conf"
    folder = next(path for path in folders if (path / f"{command}.yaml").is_file())
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        cfg = hydra.compose(command, overrides=list(overrides))
    GlobalHydra.instance().clear()
    return OmegaConf.to_container(cfg)


@cache
def bases() -> dict[str, dict]:
    """Return the configurations that are harmed, by name; to compose them takes seconds."""
    found = {
        f"generate {k}": composed("generate", *v, *SMALL[:3], SMALL[4]) for k, v in SCENES.items()
    }
    for name, chosen in NETWORKS.items():
        sizes = [o for o in SMALL if not (name == "online" and o.startswith("data.train"))]
        found[f"train {name}"] = composed("train", *TINY, *sizes, *chosen, "folder=.", "run=here")
    needed = {"evaluate": ["run=here"], "pareto": ["run=here"], "results": ["name=x"]}
    return found | {name: composed(name, *needed.get(name, [])) for name in OTHERS}


def places(node, path: tuple = ()) -> Iterator[tuple]:
    """Yield the paths of everything below a node."""
    entries = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in entries:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def at(node, path: tuple):
    return reduce(getitem, path, node)


@st.composite
def harmed(draw):
    """Return a base, a changed configuration, the path of what is changed, and what was done."""
    name = draw(st.sampled_from(list(bases())))
    cfg = deepcopy(bases()[name])
    path = draw(st.sampled_from(list(places(cfg))))
    changes = ["kind", "number", "number", "number", "endless", "unfinished", "less", "more"]
    done = draw(st.sampled_from(changes))
    old = at(cfg, path)
    if done == "less":
        parent = at(cfg, path[:-1])
        del parent[path[-1]]
        return name, cfg, path, done, None
    if done == "more":
        while not isinstance(at(cfg, path), dict):
            path = path[:-1]
        names = ["colour", "speed", "_args_", "_colour_", "memori_limit"]
        path = (*path, draw(st.sampled_from(names)))
        value = draw(st.sampled_from([1, "red", [1], {}, {"_target_": "builtins.dict"}]))
    else:
        choices = {"kind": OTHER_KINDS, "number": NUMBERS, "endless": ENDLESS}
        loops = tuple("${" + ".".join(map(str, path[:k])) + "}" for k in (1, len(path)))
        value = draw(st.sampled_from(choices.get(done, (*UNFINISHED, *loops))))
        if done == "number" and draw(st.booleans()) and isinstance(old, int | float):
            value = type(value)(value)
    at(cfg, path[:-1])[path[-1]] = value
    return name, cfg, path, done, value


# ------------------------------------------------------------------ what is wanted


def works(cfg: DictConfig, folder: Path, keys=()) -> None:
    """Make what a command makes before it computes, and let it answer a load."""
    plain.check(cfg, keys=keys)
    if "mesh" not in cfg:
        return
    scene = build.build_scene(cfg)
    data = build.instantiate(cfg, "data", scene=scene)
    load = scene.loads.sample((0, 0), [0])
    surrogate = None
    if "model" in cfg:
        surrogate = build.build_surrogate(cfg, scene)
        trainer = build.build_trainer(cfg)
        assert isinstance(trainer, L.Trainer)
    scene.skipped_work()
    data.skipped_work()
    answer = solve(scene.solver, load)
    assert answer.displacement.isfinite().all() or not answer.converged.all()
    assert bool((answer.volume_ratio > 0).all()) or not answer.converged.all()
    if surrogate is not None:
        surrogate.skipped_work()
        if getattr(surrogate.net, "prepared", True):
            with torch.no_grad():
                assert surrogate.predict(load).isfinite().all()


def refused(cfg: dict, folder: Path, keys=()) -> str:
    """Return the line that refuses a configuration; empty if it works."""
    made = OmegaConf.create(cfg)
    OmegaConf.set_struct(made, True)
    try:
        with bounded(), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # honest ones: thin cells, say
            works(made, folder, keys)
    except (build.ConfigError, DataSetError) as error:
        line = str(error)
        assert line
        assert "\n" not in line, line
        assert "llocate" not in line, line
        return line
    return ""


def own_keys(name: str):
    """Return the keys of a command besides those of all commands; see `dpl.config.check`."""
    command = name.partition(" ")[0]
    for package in ("dpl.commands", "benchmarks"):
        with suppress(ImportError):
            return getattr(importlib.import_module(f"{package}.{command}"), "KEYS", ())
    return ()


def judge(change, line: str) -> None:
    """Hold the answer to a change against what it must be."""
    name, _, path, done, value = change
    words = {part for part in path if isinstance(part, str)}
    if line:
        words |= {other for key in words for other in SHARED.get(key, ())}
        assert any(word in line for word in words), (path, value, line)
    elif not words & {"peers"}:
        assert done not in ("more", "endless", "unfinished"), (name, path, value)
        if done == "kind" and isinstance(value, str):
            assert words & FREE, (name, path, value)


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@at_most(4)
@given(harmed())
def test_a_configuration_is_refused_by_the_key_or_works(elsewhere, change):
    line = refused(change[1], elsewhere, own_keys(change[0]))
    judge(change, line)
    assert not list(elsewhere.iterdir())


# ------------------------------------------------------------------ whom a run's folder may call


def _names() -> list[str]:
    """Return all names that can be reached in what a run's folder may name parts of."""
    for module in ("pytorch.cli", "fabric.utilities.cloud_io", "pytorch.demos.boring_classes"):
        importlib.import_module(f"lightning.{module}")
    ours = ("dpl.", "torch.optim.", "lightning.")
    modules = [m for name, m in sys.modules.items() if name.startswith(ours)]
    return sorted(f"{m.__name__}.{name}" for m in modules for name in vars(m))


NAMES = _names()

KINDS = {
    *("Mesh", "Material", "Newton", "LoadFamily", "DataSet", "DataModule", "Module", "Optimizer"),
    *(
        "Source",
        "LRScheduler",
        "Plane",
        "Box",
        "Sphere",
        "Cylinder",
        "Tag",
        "DirichletBC",
        "RobinBC",
    ),
    *("Traction", "BodyForce", "FollowerPressure", "ActiveStress", "FollowerCable", "Loss"),
    *("CellField", "FibreEnergy", "FibreDirections", "ReferenceSolver"),
}
WATCHING = {"Trainer", "Callback", "Logger", "CheckpointIO"}
FUNCTIONS = {  # they compute a mesh, an array or a schedule and have no other effect
    *("box", "rectangle", "propeller", "read_mesh", "load_mesh", "check_mesh", "warmup_cosine"),
    *("facets_in", "nodes_in", "cells_in", "conjugate_gradients"),
    *("symmetric_uniform", "normal", "uniform01", "constant", "logarithmic", "log_tail_mixture"),
}


PARTS = st.sampled_from(["mesh", "loss", "trainer", "callbacks.x", "logger.x"])


@at_most(10)
@given(st.sampled_from(NAMES), PARTS)
def test_what_a_runs_folder_may_name_is_of_a_kind_that_a_run_is_made_of(name, key):
    """Whatever else our modules have imported, functions with a reach of their own included."""
    cfg = OmegaConf.create({"trainer": {"_target_": "lightning.Trainer"}})
    OmegaConf.update(cfg, key, {"_target_": name}, merge=False)
    try:
        plain.check(cfg, trust=False)
    except build.ConfigError:
        return
    module, _, attribute = name.rpartition(".")
    found = getattr(sys.modules[module], attribute)
    if isinstance(found, types.FunctionType):
        assert attribute in FUNCTIONS
        assert found.__module__.startswith("dpl.")
        return
    assert inspect.isclass(found)
    watching = key not in ("mesh", "loss")
    assert {base.__name__ for base in found.__mro__} & (KINDS | (WATCHING if watching else set()))
    assert watching or found.__module__.startswith(("dpl.", "torch.optim."))
