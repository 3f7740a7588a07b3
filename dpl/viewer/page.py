"""Page of the viewer: connects the browser (viser) with the worker."""

import contextlib
import io
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser
from torch import Tensor

from dpl.viewer import panel
from dpl.viewer.access import AccessPolicy, check_server, serve_with
from dpl.viewer.body_node import BodyNode, LocalServer
from dpl.viewer.controls import Controls
from dpl.viewer.drag_loads import LoadRequest, Patch
from dpl.viewer.environment import add_environment, move_camera
from dpl.viewer.frames import Body, ColourScale, Frame
from dpl.viewer.layout import Layout
from dpl.viewer.load_marker import LoadMarker
from dpl.viewer.recording import SUFFIXES, Recording
from dpl.viewer.surface import Floats
from dpl.viewer.worker import Worker

Load = Callable[[float, Mapping[str, float]], LoadRequest]  # E [Pa], parameters -> request
PICK_RADIUS = 0.02  # distance of a ray to the points that it may pick, beyond the nearest, over L


class Page:
    """Page with controls, readings and one or two bodies.

    Attributes:
        body: The body.
        worker: Thread that solves.
        server: viser server.
        layout: Places of the bodies and cameras that show them.
        controls: Widgets of the panel.
        recording: Recording of the shown frames.
        folder: Folder of recordings.
        frame: The most recent frame, if there is one.
        newton_frame: The most recent iterate of Newton for this load, if there is one.
        node: Node at the centre of the patch.
    """

    def __init__(self, body: Body, policy: AccessPolicy, *, title: str, folder: Path) -> None:
        """Start the server behind an access policy, and the worker.

        Raises:
            RuntimeError: The server does not enforce the policy.
        """
        self.body, self.folder, self._policy = body, folder, policy
        with serve_with(policy), contextlib.redirect_stdout(io.StringIO()):
            self.server = LocalServer(policy.host, policy.port, label="dpl", verbose=False)
        self.recording, self._scale = Recording(body), ColourScale()
        self.frame: Frame | None = None
        self.newton_frame: Frame | None = None
        self._error, self._changed = "", False
        self._load: Load = body.zero_load
        self.node = int(body.surface.nodes[body.surface.undeformed[:, 0].argmax()])
        self._drag: tuple[int, Floats, Tensor] | None = None  # node, position, displacement
        self._n_samples = 0
        self.worker = Worker(body, self._show, self._show_newton, self._show_error)
        try:
            check_server(policy)
        except BaseException:
            self.close()
            raise
        self.controls = Controls(self.server, body, title, folder)
        self.layout = Layout.of(body, self.node, self.controls.radius.value)
        self._build_scene()
        self._connect()
        self._mark_patch()
        self.worker.start()

    @property
    def url(self) -> str:
        """Address of the page for the browser, with the token."""
        return self._policy.url

    def close(self) -> None:
        """Stop worker and server."""
        self.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _build_scene(self) -> None:
        server, surface = self.server, self.body.surface
        add_environment(server, self.layout, surface)
        self._body_node = BodyNode(server, "/body", surface, "selected method", draggable=True)
        self._body_node.label.visible = False
        self._newton_node = BodyNode(
            server, "/newton", surface, "Newton from zero", draggable=False
        )
        self._newton_node.frame.position = self.layout.offset
        self._newton_node.frame.visible = False
        self._marker = LoadMarker(server, surface)

    def _connect(self) -> None:
        """Connect the events of the browser with the methods below."""
        controls, catch = self.controls, self._policy.log.catch_errors
        drag_mesh = self._body_node.drag_mesh
        assert drag_mesh is not None
        drag_mesh.on_drag("left")(catch(self.drag))
        drag_mesh.on_click(catch(self.click))
        for control, callback in (
            *((control, self.apply_controls) for control in controls.of_load),
            *((control, self._apply_moduli) for control in controls.of_moduli),
            *((control, self.apply_settings) for control in controls.of_settings),
        ):
            control.on_update(catch(callback))
        for button, callback in (
            *((controls.sample, self.sample), (controls.reset, self.reset)),
            *((controls.record, self._toggle_recording), (controls.save, self._save)),
            (controls.fit, self.fit),
        ):
            button.on_click(catch(callback))
        self.server.on_client_connect(catch(self._fit_client))

    # --- events of the browser

    async def drag(self, event: Any) -> None:
        """Load the patch so that the dragged point follows the mouse."""
        if self.frame is None:
            return
        if event.phase == "start" or self._drag is None:
            position = np.asarray(event.start_position)
            self.node = self.body.surface.nearest_node(self.frame.points, position)
            start = self.frame.displacement[self.node] / self.body.scene.length
            self._drag = self.node, position, start
        node, position, start = self._drag
        motion = np.asarray(event.end_position) - position
        target = start + torch.from_numpy(motion[: len(start)])
        if event.phase == "end":
            self._drag = None
        patch = self._patch(node)
        max_amplitude = None if self.controls.unlimited.value else 1.0
        self._show_direction(target)
        self._submit_force(lambda: patch().force_towards(target, max_amplitude=max_amplitude))

    def _show_direction(self, target: Tensor) -> None:
        """Set direction and, with the next frame, amplitude to those of a drag."""
        size = float(target.norm())
        if size > 0:
            direction = np.pad((target / size).numpy(), (0, 3 - len(target)))
            self.controls.direction.value = tuple(direction.round(2).tolist())
        self.controls.follows_frame = True

    async def click(self, event: Any) -> None:
        """Move the patch to the clicked point."""
        frame = self.frame
        if frame is None or event.ray_origin is None:
            return
        origin, direction = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        along = (frame.points - origin) @ direction
        off = np.linalg.norm(frame.points - origin - along[:, None] * direction, axis=1)
        near = off < off.min() + PICK_RADIUS
        first = np.flatnonzero(near)[along[near].argmin()]  # the nearest to the camera
        self.node = int(self.body.surface.nodes[first])
        self.apply_controls()

    def apply_controls(self, event: Any = None) -> None:
        """Load the patch as the sliders say; values set by the server are ignored."""
        if event is not None and event.client is None:
            return
        self.controls.follows_frame = False
        patch = self._patch(self.node)
        dim = self.body.scene.problem.shape[1]
        direction = torch.tensor(self.controls.direction.value[:dim]).double()
        amplitude = self.controls.amplitude.value
        self._submit_force(lambda: patch().force_along(direction, amplitude))

    def _apply_moduli(self, event: Any) -> None:
        if event.client is not None:
            self._submit()

    def sample(self, event: Any) -> None:
        """Apply a random load of the training distribution with its moduli."""
        self._n_samples += 1
        request = self.body.sample(self._n_samples)
        self.controls.modulus = request.young
        for name, value in request.parameters.items():
            self.controls.parameters[name].value = value
        self.controls.follows_frame = True
        loaded = request.force.any(dim=1).numpy()[self.body.surface.nodes]
        self.node = self.body.surface.middle_node(loaded)
        self._submit(lambda young, given: request._replace(young=young, parameters=given))
        self._marker.mask = loaded

    def reset(self, event: Any) -> None:
        """Remove the load and restore the default Young's modulus."""
        self.controls.follows_frame = False
        self.controls.amplitude.value = 0.0
        self.controls.modulus = self.body.young
        self._submit(self.body.zero_load)

    def apply_settings(self, event: Any) -> None:
        """Solve and show the same load with the selected method and quantity."""
        old, settings = self.worker.settings, self.controls.settings()
        if settings.quantity != old.quantity:
            self._scale = ColourScale()
        if settings.show_newton != old.show_newton:
            self._show_second_body(settings.show_newton)
        self.worker.submit(settings=settings)

    def _show_second_body(self, visible: bool) -> None:
        """Show or hide the body of Newton, and move the cameras."""
        self._newton_node.frame.visible = self._body_node.label.visible = visible
        self.fit(None)

    def fit(self, event: Any) -> None:
        """Move the cameras of all browsers so that they show all that is shown."""
        for client in self.server.get_clients().values():
            self._fit_client(client)

    def _fit_client(self, client: viser.ClientHandle) -> None:
        """Move the camera of a browser so that it shows all that is shown."""
        camera = self.layout.camera(
            aspect=client.camera.aspect,
            both=self.controls.show_newton.value,
            shown=None if self.frame is None else np.nan_to_num(self.frame.points),
        )
        move_camera(client, camera)

    def _toggle_recording(self, event: Any) -> None:
        (self.recording.stop if self.recording.running else self.recording.start)()
        self._changed = True

    def _save(self, event: Any) -> None:
        """Write the recording into the folder; send animations to the browser too."""
        self.recording.stop()
        suffix = SUFFIXES[event.target.value]  # no part of a path comes from the browser
        self.controls.show_state(f"Writing {len(self.recording)} frames ...")
        try:
            if suffix == ".pvd":
                path = self.recording.save_series(self.folder)
            else:
                path = self.recording.save_animation(self.folder, suffix)
                if event.client is not None:
                    event.client.send_file_download(path.name, path.read_bytes())
            self.controls.show_state(f"Written: {path}", panel.GOOD)
        except (ValueError, OSError) as error:
            self.controls.show_state(str(error), panel.BAD)

    # --- requests to the worker and its results

    def _patch(self, node: int) -> Callable[[], Patch]:
        """Return a function that makes the patch of a node with the values of the controls."""
        radius, uniform = self.controls.radius.value, self.controls.uniform.value
        return partial(self.body.patch, node, radius, uniform=uniform)

    def _submit_force(self, make_force: Callable[[], Tensor]) -> None:
        """Submit a dimensionless force (N, D), which the worker makes."""
        self._submit(lambda *moduli: self.body.request(make_force(), *moduli))

    def _submit(self, load: Load | None = None) -> None:
        """Submit a load, or the last one, with the moduli of the sliders."""
        self._load = self._load if load is None else load
        sliders = self.controls.parameters
        parameters = {name: slider.value for name, slider in sliders.items()}
        self.worker.submit(partial(self._load, self.controls.modulus, parameters))
        self._mark_patch()

    def _mark_patch(self) -> None:
        """Mark the nodes of the patch and remove the error message."""
        node_mask = self._patch(self.node)().node_mask.numpy()
        self._marker.mask = node_mask[self.body.surface.nodes]
        self._error = ""

    def _show(self, frame: Frame) -> None:
        """Show a frame; runs in the thread of the worker."""
        self.frame, self._changed, self._error = frame, True, ""
        top, edges = self._scale.update(frame.values), self.controls.edges.value
        self._body_node.show(frame, top, edges=edges)
        self._marker.show(frame)
        self.server.flush()  # viser would otherwise wait for its next update interval
        self.recording.add(frame, time.monotonic())

    def _show_newton(self, frame: Frame | None) -> None:
        """Show an iterate of Newton; runs in the thread of the worker."""
        self.newton_frame, self._changed = frame, True
        if frame is not None:
            self._newton_node.show(frame, self._scale.top, edges=self.controls.edges.value)

    def _show_error(self, text: str) -> None:
        self._error, self._changed = text, True

    def refresh(self) -> None:
        """Update the readings of the panel; to be called a few times per second."""
        if not self._changed or self.frame is None:
            return
        self._changed = False
        self.controls.show_frame(self.frame, self._scale.top, self.worker.frame_rate, self.node)
        self.controls.show_newton_frame(self.newton_frame, self.worker.settings.show_newton)
        self.controls.show_error(self._error)
        self.controls.show_recording(self.recording)
