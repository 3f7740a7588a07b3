"""Perspective camera that fits points into an image."""

from dataclasses import dataclass

import numpy as np

from dpl.viewer.surface import Floats

FIELD_OF_VIEW = 0.6  # vertical angle of view [rad]
VIEW_3D, VIEW_2D = (0.62, -1.0, 0.48), (0.0, -0.02, 1.0)  # directions from a body to the camera
UP = (0.0, 0.0, 1.0)


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
    field_of_view: float = FIELD_OF_VIEW

    @classmethod
    def fit(
        cls,
        points: Floats,
        *,
        planar: bool = False,
        aspect: float = 1.2,
        insets: tuple[float, float, float, float] = (0.05, 0.05, 0.05, 0.05),
    ) -> "Camera":
        """Return the nearest camera whose image contains all points, in the usual direction.

        A point at depth z from the camera is in the image if it lies within t z of the axis. For
        each side of the image, the point that is farthest outside determines a line of positions.

        Args:
            points: Points over L, (n, 3).
            planar: Look from above, for bodies in 2D.
            aspect: Width over height of the image.
            insets: Empty margins left, right, below and above, over width or height [-].
        """
        axes = _axes(-np.array(VIEW_2D if planar else VIEW_3D))
        x, y, z = axes @ points.T
        half = float(np.tan(FIELD_OF_VIEW / 2))
        left, right, below, above = (
            size * (1 - 2 * inset)
            for size, inset in zip((half * aspect, half * aspect, half, half), insets, strict=True)
        )
        sides = [
            ((x - right * z).max(), (-x - left * z).max(), right, left),
            ((y - above * z).max(), (-y - below * z).max(), above, below),
        ]
        depth = min(-(first + last) / (a + b) for first, last, a, b in sides)
        across = [(first - last + (a - b) * depth) / 2 for first, last, a, b in sides]
        position = axes.T @ np.array([*across, depth])
        distance = (z.min() + z.max()) / 2 - depth
        return cls(position, position + distance * axes[2])

    def project(self, points: Floats, width: int, height: int) -> Floats:
        """Return column [pixel], row [pixel] and depth over L of points (..., 3), (..., 3)."""
        x, y, depth = np.moveaxis(
            (points - self.position) @ _axes(self.look_at - self.position).T, -1, 0
        )
        scale = height / (2 * np.tan(self.field_of_view / 2))
        return np.stack([width / 2 + scale * x / depth, height / 2 - scale * y / depth, depth], -1)


def image_axes(*, planar: bool) -> tuple[Floats, Floats]:
    """Return the directions to the right and upwards in the image of `Camera.fit`, (3,) each."""
    right, up, _ = _axes(-np.array(VIEW_2D if planar else VIEW_3D))
    return right, up


def _axes(forward: Floats) -> Floats:
    """Return unit vectors to the right, upwards and forwards of a camera, as rows (3, 3)."""
    right = np.cross(forward, UP)
    axes = np.stack([right, np.cross(right, forward), forward])
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))
