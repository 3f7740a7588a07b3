"""Perspective camera, and places of the bodies that stay in view and do not overlap."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from dpl.viewer.frames import Body, Frame, ViewSettings
from dpl.viewer.surface import Floats

FIELD_OF_VIEW = 0.6  # vertical angle of view [rad]
VIEW_3D, VIEW_2D = (0.62, -1.0, 0.48), (0.0, -0.02, 1.0)  # directions from a body to the camera
UP = (0.0, 0.0, 1.0)
MAX_DEFLECTION = 1.0  # largest displacement over L that the camera takes into account [-]
GAP = 0.08  # between two bodies over L [-]
LABEL = 0.03, 0.07  # distance of a label from all shapes of its body, and its height, over L [-]
MARGINS = (0.03, 0.03, 0.03, 0.03)  # empty margins of an image: left, right, below, above [-]


@dataclass(frozen=True, eq=False)
class Camera:
    """Perspective camera with the vertical angle of view `FIELD_OF_VIEW`."""

    position: Floats  # over L, (3,)
    look_at: Floats  # point at the centre of the image over L, (3,)

    @classmethod
    def fit(
        cls,
        points: Floats,
        *,
        planar: bool = False,
        aspect: float = 1.2,
        margins: tuple[float, float, float, float] = MARGINS,
    ) -> "Camera":
        """Return the nearest camera whose image contains all points (n, 3) over L.

        It looks from above if `planar`; `aspect` and `margins` are those of the image. A point at
        depth z from the camera is in the image if it lies within t z of the axis. For each side of
        the image, the point that is farthest outside determines a line of positions.
        """
        axes = _axes(-np.array(VIEW_2D if planar else VIEW_3D))
        x, y, z = axes @ points.T
        half = np.tan(FIELD_OF_VIEW / 2) * np.array([aspect, aspect, 1.0, 1.0])
        left, right, below, above = half * (1 - 2 * np.array(margins))
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
        scale = height / (2 * np.tan(FIELD_OF_VIEW / 2))
        return np.stack([width / 2 + scale * x / depth, height / 2 - scale * y / depth, depth], -1)


def _axes(forward: Floats) -> Floats:
    """Return unit vectors to the right, upwards and forwards of a camera, as rows (3, 3)."""
    right = np.cross(forward, UP)
    axes = np.stack([right, np.cross(right, forward), forward])
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Placement:
    """Places over L of the body and of a second body that is compared with it."""

    planar: bool  # the body is in 2D
    points: Floats  # of the body at rest and under the largest loads, arrows and label, (n, 3)
    label: Floats  # position of the label above them, (3,)
    offset: Floats  # position of the second body relative to the first, (3,)

    @classmethod
    def of(cls, body: Body, node: int, radius: float) -> "Placement":
        """Return the places for loads on the patch of a node with a radius over L."""
        planar, rest = body.surface.planar, body.surface.undeformed
        right, up, _ = _axes(-np.array(VIEW_2D if planar else VIEW_3D))
        bare = np.concatenate([rest, body.surface.supports(rest).reshape(-1, 3)])
        loaded = largest_loads(body, node, radius)
        shapes = [bare, *(np.concatenate([f.points, body.arrow_ends(f)]) for f in loaded)]
        points = np.concatenate(shapes)
        middle = (rest.min(axis=0) + rest.max(axis=0)) / 2
        label = middle + ((points @ up).max() + LABEL[0] - middle @ up) * up
        points = np.concatenate([points, [label + LABEL[1] * up]])
        space = LABEL[0] + LABEL[1] + GAP  # between a body and the other one
        offsets = [
            (max(np.ptp(shape @ axis) for shape in shapes) + space) / (along @ axis) * along
            for axis, along in ((up, np.eye(3)[1 if planar else 2]), (right, right))
        ]
        cameras = [
            Camera.fit(np.concatenate([points, points + offset]), planar=planar)
            for offset in offsets
        ]
        distances = [np.linalg.norm(camera.position - camera.look_at) for camera in cameras]
        return cls(planar, points, label, offsets[int(np.argmin(distances))])

    def camera(
        self, *, aspect: float = 1.2, both: bool = False, shown: Floats | None = None
    ) -> Camera:
        """Return a camera that shows one body or both, and points (n, 3) that are shown."""
        points = self.points if shown is None else np.concatenate([self.points, shown])
        if both:
            points = np.concatenate([points, points + self.offset])
        return Camera.fit(points, planar=self.planar, aspect=aspect)


def largest_loads(body: Body, node: int, radius: float) -> Iterator[Frame]:
    """Yield the frames of the largest loads of the training along all axes and diagonals.

    Frames with displacements above `MAX_DEFLECTION` are left out, since an untrained network can
    predict any displacement.
    """
    patch, dim = body.patch(node, radius), body.scene.problem.shape[1]
    grid = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=dim))).double()
    number = grid.abs().sum(dim=1)
    for direction in grid[(number == 1) | (number == dim)]:
        frame = body.solve(body.request(patch.force_along(direction, 1.0)), ViewSettings())
        size = np.abs(frame.points - body.surface.undeformed).max()
        if size <= MAX_DEFLECTION:  # False for values that are not finite
            yield frame
