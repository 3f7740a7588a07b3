"""The folder of a run of somebody else is data: a command calls nothing that the file names."""

import itertools
import sys
from collections.abc import Iterator
from contextlib import suppress
from copy import deepcopy

import pytest
from omegaconf import OmegaConf

import dpl
from dpl.config import ConfigError, plain, resume, run_folder, validation

STORED = {  # options of train.py
    "stream of mixed loads": [
        *("mesh=propeller", "loads=mixture", "data=online", "model=gnn", "loss=blended"),
        *("optimizer=muon", "callbacks=early_stopping", "logger=csv", "trainer=ddp"),
    ],
    "inclusion": [
        *("experiment=inclusion", "scheduler=null", "callbacks=none", "model=cnn"),
        "young={low:1e6,high:1e9}",
    ],
    "fibres": [
        *("experiment=fibre_beam", "loads=point", "loads.region={_target_:dpl.fem.Tag,name:a}"),
        *("callbacks=ema", "logger=wandb"),
    ],
    "growing": ["experiment=finger", "data=growing", "model=unrolled"],
}
FOREIGN = "somebody_elses.record"
CALLS = [  # each calls or imports a module outside the package
    {"_target_": FOREIGN, "_partial_": True, "_recursive_": False},
    {"_target_": "os.mkdir", "path": "harm"},
    {"_target_": "dpl.fem.Tag", "_args_": ["a"], "name": {"a": [{"_target_": FOREIGN}]}},
    {"_target_": {"_target_": FOREIGN}},
]


