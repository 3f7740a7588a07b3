"""Write pictures and meshes of the validation loads with the largest errors for TensorBoard."""

import time
from typing import Any

import lightning as L
import numpy as np
import torch
from torch import Tensor

from dpl.fem import surface
from dpl.fem.postprocess import coarse, triangles
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.training.callbacks.tensorboard import last_step, tensorboard_writers
from dpl.training.metrics import PerLoadErrors, largest_errors, relative_errors
from dpl.visualization import plot_deformed, plot_errors
from dpl.visualization.shapes import error_scale

REFERENCE_GREY = 160  # of reference shapes, 0 to 255
MESH_STYLE = {  # three.js options of meshes in the browser
    "camera": {"cls": "PerspectiveCamera", "fov": 35},
    "lights": [
        {"cls": "AmbientLight", "color": "#ffffff", "intensity": 0.9},
        {"cls": "DirectionalLight", "color": "#ffffff", "intensity": 0.3, "position": [1, 2, 3]},
    ],
    "material": {"cls": "MeshStandardMaterial", "side": 2, "roughness": 1, "metalness": 0},
}


class WorstCasePlots(L.Callback):
    """Draws the validation loads with the largest errors for TensorBoard.

    Pictures are drawn after `every`, 2 `every`, 4 `every`, ... validations and at the end of the
    training. docs/monitoring.md describes each tag.
    """

    def __init__(
        self, *, every: int = 5, loads: int = 1, meshes: bool = True, max_polygons: int = 5000
    ) -> None:
        """Choose the frequency and the content of the pictures.

        Args:
            every: Number of validations before the first picture.
            loads: Number of loads drawn for each kind of error.
            meshes: Also write meshes.
            max_polygons: Maximum number of polygons of a surface; larger meshes are coarsened.
        """
        check_range(1, every=every, loads=loads, max_polygons=max_polygons)
        self.loads, self.meshes, self.max_polygons = loads, meshes, max_polygons
        self._validations, self._next, self._drawn_step = 0, every, -1
        self._start = self._drawing_time = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._start, self._drawing_time = time.perf_counter(), 0.0

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Count validations and draw when the count reaches the next picture."""
        if trainer.sanity_checking or trainer.state.fn == "validate":
            return
        self._validations += 1
        if self._validations >= self._next:
            self._next *= 2
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Draw the final state unless it has been drawn."""
        if last_step(trainer) != self._drawn_step:
            self._draw(trainer, pl_module)

    def state_dict(self) -> dict[str, int]:
        """Return the number of validations and that of the next picture."""
        return {"validations": self._validations, "next": self._next}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Restore the counts."""
        self._validations, self._next = state_dict["validations"], state_dict["next"]

    def _draw(self, trainer: L.Trainer, module: Any) -> None:
        writers = tensorboard_writers(trainer)
        if not writers or getattr(trainer, "datamodule", None) is None:
            return
        start = time.perf_counter()
        step = self._drawn_step = last_step(trainer)
        training, data = module.training, trainer.datamodule
        module.eval()
        samples = data.samples("val")
        errors = per_sample_errors(module, samples, data.batch_size)
        selected = errors.select(self.loads)
        some = Sample(*(column[selected] for column in samples))
        predicted = _predict(module, some)
        module.train(training)
        shapes = plot_deformed(
            module.scene.problem,
            some.displacement,
            [("", predicted)],
            names=[errors.title(load) for load in selected],
            max_polygons=self.max_polygons,
        )
        distribution = plot_errors(errors.relative, errors.size, selected)
        worst, mesh = int(torch.nan_to_num(errors.largest[selected], nan=torch.inf).argmax()), None
        pair = predicted[worst], some.displacement[worst]
        if self.meshes and pair[0].isfinite().all():
            mesh = side_by_side_mesh(module.scene, *pair, self.max_polygons)
        for writer in writers:
            writer.add_figure("validation/shapes", shapes, step)
            writer.add_figure("validation/errors", distribution, step)
            if mesh:
                writer.add_mesh("validation/worst", **mesh, global_step=step)
        self._drawing_time += time.perf_counter() - start
        fraction = self._drawing_time / (time.perf_counter() - self._start)
        for writer in writers:
            writer.add_scalar("time/pictures", fraction, step)


def per_sample_errors(module: Any, samples: Sample, batch_size: int) -> PerLoadErrors:
    """Return the errors of a surrogate on samples (S, N, D), evaluated in batches."""
    parts = []
    for columns in zip(*(column.split(batch_size) for column in samples), strict=True):
        batch = Sample(*columns)
        prediction = _predict(module, batch)
        errors = relative_errors(prediction, batch), largest_errors(prediction, batch)
        parts.append((*errors, batch.displacement.norm(dim=2).amax(dim=1)))
    return PerLoadErrors(*(torch.cat(column) for column in zip(*parts, strict=True)))


def side_by_side_mesh(
    scene: Scene, prediction: Tensor, reference: Tensor, max_polygons: int
) -> dict[str, Any]:
    """Return a mesh for TensorBoard: the predicted surface, and the reference surface below it.

    The displacements over L, (N, D), are finite. The result has the arguments of
    `SummaryWriter.add_mesh`: vertices (1, V, 3) [m], those of the prediction first; colors
    (1, V, 3), 0 to 255; faces, triangles (1, F, 3); config_dict.
    """
    points = scene.problem.points.cpu().numpy()
    polygons = coarse(points, surface(scene.problem.mesh), max_polygons)
    used, flat = np.unique(triangles(polygons), return_inverse=True)
    faces = flat.reshape(-1, 3)
    shapes = []
    for field in (prediction, reference):
        shape = np.zeros((len(used), 3))
        shape[:, : points.shape[1]] = scene.length * (points + field.cpu().numpy())[used]
        shapes.append(shape)
    error = np.linalg.norm(shapes[0] - shapes[1], axis=1)
    colours = error_scale(error).to_rgba(error, bytes=True)[:, :3]
    paint = np.concatenate([colours, np.full_like(colours, REFERENCE_GREY)])
    both = np.concatenate(shapes)
    shapes[1][:, 1] -= 1.1 * np.ptp(both[:, 1])
    return {
        "config_dict": MESH_STYLE,
        "vertices": torch.from_numpy(np.concatenate(shapes)).float()[None],
        "colors": torch.from_numpy(paint)[None],
        "faces": torch.from_numpy(np.concatenate([faces, faces + len(used)])).int()[None],
    }


def _predict(module: Any, batch: Sample) -> Tensor:
    """Return the displacements that a surrogate predicts, on the CPU."""
    with torch.no_grad():
        load = Sample(*(column.to(module.device) for column in batch)).load
        return module.predict(load).cpu()
