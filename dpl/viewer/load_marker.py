"""viser scene nodes of the load: dots on the loaded nodes and an arrow for the total force."""

import numpy as np

from dpl.viewer.body_node import LocalServer
from dpl.viewer.frames import Frame
from dpl.viewer.load_arrow import ARROW_COLOUR, arrow_ends
from dpl.viewer.surface import Floats, Surface, vertex_normals

MAX_DOTS = 120
DOT_SIZE = 0.005  # diameter of a dot over L [-]


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
            "/patch", np.zeros((1, 3)), ARROW_COLOUR, point_size=DOT_SIZE, point_shape="circle"
        )
        sizes = {"shaft_radius": 0.009, "head_radius": 0.024, "head_length": 0.055}
        self._arrow = server.scene.add_arrows("/arrow", np.zeros((1, 2, 3)), ARROW_COLOUR, **sizes)
        self._arrow.visible = False

    def show(self, frame: Frame) -> None:
        """Update the nodes to a frame."""
        points = np.nan_to_num(frame.points)
        ends = arrow_ends(self._surface, frame)
        with self._server.atomic():
            self._dots.points = self._dot_positions(points).astype(np.float32)
            self._arrow.visible = ends is not None
            if ends is not None:
                self._arrow.points = ends[None].astype(np.float32)

    def _dot_positions(self, points: Floats) -> Floats:
        """Return positions above the surface, so that the surface does not hide half of a dot."""
        normals = vertex_normals(points, self._surface.triangles)
        dots = (points + DOT_SIZE / 2 * normals)[self.mask]
        return dots[:: len(dots) // MAX_DOTS + 1]
