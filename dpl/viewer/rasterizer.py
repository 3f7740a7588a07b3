"""Rendering of frames without a display: a depth-buffered rasterizer, captions and a legend."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib import font_manager
from numba import njit
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dpl.viewer.frames import QUANTITIES
from dpl.viewer.surface import SMOOTH, Floats, Surface, triangle_normals, vertex_normals

COLOUR_MAPS = {"displacement": "viridis", "von Mises stress": "turbo", "error against FE": "magma"}
N_BANDS = 12
BACKGROUND, TEXT, TEXT_GREY, OUTLINE = (250, 250, 252), (32, 36, 48), (70, 74, 88), (205, 209, 218)
SUPERSAMPLING = 2  # pixels of the depth buffer per pixel of the image, in each direction
Bytes = NDArray[np.uint8]


def band_colours(quantity: str) -> Bytes:
    """Return the RGB colours of the bands, (N_BANDS, 3)."""
    first, last = (0.06, 0.94) if COLOUR_MAPS[quantity] == "turbo" else (0.12, 0.98)
    found = matplotlib.colormaps[COLOUR_MAPS[quantity]](np.linspace(first, last, N_BANDS))[:, :3]
    return np.asarray(np.round(255 * found), dtype=np.uint8)


@dataclass(frozen=True)
class Camera:
    """Perspective camera.

    Attributes:
        position: Position over L, (3,).
        look_at: Point at the centre of the image over L, (3,).
        field_of_view: Vertical angle of view [rad].
    """

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    field_of_view: float = 0.6

    @classmethod
    def facing(cls, surface: Surface, *, distance: float = 1.0) -> "Camera":
        """Return a camera in front of a body with space for its deformation.

        Args:
            surface: Surface of the body.
            distance: Factor on the distance to the body [-].
        """
        points = surface.undeformed
        low, high = points.min(axis=0), points.max(axis=0)
        centre = (low + high) / 2
        planar = surface.problem.shape[1] == 2
        direction = np.array([0.0, -0.02, 1.0] if planar else [0.62, -1.0, 0.48])
        length = 1.45 * distance * (0.45 + float(np.linalg.norm(high - low)))
        x, y, z = (centre + length * direction / np.linalg.norm(direction)).tolist()
        a, b, c = centre.tolist()
        return cls((x, y, z), (a, b, c))

    def axes(self) -> Floats:
        """Return the unit vectors right, up and forward, (3, 3)."""
        forward = np.subtract(self.look_at, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return column [pixel], row [pixel] and depth over L of points (n, 3), (n, 3)."""
        local = (points - self.position) @ self.axes().T
        scale = height / (2 * np.tan(self.field_of_view / 2))
        column = width / 2 + scale * local[:, 0] / local[:, 2]
        row = height / 2 - scale * local[:, 1] / local[:, 2]
        return np.stack([column, row, local[:, 2]], axis=1)


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

    def render(
        self, points: Floats, values: Floats, top: float, quantity: str, captions: Sequence[str]
    ) -> Image.Image:
        """Return the image of a deformed surface.

        Args:
            points: Positions over L, (S, 3).
            values: Values at the points, (S,).
            top: Upper end of the colour scale.
            quantity: Name of the quantity.
            captions: Lines of text in the upper left corner, the first one in large letters.
        """
        width, height = (SUPERSAMPLING * side for side in self.size)
        surface = self.surface
        depth = np.full((height, width), np.inf)
        value = np.zeros((height, width))
        normal = np.zeros((height, width, 3))
        pixels = self.camera.project(points, width, height)
        levels = np.nan_to_num(values / top if top > 0 else 0 * values)
        normals = _corner_normals(points, surface)
        _fill_triangles(pixels, surface.triangles, levels, normals, depth, value, normal)
        colours = self._shade(value, normal, quantity)
        background = np.asarray(BACKGROUND, float)
        canvas = np.where(np.isfinite(depth)[..., None], colours, background)
        _draw_lines(pixels, surface.edges, depth, canvas, 0.22, np.asarray(TEXT, float))
        outline = self.camera.project(surface.undeformed, width, height)
        colour = np.asarray(OUTLINE, float)
        _draw_lines(outline, surface.feature_edges, depth, canvas, 0.75, colour)
        image = Image.fromarray(np.asarray(canvas, dtype=np.uint8))
        image = image.resize(self.size, Image.Resampling.LANCZOS)
        _draw_captions(image, captions)
        _draw_legend(image, quantity, top)
        return image

    def _shade(self, value: Floats, normal: Floats, quantity: str) -> Floats:
        """Return colours (height, width, 3) of values in [0, 1], lit from beside the camera."""
        band = np.clip((value * N_BANDS).astype(int), 0, N_BANDS - 1)
        to_camera = np.subtract(self.camera.position, self.camera.look_at)
        light = to_camera / np.linalg.norm(to_camera) + np.array([-0.25, 0.1, 0.75])
        light = light / np.linalg.norm(light)
        brightness = 0.52 + 0.5 * np.abs(normal @ light)
        return np.clip(band_colours(quantity).astype(float)[band] * brightness[..., None], 0, 255)


