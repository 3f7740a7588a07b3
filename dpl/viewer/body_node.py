"""A body in the browser, as nodes of viser's scene."""

import numpy as np
import viser

from dpl.viewer.frames import Body
from dpl.viewer.rasterizer import BANDS, colours
from dpl.viewer.surface import Floats, bands

DARK, GREY = (28, 32, 44), (160, 166, 178)


class Server(viser.ViserServer):
    """viser's server, that is not shared with the world."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse: a browser may ask for a tunnel to this machine."""


class BodyNode:
    """One body in the browser: bands of one colour, lines, and what is grabbed.

    Attributes:
        root: Its name in the tree.
    """

    def __init__(self, server: Server, root: str, body: Body, *, grab: bool) -> None:
        """Add it.

        Args:
            server: Where.
            root: Its name.
            body: Whose.
            grab: Whether it can be dragged.
        """
        self.root, self._server, self._surface = root, server, body.surface
        scene, surface = server.scene, body.surface
        self.frame = scene.add_frame(root, show_axes=False)
        nothing = np.zeros((3, 3)), np.array([[0, 1, 2]])
        self._bands = [
            scene.add_mesh_simple(
                f"{root}/band{k}", *nothing, flat_shading=True, side="double", cast_shadow=True
            )
            for k in range(BANDS)
        ]
        self._empty = [True] * BANDS
        self._lines = scene.add_line_segments(
            f"{root}/lines",
            surface.rest[surface.lines],
            DARK,
            thickness=1.0,
            thickness_units="screen",
        )
        scene.add_line_segments(
            f"{root}/rest",
            surface.rest[surface.rims],
            GREY,
            thickness=1.0,
            thickness_units="screen",
        )
        self.grip = None
        if grab:
            self.grip = scene.add_mesh_simple(
                f"{root}/grip",
                surface.rest,
                surface.triangles,
                opacity=0.0,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )

    def show(self, points: Floats, values: Floats, top: float, quantity: str, lines: bool) -> None:
        """Draw a deformed surface."""
        levels = np.nan_to_num(values / top * BANDS if top > 0 else np.zeros_like(values))
        points = np.nan_to_num(points)
        cut = bands(points, self._surface.triangles, levels, BANDS)
        shades = colours(quantity)
        with self._server.atomic():
            for k, (handle, soup) in enumerate(zip(self._bands, cut, strict=True)):
                if not len(soup):
                    if not self._empty[k]:
                        handle.visible = False
                    self._empty[k] = True
                    continue
                handle.vertices = soup.astype(np.float32)
                handle.faces = np.arange(len(soup), dtype=np.uint32).reshape(-1, 3)
                handle.color = tuple(int(c) for c in shades[k])
                if self._empty[k]:
                    handle.visible = True
                self._empty[k] = False
            self._lines.visible = lines
            if lines:
                self._lines.points = points[self._surface.lines].astype(np.float32)
            if self.grip is not None:
                self.grip.vertices = points.astype(np.float32)
