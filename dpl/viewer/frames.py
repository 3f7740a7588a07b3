"""From a load to what is shown of its answer, without a browser."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem import Load, Solution
from dpl.fem.solvers import check_tol
from dpl.inference import Answer, Simulator
from dpl.system.threads import one_thread
from dpl.viewer.drag_loads import LoadRequest, Patch
from dpl.viewer.surface import Surface

Floats = NDArray[np.float64]
QUANTITIES = {"displacement": "m", "von Mises stress": "Pa", "error against FE": "m"}
NETWORK, TIERS = "network alone", (1e-3, 1e-6, 1e-8)
WIDER = 4.0  # by how much E may be changed where the scene has one


@dataclass(frozen=True)
class ViewSettings:
    """How a load is to be answered and shown.

    Attributes:
        quantity: What colours show, of `QUANTITIES`.
        tol: Residual ratio that the answer is to keep [-]; None: the network alone.
        budget_ms: Wall time that it may take [ms]; None: any.
        compare: Whether Newton from rest is shown beside it.
    """

    quantity: str = "displacement"
    tol: float | None = None
    budget_ms: float | None = None
    compare: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: One is out of range.
        """
        if self.quantity not in QUANTITIES:
            raise ValueError(f"quantity = {self.quantity!r} must be {' or '.join(QUANTITIES)}")
        if self.tol is not None:
            check_tol(self.tol)
        if self.budget_ms is not None and not 0 < self.budget_ms < math.inf:
            raise ValueError(f"budget_ms = {self.budget_ms} must be a number above 0")


class Frame(NamedTuple):
    """What is shown of one answer.

    Attributes:
        asked: The load.
        displacement: (N, D) [m].
        points: Surface, over L, (S, 3) [-].
        values: What colours show, at the surface, (S,), in the unit of the quantity.
        quantity: Of `QUANTITIES`.
        answer: What it is worth; None of an iterate of Newton.
        iteration: Of Newton from rest; -1: an answer.
        residual: ||R_free|| / ||f|| [-].
        volume_ratio: min det F [-].
        converged: Whether it is in balance to what was asked for.
    """

    asked: LoadRequest
    displacement: Tensor
    points: Floats
    values: Floats
    quantity: str
    answer: Answer | None
    iteration: int
    residual: float
    volume_ratio: float
    converged: bool


