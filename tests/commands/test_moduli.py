"""A run over decades of Young's modulus goes through all commands."""

import json

import pytest
import torch

import dpl
from dpl.export.onnx_graph import missing_packages

YOUNG = "young={low:1e6,high:1e10,distribution:log}"


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("moduli")


def test_a_run_over_decades_of_moduli_is_resumed_loaded_evaluated_and_exported(
    script, tiny_training, home
):
    lines = [*tiny_training, YOUNG, "model.young=true", "data.folder=data", "run=run"]
    assert script("train", *lines, "trainer.max_epochs=1", cwd=home).status == 0
    more = ["run=run", "ckpt_path=last", "trainer.max_epochs=2"]
    resumed = script("train", *more, "extras.verbose=true", cwd=home)
    assert resumed.status == 0, resumed.err
    assert "E from 1e+06 to 1e+10 Pa, uniform in log E" in " ".join(resumed.out.split())
    other = script("train", *more, YOUNG.replace("log", "uniform"), cwd=home)
    assert other.status == 2
    assert "young.distribution was log, is uniform" in other.err
    sim = dpl.load(home / "run")
    drawn = sim.scene.loads.sample((0, 2), range(200))
    assert 1e7 < float(drawn.young.median()) < 1e9
    force = sim.scene.si_inputs(drawn.unbatch()[0])["force"]
    answer = sim(force, young=drawn.young[:1])
    assert torch.isfinite(torch.as_tensor(answer.displacement)).all()
    assert script("evaluate", "run=run", cwd=home).status == 0
    if not missing_packages():
        ended = script("export", "run=run", cwd=home)
        assert ended.status == 0, ended.err
        (meta,) = (home / "run").rglob("meta.json")
        assert '"distribution": "log"' in json.dumps(json.loads(meta.read_text()))
