"""Laws of the composition root: what cannot work is refused by name before anything is computed."""

import importlib.util
import re
import shutil
from itertools import pairwise
from pathlib import Path

import hydra
import lightning as L
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import OmegaConf
from safetensors.torch import save_file

from benchmarks import benchmark, convergence, pareto, results, soak, stress, verify
from benchmarks.methods import load_runs
from dpl.commands import cli
from dpl.config import ConfigError, build, plain, resume, run_folder, validation
from dpl.training import checkpoints

ROOT = Path(__file__).parents[2]
BAD = {  # override -> what the message must name
    "material.poisson=0.7": r"poisson = 0\.7",
    "material.poisson=nan": r"material\.poisson = nan",
    "material.poisson=abc": r"material\.poisson = 'abc' must be a number",
    "material.poisson=true": r"material\.poisson = True must be a number",
    "+material.poison=1": r"material\.poison: .* did you mean material\.poisson\?",
    "material._target_=dpl.fem.mesh.regions.Rubber": r"material\._target_ = .*Rubber' does not",
    "solver._partial_=false": r"solver: .*missing .*'problem'; set _partial_: true if the caller",
    "young=-1": r"young = -1",
    "young=1e308": r"young = 1e\+308 must lie between 1e-30 and 1e\+30",
    "young={low:1e6,hihg:1e9}": r"young\.hihg: there is no such key; did you mean young\.high\?",
    "young={low:1e9,high:1e6}": r"young = .* an ascending range",
    "young={low:0,high:1e6}": r"young\.low = 0 must lie between",
    "young={low:1,high:2,distribution:normal}": r"young\.distribution = 'normal' must be one of",
    "young={low:1,high:2,_target_:os.system}": r"young = .*, not a call$",
    "mesh.nodes=[5,3]": r"mesh: nodes = \[5, 3\]",
    "mesh.nodes=[5,3,2.5]": r"mesh\.nodes = \[5, 3, 2\.5\] must be a list, each a whole number",
    "mesh.size=[1,1,nan]": r"mesh\.size\.2 = nan",
    "mesh=file": r"mesh\.path",
    "mesh=file mesh.path=nowhere.msh": r"mesh: nowhere\.msh: no such mesh file",
    "mesh=file mesh.path=12": r"mesh\.path = 12 must be",
    "fixed.at=7": r"fixed.*Plane\(axis=0, at=7\) holds no node",
    "loads=traction loads.region=7": r"loads.region = 7 must be a call or .* or a text or null$",
    "fixed.at=middle": r"fixed: at = 'middle'",
    "fixed.at=null": r"fixed\.at = None must be a number or a text",
    "degree=3": r"degree",
    "solver.tol=0": r"solver: tol = 0",
    "+solver.max_iter=0": r"solver: max_iter = 0",
    "loads.n_modes=0": r"loads: n_modes = 0",
    "loads.distribution._target_=dpl.fem.materials.tensors.hooke": r"loads\.distribution\._target_",
    "loads.n_modes=1000000000000000000000": r"loads\.n_modes = 10+ does not fit into 64 bits",
    "loads.distribution=uniform": r"loads\.distribution = 'uniform' must be",
    "~mesh": r"mesh is missing",
    "~mesh._target_": r"mesh = .* must be a call: its _target_ is missing",
    "+forces.weight=3": r"forces\.weight = 3 must be a call",
    "material._target_=os": r"material\._target_ = 'os' does not exist",
    "material._target_=os.path": r"material\._target_ = 'os\.path' cannot be called",
    "+mesh._args_=[1]": r"mesh\._args_: .* has no such option",
    "solver._partial_=yes_please": r"^solver: .*_partial_ flag must be a bool",
    "material.poisson={_target_:dpl.fem.CellField,values:[0.1]}": (
        r"^material\.poisson: values of shape \(1,\) must be 16 finite numbers"
    ),
    "material.poisson={_target_:dpl.fem.CellField,values:a,file:nowhere.vtu}": (
        r"^material\.poisson: nowhere\.vtu: no such mesh file"
    ),
    "+forces.muscle={_target_:dpl.fem.ActiveStress,value:1.0,"
    "directions:{_target_:dpl.fem.FibreData,fibre:f,file:nowhere.vtu}}": (
        r"^forces\.muscle: directions: nowhere\.vtu: no such mesh file"
    ),
    "mean_dilatation=1": r"mean_dilatation = 1 must be true or false",
}


