"""viser scene nodes of one body."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import viser

from dpl.viewer.frames import Frame
from dpl.viewer.layout import label_position
from dpl.viewer.load_arrow import arrow_ends
from dpl.viewer.renderer import N_BANDS, band_colours, colour_bands
from dpl.viewer.supports import SUPPORT_COLOUR, SupportSymbols
from dpl.viewer.surface import Floats, Ints, Surface, vertex_normals

DARK, MIDDLE, GREY = (28, 32, 44), (92, 99, 115), (186, 191, 201)
DRAG_MESH = "/drag"
LIFT = 1e-3  # distance of edges from the surface over L, so that they are not hidden [-]
OUTLINE_DISTANCE = 0.01  # displacement over L from which the undeformed outline is shown [-]


class LocalServer(viser.ViserServer):
    """viser server without tunnels to this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing; a browser could otherwise request a public tunnel."""


class BodyNode:
    """One body in the browser: a mesh per colour band, edges, supports and a mesh to drag.

    Attributes:
        frame: The frame, which has position and visibility.
        label: Name of the body, above it.
        drag_mesh: Mesh that receives mouse events; None if the body cannot be dragged.
    """

    def __init__(
        self, server: LocalServer, root: str, surface: Surface, name: str, *, draggable: bool
    ) -> None:
        """Add the nodes to the scene below a frame `root`, with a name for the label."""
        self._server, self._surface, self._root = server, surface, root
        scene, points = server.scene, surface.undeformed
        self.frame = scene.add_frame(root, show_axes=False)
        empty = np.zeros((3, 3)), np.array([[0, 1, 2]])
        solid = {"flat_shading": True, "side": "double", "receive_shadow": False}
        self._bands = [
            scene.add_mesh_simple(f"{root}/band{k}", *empty, **solid) for k in range(N_BANDS)
        ]
        self._is_empty = [True] * N_BANDS
        self._edges = self._add_lines("edges", surface.feature_edges, DARK, 1.6)
        self._mesh = self._add_lines("mesh", surface.edges, MIDDLE, 1.0)
        self._undeformed = self._add_lines("undeformed", surface.feature_edges, GREY, 1.0)
        self._add_supports(solid)
        style = {"anchor": "bottom-center", "font_screen_scale": 1.2}
        self.label = scene.add_label(f"{root}/label", name, **style)
        self.drag_mesh = None
        if draggable:
            clear = {"opacity": 0.0, "side": "double", "cast_shadow": False}
            self.drag_mesh = scene.add_mesh_simple(
                root + DRAG_MESH, points, surface.triangles, receive_shadow=False, **clear
            )

    def _add_lines(
        self, name: str, edges: Ints, colour: tuple[int, int, int], width: float
    ) -> viser.LineSegmentsHandle:
        """Add the lines of edges (K, 2) with a width [pixel]; hidden until the first frame."""
        points = self._surface.undeformed[edges] if len(edges) else np.zeros((1, 2, 3))
        return self._server.scene.add_line_segments(
            f"{self._root}/{name}",
            points,
            colour,
            thickness=width,
            thickness_units="screen",
            visible=False,
        )

    def _add_supports(self, style: Mapping[str, Any]) -> None:
        """Add the symbols of the supports."""
        self._supports = SupportSymbols.of(self._surface)
        self._slab = None
        if len(self._supports.triangles):
            vertices = self._supports.vertices(self._surface.undeformed)
            self._slab = self._server.scene.add_mesh_simple(
                f"{self._root}/supports",
                vertices,
                self._supports.triangles,
                color=SUPPORT_COLOUR,
                **style,
            )

    def show(self, frame: Frame, top: float, *, edges: bool) -> None:
        """Show a frame.

        Args:
            frame: The frame.
            top: Upper end of the colour scale; 0: a neutral colour.
            edges: Show the edges of all facets, in addition to feature edges.
        """
        points = np.nan_to_num(frame.points)
        bands = colour_bands(self._surface, frame, top)
        colours = band_colours(frame.quantity, top)
        with self._server.atomic():
            for k, (handle, soup) in enumerate(zip(self._bands, bands, strict=True)):
                was_empty, self._is_empty[k] = self._is_empty[k], not len(soup)
                if len(soup):
                    handle.vertices = soup.astype(np.float32)
                    handle.faces = np.arange(len(soup), dtype=np.uint32).reshape(-1, 3)
                    handle.color = tuple(int(c) for c in colours[k])
                if was_empty != self._is_empty[k]:
                    handle.visible = was_empty
            self._show_lines(points, edges)
            self._show_label(frame, points)
            if self._slab is not None and self._supports.moves:
                self._slab.vertices = self._supports.vertices(points).astype(np.float32)
            if self.drag_mesh is not None:
                self.drag_mesh.vertices = points.astype(np.float32)

    def _show_lines(self, points: Floats, edges: bool) -> None:
        """Show edges slightly above the surface, and the undeformed outline of a deformed body."""
        surface = self._surface
        lifted = points + LIFT * vertex_normals(points, surface.triangles)
        for handle, lines, visible in (
            (self._edges, surface.feature_edges, True),
            (self._mesh, surface.edges, edges),
        ):
            handle.visible = visible and len(lines) > 0
            if handle.visible:
                handle.points = lifted[lines].astype(np.float32)
        moved = float(np.abs(points - surface.undeformed).max())
        self._undeformed.visible = moved > OUTLINE_DISTANCE and len(surface.feature_edges) > 0

    def _show_label(self, frame: Frame, points: Floats) -> None:
        """Move the label above the body and the arrow of its load."""
        ends = arrow_ends(self._surface, frame)
        parts = [points, self._surface.undeformed, *([] if ends is None else [ends])]
        planar = self._surface.problem.shape[1] == 2
        position = label_position(np.concatenate(parts), self._surface.undeformed, planar=planar)
        self.label.position = position
