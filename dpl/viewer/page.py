"""Page of the viewer: connects the browser (viser) with the worker."""

import contextlib
import io
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from dpl.viewer.access import AccessPolicy, serve_with
from dpl.viewer.camera import UP, Placement
from dpl.viewer.controls import BAD, GOOD, GRASP, Controls, message, newton_table, problem_of
from dpl.viewer.frames import Body, Frame
from dpl.viewer.hands import GraspingHand, PullingHand
from dpl.viewer.nodes import BodyNode, LoadMarker, LocalServer, add_environment
from dpl.viewer.recording import MAX_FRAMES, SUFFIXES, Recording, farthest_node, rotating_load
from dpl.viewer.renderer import colour_top
from dpl.viewer.requests import LoadRequest, MakeRequest
from dpl.viewer.surface import Floats
from dpl.viewer.worker import Worker

PICK_RADIUS = 0.02  # distance of a ray to the points that it may pick, beyond the nearest, over L
SLOW = 1.0  # time of a solve from which the page shows it [s]


class Page:
    """Page with controls, readings and one or two bodies.

    Attributes:
        recording: Recording of the shown frames, written to `folder`.
        frame: The most recent frame, if there is one.
        newton_frame: The most recent iterate of Newton for this request, if there is one.
        node: Node at the centre of the patch.
    """

    def __init__(self, body: Body, policy: AccessPolicy, *, title: str, folder: Path) -> None:
        """Start the server behind an access policy, and the worker."""
        self.body, self.folder, self._policy = body, folder, policy
        with serve_with(policy), contextlib.redirect_stdout(io.StringIO()):
            self.server = LocalServer(policy.host, policy.port, label="dpl", verbose=False)
        self.recording, self._top = Recording(body), 0.0
        self.frame: Frame | None = None
        self.newton_frame: Frame | None = None
        self._error, self._changed, self._is_slow = "", False, False
        self.node = farthest_node(body)
        self._rotating: Callable[[float], LoadRequest] | None = rotating_load(body)
        self._grabbed: Floats | None = None  # position of the mouse at the start of a drag
        self._n_samples = 0
        self.worker = Worker(body, self._show, self._show_newton, self._show_error)
        self.controls = Controls(self.server, body, title, folder)
        self._pulling = PullingHand(body, self.controls)
        self._grasping = GraspingHand(body, self.controls)
        self.placement = Placement.of(body, self.node, self.controls.radius)
        add_environment(self.server, self.placement, body.surface.undeformed)
        self._body_node = BodyNode(self.server, "/body", body, "selected method")
        self._newton_node = BodyNode(self.server, "/newton", body, "Newton from zero")
        for node in (self._body_node, self._newton_node):
            node.label.position = self.placement.label
        self._newton_node.frame.position = self.placement.offset
        self._newton_node.frame.visible = self._body_node.label.visible = False
        self._marker = LoadMarker(self.server, body)
        self._connect()
        self._marker.mark(self._rotating(1.0).force.any(dim=1))
        self.worker.start()

    @property
    def hand(self) -> PullingHand | GraspingHand:
        """The selected mode of a drag."""
        return self._grasping if self.controls.mode.value == GRASP else self._pulling

    def close(self) -> None:
        """Stop worker and server."""
        self.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _connect(self) -> None:
        """Connect the events of the browser with the methods below."""
        controls, catch = self.controls, self._policy.log.catch_errors
        self._marker.drag_mesh.on_drag("left")(catch(self.drag))
        self._marker.drag_mesh.on_click(catch(self.click))
        for widgets, callback in (
            (controls.of_load, self.apply_controls),
            (controls.of_moduli, self.apply_moduli),
            (controls.of_settings, self.apply_settings),
            ((controls.mode,), self.apply_mode),
        ):
            for widget in widgets:
                widget.on_update(catch(callback))
        controls.sample.on_click(catch(self.sample))
        controls.reset.on_click(catch(self.reset))
        controls.record.on_click(catch(self._toggle_recording))
        controls.save.on_click(catch(self._save))
        controls.fit.on_click(catch(self.fit))
        self.server.on_client_connect(catch(self._fit_client))

    # --- events of the browser

    async def drag(self, event: Any) -> None:
        """Pull or grasp the patch so that the dragged point follows the mouse."""
        if self.frame is None:
            return
        if event.phase == "start" or self._grabbed is None:
            self._grabbed = np.asarray(event.start_position)
            node = self.body.surface.nearest_node(self.frame.points, self._grabbed)
            self.node = self.hand.take(node, self.frame)
        motion = torch.from_numpy(np.asarray(event.end_position) - self._grabbed)
        if event.phase == "end":
            self._grabbed = None
        self._submit(self.hand.move(motion[: self.body.scene.problem.shape[1]]))

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
        """Load or grasp the patch as the sliders say; values set by the server are ignored."""
        if event is not None and event.client is None:
            return
        self._submit(self.hand.hold(self.node, self.frame))

    def apply_moduli(self, event: Any) -> None:
        """Solve the last request with the moduli of the sliders."""
        if event.client is not None:
            self._submit()

    def apply_mode(self, event: Any = None) -> None:
        """Show the controls of the selected mode; the load or the grasp remains."""
        self._grabbed = self._rotating = None
        self._grasping.release()
        self.controls.show_mode()
        self._mark_patch()
        if self.frame is not None:
            self._marker.show(self.frame)

    def sample(self, event: Any) -> None:
        """Apply a random load of the training distribution with its moduli."""
        self._n_samples += 1
        request = self.body.sample(self._n_samples)
        self.controls.modulus = request.young
        for name, value in request.parameters.items():
            self.controls.parameters[name].value = value
        self.controls.follows_frame = True
        self._grasping.release()
        self._submit(lambda: request)
        self._marker.mark(request.force.any(dim=1))
        self.node = self.body.surface.middle_node(self._marker.mask)

    def reset(self, event: Any) -> None:
        """Remove the load and restore the default Young's modulus."""
        self.controls.follows_frame = False
        self._grasping.release()
        self.controls.amplitude.value = self.controls.angle.value = 0.0
        self.controls.modulus = self.body.young
        self._submit(self.body.zero_load)

    def apply_settings(self, event: Any) -> None:
        """Solve and show the same request with the selected method and quantity."""
        old, settings = self.worker.settings, self.controls.settings()
        if settings.quantity != old.quantity:
            self._top = 0.0
        if (visible := settings.show_newton) != old.show_newton:
            self._newton_node.frame.visible = self._body_node.label.visible = visible
            self.fit(None)
        self.worker.submit(settings=settings)

    def fit(self, event: Any) -> None:
        """Move the cameras of all browsers so that they show all that is shown."""
        for client in self.server.get_clients().values():
            self._fit_client(client)

    def _fit_client(self, client: viser.ClientHandle) -> None:
        """Move the camera of a browser so that it shows all that is shown."""
        camera = self.placement.camera(
            aspect=client.camera.aspect,
            both=self.controls.show_newton.value,
            shown=None if self.frame is None else np.nan_to_num(self.frame.points),
        )
        with client.atomic():
            client.camera.up_direction = UP
            client.camera.position = camera.position
            client.camera.look_at = camera.look_at

    def _toggle_recording(self, event: Any) -> None:
        if self.recording.running:
            self.recording.running = False
        else:
            self.recording.start()
        self._changed = True

    def _save(self, event: Any) -> None:
        """Write the recording into the folder; send animations to the browser too."""
        recording, state = self.recording, self.controls.state
        recording.running = False
        suffix = SUFFIXES[event.target.value]  # no part of a path comes from the browser
        state.content = message(f"Writing {len(recording.frames)} frames ...")
        try:
            if suffix == ".pvd":
                path = recording.save_series(self.folder)
            else:
                path = recording.save_animation(self.folder, suffix)
                if event.client is not None:
                    event.client.send_file_download(path.name, path.read_bytes())
            state.content = message(f"Written: {path}", GOOD)
        except (ValueError, OSError) as error:
            state.content = message(str(error), BAD)

    # --- requests to the worker and its results

    def _submit(self, make: MakeRequest | None = None) -> None:
        """Submit a request of the user, or the last one; it ends the rotation of the load."""
        self._rotating = None
        self._mark_patch()  # first, so that it does not remove an error of this request
        self.worker.submit(make and self._with_moduli(make))

    def _with_moduli(self, make: MakeRequest) -> MakeRequest:
        """Return a function that makes a request with the moduli of the sliders."""
        sliders = self.controls.parameters.items()
        return lambda: replace(
            make(),
            young=self.controls.modulus,
            parameters={name: slider.value for name, slider in sliders},
        )

    def _mark_patch(self) -> None:
        """Mark the nodes of the patch and remove the error message."""
        self._marker.mark(self.hand.marked_nodes(self.node))
        self._error = ""

    def _show(self, frame: Frame) -> None:
        """Show a frame; runs in the thread of the worker."""
        self.frame, self._changed, self._error = frame, True, ""
        self._top = colour_top(frame.values, self._top)
        self._body_node.show(frame, self._top, edges=self.controls.edges.value)
        self._marker.show(frame)
        self.server.flush()  # viser would otherwise wait for its next update interval
        self.recording.add(frame, time.monotonic())

    def _show_newton(self, frame: Frame | None) -> None:
        """Show an iterate of Newton; runs in the thread of the worker."""
        self.newton_frame, self._changed = frame, True
        if frame is not None:
            self._newton_node.show(frame, self._top, edges=self.controls.edges.value)

    def _show_error(self, text: str) -> None:
        self._error, self._changed = text, True

    def refresh(self) -> None:
        """Update the readings of the panel; to be called many times per second.

        Until a user changes the load, it rotates while a browser shows the page.
        """
        if self._rotating and self.server.get_clients():
            self.worker.submit(self._with_moduli(partial(self._rotating, time.monotonic())))
        seconds, was_slow = self.worker.solving_time, self._is_slow
        self._is_slow = seconds > SLOW
        if not (self._is_slow or was_slow or self._changed):
            return
        self._changed = False
        frame, settings, controls = self.frame, self.worker.settings, self.controls
        below = newton_table(self.newton_frame) if settings.show_newton else ""
        if self._is_slow:
            below += message(f"Solving for {seconds:.0f} s ...")
        elif self._error or frame is None:
            below += message(self._error, BAD)
        else:
            below += message(problem_of(frame, has_budget=settings.budget_ms is not None), BAD)
        if frame is None:
            controls.readings.content = below
        else:
            controls.show_frame(frame, self._top, self.node, below)
        count = f"Stop ({len(self.recording.frames)} of {MAX_FRAMES} frames)"
        controls.record.label = count if self.recording.running else "Start recording"
