"""Pictures of deformed bodies and of how wrong they are."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Problem

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

from dpl.fem import surface
from dpl.fem.postprocess import coarse

CARD = 140  # resolution of what TensorBoard shows small [dots per inch]


def deformed(
    problem: Problem,
    truth: Tensor,
    predictions: Sequence[tuple[str, Tensor]],
    *,
    names: Sequence[str] = (),
    upright: bool = False,
    most: int | None = None,
) -> "Figure":
    """Return a figure of deformed bodies coloured by the distance from where nodes should be.

    One column a load, one row a prediction; the true shape as a grey net over each.

    Args:
        problem: The body.
        truth: (B, N, D) [-].
        predictions: Named, (B, N, D) [-] each; one alone needs no name.
        names: Titles of the loads.
        upright: One row a load, one column a prediction, narrow: for TensorBoard's small cards.
        most: Polygons of a body, see `coarse`; all if left out.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    polygons, points = surface(problem.mesh), problem.points.cpu().numpy()
    polygons = coarse(points, polygons, most) if most else polygons
    right = truth.detach().cpu().numpy()
    fields = [(name, field.detach().cpu().numpy()) for name, field in predictions]
    count, shown, dim = len(right), len(fields), points.shape[1]
    rows, columns = (count, shown) if upright else (shown, count)
    size = (3.6 * columns + 0.8, 2.5 * rows) if upright else (3.6 * columns + 1.2, 2.2 * rows + 0.4)
    figure = Figure(figsize=size, dpi=CARD if upright else 100)
    if upright:  # by hand: a layout that is computed takes longer than all the rest
        more = 0.25 + 0.15 * max((name.count("\n") for name in names), default=0)
        figure.subplots_adjust(0, 0.7 / size[1], 1, 1 - more / size[1], hspace=more / 2)
    else:
        figure.set_layout_engine("constrained")
    kind = {"projection": "3d"} if dim == 3 else {}
    axes = figure.subplots(rows, columns, squeeze=False, subplot_kw=kind)
    axes = axes.T if upright else axes
    seen = np.concatenate([points[None] + right, points[None]])
    errors = [np.linalg.norm(field - right, axis=2) for _, field in fields]
    finite = [error[np.isfinite(error)] for error in errors]
    top = max(1e-12, *(float(error.max(initial=0.0)) for error in finite))
    scale = ScalarMappable(LogNorm(top * 1e-3, top), "viridis")
    for row, (name, field) in enumerate(fields):
        for column in range(count):
            ax = axes[row, column]
            error = errors[row][column][polygons].mean(axis=1)
            colours = scale.to_rgba(np.maximum(error, top * 1e-3))
            shape, true = (points + field[column])[polygons], (points + right[column])[polygons]
            _draw(ax, shape, facecolors=colours, edgecolors="none")
            _draw(ax, true, facecolors="none", edgecolors="0.4", linewidths=0.3)
            _frame(ax, seen, zoom=1.4 if upright else 1.1)
            title = [names[column]] if row == 0 and names else []
            ax.set_title("\n".join(filter(None, [*title, name])), fontsize=9)
    label = "distance from the true position / L"
    if upright:
        below = figure.add_axes((0.1, 0.45 / size[1], 0.8, 0.1 / size[1]))
        figure.colorbar(scale, cax=below, orientation="horizontal", label=label).minorticks_off()
    else:
        figure.colorbar(scale, ax=axes, label=label, shrink=0.8)
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


def spread(relative: Tensor, size: Tensor, marked: Sequence[int] = ()) -> "Figure":
    """Return a figure of errors: against the size of the answer, and how many loads are below each.

    Loads without a finite error are left out and counted in the title.

    Args:
        relative: Relative L2 errors, (B,) [-].
        size: Largest true displacement of each load over L, (B,) [-].
        marked: Loads to be named.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 5.6), dpi=CARD)
    figure.subplots_adjust(left=0.15, right=0.96, bottom=0.09, top=0.94, hspace=0.25)
    upper, lower = figure.subplots(2, 1, sharey=True)
    error, amplitude = (np.maximum(part.cpu().numpy(), 1e-16) for part in (relative, size))
    finite = np.isfinite(error)
    upper.scatter(amplitude[finite], error[finite], s=12, alpha=0.6, edgecolors="none")
    for load in marked:
        if finite[load]:
            spot = amplitude[load], error[load]
            upper.plot(*spot, "o", color="C3", markersize=7, fillstyle="none")
            upper.annotate(f" {load}", spot, fontsize=8, color="C3", va="bottom")
    upper.set(xlabel="largest displacement / L", ylabel="relative L2 error")
    if finite.any():
        upper.set(xscale="log", yscale="log")
    part = np.arange(1, len(error) + 1) / len(error)
    lower.step(part[: finite.sum()], np.sort(error[finite]), where="pre")
    for quantile in (0.5, 0.9, 0.99):
        lower.axvline(quantile, color="0.8", linewidth=0.8, zorder=0)
    lower.set(xlim=(0, 1), xlabel="part of the loads with this error or less")
    lower.set_ylabel("relative L2 error")
    missing = int((~finite).sum())
    for ax in (upper, lower):
        ax.grid(visible=True, axis="y", linewidth=0.4)
        ax.minorticks_off()  # which take as long as the rest
    title = f"{len(error)} validation loads"
    figure.suptitle(title + (f", {missing} without a finite error" if missing else ""), fontsize=11)
    return figure


def colours(error: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the colours (N, 3) of distances (N,), as `deformed` has them: three decades."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm

    top = max(1e-12, float(error.max(initial=0.0)))
    scaled = LogNorm(top * 1e-3, top)(np.maximum(error, top * 1e-3))
    return (colormaps["viridis"](scaled)[:, :3] * 255).round().astype(np.uint8)
