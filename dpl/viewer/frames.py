"""Requests, solutions and the surface values that the viewer shows; independent of the browser."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpl.inference import GraspAnswer, Simulator
from dpl.system.threads import one_thread
from dpl.viewer.requests import GraspRequest, LoadRequest, Patch
from dpl.viewer.surface import Floats, Surface, exit_distance

STRESS, ERROR = "von Mises stress", "error against FE"
QUANTITIES = {"displacement": "m", STRESS: "Pa", ERROR: "m"}  # units without prefix
YOUNG_FACTOR = 4.0  # range of E on the page, down and up, if the scene has a single value
SAMPLE_STREAM = (0, 11)  # random stream of the loads that the page draws
ARROW_LENGTH = 0.09, 0.07  # length at amplitude 0 and its increase per amplitude, over L [-]
MAX_AMPLITUDE = 2.0  # amplitude of the longest arrow [-]
BALANCED = 1e-6  # total force over the sum of nodal forces below which there is no direction


@dataclass(frozen=True)
class ViewSettings:
    """Method and quantity of a frame."""

    quantity: str = "displacement"  # that colours show, a key of `QUANTITIES`
    tol: float | None = None  # relative residual to reach [-]; None: the model alone
    budget_ms: float | None = None  # largest wall time [ms]; None: no limit
    show_newton: bool = False  # also show the iterates of Newton from zero displacement

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise ValueError(f"quantity = {self.quantity!r} must be {' or '.join(QUANTITIES)}")


class Frame(NamedTuple):
    """A displacement and the values that are shown."""

    request: LoadRequest
    displacement: Tensor  # (N, D) [m]
    points: Floats  # deformed surface over L, (S, 3) [-]
    values: Floats  # of the quantity on the surface, (S,), in its unit
    quantity: str  # key of `QUANTITIES`
    answer: Any  # of the simulator, or a `Solution` of Newton

    @property
    def grasp(self) -> GraspAnswer | None:
        """Result of a grasp; None for that of a load or an iterate of Newton."""
        return self.answer if isinstance(self.answer, GraspAnswer) else None

    @property
    def load(self) -> LoadRequest:
        """Load on the body in an answer of the simulator, with the forces of a gripper."""
        return self.request.load(self.answer)


class Body:
    """A simulator and the surface of its body.

    Attributes:
        young: Default Young's modulus, the middle of the training range [Pa].
        parameters: Default parameters of the law by name, alike.
        patch: Function from node and radius to a `Patch`. It caches the last one, which takes
            several solves.
    """

    def __init__(self, simulator: Simulator) -> None:
        """Prepare the surface of the body of a simulator."""
        self.simulator = simulator
        self.scene = simulator.scene
        self.surface = Surface.of(self.scene.problem)
        self.young = self.scene.loads.moduli.middle
        ranges = self.scene.loads.parameter_ranges
        self.parameters = {name: ends.middle for name, ends in ranges.items()}
        self.patch = lru_cache(maxsize=1)(partial(Patch, self.scene))

    @property
    def young_range(self) -> tuple[float, float]:
        """Smallest and largest Young's modulus of a request [Pa]."""
        low, high = self.scene.loads.moduli
        if low < high or self.scene.problem.has_one_modulus:
            return low, high
        return low / YOUNG_FACTOR, high * YOUNG_FACTOR

    def request(self, force: Tensor) -> LoadRequest:
        """Return the request of a dimensionless force (N, D) plus the constant force of the scene.

        The force [N] is that at the default modulus, so that a softer body has larger
        displacements.
        """
        constant = self.scene.loads.constant_force
        total = force if constant is None else force + constant
        newtons = total * (self.young * self.scene.force_unit)
        return LoadRequest(newtons, self.young, self.parameters)

    def zero_load(self) -> LoadRequest:
        """Return the request without a force of the user."""
        return self.request(torch.zeros(self.scene.problem.shape, dtype=torch.float64))

    def grasp(
        self, nodes: Tensor, translation: Tensor, rotation: Tensor, *, sliding: bool = False
    ) -> GraspRequest:
        """Return the request of a grasp; see `GraspRequest` for the arguments."""
        return GraspRequest(**vars(self.zero_load()), nodes=nodes, translation=translation,
                            rotation=rotation, sliding=sliding)  # fmt: skip

    def sample(self, index: int) -> LoadRequest:
        """Return a random load of the training distribution."""
        load = self.scene.loads.sample(SAMPLE_STREAM, [index])
        young = float(load.young)
        parameters = dict(zip(self.parameters, load.parameters[0].tolist(), strict=True))
        return LoadRequest(load.force[0] * young * self.scene.force_unit, young, parameters)

    def solve(self, request: LoadRequest, settings: ViewSettings) -> Frame:
        """Return the frame of a request, computed by the simulator."""
        answer = request.answer(self.simulator, settings.tol, settings.budget_ms)
        reference: Tensor | float = 0.0
        if settings.quantity == ERROR:
            exact = request.answer(self.simulator, self.scene.solver.tol)
            if isinstance(exact, GraspAnswer) and exact.stopped:
                raise ValueError(
                    f"colours: no finite-element solution of this grasp after "
                    f"{exact.milliseconds / 1e3:.1f} s; move the hand back"
                )
            reference = torch.as_tensor(exact.displacement)
        u = torch.as_tensor(answer.displacement)
        return self._frame(request, u, settings.quantity, answer, reference)

    def newton_frames(
        self, request: LoadRequest, settings: ViewSettings, reference: Frame
    ) -> Iterator[Frame]:
        """Yield the iterates of Newton from zero displacement; errors are against `reference`."""
        exact = reference.displacement if settings.quantity == ERROR else 0.0
        with one_thread():
            for state in request.newton_states(self.scene):
                u = self.scene.length * state.displacement[0]
                yield self._frame(request, u, settings.quantity, state, exact)

    def _frame(
        self,
        request: LoadRequest,
        displacement: Tensor,
        quantity: str,
        answer: Any,
        reference: Tensor | float,
    ) -> Frame:
        """Return the frame of displacements (N, D) [m]; values are relative to `reference`."""
        u, surface = displacement / self.scene.length, self.surface
        values = (displacement - reference).norm(dim=1).numpy()[surface.nodes]
        if quantity == STRESS and bool(displacement.any()):  # at rest it is zero up to rounding
            self.scene.problem.material.require_known(f"colours: {STRESS}")
            with torch.inference_mode():
                stress = surface.von_mises(u, request.dimensionless(self.scene).parameters)
            values = request.young * stress
        return Frame(request, displacement, surface.deformed_points(u), values, quantity, answer)

    def arrow_ends(self, frame: Frame) -> Floats:
        """Return start and end of the arrow over L, (2, 3); (0, 3) if the total force is zero.

        The axis of the arrow passes through the centre of the forces of the hand. The arrow starts
        where its axis leaves the body, so that the body does not hide it; in 2D it starts at the
        centre.
        """
        surface, force = self.surface, frame.request.hand_force(frame.answer).numpy()
        total = np.pad(force.sum(axis=0), (0, 3 - force.shape[1]))
        sizes = np.linalg.norm(force, axis=1)
        if not np.linalg.norm(total) > BALANCED * sizes.sum():
            return np.zeros((0, 3))
        direction = total / np.linalg.norm(total)
        points = np.nan_to_num(frame.points)
        weights = sizes[surface.nodes] if sizes[surface.nodes].any() else np.ones(len(points))
        centre = weights @ points / weights.sum()
        start = centre + exit_distance(points, surface.triangles, centre, direction) * direction
        amplitude = frame.request.amplitude(frame.answer, self.scene)
        length = ARROW_LENGTH[0] + ARROW_LENGTH[1] * min(max(amplitude, 0.0), MAX_AMPLITUDE)
        return np.stack([start, start + length * direction])
