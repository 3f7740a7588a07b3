"""viser scene nodes: lights and ground, the body with its supports, and its load."""

from typing import Any

import numpy as np
import viser
from torch import Tensor

from dpl.viewer.camera import FIELD_OF_VIEW, Placement
from dpl.viewer.frames import Body, Frame
from dpl.viewer.renderer import ARROW_COLOUR, N_BANDS, SUPPORT_COLOUR, band_colours, colour_bands
from dpl.viewer.surface import Floats, vertex_normals

THEME = {"show_logo": False, "show_share_button": False, "control_width": "large"}
GROUND: dict[str, Any] = {
    **{"width": 6.0, "height": 6.0, "cell_size": 0.1, "section_size": 0.5, "fade_distance": 7.0},
    **{"cell_color": (226, 228, 233), "section_color": (200, 204, 212)},
    **{"plane_color": (246, 247, 249), "shadow_opacity": 0.18},
}
SOLID: dict[str, Any] = {"flat_shading": True, "side": "double", "receive_shadow": False}
LINES: dict[str, Any] = {"thickness_units": "screen", "visible": False}  # widths in pixels
CLEAR: dict[str, Any] = {"opacity": 0.0, "cast_shadow": False, "receive_shadow": False}
ARROW: dict[str, Any] = {"shaft_radius": 0.009, "head_radius": 0.024, "head_length": 0.055}
DARK, MIDDLE, GREY = (28, 32, 44), (92, 99, 115), (186, 191, 201)
LIFT = 1e-3  # distance of edges from the surface over L, so that they are not hidden [-]
OUTLINE_DISTANCE = 0.01  # displacement over L from which the undeformed outline is shown [-]
MAX_DOTS = 120
DOT_SIZE = 0.005  # diameter of a dot over L [-]


class LocalServer(viser.ViserServer):
    """viser server without tunnels to this machine."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing; a browser could otherwise request a public tunnel."""


def add_environment(server: viser.ViserServer, placement: Placement, rest: Floats) -> None:
    """Set theme and initial camera, and add lights and ground; a body in 2D lies in the ground.

    `rest` are the points of the undeformed body over L, (S, 3).
    """
    scene, camera = server.scene, placement.camera()
    server.gui.configure_theme(brand_color=(37, 99, 235), **THEME)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(370)
    server.initial_camera.position = camera.position
    server.initial_camera.look_at = camera.look_at
    server.initial_camera.fov = FIELD_OF_VIEW
    middle = (rest.min(axis=0) + rest.max(axis=0)) / 2
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/ambient", intensity=1.9)
    for name, direction, intensity in (
        ("/sun", np.array([-0.3, 0.25, 1.0]), 0.2 if placement.planar else 1.0),
        ("/headlight", camera.position - camera.look_at, 1.0),
    ):
        position, shadow = middle + 4 * direction / np.linalg.norm(direction), name == "/sun"
        scene.add_light_directional(
            name, intensity=intensity, position=position, cast_shadow=shadow
        )
    gap, opacity = (0.01, 0.0) if placement.planar else (0.02, 0.6)  # below all shapes
    position = (*middle[:2], placement.points[:, 2].min() - gap)
    scene.add_grid("/ground", plane_opacity=opacity, position=position, **GROUND)


class BodyNode:
    """One body in the browser: a mesh per colour band, edges and supports."""

    def __init__(self, server: LocalServer, root: str, body: Body, name: str) -> None:
        """Add the nodes to the scene below `frame`, called `root`, and a label with the name."""
        self._server, self._surface, scene = server, body.surface, server.scene
        self.frame = scene.add_frame(root, show_axes=False)
        empty, line = (np.zeros((3, 3)), np.array([[0, 1, 2]])), np.zeros((1, 2, 3))
        self._meshes = [  # the bands, then the supports
            scene.add_mesh_simple(f"{root}/mesh{k}", *empty, visible=False, **SOLID)
            for k in range(N_BANDS + 1)
        ]
        self._lines = [
            scene.add_line_segments(f"{root}/lines{k}", line, colour, thickness=width, **LINES)
            for k, (colour, width) in enumerate(((DARK, 1.6), (MIDDLE, 1.0), (GREY, 1.0)))
        ]
        self.label = scene.add_label(
            f"{root}/label", name, anchor="bottom-center", font_screen_scale=1.2
        )

    def show(self, frame: Frame, top: float, *, edges: bool) -> None:
        """Show a frame, with `edges` those of all facets too; see `band_colours` for `top`."""
        surface, points = self._surface, np.nan_to_num(frame.points)
        supports = surface.supports(points).reshape(-1, 3)
        soups = [*colour_bands(surface, frame, top), supports]
        colours = [*band_colours(frame.quantity, top).tolist(), SUPPORT_COLOUR]
        lifted = points + LIFT * vertex_normals(points, surface.triangles)
        moved = np.abs(points - surface.undeformed).max() > OUTLINE_DISTANCE
        ends_of_lines = (
            lifted[surface.feature_edges],
            lifted[surface.edges] if edges else (),
            surface.undeformed[surface.feature_edges] if moved else (),
        )
        with self._server.atomic():
            for mesh, soup, colour in zip(self._meshes, soups, colours, strict=True):
                mesh.visible = len(soup) > 0
                if mesh.visible:
                    mesh.vertices = soup
                    mesh.faces = np.arange(len(soup)).reshape(-1, 3)
                    mesh.color = tuple(colour)
            for lines, ends in zip(self._lines, ends_of_lines, strict=True):
                lines.visible = len(ends) > 0
                if lines.visible:
                    lines.points = ends


class LoadMarker:
    """Dots on the loaded nodes, an arrow of the total force and a clear mesh to drag."""

    def __init__(self, server: LocalServer, body: Body) -> None:
        """Add the nodes to the scene; `drag_mesh` receives mouse events."""
        self._server, self._body, scene, surface = server, body, server.scene, body.surface
        self.mask = np.zeros(len(surface.nodes), dtype=bool)  # loaded nodes of the surface, (S,)
        self._dots = scene.add_point_cloud(
            "/patch", np.zeros((1, 3)), ARROW_COLOUR, point_size=DOT_SIZE, point_shape="circle"
        )
        self._arrow = scene.add_arrows("/arrow", np.zeros((1, 2, 3)), ARROW_COLOUR, **ARROW)
        self._arrow.visible = False
        self.drag_mesh = scene.add_mesh_simple(
            "/drag", surface.undeformed, surface.triangles, side="double", **CLEAR
        )

    def mark(self, nodes: Tensor) -> None:
        """Mark the nodes of a mask of the body, (N,)."""
        self.mask = nodes.numpy()[self._body.surface.nodes]

    def show(self, frame: Frame) -> None:
        """Update the nodes to a frame."""
        ends, points = self._body.arrow_ends(frame), np.nan_to_num(frame.points)
        # above the surface, so that it does not hide half of a dot
        normals = vertex_normals(points, self._body.surface.triangles)
        dots = (points + DOT_SIZE / 2 * normals)[self.mask]
        with self._server.atomic():
            self.drag_mesh.vertices = points
            self._dots.points = dots[:: len(dots) // MAX_DOTS + 1]
            self._arrow.visible = len(ends) > 0
            if len(ends):
                self._arrow.points = ends[None]
