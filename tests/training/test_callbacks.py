"""Callbacks log pictures of the largest errors, rates, hyperparameters and the end of a run.

Event files are read with TensorBoard's readers.
"""

import csv
import io
import time

import lightning as L
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from PIL import Image
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_accumulator import (
    EventAccumulator as Tensors,
)
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2, get_experiment, list_session_groups
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.util import tensor_util

from dpl.data import DataModule, Stream
from dpl.fem import box, rectangle, surface
from dpl.models import FCNN
from dpl.training import (
    MSE,
    Diverged,
    ErrorMetrics,
    LogHyperparameters,
    LogLearningRate,
    Surrogate,
    ThroughputMonitor,
    WorstCasePlots,
)
from dpl.training.callbacks.throughput import resident_memory
from dpl.training.callbacks.worst_cases import per_sample_errors, side_by_side_mesh
from dpl.training.metrics import median

BATCHES = 3  # an epoch of the tiny data set


def surrogate(scene):
    torch.manual_seed(0)
    return Surrogate(FCNN(scene, width=8), MSE(), scene)


def trainer(folder, *callbacks, epochs=1, logger=None, **options):
    """Return a quiet trainer; its default logger is a TensorBoard logger in the folder."""
    if logger is None:
        logger = TensorBoardLogger(folder, name="", version="", default_hp_metric=False)
    quiet = {"enable_progress_bar": False, "enable_model_summary": False}
    return L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=logger,
        callbacks=list(callbacks),
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        default_root_dir=folder,
        **{"enable_checkpointing": False, **quiet, **options},
    )


def events(folder):
    """Return the events of a run as TensorBoard reads them."""
    found = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    found.Reload()
    return found


def steps(listed):
    return [event.step for event in listed]


def last(found, tag):
    return found.Scalars(tag)[-1].value


class Slow(L.Callback):
    """Waits in each step, and longer in each validation."""

    def on_train_batch_start(self, *_):
        time.sleep(0.02)

    def on_validation_batch_start(self, *_):
        time.sleep(0.3)


class Fails(L.Callback):
    """Raises an error in the middle of an epoch."""

    def __init__(self, step, error):
        self.step, self.error = step, error

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise self.error


# ------------------------------------------------------------------ the worst loads


def test_the_number_of_validations_between_pictures_doubles_and_the_end_is_drawn(
    scene, data, tmp_path
):
    tutor = trainer(tmp_path, WorstCasePlots(every=1), epochs=6)
    tutor.fit(surrogate(scene), datamodule=data)
    found, wanted = events(tmp_path), [BATCHES * epoch - 1 for epoch in (1, 2, 4, 6)]
    assert set(found.Tags()["images"]) == {"validation/shapes", "validation/errors"}
    for tag in found.Tags()["images"]:
        assert steps(found.Images(tag)) == wanted
    for part in ("VERTEX", "FACE", "COLOR"):
        assert steps(found.Tensors(f"validation/worst_{part}")) == wanted
    assert set(wanted) <= set(steps(found.Scalars("val/e_mean"))), "the same steps as scalars"
    fractions = found.Scalars("time/pictures")
    assert steps(fractions) == wanted
    assert all(0 < event.value < 1 for event in fractions)
    for tag in found.Tags()["images"]:
        written = found.Images(tag)[-1].encoded_image_string
        picture = np.asarray(Image.open(io.BytesIO(written)).convert("L"))
        assert min(picture.shape) > 200, "large enough to read"
        assert picture.std() > 10, "not empty"
        assert len(written) < 400_000


def test_per_sample_errors_equal_the_metrics(scene, batch):
    module = surrogate(scene).eval()
    with torch.no_grad():
        prediction = module.predict(batch.load)
    judged, collection = per_sample_errors(module, batch, 5), ErrorMetrics(scene.problem)
    collection.update(prediction, batch)
    wanted = collection.compute()
    assert float(judged.relative.max()) == pytest.approx(float(wanted["rel_L2_worst"]))
    assert float(median(judged.relative)) == pytest.approx(float(wanted["rel_L2_median"]))
    assert float(judged.largest.max()) == pytest.approx(float(wanted["e_max"]))
    assert torch.allclose(judged.size, batch.displacement.norm(dim=2).amax(dim=1))


