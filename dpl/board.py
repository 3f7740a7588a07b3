"""What a run shows while it trains: its worst loads, its rates, and how it stands beside others.

Scalars go to whatever loggers there are; pictures, meshes and the HPARAMS tab to TensorBoard's.
Steps are those of Lightning's scalars: the first is 0. docs/monitoring.md says what each tag means.
"""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from dpl.data.datamodule import OnlineData
from dpl.figures import coarse, colours, deformed, spread, surface, triangles
from dpl.guard import Diverged
from dpl.metrics import Judged, MaxError, RelativeL2
from dpl.scene import Sample, Scene

GREY = 160  # of a true shape
LOOK = {  # of meshes in the browser, in the words of three.js
    "camera": {"cls": "PerspectiveCamera", "fov": 35},
    "lights": [
        {"cls": "AmbientLight", "color": "#ffffff", "intensity": 0.9},
        {"cls": "DirectionalLight", "color": "#ffffff", "intensity": 0.3, "position": [1, 2, 3]},
    ],
    "material": {"cls": "MeshStandardMaterial", "side": 2, "roughness": 1, "metalness": 0},
}


class WorstCases(L.Callback):
    """Draws the validation loads on which the network is worst, for TensorBoard.

    Under `validation/shapes` the loads with the largest relative and the largest absolute error
    beside a typical one; under `validation/errors` the errors of all; as the mesh
    `validation/worst` the load with the largest absolute error, to be turned: the prediction
    coloured by its error (blue: a thousandth of the largest or less, yellow: the largest), the
    truth below it in grey.

    Pictures come after `every` validations, twice, four times as many and so on, and at the end of
    the training; `time/pictures` is the part of the training's time that they took.
    """

    def __init__(
        self, *, every: int = 5, loads: int = 1, meshes: bool = True, most: int = 5000
    ) -> None:
        """Choose how often and how much.

        Args:
            every: Validations before the first picture.
            loads: Shown of each kind of error.
            meshes: Whether there are meshes.
            most: Polygons of a body; larger bodies are drawn coarser.

        Raises:
            ValueError: A number is less than 1.
        """
        for name, number in (("every", every), ("loads", loads), ("most", most)):
            if number < 1:
                raise ValueError(f"{name} = {number} must be 1 or more")
        self.loads, self.meshes, self.most = loads, meshes, most
        self._seen, self._next, self._last = 0, every, -1
        self._begin = self._spent = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._begin, self._spent = time.perf_counter(), 0.0

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Draw after so many validations."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        self._seen += 1
        if self._seen >= self._next:
            self._next *= 2
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Draw the last state."""
        if _step(trainer) != self._last:
            self._draw(trainer, pl_module)

    def state_dict(self) -> dict[str, int]:
        """Return how many validations there were, and when the next picture comes."""
        return {"seen": self._seen, "next": self._next}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Go on counting."""
        self._seen, self._next = state_dict["seen"], state_dict["next"]

    def _draw(self, trainer: L.Trainer, module: Any) -> None:
        boards = list(_boards(trainer))
        if not boards or getattr(trainer, "datamodule", None) is None:
            return
        start = time.perf_counter()
        step = self._last = _step(trainer)
        truth = trainer.datamodule.samples("val")
        training = module.training
        module.eval()
        judged = judge(module, truth, trainer.datamodule.batch_size)
        chosen = judged.chosen(self.loads)
        worst = chosen.index(judged.farthest)
        some = Sample(*(column[chosen] for column in truth))
        predicted = _predict(module, some)
        module.train(training)
        problem, names = module.scene.problem, [judged.title(load) for load in chosen]
        shown = [("", predicted)]
        shapes = deformed(
            problem, some.displacement, shown, names=names, upright=True, most=self.most
        )
        errors = spread(judged.relative, judged.size, chosen)
        for board in boards:
            board.add_figure("validation/shapes", shapes, step)
            board.add_figure("validation/errors", errors, step)
            if self.meshes and predicted[worst].isfinite().all():
                pair = beside(module.scene, predicted[worst], some.displacement[worst], self.most)
                board.add_mesh("validation/worst", **pair, config_dict=LOOK, global_step=step)
        self._spent += time.perf_counter() - start
        part = self._spent / (time.perf_counter() - self._begin)
        for board in boards:
            board.add_scalar("time/pictures", part, step)