def _corner_normals(points: Floats, surface: Surface) -> Floats:
    """Return a normal at each corner of each triangle, (T, 3, 3).

    Vertex normals give smooth shading; at sharp edges the normal of the triangle is used.
    """
    own = triangle_normals(points, surface.triangles)[:, None]
    mean = vertex_normals(points, surface.triangles)[surface.triangles]
    sharp = (mean * own).sum(axis=2, keepdims=True) < SMOOTH
    return np.where(sharp, own, mean)


@njit(cache=True)
def _fill_triangles(pixels, triangles, levels, normals, depth, value, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write depth, value and normal of the nearest triangle to each pixel."""
    height, width = depth.shape
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        ax, ay, az = pixels[i]
        bx, by, bz = pixels[j]
        cx, cy, cz = pixels[k]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0 or not (az > 0 and bz > 0 and cz > 0):
            continue
        left = max(int(np.floor(min(ax, bx, cx))), 0)
        right = min(int(np.ceil(max(ax, bx, cx))), width - 1)
        top = max(int(np.floor(min(ay, by, cy))), 0)
        bottom = min(int(np.ceil(max(ay, by, cy))), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                x, y = column + 0.5, row + 0.5
                w = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                u = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                v = 1.0 - w - u
                if w < 0 or u < 0 or v < 0:
                    continue
                z = 1.0 / (w / az + u / bz + v / cz)
                if z < depth[row, column]:
                    depth[row, column] = z
                    w, u, v = w * z / az, u * z / bz, v * z / cz
                    value[row, column] = w * levels[i] + u * levels[j] + v * levels[k]
                    for axis in range(3):
                        normal[row, column, axis] = (
                            w * normals[t, 0, axis]
                            + u * normals[t, 1, axis]
                            + v * normals[t, 2, axis]
                        )


@njit(cache=True)
def _draw_lines(pixels, lines, depth, canvas, opacity, colour):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Blend lines that are not hidden into an image."""
    height, width = depth.shape
    for n in range(len(lines)):
        i, j = lines[n]
        ax, ay, az = pixels[i]
        bx, by, bz = pixels[j]
        steps = int(max(abs(bx - ax), abs(by - ay))) + 1
        for step in range(steps):
            share = step / steps
            x, y = ax + share * (bx - ax), ay + share * (by - ay)
            z = 1.0 / ((1 - share) / az + share / bz)
            if not (0 <= x < width and 0 <= y < height):
                continue
            column, row = int(x), int(y)
            if z * 0.996 < depth[row, column]:
                for axis in range(3):
                    old = canvas[row, column, axis]
                    canvas[row, column, axis] = old + opacity * (colour[axis] - old)


def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    weight = "bold" if bold else "normal"
    found = font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight))
    return ImageFont.truetype(found, size)


def _draw_captions(image: Image.Image, captions: Sequence[str]) -> None:
    """Draw lines of text in the upper left corner."""
    draw = ImageDraw.Draw(image)
    unit = image.height / 540
    row = 18 * unit
    for number, line in enumerate(captions):
        title = number == 0
        size = round((25 if title else 17) * unit)
        font, colour = _font(size, bold=title), TEXT if title else TEXT_GREY
        draw.text((22 * unit, row), line, fill=colour, font=font)
        row += 1.5 * size


def _draw_legend(image: Image.Image, quantity: str, top: float) -> None:
    """Draw the colour bar at the right edge."""
    draw = ImageDraw.Draw(image)
    unit = image.height / 540
    left, high, low = image.width - 92 * unit, 120 * unit, image.height - 60 * unit
    step = (low - high) / N_BANDS
    font = _font(round(14 * unit))
    for k, colour in enumerate(band_colours(quantity)):
        y = low - (k + 1) * step
        draw.rectangle((left, y, left + 18 * unit, y + step), fill=tuple(int(c) for c in colour))
    for k in range(0, N_BANDS + 1, 3):
        label, place = f"{top * k / N_BANDS:.3g}", (left + 24 * unit, low - k * step)
        draw.text(place, label, fill=TEXT_GREY, font=font, anchor="lm")
    title = f"{quantity} [{QUANTITIES[quantity]}]"
    place = (image.width - 22 * unit, high - 22 * unit)
    draw.text(place, title, fill=TEXT, font=font, anchor="rm")
