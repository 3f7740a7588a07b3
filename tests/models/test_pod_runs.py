"""Runs of a network with bases: stored, resumed, refused."""

import json

import pytest
import torch

import dpl.fem as fem
from dpl.config import build, run_folder
from dpl.data import Stream
from dpl.training.checkpoints import read


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("pod")


@pytest.fixture
def overrides(tiny_training):
    """The command line of a run of four epochs on the tiny scene."""

    def overrides(name, *more):
        small = ["model=pod", "model.rank=100", "model.blocks=1", "model.coordinates=8"]
        recipe = ["optimizer=muon", "loss=rmse", "data.symmetry=true", "data.folder=data"]
        return [*tiny_training, *small, *recipe, "trainer.max_epochs=4", f"run={name}", *more]

    return overrides


@pytest.fixture
def trained(script, overrides, home):
    """The folder of an uninterrupted run."""
    if not (home / "whole").exists():
        ended = script("train", *overrides("whole"), cwd=home)
        assert ended.status == 0, ended.err
    return home / "whole"


def checkpoint(folder, name="last.ckpt"):
    return read(folder / "checkpoints" / name)


def alike(one, other):
    """Return True if plain data with tensors are equal bit for bit."""
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    return one == other


def test_a_loaded_run_has_the_same_predictions(trained, home, monkeypatch):
    monkeypatch.chdir(home)
    cfg, module = run_folder.load_run(trained)
    saved = checkpoint(trained, "best.safetensors")["state_dict"]
    assert cfg.model._target_.endswith("PODNet")
    assert module.net.is_fitted
    assert alike(saved, dict(module.state_dict()))
    again = run_folder.load_run(trained)[1]
    test = build.instantiate(cfg, "data", scene=module.scene).samples("test")
    with torch.no_grad():
        found = module.predict(test.load)
        assert torch.equal(found, again.predict(test.load))
    rows = json.loads((trained / "evaluation.json").read_text())
    (network,) = (row for row in rows if row["solver"] == "prediction")
    error = (found - test.displacement).flatten(1)
    e_mean = float(error.norm(dim=1).mean()) / error.shape[1]
    assert network["errors"]["e_mean"] == pytest.approx(e_mean, rel=1e-5)


def test_a_run_fits_its_bases_to_the_training_samples(trained, home, monkeypatch):
    monkeypatch.chdir(home)
    cfg, module = run_folder.load_run(trained)
    train = build.instantiate(cfg, "data", scene=module.scene).samples("train")
    expected = build.build_surrogate(cfg, module.scene)
    expected.fit_bases(train, fem.symmetries(module.scene.problem))
    buffers = dict(expected.net.named_buffers())
    assert buffers["modes"].any()
    assert alike(buffers, dict(module.net.named_buffers()))


def test_a_stream_fits_the_bases_to_the_validation_loads(script, overrides, home, trained):
    kept = [o for o in overrides("stream") if "data.train" not in o]
    more = [
        "data=online",
        "data.train.batches=2",
        "data.train.new_per_round=4",
        "trainer.max_epochs=2",
    ]
    ended = script("train", *kept, *more, cwd=home)
    assert ended.status == 0, ended.err
    cfg, module = run_folder.load_run(home / "stream")
    data = build.instantiate(cfg, "data", scene=module.scene)
    assert isinstance(data.source, Stream)
    expected = build.build_surrogate(cfg, module.scene)
    expected.fit_bases(data.samples("val"), fem.symmetries(module.scene.problem))
    assert alike(dict(expected.net.named_buffers()), dict(module.net.named_buffers()))
    weights = [dict(one.net.named_parameters()) for one in (expected, module)]
    assert not alike(*weights), "it has learnt"
    assert json.loads((home / "stream" / "evaluation.json").read_text())


@pytest.mark.parametrize(
    ("override", "reported"),
    [
        ("model.rank=0", "model: rank = 0 must be 1 or more"),
        ("+model.modes=3", "model.modes: dpl.models.PODNet has no such option"),
        ("optimizer.momentum=1.5", "optimizer: momentum = 1.5 must be"),
    ],
)
def test_a_wrong_option_ends_with_one_line_before_anything_is_solved(
    script, overrides, tmp_path, override, reported
):
    ended = script("train", *overrides("wrong", override), cwd=tmp_path)
    assert ended.status == 2
    assert ended.err.startswith(f"error: {reported}"), ended.err
    assert ended.err.count("\n") == 1
    assert not (tmp_path / "data").exists()
    assert not (tmp_path / "wrong" / "checkpoints").exists()


def test_a_run_of_another_rank_raises_an_error(trained, home, monkeypatch, tmp_path):
    monkeypatch.chdir(home)
    for name in ("config.yaml", "checkpoints/best.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    text = (tmp_path / "config.yaml").read_text()
    assert "rank: 100" in text
    (tmp_path / "config.yaml").write_text(text.replace("rank: 100", "rank: 20"))
    with pytest.raises(build.ConfigError, match=r"best\.safetensors cannot be used"):
        run_folder.load_run(tmp_path)
