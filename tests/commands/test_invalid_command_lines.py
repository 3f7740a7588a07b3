"""Laws of command lines: nonsense ends with one line before anything is solved or written."""

import contextlib
from pathlib import Path

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra

from dpl.commands import cli, dry_run, generate, train
from dpl.config import ConfigError, build, plain
from dpl.fem.assembly.kernels import COMPILING

OPTIONS = "Available options in 'model': cnn fcnn fcnn_paper gnn pod unrolled"
EXPERIMENTS = "Available options in 'experiment': beam_nh_loss beam_poisson beam_svk "
NONSENSE = {  # command line -> what the one line says
    "train experiment=beam_yuong": f"Could not find 'experiment/beam_yuong' {EXPERIMENTS}",
    "generate experiment=beam_yuong": f"Could not find 'experiment/beam_yuong' {EXPERIMENTS}",
    "train hparams_search=podd": r"Could not find 'hparams_search/podd' .*: pod$",
    "train modle=fcnn": r"^modle: there is no such key; did you mean model\?$",
    "train +modle=fcnn": r"^modle: this command has no such key; did you mean model\?$",
    "train ~modle": r"^Could not delete from config. 'modle' does not exist",
    "train +port=3": r"^port: this command has no such key",
    "train model=fcn": f"Could not find 'model/fcn' {OPTIONS}$",
    "generate model=fcnn": r"^Could not override 'model'",
    "train hydra/launcher=jobblib": r"'hydra/launcher/jobblib' .*pip install .*launch",
    "train hydra.swep.dir=3": r"^Could not override 'hydra\.swep\.dir'",
    "train model=fcnn model.widht=3": r"^model\.widht: .*; did you mean model\.width\?$",
    "train model.nodes=3": r"^Could not override 'model\.nodes'\. .* use \+model\.nodes=3$",
    "train +model.nodes=3": r"^model\.nodes: .*Unrolled has no such option; there are ",
    "train trainer.max_epoch=3": r"did you mean trainer\.max_epochs\?$",
    "train callbacks.worst.every=3": r"^Could not override 'callbacks\.worst\.every'",
    "train mesh.cell=tetra": r"^Could not override 'mesh\.cell'\. .* use \+mesh\.cell=tetra",
    "train +mesh.cel=tetra": r"^mesh\.cel: .* has no such option; did you mean mesh\.cell\?$",
    "train model=fcnn,cnn": r"^model=fcnn,cnn names several values; add -m",
    "train model.width=[1,2": r"^model\.width=\[1,2 cannot be read; quote the value",
    "train model": r"^model must be written as KEY=VALUE$",
    "train --foo": r"^unrecognized arguments: --foo; .*--help",
    "train seed=1 -m seed=2": r"^unrecognized arguments: seed=2; flags such as -m stand before",
    "train --config-dir nowhere": r"^--config-dir = nowhere must be an existing folder$",
    "train --config-name nowhere": r"^Cannot find primary config 'nowhere'",
    "train young=${nowhere}": r"^young: Interpolation key 'nowhere' not found$",
    "train -m loss=mse,msee": r"Could not find 'loss/msee'",
    "train -m data.train=8,0": r"^data\.train = 0 must lie between",
    "train -m seed=0,1 optimizer.lr=1e-3,1e30": r"^optimizer\.lr = 1e\+30 must lie between",
    "train model=fcnn model.base=cubic": r"^model\.base = 'cubic' must be one of linear or null",
    "train -m model.layers=2,1": r"^model: layers = 1 must lie between 2 and",
    "train -m loss=lr_plus loss.weight=1,-1": r"^loss: weight = -1",
    "train -m fixed.axis=0,3": r"^fixed: axis = 3",
    "train -m trainer.accelerator=cpu,foo": r"^trainer: .*foo",
    "generate -m shard=range(4) shards=3": r"^data: shard = 3 must lie between 0 and 2$",
    "train data=online +data.train.error=1e-3": r"^data\.train\.error: dpl\.data\.Stream has no",
    "generate data._target_=dpl.data.DataModule": r"^data\._target_ = .*dpl\.data\.DataSet",
    "train data._target_=dpl.data.DataSet": r"^data\._target_ = .*dpl\.data\.DataModule",
    "generate actoin=verify": r"^actoin: there is no such key; did you mean action\?$",
    "view rn=3": r"^rn: there is no such key; did you mean run\?$",
    "evaluate": r"^run is missing",
}
PARTS = {"train": train.parts, "generate": generate.parts}


