"""viser scene nodes of the load: dots on the loaded nodes and an arrow for the total force."""

import numpy as np

from dpl.viewer.body_node import LocalServer
from dpl.viewer.frames import Frame
from dpl.viewer.surface import Floats, Surface, vertex_normals

MAX_DOTS = 120
DOT_SIZE = 0.008  # diameter of a dot over L [-]
ARROW_LENGTH = 0.06, 0.22  # length at amplitude 0 and its increase per amplitude, over L [-]
MAX_AMPLITUDE = 2.0  # amplitude of the longest arrow [-]
RED = (214, 40, 57)


class LoadMarker:
    """Dots on the loaded nodes and an arrow in the direction of the total force.

    Attributes:
        mask: Loaded nodes of the surface, (S,).
    """

    def __init__(self, server: LocalServer, surface: Surface) -> None:
        """Add the nodes to the scene."""
        self._server, self._surface = server, surface
        self.mask = np.zeros(len(surface.nodes), dtype=bool)
        self._dots = server.scene.add_point_cloud(
            "/patch", np.zeros((1, 3)), RED, point_size=DOT_SIZE, point_shape="circle"
        )
        sizes = {"shaft_radius": 0.008, "head_radius": 0.022, "head_length": 0.05}
        self._arrow = server.scene.add_arrows("/arrow", np.zeros((1, 2, 3)), RED, **sizes)
        self._arrow.visible = False

    def show(self, frame: Frame) -> None:
        """Update the nodes to a frame."""
        force = frame.request.force.numpy()
        points = np.nan_to_num(frame.points)
        with self._server.atomic():
            self._dots.points = self._dot_positions(points).astype(np.float32)
            self._arrow.visible = bool(force.any())
            if force.any():
                amplitude = 0.0 if frame.answer is None else float(frame.answer.amplitude)
                self._arrow.points = self._arrow_ends(points, force, amplitude)[None]

    def _dot_positions(self, points: Floats) -> Floats:
        """Return positions above the surface, so that the surface does not hide half of a dot."""
        normals = vertex_normals(points, self._surface.triangles)
        dots = (points + DOT_SIZE / 2 * normals)[self.mask]
        return dots[:: len(dots) // MAX_DOTS + 1]

    def _arrow_ends(self, points: Floats, force: Floats, amplitude: float) -> Floats:
        """Return start and end of the arrow, (2, 3). It starts at the centre of the forces."""
        total = np.pad(force.sum(axis=0), (0, 3 - force.shape[1]))
        direction = total / max(float(np.linalg.norm(total)), 1e-300)
        weights = np.linalg.norm(force[self._surface.nodes], axis=1)
        start = points.T @ (weights / max(weights.sum(), 1e-300))
        length = ARROW_LENGTH[0] + ARROW_LENGTH[1] * min(amplitude, MAX_AMPLITUDE)
        return np.stack([start, start + length * direction]).astype(np.float32)
