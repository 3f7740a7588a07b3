"""viser scene nodes: lights and ground, the body with its supports, and its load."""

from typing import Any

import numpy as np
import viser

from dpl.viewer.camera import FIELD_OF_VIEW, Placement, label_position
from dpl.viewer.frames import Frame, arrow_ends
from dpl.viewer.renderer import ARROW_COLOUR, N_BANDS, SUPPORT_COLOUR, band_colours, colour_bands
from dpl.viewer.surface import Floats, Ints, Surface, vertex_normals

THEME = {"show_logo": False, "show_share_button": False, "control_width": "large"}
GROUND = {
    "width": 6.0,
    "height": 6.0,
    "cell_size": 0.1,
    "section_size": 0.5,
    "cell_color": (226, 228, 233),
    "section_color": (200, 204, 212),
    "plane_color": (246, 247, 249),
    "shadow_opacity": 0.18,
    "fade_distance": 7.0,
}
SOLID: dict[str, Any] = {"flat_shading": True, "side": "double", "receive_shadow": False}
DARK, MIDDLE, GREY = (28, 32, 44), (92, 99, 115), (186, 191, 201)
DRAG_MESH = "/drag"
LIFT = 1e-3  # distance of edges from the surface over L, so that they are not hidden [-]
OUTLINE_DISTANCE = 0.01  # displacement over L from which the undeformed outline is shown [-]
MAX_DOTS = 120
DOT_SIZE = 0.005  # diameter of a dot over L [-]


class LocalServer(viser.ViserServer):
    """viser server without tunnels to this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing; a browser could otherwise request a public tunnel."""


def add_environment(server: viser.ViserServer, placement: Placement, surface: Surface) -> None:
    """Set theme and initial camera, and add lights and ground; a body in 2D lies in the ground."""
    camera = placement.camera()
    server.gui.configure_theme(brand_color=(37, 99, 235), **THEME)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(370)
    server.initial_camera.position = camera.position
    server.initial_camera.look_at = camera.look_at
    server.initial_camera.fov = FIELD_OF_VIEW
    scene, points = server.scene, surface.undeformed
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/ambient", intensity=1.9)
    for name, direction, intensity in (
        ("/sun", np.array([-0.3, 0.25, 1.0]), 0.2 if surface.planar else 1.0),
        ("/headlight", camera.position - camera.look_at, 1.0),
    ):
        position, shadow = middle + 4 * direction / np.linalg.norm(direction), name == "/sun"
        scene.add_light_directional(
            name, intensity=intensity, position=position, cast_shadow=shadow
        )
    position = (*middle[:2], placement.ground)
    opacity = 0.0 if surface.planar else 0.6
    scene.add_grid("/ground", plane_opacity=opacity, position=position, **GROUND)


class BodyNode:
    """One body in the browser: a mesh per colour band, edges and supports.

    Attributes:
        frame: The frame, which has position and visibility.
        label: Name of the body, above it.
    """

    def __init__(self, server: LocalServer, root: str, surface: Surface, name: str) -> None:
        """Add the nodes to the scene below a frame `root`, with a name for the label."""
        self._server, self._surface, self._root = server, surface, root
        scene, points, supports = server.scene, surface.undeformed, surface.supports
        self.frame = scene.add_frame(root, show_axes=False)
        empty = np.zeros((3, 3)), np.array([[0, 1, 2]])
        self._bands = [
            scene.add_mesh_simple(f"{root}/band{k}", *empty, **SOLID) for k in range(N_BANDS)
        ]
        self._is_empty = [True] * N_BANDS
        self._edges = self._add_lines("edges", surface.feature_edges, DARK, 1.6)
        self._mesh = self._add_lines("mesh", surface.edges, MIDDLE, 1.0)
        self._undeformed = self._add_lines("undeformed", surface.feature_edges, GREY, 1.0)
        self._slab = None
        if len(supports.triangles):
            mesh = supports.vertices(points), supports.triangles
            self._slab = scene.add_mesh_simple(
                f"{root}/supports", *mesh, color=SUPPORT_COLOUR, **SOLID
            )
        self.label = scene.add_label(
            f"{root}/label", name, anchor="bottom-center", font_screen_scale=1.2
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

    def show(self, frame: Frame, top: float, *, edges: bool) -> None:
        """Show a frame.

        Args:
            frame: The frame.
            top: Upper end of the colour scale; 0: a neutral colour.
            edges: Show the edges of all facets, in addition to feature edges.
        """
        surface, points = self._surface, np.nan_to_num(frame.points)
        bands = colour_bands(surface, frame, top)
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
            shown = np.concatenate([points, surface.undeformed, arrow_ends(surface, frame)])
            self.label.position = label_position(shown, surface.undeformed, planar=surface.planar)
            if self._slab is not None and surface.supports.moves:
                self._slab.vertices = surface.supports.vertices(points).astype(np.float32)

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


class LoadMarker:
    """Dots on the loaded nodes, an arrow of the total force and a clear mesh to drag.

    Attributes:
        mask: Loaded nodes of the surface, (S,).
        drag_mesh: Mesh that receives mouse events.
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
        clear: dict[str, Any] = {"opacity": 0.0, "cast_shadow": False, "receive_shadow": False}
        self.drag_mesh = server.scene.add_mesh_simple(
            DRAG_MESH, surface.undeformed, surface.triangles, side="double", **clear
        )

    def show(self, frame: Frame) -> None:
        """Update the nodes to a frame."""
        ends, points = arrow_ends(self._surface, frame), np.nan_to_num(frame.points)
        with self._server.atomic():
            self.drag_mesh.vertices = points.astype(np.float32)
            self._dots.points = self._dot_positions(points).astype(np.float32)
            self._arrow.visible = len(ends) > 0
            if len(ends):
                self._arrow.points = ends[None].astype(np.float32)

    def _dot_positions(self, points: Floats) -> Floats:
        """Return positions above the surface, so that the surface does not hide half of a dot."""
        normals = vertex_normals(points, self._surface.triangles)
        dots = (points + DOT_SIZE / 2 * normals)[self.mask]
        return dots[:: len(dots) // MAX_DOTS + 1]