@pytest.mark.parametrize("override", BAD)
def test_what_cannot_work_is_refused_by_its_key(compose, override, tmp_path):
    words = [override] if "{" in override else override.split()
    cfg = compose("mesh.nodes=[5,3,3]", *words) if "mesh" not in override else compose(*words)

    def start():
        plain.check(cfg)
        build.show_plan(build.build_scene(cfg))

    with pytest.raises(ConfigError, match=BAD[override]) as refusal:
        start()
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.iterdir()), "nothing is written before all is known to work"


BAD_TRAINING = {
    "data.train=0": r"data\.train = 0 must lie between 1 and",
    "+data.vall=3": r"data\.vall: .* has no such option",
    "model.width=wide": r"model\.width = 'wide' must be a whole number or null",
    "+model.memory_limit=1e-6": r"model: .* parameters .* need .* GB, there are 0\.0 GB",
    "optimizer.lr=fast": r"optimizer\.lr = 'fast'",
    "+trainer.epochs=10": r"trainer\.epochs: .* has no such option",
    "callbacks.worst_cases._target_=dpl.training.MSE": r"callbacks\.worst_cases\.every: .* no such",
    "+callbacks.mine={_target_: dpl.fem.NeoHookeanLn, poisson: 0}": r"callbacks\.mine gives .* Neo",
    "+callbacks.mine=3": r"callbacks\.mine = 3 must be a call",
    "seed=abc": r"(seed|shuffle_seed) = 'abc'",
    "data.timeout=0": r"data: timeout = 0",
    "data=online data.train.capacity=1000000000000": r"data: 10+ samples need .* GB, there",
    "data.batch_size=10000000000": r"data: batch_size = 10+ must lie between 1 and",
    "seed=4294967296": r"seed = 4294967296 must lie between 0 and 4294967295",
    "~scheduler": r"scheduler is missing",
    "optimizer.betas=[0.9]": r"optimizer\.betas = \[0\.9\] must be",
    "optimizer._target_=dpl.training.warmup_cosine": r"optimizer\.",
    "trainer=[]": r"trainer is missing",
    "data.train=1000000000000": r"data\.train = 10+ must lie between 1 and 10000000",
    "data.workers=1000000000": r"data: workers = 10+ must lie between 0 and 1,024",
    "callbacks.worst_cases=text": r"callbacks\.worst_cases = 'text' must be a call",
    "trainer.max_epochs=-5": r"trainer\.max_epochs = -5 must lie between 1 and \d+ or be -1",
    "+trainer.limit_train_batches=0": r"trainer\.limit_train_batches = 0 must lie",
    "trainer.log_every_n_steps=-1": r"trainer\.log_every_n_steps = -1 must lie",
    "trainer.max_time=two": r"^trainer: .*'two'.* DD:HH:MM:SS",
    "trainer.max_time={minute:2}": r"^trainer: 'minute' is an invalid keyword",
    "optimizer.lr=0": r"optimizer\.lr = 0 must lie between 1e-30 and 1000000",
    "+trainer.enable_progress_bar=false": r"^trainer: .*enable_progress_bar=False.* found .*Bar",
    "+trainer.enable_checkpointing=false": r"^trainer: .*enable_checkpointing=False.* found",
}
if not torch.cuda.is_available():
    BAD_TRAINING["trainer=gpu"] = r"^trainer: No supported gpu backend found"


