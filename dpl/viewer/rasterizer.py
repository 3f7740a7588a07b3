"""Pictures of frames without a display: a depth buffer, and words beside it."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib import font_manager
from numba import njit
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dpl.viewer.frames import QUANTITIES
from dpl.viewer.surface import Floats, Surface

COLOURS = {"displacement": "viridis", "von Mises stress": "turbo", "error against FE": "magma"}
BANDS = 12
PAPER, INK, LINE, FAINT = (250, 250, 252), (32, 36, 48), (70, 74, 88), (205, 209, 218)
FINER = 2  # pixels of the buffer a pixel of the picture, each way
Bytes = NDArray[np.uint8]


def colours(quantity: str, count: int = BANDS) -> Bytes:
    """Return the colours of bands, (K, 3)."""
    first, last = (0.06, 0.94) if COLOURS[quantity] == "turbo" else (0.12, 0.98)
    found = matplotlib.colormaps[COLOURS[quantity]](np.linspace(first, last, count))[:, :3]
    return np.asarray(np.round(255 * found), dtype=np.uint8)


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from.

    Attributes:
        position: Over L, (3,).
        look_at: (3,).
        field: Vertical angle of view [radians].
    """

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    field: float = 0.6

    @classmethod
    def before(cls, surface: Surface, *, wide: float = 1.0) -> "Camera":
        """Return a camera that sees a body with room to bend; `wide` times as far away."""
        low, high = surface.rest.min(axis=0), surface.rest.max(axis=0)
        middle = (low + high) / 2
        flat = surface.problem.shape[1] == 2
        way = np.array([0.0, -0.02, 1.0]) if flat else np.array([0.62, -1.0, 0.48])
        distance = 1.45 * wide * (0.45 + float(np.linalg.norm(high - low)))
        place = middle + distance * way / np.linalg.norm(way)
        x, y, z = map(float, place)
        a, b, c = map(float, middle)
        return cls((x, y, z), (a, b, c))

    def axes(self) -> Floats:
        """Return right, up and forward, (3, 3)."""
        forward = np.subtract(self.look_at, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) < 1e-6:
            right = np.array([1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return columns, rows and depths of points (n, 3), (n, 3)."""
        seen = (points - self.position) @ self.axes().T
        scale = height / (2 * np.tan(self.field / 2))
        column = width / 2 + scale * seen[:, 0] / seen[:, 2]
        row = height / 2 - scale * seen[:, 1] / seen[:, 2]
        return np.stack([column, row, seen[:, 2]], axis=1)


@dataclass(frozen=True, eq=False)
class Renderer:
    """What every picture of one body shares.

    Attributes:
        surface: The body.
        camera: Where it is seen from.
        size: Width and height [pixels].
    """

    surface: Surface
    camera: Camera
    size: tuple[int, int] = (960, 540)

    def draw(
        self, points: Floats, values: Floats, top: float, quantity: str, words: Sequence[str]
    ) -> Image.Image:
        """Return the picture of a deformed surface.

        Args:
            points: Its nodes, over L, (S, 3).
            values: At them, (S,).
            top: Upper end of the colours.
            quantity: What values are.
            words: Lines beside it, the first large.
        """
        width, height = (FINER * side for side in self.size)
        surface = self.surface
        depth = np.full((height, width), np.inf)
        value = np.zeros((height, width))
        normal = np.zeros((height, width, 3))
        seen = self.camera.project(points, width, height)
        levels = np.nan_to_num(values / top if top > 0 else 0 * values)
        _fill(seen, surface.triangles, levels, _smooth(points, surface), depth, value, normal)
        table = colours(quantity).astype(float)
        band = np.clip((value * BANDS).astype(int), 0, BANDS - 1)
        away = np.subtract(self.camera.position, self.camera.look_at)
        towards = away / np.linalg.norm(away)
        lamp = towards + np.array([-0.25, 0.1, 0.75])
        lamp = lamp / np.linalg.norm(lamp)
        bright = 0.52 + 0.5 * np.abs(normal @ lamp)
        body = np.clip(table[band] * bright[..., None], 0, 255)
        hit = np.isfinite(depth)
        picture = np.where(hit[..., None], body, np.asarray(PAPER, float))
        _lines(seen, surface.lines, depth, picture, 0.22, np.asarray(INK, float))
        rest = self.camera.project(surface.rest, width, height)
        _lines(rest, surface.rims, depth, picture, 0.75, np.asarray(FAINT, float))
        image = Image.fromarray(np.asarray(picture, dtype=np.uint8))
        image = image.resize(self.size, Image.Resampling.LANCZOS)
        _write(image, words)
        _legend(image, quantity, top)
        return image


def _smooth(points: Floats, surface: Surface) -> Floats:
    """Return a normal at each corner of each triangle, (T, 3, 3): that of the triangle."""
    a, b, c = (points[surface.triangles[:, k]] for k in range(3))
    own = np.cross(b - a, c - a)
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, surface.triangles[:, k], own)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    mean = total[surface.triangles]
    sharp = (mean * own[:, None]).sum(axis=2, keepdims=True) < 0.9  # at an edge of the shape
    return np.where(sharp, own[:, None], mean)


@njit(cache=True)
def _fill(seen, triangles, levels, normals, depth, value, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Draw triangles into a depth buffer, with their values and normals."""
    height, width = depth.shape
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        ax, ay, az = seen[i]
        bx, by, bz = seen[j]
        cx, cy, cz = seen[k]
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
def _lines(seen, lines, depth, picture, strength, colour):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Blend lines that nothing hides into a picture."""
    height, width = depth.shape
    for n in range(len(lines)):
        i, j = lines[n]
        ax, ay, az = seen[i]
        bx, by, bz = seen[j]
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
                    old = picture[row, column, axis]
                    picture[row, column, axis] = old + strength * (colour[axis] - old)


def _font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    weight = "bold" if bold else "normal"
    found = font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight))
    return ImageFont.truetype(found, size)


def _write(image: Image.Image, words: Sequence[str]) -> None:
    """Put lines into the upper left corner."""
    pen = ImageDraw.Draw(image)
    unit = image.height / 540
    row = 18 * unit
    for number, line in enumerate(words):
        size = round((25 if number == 0 else 17) * unit)
        pen.text(
            (22 * unit, row),
            line,
            fill=INK if number == 0 else LINE,
            font=_font(size, bold=number == 0),
        )
        row += 1.5 * size


def _legend(image: Image.Image, quantity: str, top: float) -> None:
    """Put the colours and what they stand for at the right."""
    pen = ImageDraw.Draw(image)
    unit = image.height / 540
    right, high, low = image.width - 92 * unit, 120 * unit, image.height - 60 * unit
    step = (low - high) / BANDS
    font = _font(round(14 * unit))
    for k, colour in enumerate(colours(quantity)):
        y = low - (k + 1) * step
        pen.rectangle((right, y, right + 18 * unit, y + step), fill=tuple(int(c) for c in colour))
    for k in range(0, BANDS + 1, 3):
        y = low - k * step
        pen.text(
            (right + 24 * unit, y), f"{top * k / BANDS:.3g}", fill=LINE, font=font, anchor="lm"
        )
    title = f"{quantity} [{QUANTITIES[quantity]}]"
    pen.text((image.width - 22 * unit, high - 22 * unit), title, fill=INK, font=font, anchor="rm")
