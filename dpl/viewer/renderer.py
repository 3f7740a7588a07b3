"""Images of frames without a display: the body from far to near, its load and a legend."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap, Normalize, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter
from numpy.typing import NDArray
from PIL import Image

from dpl.fem.postprocess import triangle_normals
from dpl.viewer.camera import Camera
from dpl.viewer.frames import QUANTITIES, Body, Frame
from dpl.viewer.surface import Floats, Surface, contour_bands, vertex_normals

COLOUR_MAPS = {"displacement": "viridis", "von Mises stress": "turbo", "error against FE": "magma"}
MARGINS = (0.03, 0.13, 0.05, 0.17)  # margins for legend (right) and captions (above) [-]
MAX_FITTED = 100  # frames to which a camera is fitted
SEAM, LINE = 0.5, 0.9  # width of the sides of triangles, which closes gaps, and of lines [point]
N_BANDS = 12
NEUTRAL = (188, 194, 204)  # colour of a body at rest
GRAZING = -0.2  # smallest distance of the camera above a visible face, over L
BACKGROUND, TEXT, TEXT_GREY, OUTLINE = "#fafafc", "#202430", "#464a58", "#cdd1da"
ARROW_COLOUR, SUPPORT_COLOUR = (200, 24, 45), (71, 85, 105)
ARROW: dict[str, Any] = {
    "arrowstyle": "simple,tail_width=0.22,head_width=0.8,head_length=0.8",
    **{"mutation_scale": 20, "shrinkA": 0, "shrinkB": 0, "linewidth": 0.6},
    **{"facecolor": np.array(ARROW_COLOUR) / 255, "edgecolor": "white"},
}
Bytes = NDArray[np.uint8]


def band_colours(quantity: str, top: float = 1.0) -> Bytes:
    """Return the RGB colours of the bands, (N_BANDS, 3); all neutral if the scale ends at 0."""
    if top <= 0:
        return np.tile(np.asarray(NEUTRAL, dtype=np.uint8), (N_BANDS, 1))
    first, last = (0.06, 0.94) if COLOUR_MAPS[quantity] == "turbo" else (0.12, 0.98)
    found = matplotlib.colormaps[COLOUR_MAPS[quantity]](np.linspace(first, last, N_BANDS))[:, :3]
    return np.asarray(np.round(255 * found), dtype=np.uint8)


def colour_bands(surface: Surface, frame: Frame, top: float) -> list[Floats]:
    """Return the corners of the triangles of each band of colours, see `contour_bands`."""
    levels = np.nan_to_num(frame.values / top * N_BANDS if top > 0 else 0 * frame.values)
    return contour_bands(np.nan_to_num(frame.points), surface.triangles, levels, N_BANDS)


def colour_top(values: Floats, before: float = 0.0) -> float:
    """Return the upper end of a colour scale that starts at 0 and contains values.

    It is one of {1, 1.5, 2, 3, 4, 5, 6, 8} x 10^k, and stays as `before` unless the values are
    larger or far smaller. Values that are not finite are ignored.
    """
    largest = float(values[np.isfinite(values)].max(initial=0.0))
    if largest == 0:
        return 0.0
    if 0.4 * before <= largest <= before:
        return before
    power = 10.0 ** math.floor(math.log10(largest))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
    return power * next((step for step in steps if largest <= step * power * (1 + 1e-9)), 10.0)


def engineering(value: float, unit: str) -> str:
    """Return a value with three digits and its unit, such as "1.25 kN" for 1250 and "N"."""
    rounded = float(f"{value:.2e}")
    return EngFormatter(unit).format_data(rounded) if math.isfinite(value) else f"{value} {unit}"


@dataclass(frozen=True, eq=False)
class Renderer:
    """Renderer of images of one body."""

    body: Body
    camera: Camera
    size: tuple[int, int]  # width and height of images [pixel]

    @classmethod
    def fitting(cls, body: Body, frames: Sequence[Frame], size: tuple[int, int]) -> "Renderer":
        """Return a renderer whose camera shows the body at rest and in all frames, with arrows."""
        surface = body.surface
        points = np.concatenate([
            surface.supports(surface.undeformed).reshape(-1, 3),
            surface.undeformed,
            *(np.nan_to_num(frame.points) for frame in frames[:: len(frames) // MAX_FITTED + 1]),
            *(body.arrow_ends(frame) for frame in frames),
        ])  # fmt: skip
        aspect = size[0] / size[1]
        camera = Camera.fit(points, planar=surface.planar, aspect=aspect, margins=MARGINS)
        return cls(body, camera, size)

    def render(self, frame: Frame, top: float, captions: Sequence[str]) -> Image.Image:
        """Return the image of a frame with the arrow of its load, a legend and lines of text.

        Colours range from 0 to `top`. If `top` is 0, the body is neutral and there is no legend.
        """
        width, height = self.size
        dpi = height / 5.4
        figure = Figure((width / dpi, 5.4), dpi=dpi, facecolor=BACKGROUND)
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
        ax.set_axis_off()
        ax.add_collection(self._polygons(frame, top))
        if len(ends := self.body.arrow_ends(frame)):
            start, end = self.camera.project(ends, *self.size)[:, :2]
            ax.annotate("", end, start, arrowprops=ARROW)
        title, others = " · ".join(captions[:1]), " · ".join(captions[1:])
        x, y = 0.22 / figure.get_figwidth(), (1 - 0.18 / 5.4, 1 - 0.58 / 5.4)
        figure.text(x, y[0], title, color=TEXT, size=18, weight="bold", va="top")
        figure.text(x, y[1], others, color=TEXT_GREY, size=12.24, va="top")
        if top > 0:  # the colour bar at the right edge
            wide, high = figure.get_size_inches()
            bar = figure.add_axes((1 - 0.92 / wide, 0.6 / high, 0.18 / wide, 1 - 1.8 / high))
            unit, colours = QUANTITIES[frame.quantity], band_colours(frame.quantity) / 255
            scale = ScalarMappable(Normalize(0, top), ListedColormap(colours))
            labels = FuncFormatter(lambda value, _: engineering(value, unit))
            ticks = np.linspace(0, top, 5).tolist()
            figure.colorbar(scale, cax=bar, ticks=ticks, format=labels).outline.set_visible(False)
            bar.tick_params(length=0, labelsize=10, labelcolor=TEXT_GREY)
            place = 1 - 0.22 / wide, 1 - 0.98 / high
            figure.text(*place, frame.quantity, color=TEXT, size=10, ha="right", va="center")
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

    def _polygons(self, frame: Frame, top: float) -> PolyCollection:
        """Return triangles, supports and edges from far to near, those that face away first."""
        surface, camera, points = self.body.surface, self.camera, np.nan_to_num(frame.points)
        bands = colour_bands(surface, frame, top)
        soup = np.concatenate(bands)
        counts = [len(band) // 3 for band in bands]
        colours = np.repeat(band_colours(frame.quantity, top), counts, axis=0)
        symbols = surface.supports(points).reshape(-1, 3)
        edges = points[surface.feature_edges]
        sides = vertex_normals(points, surface.triangles)[surface.feature_edges].mean(axis=1)
        lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        outline = surface.undeformed[surface.feature_edges]
        none = np.zeros((len(outline), 3))
        grey = np.tile(SUPPORT_COLOUR, (len(symbols) // 3, 1))
        layers = (  # polygons, normals, colours, and shifts towards the camera
            (*self._shaded(soup, colours), np.zeros(len(colours))),
            (*self._shaded(symbols, grey), np.zeros(len(grey))),
            (edges, sides, to_rgba_array([TEXT] * len(edges), 0.7), lengths),
            (outline, none, to_rgba_array([OUTLINE] * len(outline), 0.75), none[:, 0]),
        )
        corners = np.concatenate([polygons[:, [0, 1, -1]] for polygons, *_ in layers])
        normals, rgba, shifts = (np.concatenate([layer[k] for layer in layers]) for k in (1, 2, 3))
        pixels = camera.project(corners, *self.size)
        depth = pixels[..., 2].mean(axis=1) - shifts
        faces_camera = (normals * (camera.position - corners[:, 0])).sum(axis=1) >= GRAZING
        order = np.lexsort((-depth, faces_camera))
        widths = np.full(len(order), SEAM)
        widths[len(colours) + len(grey) :] = LINE
        flat: Any = pixels[order, :, :2]
        return PolyCollection(
            flat, facecolors=rgba[order], edgecolors="face", linewidths=widths[order]
        )

    def _shaded(self, soup: Floats, colours: NDArray[Any]) -> tuple[Floats, Floats, Floats]:
        """Return corners, normals and RGBA colours of triangles (3 n, 3) with colours (n, 3)."""
        normals = triangle_normals(soup, np.arange(len(soup)).reshape(-1, 3))
        to_camera = self.camera.position - self.camera.look_at
        light = to_camera / np.linalg.norm(to_camera) + np.array([-0.25, 0.1, 0.75])
        brightness = 0.7 + 0.32 * np.abs(normals @ light) / np.linalg.norm(light)
        shades = np.clip(colours * brightness[:, None], 0, 255) / 255
        return soup.reshape(-1, 3, 3), normals, np.insert(shades, 3, 1.0, axis=1)
