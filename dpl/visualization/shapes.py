"""Figures of reference and predicted shapes with the nodal errors of the predictions."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Problem, surface
from dpl.fem.postprocess import coarse, facet_edges, triangle_normals
from dpl.visualization.style import DPI

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

Array = NDArray[Any]
DECADES = 1e-3  # smallest over largest error of a logarithmic colour scale
WIDE = 0.1  # part of the largest error below which a median error needs a logarithmic scale
SMALLEST_ERROR = 1e-12  # smallest upper end of a colour scale
ELEVATION, AZIMUTH = np.deg2rad((18.0, -60.0))  # of the view
PANEL = 3.2  # longer side of a panel [inch]
GAP, LINE, BAR = 0.08, 0.17, 0.12  # between panels, of a line of text, of a colour bar [inch]
MARGIN, BELOW = 0.05, 0.75  # beside and below all panels [inch]
LABEL = "nodal error / L [-]"
OUTSIDE = 0.5  # part of the size of a body that predictions extend a panel by at most
REFERENCE = "finite elements"


def plot_deformed(
    problem: Problem,
    truth: Tensor,
    predictions: Sequence[tuple[str, Tensor]],
    *,
    names: Sequence[str] = (),
    max_polygons: int | None = None,
) -> "Figure":
    """Return a figure of the reference shapes and of predicted shapes beside them.

    Rows are loads; the figure fits TensorBoard's narrow cards. The first column shows the reference
    in grey with the outline of the undeformed body. Each other column shows a prediction, coloured
    by the nodal error with a scale of its own, and the outline of the reference in black. A scale
    is logarithmic if errors span decades. A prediction that is not finite is left out of its panel.

    Args:
        problem: The body.
        truth: Displacements over L, (B, N, D) [-].
        predictions: Pairs of a name and displacements over L, (B, N, D) [-].
        names: Titles of the loads.
        max_polygons: Largest number of polygons per body, see `coarse`; None: all.
    """
    body = _Outlined(problem, max_polygons)
    true, *fields = (u.detach().cpu().numpy() for u in (truth, *(u for _, u in predictions)))
    extents = _extents(body.points, true, fields)
    lines = max((name.count("\n") + 1 for name in names), default=0)
    figure, axes, bars = _grid(len(predictions) + 1, extents, lines)
    for load, (ax, u) in enumerate(zip(axes[0], true, strict=True)):
        body.draw_lines(ax, body.points, "0.6", zorder=0)
        body.draw(ax, body.points + u, body.shades(body.points + u), "0.2")
        if names:
            ax.set_title(names[load], fontsize=9, loc="left")
    for row, bar, field in zip(axes[1:], bars, fields, strict=True):
        error = np.linalg.norm(field - true, axis=2)
        scale = error_scale(error)
        for ax, u, exact, value in zip(row, field, true, error, strict=True):
            if np.isfinite(u).all():
                means = value[body.polygons].mean(axis=1)
                body.draw(ax, body.points + u, scale.to_rgba(means), "0.75")
            body.draw_lines(ax, body.points + exact, "black", zorder=2)
        figure.colorbar(scale, cax=bar, orientation="horizontal").set_label(LABEL, fontsize=8)
        bar.tick_params(labelsize=7)
        bar.minorticks_off()
        if bar.get_xscale() == "linear":  # else labels overlap
            bar.locator_params(axis="x", nbins=4)
    for ax, name in zip(axes[:, -1], [REFERENCE, *(name for name, _ in predictions)], strict=True):
        ax.set_xlabel(name or "prediction", labelpad=2)
    for row in axes:
        for ax, (low, high) in zip(row, extents, strict=True):
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
            ax.set_aspect("equal")
            ax.spines[:].set_visible(False)
    return figure


class _Outlined:
    """Polygons and feature edges of the surface of a body."""

    def __init__(self, problem: Problem, max_polygons: int | None) -> None:
        self.points = problem.points.cpu().numpy()
        self.polygons = every = surface(problem.mesh)  # (P, corners)
        edges, features = facet_edges(self.points, every)
        self.edges = edges[features]  # (K, 2)
        sides = np.stack([every, np.roll(every, -1, axis=1)], axis=-1)  # (P, corners, 2)
        key = np.sort(sides, axis=2) @ [len(self.points), 1]
        owner, side = np.isin(key, np.sort(self.edges, axis=1) @ [len(self.points), 1]).nonzero()
        # feature edges once for each of their polygons, (S, 2), and these polygons, (S, corners)
        self.sides, self.owners = sides[owner, side], every[owner]
        if max_polygons:
            self.polygons = coarse(self.points, every, max_polygons)

    def shades(self, points: Array) -> Array:
        """Return greys, (P, 3), of the polygons under a light from the upper left; 2D: one grey."""
        if points.shape[1] == 2:
            return np.full((len(self.polygons), 3), 0.85)
        light = np.array([-0.3, -0.85, 0.45])
        lit = triangle_normals(points, self.polygons[:, :3]) @ light
        return np.repeat(0.62 + 0.32 * np.maximum(lit, 0.0)[:, None], 3, axis=1)

    def draw(self, ax: Any, points: Array, colours: Array, edges: str) -> None:
        """Draw the polygons and feature edges of points (N, D) from far to near."""
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_rgba_array

        flat, depth = project(points)
        parts = self.polygons, self.owners  # a side is drawn after each of its polygons
        order = np.concatenate([depth[part].mean(axis=1) for part in parts]).argsort(kind="stable")
        shapes = [*flat[self.polygons], *flat[self.sides]]
        lines = np.repeat(to_rgba_array(edges), len(self.sides), axis=0)
        paint = np.concatenate([to_rgba_array(colours), lines])
        widths = np.repeat([0.3, 0.6], [len(self.polygons), len(self.sides)])
        shapes, widths = [shapes[k] for k in order], widths[order]
        colours, edges = paint[order], "face"
        faces = PolyCollection(shapes, facecolors=colours, edgecolors=edges, linewidths=widths)
        ax.add_collection(faces)

    def draw_lines(self, ax: Any, points: Array, colour: str, zorder: int) -> None:
        """Draw the feature edges of points (N, D)."""
        from matplotlib.collections import LineCollection

        lines = list(project(points)[0][self.edges])
        ax.add_collection(LineCollection(lines, colors=colour, linewidths=0.7, zorder=zorder))


def project(points: Array) -> tuple[Array, Array]:
    """Return a parallel projection, (N, 2), of points (N, D) and their depth towards the viewer."""
    if points.shape[1] == 2:
        return points, np.zeros(len(points))
    ce, se, ca, sa = np.cos(ELEVATION), np.sin(ELEVATION), np.cos(AZIMUTH), np.sin(AZIMUTH)
    axes = np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])
    seen = points @ axes.T
    return seen[:, :2], seen[:, 2]


def error_scale(error: Array) -> "ScalarMappable":
    """Return a colour scale whose upper end is the largest finite error.

    It is logarithmic over three decades if half of the positive errors are small, else linear.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm, Normalize

    positive = error[np.isfinite(error) & (error > 0)]
    largest = float(positive.max(initial=SMALLEST_ERROR))
    if len(positive) and np.median(positive) < WIDE * largest:
        return ScalarMappable(LogNorm(largest * DECADES, largest, clip=True), "viridis")
    return ScalarMappable(Normalize(0.0, largest, clip=True), "viridis")


