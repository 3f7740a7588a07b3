"""What others get of a run: its data set as arrays, and a folder that `dpl.load` reads."""

import shutil

import numpy as np
import pytest
import torch
import yaml

import dpl
from dpl import config


@pytest.fixture
def trained(trained_run, tmp_path):
    """A working directory with a copy of a short training run."""
    shutil.copytree(trained_run.parents[1], tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def exported(script, trained):
    """The folder of the export of this run."""
    ended = script("export", "run=runs/first", "outputs=[dataset,publish]", cwd=trained)
    assert ended.status == 0, ended.err[-2000:]
    assert max(map(len, ended.out.splitlines())) <= 100
    return trained / "runs/first/export"


def test_an_exported_data_set_is_that_of_the_run_in_si_units(exported, trained):
    cfg, surrogate = config.load_run(trained / "runs/first")
    data, scene = config.load_data(cfg, surrogate.scene), surrogate.scene
    with np.load(exported / "dataset" / "pairs.npz") as found:
        for k, split in enumerate(data.sizes):
            own, rows = data.samples(split), found["split"] == k
            assert np.allclose(scene.length * own.displacement, found["displacement"][rows])
            load = scene.load_of(*(torch.from_numpy(found[n][rows]) for n in ("force", "young")))
            assert torch.allclose(load.force, own.force)
        assert found["points"].shape == found["force"].shape[1:]
    card = (exported / "dataset" / "README.md").read_text()
    assert scene.fingerprint in card
    assert f"{int(rows.sum())} {split}" in card
    assert (exported / "dataset" / "body.vtu").is_file()


def test_a_published_run_answers_as_the_run(exported, trained, monkeypatch, tmp_path_factory):
    constants = pytest.importorskip("huggingface_hub.constants")
    published = exported / "published"
    sim = dpl.load(trained / "runs/first")
    force = sim.scene.si_inputs(sim.scene.loads.sample(3, range(1)))["force"][0]
    expected = sim(force).displacement
    shutil.rmtree(trained / "runs" / "first" / "checkpoints")
    assert torch.equal(dpl.load(published)(force).displacement, expected)
    card = (published / "README.md").read_text()
    assert yaml.safe_load(card.split("---")[1])["license"] == "apache-2.0"
    assert "median" in card
    # the cache of the hub: files are links into a folder of their contents
    cache = tmp_path_factory.mktemp("hub") / "models--owner--name"
    snapshot = cache / "snapshots" / "0123456789abcdef0123456789abcdef01234567"
    (cache / "refs").mkdir(parents=True)
    (cache / "refs" / "main").write_text(snapshot.name)
    for k, path in enumerate(file for file in published.rglob("*") if file.is_file()):
        (cache / "blobs").mkdir(exist_ok=True)
        shutil.copy(path, cache / "blobs" / str(k))
        link = snapshot / path.relative_to(published)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(cache / "blobs" / str(k))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache.parent))
    assert torch.equal(dpl.load("hf://owner/name")(force).displacement, expected)
    with pytest.raises(dpl.ConfigError, match=r"^hf://owner/none cannot be downloaded: "):
        dpl.load("hf://owner/none")


def test_a_folder_with_files_and_a_run_without_weights_are_refused(exported, script, trained):
    arguments = "run=runs/first", "outputs=[publish]"
    ended = script("export", *arguments, cwd=trained)
    assert ended.status == 2
    assert "published must be empty; choose another folder" in ended.err
    weights = trained / "runs/first/checkpoints/best.safetensors"
    weights.rename(weights.with_suffix(".ckpt"))
    ended = script("export", *arguments, "folder=other", cwd=trained)
    assert ended.status == 2
    assert len(ended.err.strip().splitlines()) == 1
