"""Tiny runs that the tests of the commands share."""

import shutil

import pytest


@pytest.fixture(scope="session")
def home(tmp_path_factory):
    """The folder of the runs."""
    return tmp_path_factory.mktemp("benchmarks")


@pytest.fixture
def trained(script, tiny_training, home):
    """A folder with runs/tiny and runs/other, in each a run of the paper's network and `unrolled`.

    Runs and data are written once; tests write elsewhere.
    """
    if not (home / "runs/other").exists():
        shared = [one for one in tiny_training if not one.startswith("model.")]
        models = {"fcnn": ["model=fcnn", "model.width=16"], "unrolled": ["model=unrolled"]}
        for name, more in models.items():
            common = ["data.folder=data", "trainer.max_epochs=1", f"run=runs/tiny/{name}"]
            ended = script("train", *shared, *common, *more, cwd=home)
            assert ended.status == 0, ended.err
        shutil.copytree(home / "runs/tiny", home / "runs/other")
    return home
