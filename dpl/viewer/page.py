"""The page: a thin layer of viser between a browser and a worker."""

import contextlib
import io
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem import HasModes
from dpl.viewer import environment, panel
from dpl.viewer.access import AccessPolicy, check, serve_with
from dpl.viewer.body_node import BodyNode, Server
from dpl.viewer.drag_loads import LoadRequest
from dpl.viewer.frames import QUANTITIES, TIERS, Body, Frame, Scale, ViewSettings
from dpl.viewer.rasterizer import Camera, Renderer
from dpl.viewer.recording import MOST, Recording
from dpl.viewer.surface import Floats
from dpl.viewer.worker import Worker

Hold = Callable[[float | None, float | None], LoadRequest]  # E, Poisson's ratio -> load
ALONE, BUDGET = "network alone", "as far as the budget"
ANSWERS = (ALONE, *(f"corrected to {tol:.0e}" for tol in TIERS), BUDGET)
NEAR = 0.8  # distance of the camera from one body
DOTS = 120  # at most, that mark a patch
RED = (214, 40, 57)


class Page:
    """Controls, readings and bodies in the browser.

    Attributes:
        body: What is simulated.
        worker: What answers.
        server: viser's.
        camera: Where a browser begins.
    """

    def __init__(self, body: Body, door: AccessPolicy, *, title: str, folder: Path) -> None:
        """Serve behind a door.

        Args:
            body: What is simulated.
            door: Who may come in.
            title: Name of the run.
            folder: Where recordings are written.

        Raises:
            RuntimeError: The door does not hold.
        """
        self.body, self._door, self._folder = body, door, folder
        self._problem = body.scene.problem
        with serve_with(door), contextlib.redirect_stdout(io.StringIO()):
            self.server = Server(host=door.host, port=door.port, label="dpl", verbose=False)
        try:
            check(door)
        except BaseException:
            self.close()
            raise
        self.recording = Recording(body)
        self._scale = Scale()
        self._frame: Frame | None = None
        self._beside: tuple[Frame | None, int] = None, 0
        self._said, self._dirty = "", False
        self._hold: Hold = lambda young, poisson: body.rest(young, poisson)
        tip = body.surface.rest[:, 0].argmax()
        self._node = int(body.surface.nodes[tip])
        self._grabbed: tuple[int, Floats, Tensor] | None = None
        self._draws = 0
        self._build_scene()
        self._build_panel(title)
        self.worker = Worker(body, self._show, beside=self._show_beside, trouble=self._trouble)
        self._mark()
        self.worker.start()

    @property
    def address(self) -> str:
        """What is typed into the browser, with the token."""
        return self._door.address

    def close(self) -> None:
        """End."""
        if hasattr(self, "worker"):
            self.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # --- the scene

    def _build_scene(self) -> None:
        server, surface = self.server, self.body.surface
        low, high = surface.rest.min(axis=0), surface.rest.max(axis=0)
        self.camera = Camera.before(surface, wide=NEAR)
        environment.build(server, self.camera, low, high, flat=self._problem.shape[1] == 2)
        self._network = BodyNode(server, "/network", self.body, grab=True)
        self._fe = BodyNode(server, "/fe", self.body, grab=False)
        aside = float(high[1] - low[1]) + 0.7
        self._aside = np.array([0.0, aside, 0.0])
        self._fe.frame.position = self._aside
        self._fe.frame.visible = False
        corner = np.array([low[0], low[1], high[2] + 0.12])
        server.scene.add_label("/fe/label", "Newton from rest", position=corner)
        self._label = server.scene.add_label(
            "/network/label", "answer", position=corner, visible=False
        )
        self._patch_dots = server.scene.add_point_cloud(
            "/patch", np.zeros((1, 3)), RED, point_size=0.004, point_shape="circle"
        )
        self._arrow = server.scene.add_arrows(
            "/arrow",
            np.zeros((1, 2, 3)),
            RED,
            shaft_radius=0.008,
            head_radius=0.022,
            head_length=0.05,
        )
        self._arrow.visible = False
        assert self._network.grip is not None
        caught = self._door.complaints.caught
        self._network.grip.on_drag("left")(caught(self._dragged))
        self._network.grip.on_click(caught(self._clicked))

    async def _dragged(self, event: Any) -> None:
        """Move the grabbed point with the hand."""
        frame = self._frame
        if frame is None:
            return
        if event.phase == "start" or self._grabbed is None:
            place = np.asarray(event.start_position)
            node = self.body.surface.nearest(frame.points, place)
            self._node = node
            moved = frame.displacement[node] / self._problem.length
            self._grabbed = node, place, moved
        node, place, moved = self._grabbed
        way = np.asarray(event.end_position) - place
        target = moved + torch.from_numpy(way[: len(moved)])
        if event.phase == "end":
            self._grabbed = None
        self._push(node, target)

    async def _clicked(self, event: Any) -> None:
        """Make the clicked point the centre of the patch."""
        frame = self._frame
        if frame is None or event.ray_origin is None:
            return
        origin, way = np.asarray(event.ray_origin), np.asarray(event.ray_direction)
        along = (frame.points - origin) @ way
        off = np.linalg.norm(frame.points - origin - along[:, None] * way, axis=1)
        near = off < off.min() + 0.02  # of those that the ray passes, the first
        first = np.flatnonzero(near)[along[near].argmin()]
        self._node = int(self.body.surface.nodes[first])
        self._controlled()

    def _push(self, node: int, target: Tensor) -> None:
        """Load an area so that its centre goes to a displacement over L (D,)."""
        radius, uniform, free = self._radius.value, self._uniform.value, self._beyond.value

        def hold(young: float | None, poisson: float | None) -> LoadRequest:
            patch = self.body.patch(node, radius, uniform=uniform)
            most = None if free else 1.0
            return self.body.asked(patch.towards(target, most=most), young, poisson)

        self._ask(hold)

    def _controlled(self, event: Any = None) -> None:
        """Load an area as the controls say."""
        if event is not None and event.client is None:
            return
        node, radius, uniform = self._node, self._radius.value, self._uniform.value
        way = torch.tensor(self._direction.value[: self._problem.shape[1]]).double()
        amplitude = self._amplitude.value

        def hold(young: float | None, poisson: float | None) -> LoadRequest:
            patch = self.body.patch(node, radius, uniform=uniform)
            return self.body.asked(patch.along(way, amplitude), young, poisson)

        self._ask(hold)

    def _ask(self, hold: Hold | None = None) -> None:
        """Ask for the newest load under the newest moduli."""
        self._hold = self._hold if hold is None else hold
        ratio = None if self._poisson is None else self._poisson.value
        self.worker.ask(partial(self._hold, self._young.value, ratio))
        self._mark()

    def _mark(self) -> None:
        """Show the area that is loaded."""
        patch = self.body.patch(self._node, self._radius.value, uniform=self._uniform.value)
        self._marked = patch.inside.numpy()[self.body.surface.nodes]
        self._said = ""

    # --- the panel

    def _build_panel(self, title: str) -> None:
        gui, scene = self.server.gui, self.body.scene
        nodes, dim = self._problem.shape
        law = type(self._problem.material).__name__
        gui.add_html(
            panel.message(f"{title} · {nodes * dim:,} degrees of freedom · {law}", "inherit")
        )
        self._reading, self._colours = gui.add_html(""), gui.add_html("")
        self._newton = gui.add_html("", visible=False)
        self._told = gui.add_html("")
        with gui.add_folder("Load"):
            gui.add_html(
                panel.message("Drag the body to pull it; click it to place the patch.", "inherit")
            )
            loads = scene.loads
            low, high = loads.patch_radius if isinstance(loads, HasModes) else (0.0, 1.0)
            span = max(high, 0.05)
            self._radius = gui.add_slider(
                "patch radius / L", 0.0, float(span), 0.01, float(min(max(0.4, low), span))
            )
            self._direction = gui.add_vector3(
                "direction", (0.0, 1.0 if dim == 2 else 0.0, 1.0), step=0.1
            )
            self._amplitude = gui.add_slider("amplitude", -2.0, 2.0, 0.01, 0.0, marks=(-1, 0, 1))
            least, most = self.body.young_span
            self._young = gui.add_slider(
                "E [Pa]", least, most, (most - least) / 500, self.body.young
            )
            span_nu = scene.loads.poisson_range
            self._poisson = (
                None
                if span_nu is None
                else gui.add_slider(
                    "Poisson's ratio", *map(float, span_nu), 1e-3, self.body.poisson
                )
            )
            self._beyond = gui.add_checkbox(
                "beyond range",
                False,
                hint="let a drag ask for more than the training's largest loads",
            )
            self._uniform = gui.add_checkbox(
                "even force",
                False,
                hint="one force at all nodes of the patch: unlike the training's",
            )
            random, reset = (
                gui.add_button("Random load of the training"),
                gui.add_button("Reset", color="gray"),
            )
        with gui.add_folder("Answer and colours"):
            self._answered = gui.add_dropdown("answer", ANSWERS)
            self._budget = gui.add_number("budget [ms]", 20.0, min=0.1, max=10_000.0)
            self._quantity = gui.add_dropdown("colours", tuple(QUANTITIES))
            self._mesh = gui.add_checkbox("mesh lines", True)
            self._compare = gui.add_checkbox("Newton from rest beside it", False)
        with gui.add_folder("Record", expand_by_default=False):
            self._record = gui.add_button("Start recording", color="red")
            self._state = gui.add_html(panel.message(f"Saved into {self._folder}", "inherit"))
            saves = gui.add_button_group("save as", ("VTU", "GIF", "MP4"))
        caught = self._door.complaints.caught
        for control in (self._direction, self._amplitude, self._uniform, self._radius):
            control.on_update(caught(self._controlled))
        for control in (self._young, self._poisson):
            if control is not None:
                control.on_update(
                    caught(lambda event: None if event.client is None else self._ask())
                )
        for control in (self._answered, self._budget, self._quantity, self._compare):
            control.on_update(caught(self._wished))
        self._mesh.on_update(caught(self._wished))
        random.on_click(caught(self._sampled))
        reset.on_click(caught(self._reset))
        self._record.on_click(caught(self._toggle))
        saves.on_click(caught(self._save))

    def _wished(self, event: Any) -> None:
        """Ask for the same load, answered or shown otherwise."""
        chosen = self._answered.value
        tol = dict(zip(ANSWERS[1:4], TIERS, strict=True)).get(chosen)
        budget = self._budget.value if chosen == BUDGET else None
        if budget is not None:
            tol = TIERS[-1]
        compare = bool(self._compare.value)
        if self._quantity.value != self.worker.wish.quantity:
            self._scale = Scale()
        if compare != self.worker.wish.compare:
            self._fe.frame.visible = self._newton.visible = self._label.visible = compare
            middle = self._aside / 2 if compare else np.zeros(3)
            camera = Camera.before(self.body.surface, wide=1.25 if compare else NEAR)
            for client in self.server.get_clients().values():
                client.camera.position = camera.position + middle
                client.camera.look_at = camera.look_at + middle
        try:
            self.worker.ask(wish=ViewSettings(self._quantity.value, tol, budget, compare))
        except ValueError as error:
            self._trouble(str(error))

    def _sampled(self, event: Any) -> None:
        """Ask for a random load of the training, with its moduli."""
        self._draws += 1
        asked = self.body.sample(self._draws)
        self._young.value = float(np.clip(asked.young, *self.body.young_span))
        if self._poisson is not None and asked.poisson is not None:
            self._poisson.value = asked.poisson

        def hold(young: float | None, poisson: float | None) -> LoadRequest:
            return asked._replace(
                young=asked.young if young is None else young,
                poisson=None if asked.poisson is None else poisson,
            )

        self._ask(hold)
        self._marked = asked.force.any(dim=1).numpy()[self.body.surface.nodes]

    def _reset(self, event: Any) -> None:
        """Take the load away."""
        self._amplitude.value = 0.0
        self._young.value = self.body.young
        self._ask(self.body.rest)

    def _toggle(self, event: Any) -> None:
        """Start or stop a recording."""
        if self.recording.running:
            self.recording.stop()
        else:
            self.recording.start()
        self._dirty = True

    def _save(self, event: Any) -> None:
        """Write the recording into the folder; a film goes to the browser too."""
        self.recording.stop()
        kind = event.target.value
        self._state.content = panel.message(f"Writing {len(self.recording)} frames ...")
        try:
            if kind == "VTU":
                path = self.recording.save_series(self._folder)
            else:
                scenery = Renderer(self.body.surface, Camera.before(self.body.surface))
                path = self.recording.save_film(self._folder, scenery, f".{kind.lower()}")
                if event.client is not None:
                    event.client.send_file_download(path.name, path.read_bytes())
            self._state.content = panel.message(f"Written: {path}", panel.GOOD)
        except (ValueError, OSError) as error:
            self._state.content = panel.message(str(error), panel.BAD)

    # --- what the worker brings

    def _show(self, frame: Frame) -> None:
        """Show an answer; in the worker's thread."""
        self._frame, self._dirty, self._said = frame, True, ""
        top = self._scale.follow(frame.values)
        self._network.show(frame.points, frame.values, top, frame.quantity, self._mesh.value)
        self._show_load(frame)
        self.server.flush()  # now, and not with viser's next window
        self.recording.take(frame, time.monotonic())

    def _show_load(self, frame: Frame) -> None:
        """Show where a load acts and which way it goes."""
        where = self._marked
        force = frame.asked.force.numpy()
        size = float(np.linalg.norm(force))
        with self.server.atomic():
            dots = frame.points[where]
            dots = dots[:: len(dots) // DOTS + 1]
            self._patch_dots.points = np.nan_to_num(dots).astype(np.float32)
            self._arrow.visible = size > 0
            if size > 0:
                total = np.pad(force.sum(axis=0), (0, 3 - force.shape[1]))
                way = total / max(float(np.linalg.norm(total)), 1e-300)
                acts = np.linalg.norm(force[self.body.surface.nodes], axis=1)
                start = np.nan_to_num(frame.points).T @ (acts / max(acts.sum(), 1e-300))
                share = 0.0 if frame.answer is None else min(float(frame.answer.amplitude), 2.0)
                ends = np.stack([start, start + (0.06 + 0.22 * share) * way])
                self._arrow.points = ends[None].astype(np.float32)

    def _show_beside(self, frame: Frame | None) -> None:
        """Show an iterate of Newton; in the worker's thread."""
        self._dirty = True
        self._beside = frame, 0 if frame is None else frame.iteration
        if frame is not None:
            top = self._scale.top
            self._fe.show(frame.points, frame.values, top, frame.quantity, self._mesh.value)

    def _trouble(self, words: str) -> None:
        """Say why there is no answer."""
        self._said, self._dirty = words, True

    def refresh(self) -> None:
        """Bring the readings up to date; a few times a second is enough."""
        if not self._dirty or self._frame is None:
            return
        self._dirty = False
        frame = self._frame
        finite = frame.values[np.isfinite(frame.values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
        self._reading.content = panel.readout(frame, self.worker.rate)
        self._colours.content = panel.legend(frame.quantity, self._scale.top, low, high)
        if self.worker.wish.compare:
            self._newton.content = panel.newton(*self._beside)
        self._told.content = panel.message(self._said, panel.BAD)
        running, count = self.recording.running, len(self.recording)
        self._record.label = f"Stop ({count} of {MOST} frames)" if running else "Start recording"
        if running:
            self._state.content = panel.message(f"{count} frames", "inherit")