BAD_COMMANDS = {
    "evaluate run=x tols=[small]": r"tols = \['small'\] must be a list, each a number",
    "convergence twice=perhaps": r"twice = 'perhaps' must be true or false",
    "evaluate run=x tols=[1.0]": r"tols = \[1\.0\] must lie between 1e-15 and 1, 1 excluded",
    "pareto run=x threads=[]": r"threads = \[\] must name one value or more",
    "results name=x count=many": r"count = 'many' must be a whole number",
    "benchmark repeats=0": r"repeats = 0 must lie between 1 and",
    "benchmark reference_codes=text": r"reference_codes = 'text' must be",
    "soak folder=. minutes=0": r"minutes = 0 must lie between 0\.01 and",
    "view run=x trust={_target_:builtins.dict}": r"trust = .* must be true or false",
    "verify cases=3": r"cases = 3 must be a list, each a text",
}


KEYS = {
    one.__name__.rpartition(".")[2]: one.KEYS
    for one in (benchmark, convergence, pareto, results, soak, stress, verify)
}


@pytest.mark.parametrize("line", BAD_COMMANDS)
def test_what_a_command_is_told_is_held_to_what_it_must_be(compose, line):
    command, *overrides = line.split()
    with pytest.raises(ConfigError, match=BAD_COMMANDS[line]):
        plain.check(compose(*overrides, command=command), keys=KEYS.get(command, ()))


@pytest.mark.parametrize("override", BAD_TRAINING)
def test_what_cannot_train_is_refused_by_its_key(compose, override, scene, tmp_path):
    words = [override] if "{" in override else override.split()
    cfg = compose("folder=.", "model=fcnn", *words, command="train")

    def start():
        plain.check(cfg)
        build.instantiate(cfg, "data", scene=scene)
        build.build_surrogate(cfg, scene)
        build.build_trainer(cfg)

    with pytest.raises(ConfigError, match=BAD_TRAINING[override]):
        start()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "override",
    ["young=1", "young=[1e9,2e11]", "mesh.size=[1,1,2]", "model.width=null", "+solver.max_iter=9"],
)
def test_what_works_is_not_refused(compose, override):
    cfg = compose("folder=.", "model=fcnn", override, command="train")
    before = OmegaConf.to_yaml(cfg)
    plain.check(cfg)
    assert OmegaConf.to_yaml(cfg) == before, "a check changes nothing"


STIFF = ["material=yeoh_k2", "material.bulk=1e300", "material.poisson=null", "+mesh.cell=tetra"]
CORNER = {"_target_": "dpl.fem.Box", "lower": [0, 0, 0], "upper": [0, 0, 0]}
SPHERE = {"_target_": "dpl.fem.Sphere", "centre": [0, 0, 0], "radius": 1e3}
UNUSABLE = {  # options, a key and its node -> the message
    "K(0) is no matrix": (STIFF, "seed", 0, r"material, mesh, .*K\(0\) cannot be used"),
    "all is fixed": ([], "fixed", SPHERE, "fixed or supports: all nodes are fixed"),
    "loose": ([], "fixed", CORNER, "3 rigid modes are unconstrained: rotation"),
}
for made in ("dpl.training.LrStar", "skfem.MeshHex", "dpl.fem.propeller"):
    kind = r"gives an object of .*; it must give Material"
    UNUSABLE[f"material {made}"] = ([], "material", {"_target_": made}, f"material {kind}")
    kind = r"gives .*; it must give ActiveStress or Body"
    part = {"weight": {"_target_": made}}
    UNUSABLE[f"force {made}"] = ([], "forces", part, rf"forces\.weight {kind}")


@pytest.mark.parametrize("name", UNUSABLE)
def test_a_body_that_cannot_be_used_is_refused_where_it_is_built(compose, tiny, name):
    overrides, key, node, message = UNUSABLE[name]
    cfg = compose(*tiny, *overrides)
    OmegaConf.set_struct(cfg, False)
    cfg[key] = node
    plain.check(cfg)
    with pytest.raises(ConfigError, match=message):
        build.build_scene(cfg)