def test_a_single_load_with_a_nan_prediction_is_drawn_once_without_a_mesh(scene, data, tmp_path):
    data.sizes["val"] = 1
    module = surrogate(scene)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.fill_(torch.nan)
    tutor = trainer(tmp_path, WorstCasePlots(every=2), epochs=2)
    tutor.fit(module, datamodule=data)
    found = events(tmp_path)
    assert steps(found.Images("validation/errors")) == [2 * BATCHES - 1]
    assert not found.Tags()["tensors"]


def test_pictures_do_not_change_the_training(scene, data, tmp_path):
    """Bit for bit, with a network that draws random numbers in training; here without meshes."""
    learnt, pictures = [], WorstCasePlots(every=1, meshes=False)
    for name, callbacks in (("with", [pictures, ThroughputMonitor()]), ("without", [])):
        module = surrogate(scene)
        module.net.stages.append(torch.nn.Dropout(0.2))
        torch.manual_seed(1)
        trainer(tmp_path / name, *callbacks, epochs=2).fit(module, datamodule=data)
        learnt.append(module.state_dict())
    for key, value in learnt[0].items():
        assert torch.equal(value, learnt[1][key]), key
    found = events(tmp_path / "with")
    assert found.Images("validation/shapes")
    assert not found.Tags()["tensors"]


@pytest.mark.parametrize("option", ["every", "loads", "max_polygons"])
def test_numbers_of_pictures_are_at_least_one(option):
    with pytest.raises(ValueError, match=f"{option} = 0 must be 1 or more"):
        WorstCasePlots(**{option: 0})


# ------------------------------------------------------------------ meshes

BODIES = {
    "tetrahedra": {"cell": "tetra"},
    "quadratic": {"mesh": box((4.0, 1.0, 1.0), (4, 2, 2)), "degree": 2},
    "quadrilaterals": {"mesh": rectangle([8.0, 2.0], [5, 3])},
}