@pytest.fixture
def ask(monkeypatch, tmp_path, folder_of):
    """Checks a command line as its command does, in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    GlobalHydra.instance().clear()

    def ask(command, *arguments):
        args = dry_run.arguments_of(arguments, command, folder_of(command))
        with dry_run.initialized(args):
            dry_run.check(args, PARTS.get(command))

    return ask


@pytest.mark.parametrize("line", NONSENSE)
def test_a_command_line_that_cannot_work_is_refused_in_one_line(ask, capfd, tiny, line, tmp_path):
    command, *arguments = line.split()
    small = [*tiny, "model=fcnn", "model.width=8"] if line.startswith("train -m") else []
    with pytest.raises(ConfigError, match=NONSENSE[line]) as refusal:
        ask(command, *arguments, *small)
    assert "\n" not in str(refusal.value)
    assert "full_key" not in str(refusal.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert capfd.readouterr().err.replace(f"{COMPILING}\n", "") == ""


@pytest.mark.parametrize(
    "line",
    [
        "train",
        "train ~experiment ~hparams_search",
        "train experiment=beam_young",
        "train +mesh.cell=tetra model=fcnn ++model.width=8",
        "train run=new/folder",
        "generate --cfg job young=-1",
    ],
)
def test_a_command_line_that_works_is_not_refused_and_leaves_nothing(ask, line, tmp_path):
    ask(*line.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_every_job_of_a_sweep_is_checked_and_rehearsed_before_the_first(ask, monkeypatch):
    rehearsed = []
    monkeypatch.setitem(PARTS, "train", rehearsed.append)
    ask("train", "-m", "model=fcnn,cnn", "loss=mse,lr_star", "seed=0,1")
    seen = {tuple(c[k]._target_.rpartition(".")[2] for k in ("model", "loss")) for c in rehearsed}
    assert seen == {(model, loss) for model in ("FCNN", "CNN") for loss in ("MSE", "LrStar")}
    assert len(rehearsed) == 4, "a seed decides nothing about whether a job can work"
    ask("train")
    assert len(rehearsed) == 4, "a single job builds its parts when it runs"


def test_configurations_beside_those_of_the_package_are_checked_too(ask, script, tmp_path):
    path = tmp_path / "mine/material/soft.yaml"
    path.parent.mkdir(parents=True)
    path.write_text("_target_: dpl.fem.NeoHookeanLn\npoisson: 0.1\n")
    ask("generate", "--config-dir", "mine", "material=soft")
    with pytest.raises(ConfigError, match=r"Could not find 'material/sofd' .* soft "):
        ask("generate", "--config-dir", "mine", "material=sofd")
    path.write_text("{_target_: dpl.fem.NeoHookeanLn, poisson: ???}")  # is no YAML
    ended = script("generate", "--config-dir", "mine", "material=soft", cwd=tmp_path)
    assert ended.status == 2
    (line,) = ended.err.strip().splitlines()
    assert line.startswith("error: ")
    assert "soft.yaml" in line


@pytest.mark.parametrize(
    "line",
    [
        "train modle=fcnn",
        "train data.batch_size=0",
        "train model=fcnn trainer.max_epochs=-1",
        "train data.folder=/dev/null",
        "train run=null",
        "train run=${nowhere}",
        "train run=/proc/nope",
        "train model=3",
        "train -m optimizer.lr=interval(1e-3,1)",
        "train model=fcnn ~callbacks",
        "benchmark linear=[foo]",
        "benchmark linear=[]",
    ],
)
def test_a_command_ends_with_one_line_and_2(script, tiny, tmp_path, line):
    command, *arguments = line.split()
    small = tiny if command == "train" else []
    ended = script(command, *arguments, *small, cwd=tmp_path)
    assert ended.status == 2
    assert ended.err.startswith("error: ")
    assert ended.err.count("\n") == 1
    assert "Traceback" not in ended.out
    assert "solving" not in ended.out
    assert not list(tmp_path.iterdir())


def test_a_region_may_be_left_out_where_supports_hold_the_body(scene_of, tiny):
    """As a refused `fixed=null` advises."""
    with pytest.raises(ConfigError, match="6 rigid modes are unconstrained"):
        scene_of(*tiny, "~fixed")
    end = "region: {_target_: dpl.fem.Plane, axis: 0, at: min}"
    held = f"+supports.end={{_target_: dpl.fem.DirichletBC, value: [0, 0, 0], {end}}}"
    usual, scene = scene_of(*tiny), scene_of(*tiny, "~fixed", held)
    assert bool((scene.problem.free == usual.problem.free).all())


KEPT = "dirpath:./checkpoints,filename"
LAST = f"+callbacks.z={{_target_:lightning.pytorch.callbacks.ModelCheckpoint,{KEPT}:last}}"
BEST = f"+callbacks.y={{_target_:dpl.training.BestWeights,{KEPT}:best,monitor:val/e_mean}}"
NONE = "callbacks=none ~callbacks.best_weights ~callbacks.last_checkpoint"
OFTEN = "trainer.check_val_every_n_epoch=1"
OTHER = LAST.replace("last", "other")
CALLBACKS = {  # what keeps weights from which a run can be loaded, and what does not
    "": True,
    "callbacks=none": True,
    NONE: False,
    f"{NONE} +trainer.fast_dev_run=true": True,  # nothing is kept on purpose
    "callbacks.best_weights.dirpath=x callbacks.last_checkpoint.dirpath=x": False,
    f"{NONE} {OTHER}": False,
    f"{NONE} {LAST}": True,
    f"{NONE} {BEST}": True,  # the last epoch is validated
    f"{NONE} {BEST} {OFTEN} +trainer.limit_val_batches=0": False,
}


@pytest.mark.parametrize("line", CALLBACKS)
def test_a_training_that_would_keep_no_weights_is_refused(compose, tiny_training, line):
    sizes = [one for one in tiny_training if "check_val" not in one]
    cfg = compose("folder=.", *sizes, "trainer.max_epochs=2", *line.split(), command="train")
    plain.check(cfg)
    trainer = build.build_trainer(cfg)
    advice = r"^callbacks must write weights .*; add \+callbacks\.last="
    refused = pytest.raises(ConfigError, match=advice)
    with contextlib.nullcontext() if CALLBACKS[line] else refused:
        cli.check_trainer(trainer, cfg)


def test_the_advice_for_extras_works_where_it_is_given(monkeypatch):
    from dpl import version

    assert version.install("onnx") == "pip install -c constraints.txt -e '.[onnx]'"
    monkeypatch.setattr(version, "ROOT", Path("nowhere/site-packages"))
    assert version.install("onnx") == "pip install 'deepphysics[onnx]'"


def test_a_single_job_is_composed_once(script, monkeypatch, tmp_path):
    composed = []
    original = ConfigLoaderImpl.load_configuration

    def counted(self, *args, **kwargs):
        composed.append(args or kwargs)
        return original(self, *args, **kwargs)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)
    assert script("evaluate", "run=nowhere", cwd=tmp_path).status == 2
    assert len(composed) == 1