def test_checking_calls_nothing(compose, monkeypatch):
    called = []
    monkeypatch.setattr("dpl.fem.mesh.reading.read_mesh", lambda path: called.append(path))
    cfg = compose("mesh=file", "mesh.path=part.msh")
    cfg.mesh._target_ = "dpl.fem.read_mesh"
    plain.check(cfg)
    assert called == []


def test_the_configured_scene_is_the_one_built_by_hand(scene_of, tiny, scene):
    assert scene_of(*tiny).fingerprint == scene.fingerprint


# ------------------------------------------------------------------ commands


def test_an_interrupt_ends_a_command_with_130_and_a_fault_of_ours_keeps_its_traceback(capsys):
    with pytest.raises(SystemExit) as end, cli.readable_errors():
        raise KeyboardInterrupt
    assert end.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"
    with pytest.raises(ZeroDivisionError), cli.readable_errors():
        raise ZeroDivisionError


@pytest.mark.skipif(
    importlib.util.find_spec("optuna") is not None,
    reason="Optuna is installed",
)
@pytest.mark.parametrize("argument", ["hparams_search=pod", "hydra/sweeper=optuna"])
def test_a_sweep_without_optuna_says_in_one_line_what_to_install(script, argument, tmp_path):
    ended = script("train", argument, cwd=tmp_path)
    assert ended.status == 2
    assert ended.err.count("\n") == 1
    assert "'hydra/sweeper/optuna'" in ended.err
    assert "pip install -c constraints.txt -e '.[sweep]'" in ended.err
    assert not list(tmp_path.iterdir())


def test_hyperparameters_are_flat_and_a_call_goes_by_its_name(compose):
    cfg = compose("folder=.", "model=pod", "young=[1e6,2e11]", command="train")
    flat = plain.hyperparameters(cfg)
    assert flat["model"] == "PODNet"
    assert (flat["model.width"], flat["optimizer.lr"], flat["loss"]) == (256, 5e-3, "RMSELoss")
    assert flat["young"] == "[1000000.0, 200000000000.0]"
    assert all(isinstance(value, bool | int | float | str) for value in flat.values())
    noise = ("run", "folder", "ckpt_path", "callbacks", "logger", "paths", "extras", "tags")
    assert not [key for key in flat if key.startswith(noise) or "_target_" in key]
    assert flat.keys() - plain.hyperparameters(cfg, without=("loss",)).keys() >= {"loss"}


@pytest.mark.parametrize(
    ("score", "reported"),
    [(2e-3, 2e-3), (float("nan"), float("inf")), (float("inf"), float("inf"))],
)
def test_the_best_error_is_the_score_of_the_checkpoint_that_is_kept_for_it(score, reported):
    best, last = ModelCheckpoint(monitor="val/e_mean"), ModelCheckpoint()
    best.best_model_score, last.best_model_score = torch.tensor(score), torch.tensor(1e-9)
    trainer = L.Trainer(logger=False, callbacks=[last, best], accelerator="cpu")
    assert cli.best_error(trainer) == pytest.approx(reported)


# ------------------------------------------------------------------ runs


