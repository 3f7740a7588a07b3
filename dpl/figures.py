"""Pictures of deformed bodies."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import lightning as L
import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.problem import Problem
from dpl.scene import Sample

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

# Vertices of a cell's facets in turn around each facet, by cell shape.
FACETS = {
    "Tetrahedral": ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)),
    "Hexahedral": (
        (0, 1, 4, 2),
        (0, 1, 5, 3),
        (0, 2, 6, 3),
        (1, 4, 7, 5),
        (2, 4, 7, 6),
        (3, 5, 7, 6),
    ),
}


def surface(mesh: skfem.Mesh) -> NDArray[np.int_]:
    """Return what is seen of a mesh as polygons of vertices, (P, corners).

    In 3D the facets on the boundary, in 2D the cells.
    """
    if mesh.dim() == 2:
        corners = 3 if mesh.elem.refdom.name == "Triangular" else 4
        return mesh.t[:corners].T
    faces = np.concatenate([mesh.t[list(corners)].T for corners in FACETS[mesh.elem.refdom.name]])
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[count == 1]]


def deformed(
    problem: Problem,
    truth: Tensor,
    predictions: Sequence[tuple[str, Tensor]],
    *,
    names: Sequence[str] = (),
) -> "Figure":
    """Return a figure of deformed bodies coloured by the distance from where nodes should be.

    One column a load, one row a prediction; the true shape as a grey net over each.

    Args:
        problem: The body.
        truth: (B, N, D) [-].
        predictions: Named, (B, N, D) [-] each.
        names: Titles of the loads.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    polygons, points = surface(problem.mesh), problem.points.cpu().numpy()
    right = truth.detach().cpu().numpy()
    fields = [(name, field.detach().cpu().numpy()) for name, field in predictions]
    columns, dim = len(right), points.shape[1]
    figure = Figure(figsize=(3.6 * columns + 1.2, 2.2 * len(fields) + 0.4), layout="constrained")
    axes = figure.subplots(
        len(fields), columns, squeeze=False, subplot_kw={"projection": "3d"} if dim == 3 else {}
    )
    seen = np.concatenate([points[None] + right, points[None]])
    errors = [np.linalg.norm(field - right, axis=2) for _, field in fields]
    finite = [error[np.isfinite(error)] for error in errors]
    top = max(1e-12, *(float(error.max(initial=0.0)) for error in finite))
    scale = ScalarMappable(LogNorm(top * 1e-3, top), "viridis")
    for row, (name, field) in enumerate(fields):
        for column in range(columns):
            ax = axes[row, column]
            error = errors[row][column][polygons].mean(axis=1)
            colours = scale.to_rgba(np.maximum(error, top * 1e-3))
            shape, true = (points + field[column])[polygons], (points + right[column])[polygons]
            _draw(ax, shape, facecolors=colours, edgecolors="none")
            _draw(ax, true, facecolors="none", edgecolors="0.4", linewidths=0.3)
            _frame(ax, seen, zoom=1.1)
            title = [names[column]] if row == 0 and names else []
            ax.set_title("\n".join([*title, name]), fontsize=9)
    figure.colorbar(scale, ax=axes, label="distance from the true position / L", shrink=0.8)
    return figure


def body(
    ax: Any,
    problem: Problem,
    displacement: Tensor | None = None,
    *,
    values: Tensor | None = None,
    limits: tuple[float, float] | None = None,
    colours: str = "viridis",
    room: Sequence[Tensor] = (),
) -> "ScalarMappable":
    """Draw a body on matplotlib's axes, deformed, and return its colours, for a colour bar.

    Args:
        ax: Of projection "3d" for a body in 3D.
        problem: The body.
        displacement: (N, D) [-]; at rest if left out.
        values: What its colours show, (N,), each polygon the mean of its corners; grey if left out.
        limits: Smallest and largest value of the colours; those of the values if left out.
        colours: Name of a colour map of matplotlib.
        room: Further displacements (N, D) that the axes are to have room for, so that pictures
            side by side have one scale.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    polygons, points = surface(problem.mesh), problem.points.cpu().numpy()
    moved = [points + u.detach().cpu().numpy() for u in (displacement, *room) if u is not None]
    places = points if displacement is None else moved[0]
    shades = np.zeros(len(points)) if values is None else values.detach().cpu().numpy()
    scale = ScalarMappable(Normalize(*(limits or (shades.min(), shades.max()))), colours)
    faces: Any = "0.85" if values is None else scale.to_rgba(shades[polygons].mean(axis=1))
    _draw(ax, places[polygons], facecolors=faces, edgecolors="0.3", linewidths=0.2)
    _frame(ax, np.stack([points, *moved]), zoom=1.0)
    return scale


def _draw(ax: Any, polygons: Any, **style: Any) -> None:
    from matplotlib.collections import PolyCollection
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if polygons.shape[-1] == 3:
        ax.add_collection3d(Poly3DCollection(polygons, clip_on=False, **style))
    else:
        ax.add_collection(PolyCollection(polygons, **style))


def _frame(ax: Any, points: NDArray[np.float64], *, zoom: float) -> None:
    """Show the box of all points, equal scales, no axes."""
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    if len(low) == 3:
        ax.set_zlim(low[2], high[2])
        ax.set_box_aspect(high - low, zoom=zoom)
        ax.view_init(elev=18, azim=-60)
    else:
        ax.set_aspect("equal")
    ax.set_axis_off()


class DeformedShapes(L.Callback):
    """Puts pictures of predicted against true shapes into TensorBoard."""

    def __init__(self, *, every: int = 20, loads: int = 3) -> None:
        """Choose how often and how much.

        Args:
            every: Validations between pictures.
            loads: Validation loads shown.
        """
        self.every, self.loads, self._seen = every, loads, 0

    def on_validation_epoch_end(self, trainer: L.Trainer, module: Any) -> None:
        """Draw after every so many validations."""
        if trainer.sanity_checking:
            return
        self._seen += 1
        if self._seen % self.every == 0:
            self._draw(trainer, module)

    def on_fit_end(self, trainer: L.Trainer, module: Any) -> None:
        """Draw the last state."""
        self._draw(trainer, module)

    def _draw(self, trainer: L.Trainer, module: Any) -> None:
        if not hasattr(getattr(trainer.logger, "experiment", None), "add_figure"):
            return
        some = trainer.datamodule.samples("val")
        batch = Sample(*(column[: self.loads].to(module.device) for column in some))
        with torch.no_grad():
            prediction = module.predict(batch.load)
        figure = deformed(module.scene.problem, batch.displacement, [("network", prediction)])
        trainer.logger.experiment.add_figure("deformed shapes", figure, trainer.global_step)
