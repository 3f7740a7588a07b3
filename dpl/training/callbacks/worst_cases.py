"""What a run shows while it trains: its worst loads, its rates, and how it stands beside others.

Scalars go to whatever loggers there are; pictures, meshes and the HPARAMS tab to TensorBoard's.
Steps are those of Lightning's scalars: the first is 0. docs/monitoring.md says what each tag means.
"""

import time
from collections.abc import Iterator
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from dpl.fem import surface
from dpl.fem.postprocess import coarse, triangles
from dpl.scene import Sample, Scene
from dpl.training.metrics import MaxError, PerLoadErrors, RelativeL2
from dpl.visualization import error_colours, plot_deformed, plot_errors

GREY = 160  # of a true shape
LOOK = {  # of meshes in the browser, in the words of three.js
    "camera": {"cls": "PerspectiveCamera", "fov": 35},
    "lights": [
        {"cls": "AmbientLight", "color": "#ffffff", "intensity": 0.9},
        {"cls": "DirectionalLight", "color": "#ffffff", "intensity": 0.3, "position": [1, 2, 3]},
    ],
    "material": {"cls": "MeshStandardMaterial", "side": 2, "roughness": 1, "metalness": 0},
}


class WorstCasePlots(L.Callback):
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
        judged = per_sample_errors(module, truth, trainer.datamodule.batch_size)
        chosen = judged.chosen(self.loads)
        worst = chosen.index(judged.farthest)
        some = Sample(*(column[chosen] for column in truth))
        predicted = _predict(module, some)
        module.train(training)
        problem, names = module.scene.problem, [judged.title(load) for load in chosen]
        shown = [("", predicted)]
        shapes = plot_deformed(
            problem, some.displacement, shown, names=names, upright=True, max_polygons=self.most
        )
        errors = plot_errors(judged.relative, judged.size, chosen)
        for board in boards:
            board.add_figure("validation/shapes", shapes, step)
            board.add_figure("validation/errors", errors, step)
            if self.meshes and predicted[worst].isfinite().all():
                pair = side_by_side_mesh(
                    module.scene, predicted[worst], some.displacement[worst], self.most
                )
                board.add_mesh("validation/worst", **pair, config_dict=LOOK, global_step=step)
        self._spent += time.perf_counter() - start
        part = self._spent / (time.perf_counter() - self._begin)
        for board in boards:
            board.add_scalar("time/pictures", part, step)


def per_sample_errors(module: Any, truth: Sample, batch_size: int) -> PerLoadErrors:
    """Return how wrong a surrogate is on loads with the truth, (B, ...)."""
    relative, largest = RelativeL2(), MaxError()
    parts = []
    for columns in zip(*(column.split(batch_size) for column in truth), strict=True):
        batch = Sample(*columns)
        prediction = _predict(module, batch)
        size = batch.displacement.norm(dim=2).amax(dim=1)
        parts.append(
            PerLoadErrors(
                relative.measure(prediction, batch), largest.measure(prediction, batch), size
            )
        )
    return PerLoadErrors(*(torch.cat(column) for column in zip(*parts, strict=True)))


def side_by_side_mesh(
    scene: Scene, prediction: Tensor, truth: Tensor, most: int
) -> dict[str, Tensor]:
    """Return a prediction (N, D) [-] and, below it, the truth as one mesh for TensorBoard.

    The surface in triangles. Its first half of vertices is where the prediction puts them, in
    metres, its second half where they should be, moved down.

    Args:
        scene: Whose body it is.
        prediction: Finite.
        truth: (N, D) [-].
        most: Polygons, see `dpl.fem.postprocess.coarse`.

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
    paint = np.concatenate([error_colours(error), np.full((len(used), 3), GREY, np.uint8)])
    both = np.concatenate(shapes)
    shapes[1][:, 1] -= 1.1 * np.ptp(both[:, 1])
    return {
        "vertices": torch.from_numpy(np.concatenate(shapes)).float()[None],
        "colors": torch.from_numpy(paint)[None],
        "faces": torch.from_numpy(np.concatenate([faces, faces + len(used)])).int()[None],
    }


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