def judge(module: Any, truth: Sample, batch_size: int) -> Judged:
    """Return how wrong a surrogate is on loads with the truth, (B, ...)."""
    relative, largest = RelativeL2(), MaxError()
    parts = []
    for columns in zip(*(column.split(batch_size) for column in truth), strict=True):
        batch = Sample(*columns)
        prediction = _predict(module, batch)
        size = batch.displacement.norm(dim=2).amax(dim=1)
        parts.append(
            Judged(relative.measure(prediction, batch), largest.measure(prediction, batch), size)
        )
    return Judged(*(torch.cat(column) for column in zip(*parts, strict=True)))


def beside(scene: Scene, prediction: Tensor, truth: Tensor, most: int) -> dict[str, Tensor]:
    """Return a prediction (N, D) [-] and, below it, the truth as one mesh for TensorBoard.

    The surface in triangles. Its first half of vertices is where the prediction puts them, in
    metres, its second half where they should be, moved down.

    Args:
        scene: Whose body it is.
        prediction: Finite.
        truth: (N, D) [-].
        most: Polygons, see `dpl.figures.coarse`.

    Returns:
        vertices: (1, V, 3) [m].
        colors: (1, V, 3), 0 to 255.
        faces: (1, F, 3).
    """
    points = scene.problem.points.cpu().numpy()
    polygons = coarse(points, surface(scene.problem.mesh), most)
    used, flat = np.unique(triangles(polygons), return_inverse=True)
    faces = flat.reshape(-1, 3)
    shapes = []
    for field in (prediction, truth):
        shape = np.zeros((len(used), 3))
        shape[:, : points.shape[1]] = scene.length * (points + field.cpu().numpy())[used]
        shapes.append(shape)
    error = np.linalg.norm(shapes[0] - shapes[1], axis=1)
    paint = np.concatenate([colours(error), np.full((len(used), 3), GREY, np.uint8)])
    both = np.concatenate(shapes)
    shapes[1][:, 1] -= 1.1 * np.ptp(both[:, 1])
    return {
        "vertices": torch.from_numpy(np.concatenate(shapes)).float()[None],
        "colors": torch.from_numpy(paint)[None],
        "faces": torch.from_numpy(np.concatenate([faces, faces + len(used)])).int()[None],
    }


class SampleRates(L.Callback):
    """Logs how fast samples are made and used, once an epoch, validation left out.

    `rate/steps` and `rate/consumed` (samples) a second; of a stream besides `rate/produced`
    (samples a second), `online/waiting` (part of the time in which the optimiser had nothing to
    do), `online/uses` (of a sample, on average) and `online/buffer` (samples). `memory/process`
    and, on a GPU, the most that was taken of it, `memory/gpu` [GB].
    """

    def __init__(self) -> None:
        """Start with nothing counted."""
        self._steps = self._samples = 0
        self._seconds = self._mark = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start counting."""
        self._steps, self._samples, self._seconds = trainer.global_step, 0, 0.0
        self._mark = time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Sequence[Tensor],
        batch_idx: int,
    ) -> None:
        """Count a batch and its time."""
        now = time.perf_counter()
        self._seconds, self._mark = self._seconds + now - self._mark, now
        self._samples += len(batch[0])

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave its time out."""
        self._mark = time.perf_counter()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log the epoch; of several processes the sums."""
        seconds = max(self._seconds, 1e-9)
        sums = {"rate/consumed": self._samples / seconds, "memory/process": resident()}
        means = {"rate/steps": (trainer.global_step - self._steps) / seconds}
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, OnlineData) and (rates := data.rates) is not None:
            sums |= {"rate/produced": rates.produced, "online/buffer": float(rates.buffer)}
            means |= {"online/waiting": rates.waiting, "online/uses": rates.uses}
        if pl_module.device.type == "cuda":
            sums["memory/gpu"] = torch.cuda.max_memory_allocated(pl_module.device) / 1e9
        pl_module.log_dict(sums, sync_dist=True, reduce_fx="sum")
        pl_module.log_dict(means, sync_dist=True)


class LearningRate(LearningRateMonitor):
    """Lightning's callback, which would end a training that has no logger."""

    def on_train_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Find the optimisers, if there is a logger."""
        if trainer.loggers:
            super().on_train_start(trainer, *args, **kwargs)

    def on_train_batch_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Log the rate, if there is a logger."""
        if trainer.loggers:
            super().on_train_batch_start(trainer, *args, **kwargs)

    def on_train_epoch_start(self, trainer: L.Trainer, *args: Any, **kwargs: Any) -> None:
        """Log the rate, if there is a logger."""
        if trainer.loggers:
            super().on_train_epoch_start(trainer, *args, **kwargs)