def _trained(folder, *overrides):
    """Train for one epoch, as `train.py` does; return the surrogate as it is in memory."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        places = [f"data.folder={folder}/data", f"folder={folder}", "run=here"]
        one = ["callbacks=none", "trainer.max_epochs=1"]
        cfg = hydra.compose("train", overrides=[*overrides, *places, *one])
    scene = build.build_scene(cfg)
    surrogate = build.build_surrogate(cfg, scene)
    trainer = build.build_trainer(cfg)
    resume.save_config(cfg, folder)
    trainer.fit(surrogate, datamodule=build.instantiate(cfg, "data", scene=scene))
    return surrogate


@pytest.fixture(scope="module")
def trained(tiny_training, tmp_path_factory):
    """A run of one epoch and its surrogate."""
    folder = tmp_path_factory.mktemp("run")
    return folder, _trained(folder, *tiny_training)


@pytest.fixture
def copied(trained, tmp_path):
    """The run in a folder that may be harmed."""
    return shutil.copytree(trained[0], tmp_path / "copy")


def test_a_run_comes_back_as_it_was(trained):
    folder, surrogate = trained
    cfg, again = run_folder.load_run(folder)
    assert again.scene.fingerprint == surrogate.scene.fingerprint
    load = surrogate.scene.loads.sample((0, 2), range(4))
    with torch.no_grad():
        assert torch.equal(again.predict(load), surrogate.predict(load))
    assert not again.training
    assert cfg.mesh.nodes == [5, 3, 3]
    text = (folder / "config.yaml").read_text()
    assert "${" not in text
    assert "???" not in text


WIDE = ["young={low:1e6,high:2e11,distribution:log}", "model.young=true"]


@pytest.fixture(scope="module")
def several(tiny_training, tmp_path_factory):
    """A folder of runs of one fingerprint that differ in size or moduli, and their surrogates."""
    home = tmp_path_factory.mktemp("runs")
    steel = ["young=[1e9,2e11]", "model.young=true"]
    runs = {"a": steel, "b": WIDE, "c": [*steel, "mesh.size=[200.0,50.0,50.0]"]}
    kept = {name: _trained(home / name, *tiny_training, *more) for name, more in runs.items()}
    shutil.copytree(home / "a", home / "d")
    kept["d"] = kept["a"]
    assert len({surrogate.scene.fingerprint for surrogate in kept.values()}) == 1
    return home, kept


def test_runs_of_other_moduli_or_sizes_come_back_as_they_were(several):
    home, kept = several
    loads = kept["b"].scene.loads.sample((0, 2), range(4))
    force, young = loads.force * 1e9, loads.young
    found = load_runs(home)
    for name, (_, again) in found.items():
        with torch.no_grad():
            assert torch.equal(again(force, young), kept[name](force, young)), name
    assert found["d"][1].scene is found["a"][1].scene, "one factor for runs of one scene"
    assert young.max() > 2 * young.min()
    surrogate = found["b"][1]
    with torch.no_grad():  # E is an input
        answer = surrogate.predict(loads)
        assert answer.isfinite().all()
        flipped = surrogate.predict(loads._replace(young=young.flip(0)))
    assert not torch.allclose(answer, flipped)


def test_runs_of_other_scenes_are_refused(several, tiny_training, tmp_path):
    shutil.copytree(several[0] / "a", tmp_path / "a")
    _trained(tmp_path / "b", *tiny_training, *WIDE, "material.poisson=0.25")
    with pytest.raises(ConfigError, match=r"b is of another scene than a: law\.poisson"):
        load_runs(tmp_path)


def test_a_run_that_is_missing_or_has_no_checkpoint_is_refused(copied, tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere has no config\.yaml"):
        run_folder.load_run(tmp_path / "nowhere")
    for path in (copied / "checkpoints").iterdir():
        path.unlink()
    with pytest.raises(ConfigError, match=r"has no checkpoints/"):
        run_folder.load_run(copied)


def test_all_that_a_run_of_conf_calls_is_trusted():
    """What is new in conf/ must be put where it may be read back, or a run of it could not be."""
    seen = set()
    for key in validation.EXPECTED_TYPES:
        for path in (ROOT / "conf" / key).glob("*.yaml"):
            cfg = OmegaConf.to_container(OmegaConf.load(path))
            cfg = cfg if "_global_" in path.read_text() else {key: cfg}
            for place, node in validation.iter_nodes(cfg):
                if isinstance(node, dict) and "_target_" in node:
                    kinds = validation._kinds(place, cfg)
                    assert callable(validation._target(place, node["_target_"], kinds)), path
                    seen.add(key)
    assert seen >= {"mesh", "material", "loads", "model", "trainer", "callbacks", "logger"}


BOMB = "\n".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in pairwise("abcdefgh"))


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("a: &a [lol]\n" + BOMB, "refers to parts of itself"),
        ("seed: ${oc.env:HOME}", "holds an interpolation"),
        ("seed: [1", "is not the configuration of a run"),
        ("- 1", "is no list of keys and values"),
        ("!!python/object/apply:os.system [ls]", "is not the configuration of a run"),
        ("a: " + "[" * 1000, "is not the configuration of a run"),
        ("a: " + "x" * 2_000_000, "has 2,000,003 bytes, of 100,000 at most"),
    ],
    ids=range(7),
)
def test_a_configuration_that_no_run_writes_is_refused_by_name(copied, text, reported):
    (copied / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=reported) as refusal:
        run_folder.load_run(copied)
    assert "config.yaml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


FIRST = "predictor.net.stages.0.weight"


@pytest.mark.parametrize(
    ("name", "change", "reported"),
    [
        (FIRST, lambda w: w[1:], rf"size mismatch for {FIRST}"),
        (FIRST, lambda w: w.long(), r"net\.stages\.0\.weight of torch\.int64 must"),
        (FIRST, lambda w: w / 0, r"net\.stages\.0\.weight must be finite"),
        (FIRST, lambda w: w + 1e38, "the answers of the network are not finite"),
        ("predictor.force_scale", lambda w: -w, r"force_scale = -\S+ must be above 0"),
    ],
)
def test_damaged_weights_are_refused_by_name(copied, name, change, reported):
    best = copied / "checkpoints" / "best.safetensors"
    checkpoint = checkpoints.read(best)
    checkpoint["state_dict"][name] = change(checkpoint["state_dict"][name])
    checkpoints.write(checkpoint, best)
    with pytest.raises(ConfigError, match=rf"best\.safetensors cannot be used: .*{reported}"):
        run_folder.load_run(copied)


@pytest.mark.parametrize("harm", ["truncated", "text", "no weights", "no scene"])
def test_a_damaged_checkpoint_is_refused_by_name(copied, harm):
    best = copied / "checkpoints" / "best.safetensors"
    if harm == "truncated":
        best.write_bytes(best.read_bytes()[:-1000])
    elif harm == "text":
        best.write_text("hello")
    elif harm == "no scene":
        save_file(checkpoints.read(best)["state_dict"], best)
    else:
        checkpoints.write({**checkpoints.read(best), "state_dict": {}}, best)
    with pytest.raises(ConfigError, match=r"best\.safetensors"):
        run_folder.load_run(copied)


def test_a_run_comes_back_from_its_best_checkpoint_that_is_there(copied):
    folder = copied / "checkpoints"
    (folder / "best.safetensors").unlink()
    last = checkpoints.read(folder / "last.ckpt")
    for name, state in (
        ("last.ckpt", last["state_dict"]),  # a run without validation
        ("best.ckpt", {name: tensor + 1 for name, tensor in last["state_dict"].items()}),
    ):
        checkpoints.write({**last, "state_dict": state}, folder / name)
        surrogate = run_folder.load_run(copied)[1]
        assert not surrogate.training
        found = surrogate.state_dict()
        assert all(torch.equal(found[name], tensor) for name, tensor in state.items())


# ------------------------------------------------------------------ resumed


@pytest.fixture
def resumed(compose, tiny_training, trained):
    """The configuration that resumes the run, changed as requested."""

    def resumed(*overrides):
        folder = trained[0]
        common = [f"folder={folder}", "trainer.max_epochs=1", *tiny_training]
        path = f"{folder}/checkpoints/last.ckpt"
        return compose(*common, f"ckpt_path={path}", *overrides, command="train")

    return resumed


@pytest.mark.parametrize(
    "override",
    ["trainer.max_epochs=9", "data.workers=1", "data.folder=elsewhere", "trainer.devices=2"],
)
def test_a_run_may_be_resumed_for_longer_and_elsewhere(resumed, override):
    cfg, key = resumed(override), override.partition("=")[0]
    before = OmegaConf.load(f"{cfg.folder}/config.yaml")
    assert OmegaConf.select(before, key) != OmegaConf.select(cfg, key)
    assert resume.check_resumed(cfg)["epoch"] == 0


@pytest.mark.parametrize(
    ("override", "reported"),
    [
        ("model.width=17", "model.width was 16, is 17"),
        ("material.poisson=0.25", "material.poisson was 0.3, is 0.25"),
        ("seed=1", "data.shuffle_seed was 0, is 1; seed was 0, is 1"),
        ("loss=mse", "loss._target_ was dpl.training.LrStar, is dpl.training.MSE"),
        ("+trainer.gradient_clip_val=1.0", "trainer.gradient_clip_val was None, is 1.0"),
        ("~scheduler", "scheduler"),
    ],
)
def test_a_run_is_not_resumed_with_another_configuration(resumed, override, reported):
    with pytest.raises(ConfigError, match="is of another configuration") as refusal:
        resume.check_resumed(resumed(override))
    assert reported in str(refusal.value)


@pytest.fixture
def resumed_config(compose):
    """Returns the configuration that a command line resumes a run with."""

    def resumed_config(folder, *overrides):
        lines = [f"folder={folder}", "ckpt_path=last", *overrides]
        return resume.resumed_config(compose(*lines, command="train"), lines)

    return resumed_config


def test_a_run_is_resumed_with_the_configuration_that_lies_in_it(trained, resumed_config):
    cfg = resumed_config(trained[0], "trainer.max_epochs=7", "callbacks=early_stopping")
    before = OmegaConf.load(trained[0] / "config.yaml")
    for key in ("mesh", "loads", "solver", "data", "model", "optimizer", "loss", "seed"):
        assert cfg[key] == before[key], key
    assert (cfg.trainer.max_epochs, cfg.trainer.check_val_every_n_epoch) == (7, 1)
    assert "early_stopping" in cfg.callbacks, "those of the command line"
    plain.check(cfg)
    assert resume.check_resumed(cfg)["epoch"] == 0


@pytest.mark.parametrize(
    ("override", "changed"),
    [
        ("optimizer.lr=0.5", r"optimizer\.lr was 0\.001, is 0\.5;"),
        ("~scheduler", r"scheduler\._partial_ was True, is None;"),
        ("experiment=beam_svk", r"data\.batch_size was 8, is 256; "),  # compared as a whole
    ],
)
def test_a_resumed_run_names_only_what_the_command_line_changes(
    trained, resumed_config, override, changed
):
    with pytest.raises(ConfigError, match=f"configuration: {changed}"):
        resume.check_resumed(resumed_config(trained[0], override))


def test_an_option_of_the_trainer_changes_only_the_machine_of_a_resumed_run(
    trained, resumed_config
):
    cfg = resumed_config(trained[0], "trainer=ddp")
    assert (cfg.trainer.strategy, cfg.trainer.devices) == ("ddp", 2)
    assert (cfg.trainer.max_epochs, cfg.trainer.check_val_every_n_epoch) == (1, 1)
    longer = resumed_config(trained[0], "trainer.max_epochs=7", "trainer=cpu")
    assert (longer.trainer.accelerator, longer.trainer.max_epochs) == ("cpu", 7)
    plain.check(longer)
    assert resume.check_resumed(longer)["epoch"] == 0


@pytest.mark.parametrize(
    ("named", "used"),
    [
        (None, None),
        ("{elsewhere}", "{run}/data"),
        ("{run}/more/data", "{run}/more/data"),
        ("{run}/../{run_name}2", "{run}/data"),
        ("{data}", "{data}"),  # which is there
    ],
)
def test_a_run_makes_its_data_set_in_its_folder_or_where_the_command_line_says(
    copied, trained, resumed_config, tmp_path, named, used
):
    places = {"elsewhere": tmp_path / "elsewhere", "run": copied, "data": trained[0] / "data"}
    named, used = (one and one.format(**places, run_name=copied.name) for one in (named, used))
    cfg = OmegaConf.load(copied / "config.yaml")
    cfg.data.folder = named
    (copied / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    assert resumed_config(copied).data.folder == used
    if named == str(places["elsewhere"]):
        assert run_folder.load_run(copied)[0].data.folder == used
        assert run_folder.load_run(copied, trust=True)[0].data.folder == named
    assert resumed_config(copied, "data.folder=here").data.folder == "here"


def test_a_run_that_is_not_there_is_not_resumed_but_begun(compose, tmp_path):
    path = f"{tmp_path}/nowhere.ckpt"
    cfg = compose(f"folder={tmp_path}", f"ckpt_path={path}", command="train")
    with pytest.raises(ConfigError, match=r"nowhere\.ckpt does not exist; leave it out"):
        resume.check_resumed(cfg)
    resume.check_resumed(compose(f"folder={tmp_path}", "ckpt_path=last", command="train"))


@pytest.mark.parametrize("harm", ["text", "weights", "pickle", "folder"])
def test_a_checkpoint_that_cannot_be_resumed_is_refused_in_one_line(resumed, copied, harm):
    names = {"weights": "best.safetensors", "folder": "."}
    path = copied / "checkpoints" / names.get(harm, "last.ckpt")
    if harm == "text":
        path.write_text("hello")
    elif harm == "pickle":
        torch.save({**checkpoints.read(path), "more": Path(path)}, path)
    with pytest.raises(ConfigError, match=r"^ckpt_path(:| =)") as refusal:
        resume.check_resumed(resumed(f"ckpt_path={path}"))
    assert "\n" not in str(refusal.value)
    assert "weights_only" not in str(refusal.value)


def test_a_run_is_not_resumed_for_fewer_epochs_than_it_has_done(resumed, copied):
    path = copied / "checkpoints" / "last.ckpt"
    found = {**checkpoints.read(path), "epoch": 4}
    checkpoints.write(found, path)
    resume.check_resumed(resumed(f"ckpt_path={path}", "trainer.max_epochs=5"))
    with pytest.raises(ConfigError, match=r"^trainer\.max_epochs = 4 must be 5 or more; the run"):
        resume.check_resumed(resumed(f"ckpt_path={path}", "trainer.max_epochs=4"))


FOREIGN = {  # what is changed in a checkpoint -> what the one line says
    "identity": ({"degree": 7}, "the checkpoint is of scene .*; degree: 7 there, 1 here"),
    "state_dict": ({"a": torch.zeros(2)}, r"Unexpected key\(s\) in state_dict: .a."),
    "loops": ({"fit_loop": 3}, "cannot be resumed"),
    "optimizer_states": ([{}], "cannot be resumed"),
    "random": ({"numpy": 3}, "cannot be resumed"),
}


@pytest.mark.parametrize("part", FOREIGN)
def test_a_foreign_checkpoint_ends_training_with_one_line(
    copied, script, tiny_training, part, tmp_path
):
    path, (value, reported) = copied / "checkpoints" / "last.ckpt", FOREIGN[part]
    found = checkpoints.read(path)
    more = {"scene": "0f" * 32} if part == "identity" else {}
    checkpoints.write({**found, part: value, **more}, path)
    (copied / "config.yaml").unlink()  # else that would tell the difference
    quiet = [f"data.folder={copied}/data", "trainer.max_epochs=2", "run=new"]
    ended = script("train", *tiny_training, *quiet, f"ckpt_path={path}", cwd=tmp_path)
    assert ended.status == 2, ended.err
    line = ended.err.strip().splitlines()[-1]
    assert re.search(f"^error: ckpt_path.*{reported}", line), line
    assert "Traceback" not in ended.err


def test_the_run_of_another_scene_is_refused(copied):
    cfg = OmegaConf.load(copied / "config.yaml")
    cfg.material.poisson = 0.25
    (copied / "config.yaml").write_text(OmegaConf.to_yaml(cfg))
    with pytest.raises(ConfigError, match="the checkpoint is of scene"):
        run_folder.load_run(copied)


def test_the_weights_are_a_function_of_the_seed(compose, scene):
    def weights(seed):
        cfg = compose("folder=.", f"seed={seed}", "model=fcnn", "model.width=8", command="train")
        return build.build_surrogate(cfg, scene).state_dict()

    one, same, other = weights(0), weights(0), weights(1)
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)
