"""The measurement of devices: every network is measured, and what is timed is what is named."""

import pytest
import torch

from benchmarks import devices

CPU = torch.device("cpu")
QUICK = devices.Clock(CPU, 2, 5.0, warm_up=1), [4], [1, 8]


@pytest.fixture(scope="module")
def samples(scene):
    return devices.samples_of(scene, 12)


@pytest.mark.parametrize("name", devices.NETWORKS)
def test_every_network_is_measured_at_every_batch(name, scene, samples):
    rows = list(devices.measure(name, scene, samples, *QUICK))
    tasks = [(devices.RESIDENT, 1), (devices.COPIED, 1), (devices.RESIDENT, 8), (devices.COPIED, 8)]
    trained = [] if name == "unrolled" else [(devices.TRAINING, 4)]
    assert [(row.task, row.batch) for row in rows] == tasks + trained
    for row in rows:
        assert 0 < row.ms <= row.ms_p99
        assert row.loads_per_second == pytest.approx(1e3 * row.batch / row.ms)
        assert row.peak_memory_mb > 50
        assert (row.parameters > 0) == (name != "unrolled")


def test_a_timed_training_step_lowers_the_loss(scene, samples):
    torch.manual_seed(0)
    surrogate = devices.fitted("fcnn", scene, samples)
    step = devices.training_step(surrogate, surrogate.encode(samples), 12)
    first = step()
    for _ in range(20):
        last = step()
    assert last < 0.7 * first


def test_a_timed_prediction_is_that_of_the_surrogate_with_repeated_loads(scene, samples):
    surrogate = devices.fitted("cnn", scene, samples)
    predict = devices.prediction(surrogate, samples, 30, copies=True)
    with torch.inference_mode():
        expected = surrogate.predict(samples.load)
    found = predict()
    assert len(found) == 30
    torch.testing.assert_close(found[12:24], expected)
    torch.testing.assert_close(found[24:], expected[:6])


@pytest.mark.parametrize("has_gpu", [False, True])
def test_auto_takes_a_gpu_if_there_is_one_and_cuda_needs_one(has_gpu, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_gpu)
    assert devices.select_device("auto") == torch.device("cuda" if has_gpu else "cpu")
    assert devices.select_device("cpu") == CPU
    for name, words in (("cuda", "needs a GPU"), ("tpu", "must be auto, cpu or cuda")):
        if not (has_gpu and name == "cuda"):
            with pytest.raises(ValueError, match=words):
                devices.select_device(name)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("name", devices.NETWORKS)
def test_every_network_is_measured_on_a_gpu(name, scene, samples):
    clock = devices.Clock(torch.device("cuda"), 3, 10.0)
    rows = list(devices.measure(name, scene, samples, clock, [4], [1, 64]))
    assert len(rows) == (4 if name == "unrolled" else 5)
    assert all(row.device == "cuda" and row.peak_memory_mb > 0 for row in rows)
