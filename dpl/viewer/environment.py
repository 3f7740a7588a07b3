"""Theme, camera, lights and ground of the page."""

import numpy as np
import viser

from dpl.viewer.rasterizer import Camera
from dpl.viewer.surface import Floats


def add_environment(
    server: viser.ViserServer, camera: Camera, low: Floats, high: Floats, *, planar: bool
) -> None:
    """Set the theme and the initial camera, and add lights and ground.

    Args:
        server: The server of the page.
        camera: Initial camera of a browser.
        low: Lower corner of the bounding box of the undeformed body over L, (3,).
        high: Upper corner.
        planar: True for a body in 2D, which lies in the ground plane.
    """
    gui, scene = server.gui, server.scene
    gui.configure_theme(
        show_logo=False,
        show_share_button=False,
        brand_color=(37, 99, 235),
        control_width="large",
    )
    gui.main_panel.dock_right()
    gui.main_panel.set_width(370)
    server.initial_camera.position = camera.position
    server.initial_camera.look_at = camera.look_at
    server.initial_camera.fov = camera.field_of_view
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/ambient", intensity=1.9)
    to_camera = np.subtract(camera.position, camera.look_at)
    for name, direction, intensity, shadow in (
        ("sun", np.array([-0.3, 0.25, 1.0]), 1.5, True),
        ("headlight", to_camera, 1.4, False),
    ):
        position = (low + high) / 2 + 4 * direction / np.linalg.norm(direction)
        scene.add_light_directional(
            f"/{name}", intensity=intensity, position=position, cast_shadow=shadow
        )
    scene.add_grid(
        "/ground",
        width=6.0,
        height=6.0,
        cell_size=0.1,
        section_size=0.5,
        cell_color=(226, 228, 233),
        section_color=(200, 204, 212),
        plane_color=(246, 247, 249),
        plane_opacity=0.0 if planar else 0.6,
        shadow_opacity=0.18,
        fade_distance=7.0,
        position=(*((low + high) / 2)[:2], float(low[2]) - (0.01 if planar else 0.45)),
    )