class Session(L.Callback):
    """Tells loggers what makes this run differ from others, and how it ended.

    TensorBoard's HPARAMS tab shows a run from its first step on, with the last of all its scalars;
    one that was interrupted stays open, one that diverged has failed, one that was judged
    (`finish`) has succeeded. A resumed run goes on in the same curves: what was written beyond the
    checkpoint by the session before is withdrawn.

    Attributes:
        hyperparameters: Flat, numbers, truth values and texts.
        begun: Whether an epoch has begun in this session.
    """

    def __init__(self, hyperparameters: Mapping[str, bool | int | float | str]) -> None:
        """Keep what to tell."""
        self.hyperparameters = dict(hyperparameters)
        self.begun = False

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Remember that what is resumed has been restored."""
        self.begun = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Tell what run this is."""
        from torch.utils.tensorboard.summary import hparams

        if not trainer.is_global_zero:
            return
        for logger in trainer.loggers:
            if not isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(self.hyperparameters)
        # not the list of columns, which Lightning would write: it hides those of other runs
        _, start, _ = hparams(self.hyperparameters, {})
        for board in _boards(trainer):
            writer = board._get_file_writer()
            writer.add_event(_started(), trainer.global_step)  # readers count the second one
            writer.add_summary(start)

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Tell that a training diverged; others can be resumed."""
        if isinstance(exception, Diverged):
            for board in _boards(trainer):
                board._get_file_writer().add_summary(_end(failed=True))

    def finish(self, trainer: L.Trainer, errors: Mapping[str, float]) -> None:
        """Tell the errors of the best weights on the test loads, as `best/NAME`.

        So they come first in the HPARAMS tab, which sorts by name and shows a few.
        """
        if not trainer.is_global_zero:
            return
        named = {f"best/{name}": value for name, value in errors.items()}
        for logger in trainer.loggers:
            logger.log_metrics(named, step=_step(trainer))
        for board in _boards(trainer):
            board._get_file_writer().add_summary(_end(failed=False))
        for logger in trainer.loggers:
            logger.save()
            logger.finalize("success")


def resident() -> float:
    """Return the memory that this process holds [GB]; zero where the system does not say."""
    with suppress(OSError):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e9
    return 0.0


def _boards(trainer: L.Trainer) -> Iterator[Any]:
    """Yield TensorBoard's writers; none in any but the first process."""
    if trainer.is_global_zero:
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                yield logger.experiment


def _step(trainer: L.Trainer) -> int:
    """Return the step under which Lightning writes the scalars of the step before this moment."""
    return max(0, trainer.global_step - 1)


def _predict(module: Any, batch: Sample) -> Tensor:
    """Return what a surrogate answers, on the CPU."""
    with torch.no_grad():
        load = Sample(*(column.to(module.device) for column in batch)).load
        return module.predict(load).cpu()


def _started() -> Any:
    """Return the event of a session's start: readers drop what they have of later steps."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    return Event(session_log=SessionLog(status=SessionLog.START))


def _end(*, failed: bool) -> Any:
    """Return the summary that ends a session of the HPARAMS tab."""
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2

    status = api_pb2.STATUS_FAILURE if failed else api_pb2.STATUS_SUCCESS
    info = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
    data = plugin_data_pb2.HParamsPluginData(session_end_info=info)
    described = metadata.create_summary_metadata(data)
    return Summary(value=[Summary.Value(tag=metadata.SESSION_END_INFO_TAG, metadata=described)])
