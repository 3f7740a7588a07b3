"""viser scene nodes of one body."""

import numpy as np
import viser

from dpl.viewer.frames import Body
from dpl.viewer.rasterizer import N_BANDS, band_colours
from dpl.viewer.surface import Floats, contour_bands

DARK, GREY = (28, 32, 44), (160, 166, 178)
DRAG_MESH = "/drag"


class LocalServer(viser.ViserServer):
    """viser server without tunnels to this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing; a browser could otherwise request a public tunnel."""


class BodyNode:
    """One body in the browser: one mesh per colour band, edges, and a transparent mesh to drag.

    Attributes:
        root: Name of its frame in the scene tree.
        frame: The frame, which has position and visibility.
        drag_mesh: Mesh that receives mouse events; None if the body cannot be dragged.
    """

    def __init__(self, server: LocalServer, root: str, body: Body, *, draggable: bool) -> None:
        """Add the nodes to the scene.

        Args:
            server: The server of the page.
            root: Name of the frame.
            body: The body.
            draggable: Add the mesh that receives mouse events.
        """
        self.root, self._server, self._surface = root, server, body.surface
        scene, surface = server.scene, body.surface
        self.frame = scene.add_frame(root, show_axes=False)
        empty = np.zeros((3, 3)), np.array([[0, 1, 2]])
        self._bands = [
            scene.add_mesh_simple(
                f"{root}/band{k}", *empty, flat_shading=True, side="double", cast_shadow=True
            )
            for k in range(N_BANDS)
        ]
        self._is_empty = [True] * N_BANDS
        style = {"thickness": 1.0, "thickness_units": "screen"}
        points = surface.undeformed
        self._edges = scene.add_line_segments(f"{root}/edges", points[surface.edges], DARK, **style)
        outline = points[surface.feature_edges]
        scene.add_line_segments(f"{root}/undeformed", outline, GREY, **style)
        self.drag_mesh = None
        if draggable:
            self.drag_mesh = scene.add_mesh_simple(
                root + DRAG_MESH,
                points,
                surface.triangles,
                opacity=0.0,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )

    def show(self, points: Floats, values: Floats, top: float, quantity: str, edges: bool) -> None:
        """Update the nodes to a deformed surface.

        Args:
            points: Positions over L, (S, 3).
            values: Values of the quantity, (S,).
            top: Upper end of the colour scale.
            quantity: Name of the quantity.
            edges: Show the edges of facets.
        """
        levels = np.nan_to_num(values / top * N_BANDS if top > 0 else np.zeros_like(values))
        points = np.nan_to_num(points)
        bands = contour_bands(points, self._surface.triangles, levels, N_BANDS)
        colours = band_colours(quantity)
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
