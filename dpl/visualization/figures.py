"""Figures of deformed bodies and of errors of predictions."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from dpl.fem import Problem, surface
from dpl.visualization.style import COLOURS, DPI

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure


def draw_body(
    ax: Any,
    problem: Problem,
    displacement: Tensor | None = None,
    *,
    values: Tensor | None = None,
    limits: tuple[float, float] | None = None,
    colours: str = "viridis",
    fit: Sequence[Tensor] = (),
) -> "ScalarMappable":
    """Draw a body on matplotlib axes and return its colour scale, for a colour bar.

    Args:
        ax: Axes; of projection "3d" for a body in 3D.
        problem: The body.
        displacement: Over L, (N, D) [-]; None: the undeformed body.
        values: Values at the nodes, (N,). Each polygon has the colour of the mean of its corners.
            None: a grey body.
        limits: Smallest and largest value of the colour scale; None: those of `values`.
        colours: Name of a matplotlib colour map.
        fit: Further displacements (N, D) that the axes limits must contain, so that several axes
            have the same scale.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    polygons, points = surface(problem.mesh), problem.points.cpu().numpy()
    deformed = [points + u.detach().cpu().numpy() for u in (displacement, *fit) if u is not None]
    corners: Any = (points if displacement is None else deformed[0])[polygons]
    nodal = np.zeros(len(points)) if values is None else values.detach().cpu().numpy()
    scale = ScalarMappable(Normalize(*(limits or (nodal.min(), nodal.max()))), colours)
    faces: Any = "0.85" if values is None else scale.to_rgba(nodal[polygons].mean(axis=1))
    style: dict[str, Any] = {"facecolors": faces, "edgecolors": "0.3", "linewidths": 0.2}
    if points.shape[1] == 3:
        ax.add_collection3d(Poly3DCollection(corners, clip_on=False, **style))
    else:
        ax.add_collection(PolyCollection(corners, **style))
    low, high = (end(np.stack([points, *deformed]), axis=(0, 1)) for end in (np.min, np.max))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if len(low) == 3:
        ax.set_zlim(low[2], high[2])
        ax.set_box_aspect(high - low)
        ax.view_init(elev=18, azim=-60)
    else:
        ax.set_aspect("equal")
    ax.set_axis_off()
    return scale


def plot_errors(relative: Tensor, size: Tensor, marked: Sequence[int] = ()) -> "Figure":
    """Return a figure of errors against displacement, and of their cumulative distribution.

    They are the relative L2 errors (B,) of loads and their largest displacements over L, (B,).
    `marked` loads are annotated; those without a finite error are left out, counted in the title.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 5.6), dpi=DPI)
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
        ax.minorticks_off()  # drawing them takes as long as the rest
    title = f"{len(error)} validation loads"
    figure.suptitle(title + (f", {missing} without a finite error" if missing else ""), fontsize=11)
    return figure


def plot_misfits(
    size: Tensor, misfits: Mapping[str, Tensor], label: str, *, limit: float | None = None
) -> "Figure":
    """Return a figure of relative misfits (S,) by name [-] against displacements over L, (S,) [-].

    `label` names the misfits, `limit` is the largest one that is accepted.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 3.4), dpi=DPI, layout="constrained")
    ax, width = figure.subplots(), size.cpu().numpy()
    styles = zip(misfits.items(), COLOURS, ("full", "none"), strict=False)
    for (name, values), colour, fill in styles:
        height = np.maximum(values.cpu().numpy(), 1e-16)
        style: dict[str, Any] = {"color": colour, "fillstyle": fill, "markeredgewidth": 0.6}
        ax.plot(width, height, "o", markersize=3.5, alpha=0.6, label=name, **style)
    if limit is not None:
        ax.axhline(limit, color="0.3", linewidth=0.8, linestyle="--", label=f"limit {limit:g}")
    ax.set(xlabel="largest displacement / L", ylabel=label, xscale="log", yscale="log")
    ax.grid(visible=True, axis="y", linewidth=0.4)
    ax.minorticks_off()
    figure.legend(loc="outside upper center", fontsize=8, frameon=False)
    return figure
