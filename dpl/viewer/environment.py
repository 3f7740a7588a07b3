"""Where a body stands in the browser: camera, lights, ground."""

import numpy as np
import viser

from dpl.viewer.rasterizer import Camera
from dpl.viewer.surface import Floats


def build(
    server: viser.ViserServer, camera: Camera, low: Floats, high: Floats, *, flat: bool
) -> None:
    """Put the page's frame, the camera, lights and the ground there.

    Args:
        server: Where.
        camera: Where a browser begins.
        low: Corner of the body at rest, (3,) over L.
        high: The opposite corner.
        flat: Whether the body lies in the plane of the ground.
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
    server.initial_camera.fov = camera.field
    scene.configure_environment_map(None)
    scene.configure_default_lights(False)
    scene.add_light_ambient("/ambient", intensity=1.9)
    towards = np.subtract(camera.position, camera.look_at)
    for name, way, strength, shadow in (
        ("sun", np.array([-0.3, 0.25, 1.0]), 1.5, True),
        ("eye", towards, 1.4, False),
    ):
        place = (low + high) / 2 + 4 * way / np.linalg.norm(way)
        scene.add_light_directional(
            f"/{name}", intensity=strength, position=place, cast_shadow=shadow
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
        plane_opacity=0.0 if flat else 0.6,
        shadow_opacity=0.18,
        fade_distance=7.0,
        position=(*((low + high) / 2)[:2], float(low[2]) - (0.01 if flat else 0.45)),
    )