class Body:
    """A simulator and what is seen of its body.

    Attributes:
        simulator: What answers.
        surface: What is seen.
        young: E where nothing else is said, the middle of the training's [Pa].
        poisson: The same of Poisson's ratio; None where the law has its own.
    """

    def __init__(self, simulator: Simulator) -> None:
        """Take a simulator."""
        self.simulator = simulator
        self.scene = simulator.scene
        self.surface = Surface.of(self.scene.problem)
        self.young = sum(self.scene.loads.young_range) / 2
        span = self.scene.loads.poisson_range
        self.poisson = None if span is None else sum(span) / 2
        self._patch: Patch | None = None

    @property
    def young_span(self) -> tuple[float, float]:
        """Smallest and largest E that can be asked for [Pa]."""
        low, high = self.scene.loads.young_range
        return (low, high) if low < high else (low / WIDER, high * WIDER)

    @property
    def force_unit(self) -> float:
        """Force of a dimensionless 1 at the usual E [N], in 2D [N/m]."""
        return self.young * self.scene.force_unit

    def asked(
        self, force: Tensor, young: float | None, poisson: float | None = None
    ) -> LoadRequest:
        """Return a dimensionless force (N, D), and what every load holds besides, as a load.

        The force is that of the usual E, so that a softer body is moved further by it.

        Raises:
            ValueError: A modulus is out of its range.
        """
        young = self.young if young is None else young
        low, high = self.young_span
        if not low * (1 - 1e-9) <= young <= high * (1 + 1e-9):
            raise ValueError(f"E = {young:g} Pa must lie between {low:g} and {high:g}")
        span = self.scene.loads.poisson_range
        if span is None:
            poisson = None
        else:
            poisson = sum(span) / 2 if poisson is None else poisson
            if not span[0] <= poisson <= span[1]:
                raise ValueError(f"Poisson's ratio {poisson:g} must lie in {list(span)}")
        always = self.scene.loads.constant_force
        whole = force if always is None else force + always
        return LoadRequest(whole * self.force_unit, young, poisson)

    def rest(self, young: float | None = None, poisson: float | None = None) -> LoadRequest:
        """Return the load of no hand."""
        return self.asked(
            torch.zeros(self.scene.problem.shape, dtype=torch.float64), young, poisson
        )

    def sample(self, index: int) -> LoadRequest:
        """Return a random load like those of the training."""
        load = self.scene.loads.sample((0, 11), [index])
        young = float(load.young)
        ratio = float(load.poisson) if load.poisson.numel() else None
        return LoadRequest(load.force[0] * young * self.scene.force_unit, young, ratio)

    def patch(self, node: int, radius: float, *, uniform: bool = False) -> Patch:
        """Return the loads of an area; the last is kept, for it takes a few solves.

        Raises:
            ValueError: There is no such node, or the radius is out of range.
        """
        if not 0 <= node < self.scene.problem.shape[0]:
            raise ValueError(f"node = {node} is none of the body")
        if not 0 <= radius < math.inf:
            raise ValueError(f"radius = {radius} must be a length")
        same = (node, radius, uniform)
        kept = self._patch
        if kept is None or (kept.node, kept.radius, kept.uniform) != same:
            self._patch = kept = Patch(self.scene, node, radius, uniform)
        return kept

    def load(self, asked: LoadRequest) -> Load:
        """Return a load as solvers take it."""
        ratio = None if asked.poisson is None else torch.tensor([asked.poisson]).double()
        return self.scene.load_of(asked.force[None], torch.tensor([asked.young]).double(), ratio)

    def answer(self, asked: LoadRequest, wish: ViewSettings) -> Frame:
        """Return the answer to a load, and what it is worth, as it is shown."""
        answer = self._ask(asked, tol=wish.tol, budget_ms=wish.budget_ms)
        over_length = answer.displacement / self.scene.length
        other = None
        if wish.quantity == "error against FE":
            exact = self._ask(asked, tol=self.scene.solver.tol, warm=True)
            other = exact.displacement / self.scene.length
        return Frame(
            asked,
            answer.displacement,
            self.surface.moved(over_length),
            self._values(over_length, other, asked, wish.quantity),
            wish.quantity,
            answer,
            -1,
            answer.residual,
            answer.volume_ratio,
            answer.converged,
        )

    def _ask(self, asked: LoadRequest, **options: Any) -> Answer:
        return self.simulator(asked.force, young=asked.young, poisson=asked.poisson, **options)

    def newton(self, asked: LoadRequest, wish: ViewSettings, beside: Frame) -> Iterator[Frame]:
        """Yield Newton's iterates from rest as they are shown; errors are those of `beside`."""
        answer = beside.displacement / self.scene.length
        with one_thread():
            for state in self.scene.solver.iterate(self.load(asked)):
                yield self._iterate(state, answer, asked, wish)

    def _iterate(
        self, state: Solution, answer: Tensor, asked: LoadRequest, wish: ViewSettings
    ) -> Frame:
        u = state.displacement[0]
        return Frame(
            asked,
            u * self.scene.length,
            self.surface.moved(u),
            self._values(u, answer, asked, wish.quantity),
            wish.quantity,
            None,
            int(state.iterations),
            float(state.residual),
            float(state.volume_ratio),
            bool(state.converged),
        )

    def _values(self, u: Tensor, other: Tensor | None, asked: LoadRequest, quantity: str) -> Floats:
        """Return what colours show of a displacement (N, D) [-], at the surface, (S,)."""
        if quantity == "von Mises stress":
            with torch.inference_mode():
                return asked.young * self.surface.von_mises(u, self.load(asked).poisson)
        shown = u - other if quantity == "error against FE" and other is not None else u
        return self.scene.length * shown.norm(dim=1).numpy()[self.surface.nodes]


class Scale:
    """The range of colours: from 0 to a round number that follows the values without trembling."""

    def __init__(self) -> None:
        """Begin without a range."""
        self.top = 0.0

    def follow(self, values: Floats) -> float:
        """Return the upper end for values, of which some may not be finite."""
        finite = values[np.isfinite(values)]
        largest = float(finite.max()) if len(finite) else 0.0
        if largest > self.top or largest < 0.4 * self.top:
            self.top = round_up(largest)
        return self.top


def round_up(number: float) -> float:
    """Return the smallest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is not smaller."""
    if not 0 < number < math.inf:
        return 0.0
    power = 10.0 ** math.floor(math.log10(number))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    return power * next((step for step in steps if number <= step * power * (1 + 1e-9)), 10.0)


def between(old: LoadRequest, new: LoadRequest, share: float) -> LoadRequest:
    """Return the load that lies so far, from 0 to 1, on the way from one to another."""
    if share >= 1:
        return new
    force = torch.lerp(old.force, new.force, share)
    return new._replace(force=force, young=old.young + share * (new.young - old.young))
