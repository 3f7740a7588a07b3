"""Theme, camera, lights and ground of the page."""

import numpy as np
import viser

from dpl.viewer.camera import UP, Camera
from dpl.viewer.layout import Layout
from dpl.viewer.surface import Surface

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


def add_environment(server: viser.ViserServer, layout: Layout, surface: Surface) -> None:
    """Set theme and initial camera, and add lights and ground; a body in 2D lies in the ground."""
    camera = layout.camera()
    server.gui.configure_theme(brand_color=(37, 99, 235), **THEME)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(370)
    server.initial_camera.position = camera.position
    server.initial_camera.look_at = camera.look_at
    server.initial_camera.fov = camera.field_of_view
    scene, points = server.scene, surface.undeformed
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/ambient", intensity=1.9)
    for name, direction, intensity in (
        ("/sun", np.array([-0.3, 0.25, 1.0]), 0.2 if layout.planar else 1.0),
        ("/headlight", camera.position - camera.look_at, 1.0),
    ):
        position, shadow = middle + 4 * direction / np.linalg.norm(direction), name == "/sun"
        scene.add_light_directional(
            name, intensity=intensity, position=position, cast_shadow=shadow
        )
    position = (*middle[:2], layout.ground)
    opacity = 0.0 if layout.planar else 0.6
    scene.add_grid("/ground", plane_opacity=opacity, position=position, **GROUND)


def move_camera(client: viser.ClientHandle, camera: Camera) -> None:
    """Move the camera of a browser."""
    with client.atomic():
        client.camera.up_direction = UP
        client.camera.position = camera.position
        client.camera.look_at = camera.look_at
