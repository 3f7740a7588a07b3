"""viser scene nodes of one body."""

import numpy as np
import viser

from dpl.viewer.frames import Frame
from dpl.viewer.renderer import N_BANDS, band_colours, colour_bands
from dpl.viewer.surface import Surface

DARK, GREY = (28, 32, 44), (160, 166, 178)
DRAG_MESH = "/drag"


class LocalServer(viser.ViserServer):
    """viser server without tunnels to this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing; a browser could otherwise request a public tunnel."""


class BodyNode:
    """One body in the browser: one mesh per colour band, edges, and a transparent mesh to drag.

    Attributes:
        frame: The frame, which has position and visibility.
        drag_mesh: Mesh that receives mouse events; None if the body cannot be dragged.
    """

    def __init__(
        self, server: LocalServer, root: str, surface: Surface, *, draggable: bool
    ) -> None:
        """Add the nodes to the scene below a frame `root`."""
        self._server, self._surface = server, surface
        scene, points = server.scene, surface.undeformed
        self.frame = scene.add_frame(root, show_axes=False)
        empty = np.zeros((3, 3)), np.array([[0, 1, 2]])
        solid = {"flat_shading": True, "side": "double", "cast_shadow": True}
        self._bands = [
            scene.add_mesh_simple(f"{root}/band{k}", *empty, **solid) for k in range(N_BANDS)
        ]
        self._is_empty = [True] * N_BANDS
        style = {"thickness": 1.0, "thickness_units": "screen"}
        self._edges = scene.add_line_segments(f"{root}/edges", points[surface.edges], DARK, **style)
        outline = points[surface.feature_edges]
        scene.add_line_segments(f"{root}/undeformed", outline, GREY, **style)
        self.drag_mesh = None
        if draggable:
            clear = {"opacity": 0.0, "side": "double", "cast_shadow": False}
            self.drag_mesh = scene.add_mesh_simple(
                root + DRAG_MESH, points, surface.triangles, receive_shadow=False, **clear
            )

    def show(self, frame: Frame, top: float, *, edges: bool) -> None:
        """Show a frame; `top`: upper end of the colour scale; `edges`: with the edges of facets."""
        points = np.nan_to_num(frame.points)
        bands = colour_bands(self._surface, frame, top)
        colours = band_colours(frame.quantity)
        with self._server.atomic():
            for k, (handle, soup) in enumerate(zip(self._bands, bands, strict=True)):
                was_empty, self._is_empty[k] = self._is_empty[k], not len(soup)
                if len(soup):
                    handle.vertices = soup.astype(np.float32)
                    handle.faces = np.arange(len(soup), dtype=np.uint32).reshape(-1, 3)
                    handle.color = tuple(int(c) for c in colours[k])
                if was_empty != self._is_empty[k]:
                    handle.visible = was_empty
            self._edges.visible = edges
            if edges:
                self._edges.points = points[self._surface.edges].astype(np.float32)
            if self.drag_mesh is not None:
                self.drag_mesh.vertices = points.astype(np.float32)