@pytest.fixture
def stored(compose):
    """Composes the configuration that train.py stores."""
    return lambda *options: plain.to_container(
        compose("folder=runs/a", "run=runs/a", *options, command="train")
    )


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of somebody else that leaves files when it is imported and called."""
    (tmp_path / "somebody_elses.py").write_text(
        "from pathlib import Path\n"
        "Path('imported').touch()\n"
        "def record(*given, **named): Path('called').touch()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield
    assert "somebody_elses" not in sys.modules
    assert not [name for name in ("imported", "called", "harm") if (tmp_path / name).exists()]


def harmed(cfg: dict, call: object) -> Iterator[str]:
    """Put a call in place of each value, at the end of each list and under a new key of each node.

    Yields the path of each place while the call is there.
    """
    for path, node in list(validation.iter_nodes(cfg)):
        if isinstance(node, dict):
            before = dict(node)
            for key in (*before, "more"):
                node[key] = call
                yield f"{path}.{key}"
                node.clear()
                node.update(before)
        elif isinstance(node, list):
            before = list(node)
            for k in range(len(before) + 1):
                node[k : k + 1] = [call]
                yield f"{path}.{k}"
                node[:] = before


@pytest.mark.parametrize("name", STORED)
def test_no_key_of_a_stored_configuration_calls_anything_foreign(
    name, stored, module, monkeypatch, tmp_path
):
    cfg = stored(*STORED[name])
    monkeypatch.setattr(run_folder, "read_config", lambda path: cfg)
    assert run_folder.checked_config(tmp_path) == cfg, "a run is read back"
    resumed = deepcopy(cfg)  # by this command line
    accepted, first = [], list(STORED).index(name)
    for number, place in enumerate(harmed(cfg, call := {})):
        call.clear()
        call.update(CALLS[(number + first) % len(CALLS)])  # pairwise with the configurations
        with suppress(ConfigError):
            run_folder.checked_config(tmp_path, trust=resumed)
            accepted.append((place, call["_target_"]))
    assert not accepted


HARMFUL = [  # calls that would do harm
    {"_target_": "os.system", "command": "touch harm"},
    {"_target_": "builtins.eval", "_args_": ["open('harm', 'w')"]},
    {"_target_": "subprocess.run", "args": ["touch", "harm"]},
    {"_target_": "pathlib.Path.touch", "self": "harm"},
    {"_target_": "hydra.utils.call", "config": {"_target_": "os.system", "command": "touch harm"}},
    {"_target_": "dpl.config.build.sys.exit", "_args_": [3]},
    {"_target_": "dpl.config.instantiate", "cfg": {"x": {"_target_": "os.getcwd"}}, "key": "x"},
    {"_target_": "dpl.config.load_run", "folder": "evil", "trust": True},
    {"_target_": "dpl.config.validation.importlib", "name": "antigravity"},
    {"_target_": "dpl.scene.replace", "func": "os.system"},
    {"_target_": "dpl.system.files.atomic_write", "path": "harm"},
    {"_target_": "dpl.fem.write_mesh", "mesh": {"_target_": "dpl.fem.box"}, "path": "harm.vtk"},
    {"_target_": "benchmarks.peers.time_reference_code", "python": "touch", "program": "harm"},
    {
        "_target_": "lightning.pytorch.cli.instantiate_class",
        "args": ["touch harm"],
        "init": {"class_path": "os.system"},
    },
    {"_target_": "lightning.fabric.utilities.cloud_io._load", "path_or_url": "evil.ckpt"},
    {"_target_": "torch.load", "f": "evil.ckpt", "weights_only": False},
    {"_target_": "torch.optim.os.system", "command": "touch harm"},
    {"_target_": "torch.optim.lr_scheduler.partial", "func": "os.system"},
    {"_target_": "dpl", "a": 1},
    {"_target_": 3},
    {"_target_": ["os.system"]},
    {"_target_": {"_target_": "os.system", "command": "touch harm"}},
    {"_target_": "dpl.fem.identity.partial", "func": "os.system"},
    {"_target_": "lightning.pytorch.loggers.WandbLogger"},
    *(
        {"_target_": name, "path": "x"}
        for name in (
            "dpl.config.validation.importlib.import_module",  # a foreign module behind `dpl.`
            "dpl.evaluation.tables.write",
            "dpl.fem.mesh.generators.Sequence",
            "torch.optim.Optimizer.__init__.__globals__",
        )
    ),
]


REFUSED = "(not called|must be|does not exist|cannot be called)"


def test_a_run_calls_only_classes_and_functions_of_its_parts(stored, monkeypatch, tmp_path):
    """Functions with a reach of their own lie in modules of the package too."""
    cfg = stored()
    monkeypatch.setattr(run_folder, "read_config", lambda path: cfg)
    for key, call in itertools.product(("mesh", "loss", "trainer"), HARMFUL):
        before = cfg[key]
        cfg[key] = call
        with pytest.raises(ConfigError, match=rf"{key}\b.*{REFUSED}"):
            run_folder.checked_config(tmp_path)
        cfg[key] = {"_target_": "dpl.training.MSE", "_partial_": True, "first": [call]}
        with pytest.raises(ConfigError):
            run_folder.checked_config(tmp_path)
        cfg[key] = before


@pytest.fixture
def run(stored, tmp_path):
    """Writes the configuration of a run with an option of its own and without weights."""

    def run(key, value):
        cfg = OmegaConf.create(stored("trainer.max_epochs=1"))
        OmegaConf.update(cfg, key, value, force_add=True)
        folder = tmp_path / "runs" / "a"
        (folder / "checkpoints").mkdir(parents=True)
        for name in ("last.ckpt", "best.safetensors"):
            (folder / "checkpoints" / name).touch()
        (folder / "config.yaml").write_text(OmegaConf.to_yaml(cfg))

    return run


READERS = {  # arguments of the commands that read a run
    "train": "run=runs/a ckpt_path=last",
    "evaluate": "run=runs/a",
    "view": "run=runs/a",
    "export": "run=runs/a",
    "pareto": "run=runs",
    "convergence": "run=runs",
}


@pytest.mark.parametrize(
    ("command", "key"),
    zip(
        ["load", *READERS],
        itertools.cycle(["loads.amplitude", "trainer.profiler", "callbacks.more"]),
        strict=False,
    ),
)
def test_no_command_calls_what_a_run_names(command, key, run, module, script, tmp_path):
    run(key, {"_target_": FOREIGN})
    if command == "load":
        with pytest.raises(ConfigError) as refusal:
            dpl.load("runs/a")
        error = f"error: {refusal.value}"
    else:
        ended = script(command, *READERS[command].split(), cwd=tmp_path)
        assert ended.status == 2
        error = ended.err
    line = f"config.yaml: {key} names {FOREIGN}, which this key does not allow; not called"
    assert error.startswith("error: ")
    assert line in error
    assert error.count("\n") <= 1


OWN = {  # calls of the user's own classes on the command line
    "+trainer.profiler": "{_target_: lightning.pytorch.profilers.SimpleProfiler}",
    "trainer.strategy": "{_target_: lightning.pytorch.strategies.SingleDeviceStrategy}",
    "trainer.plugins": "[{_target_: lightning.pytorch.plugins.MixedPrecision, "
    "precision: bf16-mixed, device: cpu}]",
}


@pytest.mark.parametrize("key", OWN)
def test_the_command_line_may_name_any_object_where_one_is_expected(key, compose, run):
    place, own = key.lstrip("+"), OmegaConf.create(OWN[key])
    run(place, own)

    def resumed(*more):
        lines = ["folder=runs/a", "run=runs/a", "ckpt_path=last", *more]
        return resume.resumed_config(compose(*lines, command="train"), lines)

    again = resumed(f"{key}={OWN[key]}")
    plain.check(again)
    assert OmegaConf.select(again, place) == own
    assert resumed("trust=true").trainer == again.trainer
    with pytest.raises(ConfigError, match="not called without trust=true"):
        resumed()


@pytest.mark.parametrize(
    "key",
    [
        *("trainer.max_epochs", "trainer.precision", "mesh.size", "mesh.size.1", "tags", "seed"),
        *("ckpt_path", "paths.runs", "extras.view", "young", "callbacks.training_time.folder"),
    ],
)
def test_a_call_is_refused_where_a_value_is_expected(stored, key):
    cfg = OmegaConf.create(stored())
    OmegaConf.update(cfg, key, {"_target_": "builtins.str"}, merge=False)
    with pytest.raises(ConfigError, match=f"^{key.partition('.')[0]}.* = .* must be"):
        plain.check(cfg)