def _extents(points: Array, true: Array, fields: Sequence[Array]) -> list[tuple[Array, Array]]:
    """Return the corners, (2,) each, of a rectangle for each load; all have one size.

    They contain the body before and after, and predictions up to half of its size outside.
    """
    corners = []
    for load, u in enumerate(true):
        shapes = [points, points + u, *(points + field[load] for field in fields)]
        flat = [project(shape)[0] for shape in shapes if np.isfinite(shape).all()]
        low, high = (np.array([end(shape, axis=0) for shape in flat]) for end in (np.min, np.max))
        first, last = low[:2].min(axis=0), high[:2].max(axis=0)
        beyond = OUTSIDE * (last - first).max()
        low, high = low.min(axis=0), high.max(axis=0)
        corners.append((np.maximum(low, first - beyond), np.minimum(high, last + beyond)))
    size = np.max([high - low for low, high in corners], axis=0) * 1.04
    middles = [(low + high) / 2 for low, high in corners]
    return [(middle - size / 2, middle + size / 2) for middle in middles]


def _grid(
    columns: int, extents: Sequence[tuple[Array, Array]], titles: int
) -> tuple["Figure", Any, Any]:
    """Return a figure, its axes (columns, loads), and axes of colour bars of all columns but one.

    The panels have the shape of the body. There are `titles` lines above a load.
    """
    from matplotlib.figure import Figure

    low, high = extents[0]
    width, height = (high - low) * min(PANEL / (high - low))
    step, loads = height + 0.08 + LINE * titles + GAP, len(extents)
    size = 2 * MARGIN + columns * (width + GAP), BELOW + loads * step
    figure = Figure(figsize=size, dpi=DPI)
    figure.set_layout_engine("none")  # panels are placed here, whatever the style says

    def add(x: float, y: float, w: float, h: float, label: str = "") -> Any:
        room = x / size[0], y / size[1], w / size[0], h / size[1]
        return figure.add_axes(room, label=label)

    left = [MARGIN + column * (width + GAP) for column in range(columns)]
    heights = [BELOW + (loads - 1 - load) * step for load in range(loads)]
    axes = [[add(x, y, width, height) for y in heights] for x in left]
    place = BELOW - 0.33, 0.84 * width, BAR
    bars = [add(x + 0.08 * width, *place, label="<colorbar>") for x in left[1:]]
    return figure, np.array(axes), bars
