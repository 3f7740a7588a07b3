"""A run over decades of Young's modulus is resumed, loaded and asked."""

import torch

import dpl

YOUNG = "young={low:1e6,high:1e10,distribution:log}"


def test_a_run_over_decades_of_moduli_is_resumed_and_loaded(script, tiny_training, tmp_path):
    lines = [*tiny_training, YOUNG, "model.young=true", "data.folder=data", "run=run"]
    assert script("train", *lines, "trainer.max_epochs=1", cwd=tmp_path).status == 0
    more = ["run=run", "ckpt_path=last", "trainer.max_epochs=2"]
    resumed = script("train", *more, "extras.verbose=true", cwd=tmp_path)
    assert resumed.status == 0, resumed.err
    assert "E from 1e+06 to 1e+10 Pa, uniform in log E" in " ".join(resumed.out.split())
    other = script("train", *more, YOUNG.replace("log", "uniform"), cwd=tmp_path)
    assert other.status == 2
    assert "young.distribution was log, is uniform" in other.err
    sim = dpl.load(tmp_path / "run")
    drawn = sim.scene.loads.sample((0, 2), range(200))
    assert 1e7 < float(drawn.young.median()) < 1e9
    force = sim.scene.si_inputs(drawn.unbatch()[0])["force"]
    answer = sim(force, young=drawn.young[:1])
    assert torch.isfinite(torch.as_tensor(answer.displacement)).all()
