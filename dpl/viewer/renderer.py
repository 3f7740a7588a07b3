"""Images of frames without a display: the surface from far to near, captions and a legend."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from dpl.viewer.frames import QUANTITIES, Frame
from dpl.viewer.surface import Floats, Surface, contour_bands, triangle_normals, vertex_normals

COLOUR_MAPS = {"displacement": "viridis", "von Mises stress": "turbo", "error against FE": "magma"}
N_BANDS = 12
GRAZING = -0.2  # smallest distance of the camera above a visible face, over L
BACKGROUND, TEXT, TEXT_GREY, OUTLINE = "#fafafc", "#202430", "#464a58", "#cdd1da"
Bytes = NDArray[np.uint8]


def band_colours(quantity: str) -> Bytes:
    """Return the RGB colours of the bands, (N_BANDS, 3)."""
    first, last = (0.06, 0.94) if COLOUR_MAPS[quantity] == "turbo" else (0.12, 0.98)
    found = matplotlib.colormaps[COLOUR_MAPS[quantity]](np.linspace(first, last, N_BANDS))[:, :3]
    return np.asarray(np.round(255 * found), dtype=np.uint8)


def colour_bands(surface: Surface, frame: Frame, top: float) -> list[Floats]:
    """Return the corners of the triangles of each band of colours, see `contour_bands`."""
    levels = np.nan_to_num(frame.values / top * N_BANDS if top > 0 else 0 * frame.values)
    return contour_bands(np.nan_to_num(frame.points), surface.triangles, levels, N_BANDS)


@dataclass(frozen=True, eq=False)
class Camera:
    """Perspective camera.

    Attributes:
        position: Position over L, (3,).
        look_at: Point at the centre of the image over L, (3,).
        field_of_view: Vertical angle of view [rad].
    """

    position: Floats
    look_at: Floats
    field_of_view: float = 0.6

    @classmethod
    def facing(cls, surface: Surface, *, distance: float = 1.0) -> "Camera":
        """Return a camera in front of a body; `distance` is a factor on the usual distance [-]."""
        low, high = surface.undeformed.min(axis=0), surface.undeformed.max(axis=0)
        centre, planar = (low + high) / 2, surface.problem.shape[1] == 2
        direction = np.array([0.0, -0.02, 1.0] if planar else [0.62, -1.0, 0.48])
        length = 1.45 * distance * (0.45 + float(np.linalg.norm(high - low)))
        return cls(centre + length * direction / np.linalg.norm(direction), centre)

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return column [pixel], row [pixel] and depth over L of points (..., 3), (..., 3)."""
        forward = self.look_at - self.position
        right = np.cross(forward, (0.0, 0.0, 1.0))
        axes = np.stack([right, np.cross(right, forward), forward])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        x, y, depth = np.moveaxis((points - self.position) @ axes.T, -1, 0)
        scale = height / (2 * np.tan(self.field_of_view / 2))
        return np.stack([width / 2 + scale * x / depth, height / 2 - scale * y / depth, depth], -1)


@dataclass(frozen=True, eq=False)
class Renderer:
    """Renderer of images of one body.

    Attributes:
        surface: Surface of the body.
        camera: The camera.
        size: Width and height of images [pixel].
    """

    surface: Surface
    camera: Camera
    size: tuple[int, int] = (960, 540)

    def render(self, frame: Frame, top: float, captions: Sequence[str]) -> Image.Image:
        """Return the image of a frame with a colour scale from 0 to `top` and lines of text."""
        width, height = self.size
        dpi = height / 5.4
        figure = Figure((width / dpi, 5.4), dpi=dpi, facecolor=BACKGROUND)
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
        ax.set_axis_off()
        ax.add_collection(self._polygons(frame, top))
        _draw_captions(figure, captions)
        _draw_legend(figure, frame.quantity, top)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

    def _polygons(self, frame: Frame, top: float) -> PolyCollection:
        """Return triangles and edges from far to near, those that face away first."""
        surface, camera, points = self.surface, self.camera, np.nan_to_num(frame.points)
        bands = colour_bands(surface, frame, top)
        soup = np.concatenate(bands)
        normals = triangle_normals(soup, np.arange(len(soup)).reshape(-1, 3))
        to_camera = camera.position - camera.look_at
        light = to_camera / np.linalg.norm(to_camera) + np.array([-0.25, 0.1, 0.75])
        brightness = 0.52 + 0.5 * np.abs(normals @ light) / np.linalg.norm(light)
        counts = [len(band) // 3 for band in bands]
        colours = np.repeat(band_colours(frame.quantity), counts, axis=0)
        shades = np.clip(colours * brightness[:, None], 0, 255) / 255
        edges, outline = points[surface.edges], surface.undeformed[surface.feature_edges]
        sides = vertex_normals(points, surface.triangles)[surface.edges].mean(axis=1)
        lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        none = np.zeros((len(outline), 3))
        layers = (  # polygons, normals, colours, and shifts towards the camera
            (soup.reshape(-1, 3, 3), normals, np.insert(shades, 3, 1.0, axis=1), 0 * shades[:, 0]),
            (edges, sides, to_rgba_array([TEXT] * len(edges), 0.22), lengths),
            (outline, none, to_rgba_array([OUTLINE] * len(outline), 0.75), none[:, 0]),
        )
        corners = np.concatenate([polygons[:, [0, 1, -1]] for polygons, *_ in layers])
        normals, rgba, shifts = (np.concatenate([layer[k] for layer in layers]) for k in (1, 2, 3))
        pixels = camera.project(corners, *self.size)
        depth = pixels[..., 2].mean(axis=1) - shifts
        faces_camera = (normals * (camera.position - corners[:, 0])).sum(axis=1) >= GRAZING
        order = np.lexsort((-depth, faces_camera))
        flat: Any = pixels[order, :, :2]
        return PolyCollection(flat, facecolors=rgba[order], edgecolors="face", linewidths=0.5)


def _draw_captions(figure: Figure, captions: Sequence[str]) -> None:
    """Draw lines of text in the upper left corner."""
    width, height = figure.get_size_inches()
    below = 0.18  # [inch]
    for number, line in enumerate(captions):
        size, colour, weight = (17, TEXT_GREY, "normal") if number else (25, TEXT, "bold")
        place = 0.22 / width, 1 - below / height
        figure.text(*place, line, color=colour, size=0.72 * size, weight=weight, va="top")
        below += 0.015 * size


def _draw_legend(figure: Figure, quantity: str, top: float) -> None:
    """Draw the colour bar at the right edge."""
    width, height = figure.get_size_inches()
    bar = figure.add_axes((1 - 0.92 / width, 0.6 / height, 0.18 / width, 1 - 1.8 / height))
    bar.imshow(band_colours(quantity)[::-1, None], aspect="auto", extent=(0, 1, 0, N_BANDS))
    ticks = range(0, N_BANDS + 1, 3)
    labels = [f"{top * k / N_BANDS:.3g}" for k in ticks]
    bar.set(xticks=[], yticks=ticks, yticklabels=labels, frame_on=False)
    bar.yaxis.tick_right()
    bar.tick_params(length=0, labelsize=10, labelcolor=TEXT_GREY)
    title, place = f"{quantity} [{QUANTITIES[quantity]}]", (1 - 0.22 / width, 1 - 0.98 / height)
    figure.text(*place, title, color=TEXT, size=10, ha="right", va="center")