@pytest.mark.parametrize("name", BODIES)
def test_the_mesh_has_the_predicted_positions_of_the_surface(make_scene, name):
    scene = make_scene(**BODIES[name], n_modes=2)
    generator = torch.Generator().manual_seed(0)
    truth, noise = (
        0.1 * torch.randn(scene.problem.shape, dtype=torch.float64, generator=generator)
        for _ in range(2)
    )
    prediction = truth + 0.1 * noise
    pair = side_by_side_mesh(scene, prediction, truth, 5000)
    (vertices,), (colors,), (faces,) = pair["vertices"], pair["colors"], pair["faces"]
    polygons = surface(scene.problem.mesh)
    used, dim = np.unique(polygons), scene.problem.shape[1]
    half = len(used)
    assert vertices.shape == colors.shape == (2 * half, 3)
    points = scene.problem.points
    wanted = scene.length * (points + prediction)[used]
    assert torch.allclose(vertices[:half, :dim].double(), wanted, rtol=1e-6, atol=1e-6)
    below = vertices[half:, :dim].double() - scene.length * (points + truth)[used]
    assert torch.allclose(below, below[0].expand_as(below), atol=1e-4), "the truth, moved"
    assert float(below[0, 1]) < 0
    if dim == 2:
        assert not vertices[:, 2].any()
    else:
        assert float(vertices[half:, 1].max()) < float(vertices[:half, 1].min())
    error = (prediction - truth)[used].norm(dim=1)
    light = colors[:half].double() @ torch.tensor([0.3, 0.6, 0.1], dtype=torch.float64)
    assert int(light.argmax()) == int(error.argmax())
    assert (light[error.argsort()].diff() > -2).all(), "brighter where it is more wrong"
    assert (colors[half:] == colors[half, 0]).all()
    corners = polygons.shape[1]
    assert faces.shape == (2 * (corners - 2) * len(polygons), 3)
    assert sorted(set(faces.flatten().tolist())) == list(range(2 * half))
    of_one = faces[: len(faces) // 2]
    assert int(of_one.max()) == half - 1
    assert torch.equal(faces[len(faces) // 2 :], of_one + half)


def test_the_written_mesh_is_that_of_the_load_with_the_largest_error(scene, data, tmp_path):
    module = surrogate(scene)
    trainer(tmp_path, WorstCasePlots(), epochs=2).fit(module, datamodule=data)
    truth = data.samples("val")
    with torch.no_grad():
        prediction = module.eval().predict(truth.load)
    worst = int((prediction - truth.displacement).norm(dim=2).amax(dim=1).argmax())
    pair = side_by_side_mesh(scene, prediction[worst], truth.displacement[worst], 5000)
    found = events(tmp_path)
    for part, name in (("VERTEX", "vertices"), ("FACE", "faces"), ("COLOR", "colors")):
        (event,) = found.Tensors(f"validation/worst_{part}")
        written = tensor_util.make_ndarray(event.tensor_proto)
        # answers to a batch of another size differ by the rounding of single precision
        off = np.abs(written.astype(float) - pair[name].numpy())
        assert off.max() <= {"vertices": 1e-4, "faces": 0, "colors": 2}[name], name
    kinds = found.summary_metadata["validation/worst_VERTEX"].plugin_data
    assert kinds.plugin_name == "mesh"


def test_the_mesh_of_a_large_body_is_coarser(make_scene):
    scene = make_scene(nodes=(13, 5, 5), n_modes=2)
    field = torch.zeros(scene.problem.shape, dtype=torch.float64)
    fine, rough = (side_by_side_mesh(scene, field, field, most) for most in (5000, 60))
    assert fine["faces"].shape[1] == 2 * 2 * (4 * 4 * 12 + 2 * 16)
    assert 10 < rough["faces"].shape[1] <= 2 * 2 * 60
    spans = [pair["vertices"][0, :, 0].max() - pair["vertices"][0, :, 0].min()
             for pair in (fine, rough)]  # fmt: skip
    assert float(spans[1]) == pytest.approx(float(spans[0]), rel=0.1)


# ------------------------------------------------------------------ rates


def test_rates_exclude_the_time_of_validation(scene, data, tmp_path):
    tutor = trainer(tmp_path, ThroughputMonitor(), Slow(), epochs=3)
    start = time.perf_counter()
    tutor.fit(surrogate(scene), datamodule=data)
    wall = time.perf_counter() - start
    found = events(tmp_path)
    pace = [event.value for event in found.Scalars("rate/steps")]
    used = [event.value for event in found.Scalars("rate/consumed")]
    assert steps(found.Scalars("rate/steps")) == [2, 5, 8]
    assert steps(found.Scalars("rate/consumed")) == [2, 5, 8]
    assert used == pytest.approx([4 * rate for rate in pace], rel=1e-5), "batches of 4"
    assert all(0 < rate < 1 / 0.02 for rate in pace)
    training = sum(BATCHES / rate for rate in pace)
    assert 9 * 0.02 < training < wall - 3 * 0.3, "a validation takes 0.3 s"
    assert not [tag for tag in found.Tags()["scalars"] if tag.startswith("online/")]
    assert last(found, "memory/process") == pytest.approx(resident_memory(), rel=0.5)


def test_a_stream_logs_its_production_rate_and_buffer_size(scene, folder, data, tmp_path):
    stream = Stream(batches=3, new_per_round=4, reuse=1, capacity=64)
    options = {"val": 4, "test": 4, "workers": 0, "batch_size": 4}
    module = DataModule(scene, folder=str(folder), train=stream, **options)
    threads = torch.get_num_threads()
    tutor = trainer(tmp_path, ThroughputMonitor(), epochs=3)
    tutor.fit(surrogate(scene), datamodule=module)
    module.teardown("fit")
    torch.set_num_threads(threads)
    found = events(tmp_path)
    for tag in ("rate/produced", "rate/consumed", "rate/steps", "online/waiting", "online/uses"):
        assert steps(found.Scalars(tag)) == [2, 5, 8]
        assert all(event.value > 0 for event in found.Scalars(tag)), tag
    assert [event.value for event in found.Scalars("online/buffer")] == [12, 24, 36]
    assert all(event.value <= 1 for event in found.Scalars("online/waiting"))
    assert last(found, "online/uses") == pytest.approx(1)


# ------------------------------------------------------------------ loggers


def test_a_run_without_a_logger_runs(scene, data, tmp_path):
    session = LogHyperparameters({"model": "FCNN"})
    callbacks = WorstCasePlots(every=1), ThroughputMonitor(), LogLearningRate(), session
    tutor = trainer(tmp_path, *callbacks, logger=False, epochs=2)
    tutor.fit(surrogate(scene), datamodule=data)
    session.finish(tutor, {"e_mean": 0.1})
    assert not list(tmp_path.rglob("events*"))


def test_two_loggers_have_the_scalars_hyperparameters_errors_and_pictures(scene, data, tmp_path):
    board = TensorBoardLogger(tmp_path, name="board", version="")
    logger = [CSVLogger(tmp_path, name="", version=""), board]
    session = LogHyperparameters({"model": "FCNN", "optimizer.lr": 1e-3})
    callbacks = WorstCasePlots(every=1), ThroughputMonitor(), LogLearningRate(), session
    tutor = trainer(tmp_path, *callbacks, logger=logger, epochs=2)
    tutor.fit(surrogate(scene), datamodule=data)
    session.finish(tutor, {"e_mean": 0.125})
    rows = list(csv.DictReader((tmp_path / "metrics.csv").open()))
    assert len([row for row in rows if row["rate/steps"]]) == 2
    assert len([row for row in rows if row["lr-AdamW"]]) >= 2 * BATCHES
    assert [float(row["best/e_mean"]) for row in rows if row["best/e_mean"]] == [0.125]
    assert "FCNN" in (tmp_path / "hparams.yaml").read_text()
    assert len(events(tmp_path / "board").Images("validation/shapes")) == 2


# ------------------------------------------------------------------ sessions


def resumable(folder, *callbacks, **options):
    kept = ModelCheckpoint(
        folder, "last", save_on_train_epoch_end=True, enable_version_counter=False
    )
    pictures = WorstCasePlots(every=2), ThroughputMonitor()
    return trainer(folder, *pictures, kept, *callbacks, enable_checkpointing=True, **options)


@pytest.fixture
def broken(scene, data, tmp_path):
    """The folder of a run of five epochs that was interrupted in the fourth and resumed."""
    folder = tmp_path / "broken"
    with pytest.raises(RuntimeError, match="power"):
        resumable(folder, LogHyperparameters({}), Fails(11, RuntimeError("power")), epochs=5).fit(
            surrogate(scene), datamodule=data
        )
    assert steps(events(folder).Scalars("loss/train"))[-1] >= 9, "beyond the checkpoint"
    kept = {"ckpt_path": str(folder / "last.ckpt"), "weights_only": True}
    resumable(folder, LogHyperparameters({}), epochs=5).fit(
        surrogate(scene), datamodule=data, **kept
    )
    return folder


def test_a_resumed_run_continues_the_same_curves(scene, data, tmp_path, broken):
    """Every step is logged once, with the values of an uninterrupted run."""
    straight = tmp_path / "straight"
    resumable(straight, LogHyperparameters({}), epochs=5).fit(surrogate(scene), datamodule=data)
    one, other = events(broken), events(straight)
    assert set(one.Tags()["scalars"]) == set(other.Tags()["scalars"])
    for tag in one.Tags()["scalars"]:
        seen = one.Scalars(tag)
        if tag != "epoch":  # which Lightning writes beside all others
            assert steps(seen) == sorted(set(steps(seen))), tag
        assert steps(seen) == steps(other.Scalars(tag)), tag
        if tag.startswith(("loss/", "val/")):
            wanted = [event.value for event in other.Scalars(tag)]
            assert [event.value for event in seen] == pytest.approx(wanted, rel=1e-6), tag
    shown = Tensors(str(broken), tensor_size_guidance={"scalars": 0})  # what its page is made from
    shown.Reload()
    assert steps(shown.Tensors("loss/train")) == list(range(15))
    for tag in one.Tags()["images"]:
        assert steps(one.Images(tag)) == steps(other.Images(tag)) == [5, 11, 14], tag
    for tag in (t for t in one.Tags()["tensors"] if "worst" in t):
        assert steps(one.Tensors(tag)) == steps(other.Tensors(tag)), tag


def hparams_tab(folder):
    """Return the status and metrics of each run as TensorBoard shows them in the HPARAMS tab."""
    runs = EventMultiplexer()
    runs.AddRunsFromDirectory(str(folder))
    runs.Reload()
    backend = Context(TBContext(data_provider=MultiplexerDataProvider(runs, str(folder))))
    requested = RequestContext(), backend, ""
    columns = get_experiment.Handler(*requested, api_pb2.GetExperimentRequest()).run()
    request = api_pb2.ListSessionGroupsRequest(
        start_index=0,
        slice_size=100,
        allowed_statuses=[
            *(api_pb2.STATUS_SUCCESS, api_pb2.STATUS_FAILURE),
            *(api_pb2.STATUS_RUNNING, api_pb2.STATUS_UNKNOWN),
        ],
        col_params=[
            *({"hparam": info.name} for info in columns.hparam_infos),
            *({"metric": info.name} for info in columns.metric_infos),
        ],
    )
    lines = list_session_groups.Handler(*requested, request).run().session_groups
    return {
        line.hparams["name"].string_value: (
            [session.status for session in line.sessions],
            {value.name.tag: value.value for value in line.metric_values},
        )
        for line in lines
    }


def test_the_hparams_tab_shows_running_failed_and_finished_runs(scene, data, tmp_path):
    ends = {
        "judged": None,
        "interrupted": Fails(4, KeyboardInterrupt()),
        "diverged": Fails(4, Diverged("no finite gradients")),
    }
    for name, end in ends.items():
        session = LogHyperparameters({"name": name, "optimizer.lr": 1e-3, "wide": True})
        tutor = trainer(tmp_path / name, session, *filter(None, [end]), epochs=3)
        try:
            tutor.fit(surrogate(scene), datamodule=data)
        except (SystemExit, Diverged):
            continue
        session.finish(tutor, {"e_mean": 0.25, "SNR_min": 30.0})
    with pytest.raises(SystemExit):
        resumable(
            tmp_path / "resumed", session := LogHyperparameters({"name": "resumed"}),
            Fails(4, KeyboardInterrupt()), epochs=3,
        ).fit(surrogate(scene), datamodule=data)  # fmt: skip
    tutor = resumable(tmp_path / "resumed", session, epochs=3)
    path = str(tmp_path / "resumed/last.ckpt")
    tutor.fit(surrogate(scene), datamodule=data, ckpt_path=path, weights_only=True)
    session.finish(tutor, {"e_mean": 0.5})
    shown = hparams_tab(tmp_path)
    assert set(shown) == {*ends, "resumed"}
    assert {name: status for name, (status, _) in shown.items()} == {
        "judged": [api_pb2.STATUS_SUCCESS],
        "interrupted": [api_pb2.STATUS_UNKNOWN],
        "diverged": [api_pb2.STATUS_FAILURE],
        "resumed": [api_pb2.STATUS_SUCCESS],
    }
    for name, (_, errors) in shown.items():
        found = events(tmp_path / name)
        assert errors["val/e_mean"] == pytest.approx(last(found, "val/e_mean"), rel=1e-6)
        assert ("best/e_mean" in errors) == (name in ("judged", "resumed"))
    assert shown["judged"][1]["best/e_mean"] == 0.25
    assert shown["judged"][1]["best/SNR_min"] == 30.0


# ------------------------------------------------------------------ the command


def test_the_command_works_without_a_logger(script, tiny_training, folder, data, tmp_path):
    sizes = ["data.train=12", f"data.folder={folder}", "trainer.max_epochs=1", "run=mine"]
    ended = script("train", *tiny_training, *sizes, "logger=none", cwd=tmp_path)
    assert ended.status == 0, ended.err
    found = {path.name for path in (tmp_path / "mine").iterdir() if path.is_file()}
    assert found == {
        *("config.yaml", "evaluation.json", "shapes.png", "training.jsonl", "worst.vtu")
    }
