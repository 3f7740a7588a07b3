"""Eigenmodes of the rest stiffness and the random loads made of them.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.2.2: f = Phi q with few modes, kept on
random areas of the boundary.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.modal_basis import Array, Modes, eigenmodes
from dpl.fem.loads.sampling import SAMPLINGS, Quantile, constant, symmetric_uniform, uniform01
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load

LEAST = 1e-12  # deflection, below which rounding answers [-]


@dataclass(frozen=True, eq=False)
class ModalLoads:
    """Random loads f = Phi q on random areas of the boundary.

    Each mode's q is drawn by `distribution` times its largest value: for the softest mode the
    one whose linear answer moves some node by `deflection`, for the others that of equal energy
    (`eigenvalue_exponent` 0.5). All of it is multiplied by the amplitude, then kept on the boundary
    nodes within a random distance of a random one.

    A load is a function of a point of the unit cube, and that of (seed, index) alone.

    Attributes:
        linear: The body, with the factor of its K(0).
        n_modes: Modes at least; the last family of neighbouring eigenvalues is taken whole.
        deflection: Largest linear deflection of the softest mode over L [-].
        patch: Smallest and largest radius of the area over L [-].
        distribution: Quantiles of q over its largest value, per mode, in [-1, 1].
        eigenvalue_exponent: Largest q of a mode as a power of its eigenvalue: 0.5 for equal
            energies, 1 for equal deflections, 0 for equal forces.
        radius: Quantiles of the radius, from 0 (the smallest) to 1 (the largest).
        amplitude: Quantiles of a factor on the whole load, in [0, 1].
        sampling: How loads fill the cube: "independent" points or a "sobol" sequence.
        young: Young's modulus [Pa], or a range of which each load draws its own.
        constant_force: Force that every load holds besides, (N, D) [-]; none if left out.
    """

    linear: LinearSolver
    n_modes: int = 5
    deflection: float = 0.4
    patch: Sequence[float] = (0.0, 1.0)
    distribution: Quantile = symmetric_uniform
    eigenvalue_exponent: float = 0.5
    radius: Quantile = uniform01
    amplitude: Quantile = constant
    sampling: str = "independent"
    young: float | Sequence[float] = 1.0
    constant_force: Tensor | None = None

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        if self.n_modes < 1:
            raise ValueError(f"n_modes = {self.n_modes} must be 1 or more")
        if not LEAST <= self.deflection <= 10:
            span = f"between {LEAST:g} and 10 (times L)"
            raise ValueError(f"deflection = {self.deflection} must lie {span}")
        low, high = self.patch if len(self.patch) == 2 else (1, 0)
        if not 0 <= low <= high < math.inf:
            raise ValueError(f"patch = {list(self.patch)} must be a smallest and a largest radius")
        if not -1 <= self.eigenvalue_exponent <= 2:
            raise ValueError(
                f"eigenvalue_exponent = {self.eigenvalue_exponent} must lie between -1 and 2"
            )
        if self.sampling not in SAMPLINGS:
            named = " or ".join(SAMPLINGS)
            raise ValueError(f"sampling = {self.sampling!r} must be {named}")
        moduli = [self.young] * 2 if isinstance(self.young, int | float) else list(self.young)
        if len(moduli) != 2 or not 0 < moduli[0] <= moduli[1] < math.inf:
            raise ValueError(f"young = {self.young} must be a modulus above 0 [Pa] or [low, high]")
        for name, low in (("distribution", -1.0), ("radius", 0.0), ("amplitude", 0.0)):
            drawn = getattr(self, name)(np.linspace(0.0, 1 - 2.0**-53, 1001))
            if not ((drawn >= low) & (drawn <= 1)).all():
                raise ValueError(f"{name} draws numbers outside [{low:g}, 1]")

    @property
    def problem(self) -> Problem:
        """The body."""
        return self.linear.problem

    @cached_property
    def modes(self) -> Modes:
        """The modes that are excited."""
        return eigenmodes(self.linear, self.n_modes)

    @cached_property
    def q_max(self) -> Tensor:
        """Largest modal loads, (M,) [-]."""
        values, vectors = self.modes
        softest = self.deflection * values[0] / vectors[..., 0].norm(dim=1).max()
        return softest * (values / values[0]) ** self.eigenvalue_exponent

    @property
    def largest_force(self) -> float:
        """||Phi q_max|| [-], the scale of residuals in the paper's losses."""
        return float(self.q_max.norm())

    @property
    def young_range(self) -> tuple[float, float]:
        """Smallest and largest Young's modulus [Pa]."""
        moduli = [self.young] if isinstance(self.young, int | float) else self.young
        return float(moduli[0]), float(moduli[-1])

    @property
    def loadable_dofs(self) -> Tensor:
        """Degrees of freedom that these loads can act on and that can move, (N, D)."""
        return self.problem.boundary[:, None] & self.problem.free

    @property
    def n_random(self) -> int:
        """d, numbers that a load is made of: M for q, then centre, radius, amplitude, modulus.

        And Poisson's ratio where the law has a range of them.
        """
        return len(self.q_max) + 4 + self._own

    @property
    def poisson_range(self) -> tuple[float, float] | None:
        """Smallest and largest Poisson's ratio [-]; None if the law has one for all loads."""
        return self.problem.material.poisson_range

    @property
    def _own(self) -> int:
        """P, moduli besides Young's of which each load draws its own."""
        return int(self.poisson_range is not None)

    def points(self, seed: int | Sequence[int], indices: Sequence[int]) -> Tensor:
        """Return the points of the unit cube that loads stand for, (B, d)."""
        drawn = [SAMPLINGS[self.sampling](seed, index, self.n_random) for index in indices]
        return torch.from_numpy(np.stack(drawn))

    def at(self, points: Tensor) -> Load:
        """Return the loads of points of the unit cube, (B, d)."""
        forces = torch.stack([self._force(point.numpy()) for point in points])
        return Load(forces, self.young_at(points), self.poisson_at(points))

    def young_at(self, points: Tensor) -> Tensor:
        """Return the Young's moduli of points, (B,) [Pa]."""
        low, high = self.young_range
        return low + (high - low) * points[:, -1 - self._own]

    def poisson_at(self, points: Tensor) -> Tensor:
        """Return the Poisson's ratios of points, (B, P) [-]; P = 0 if the law has one."""
        low, high = self.poisson_range or (0.0, 0.0)
        return low + (high - low) * points[:, points.shape[1] - self._own :]

    def sample(
        self, seed: int | Sequence[int], indices: Sequence[int], *, amplitude: float = 1.0
    ) -> Load:
        """Return loads.

        Args:
            seed: Names the stream.
            indices: Which loads of the stream, B of them.
            amplitude: Factor on all forces [-].
        """
        load = self.at(self.points(seed, indices))
        return load._replace(force=amplitude * load.force)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return where forces (B, N, D) [-] lie among these loads: amplitudes (B,), strangeness.

        The amplitude is the largest modal load over its largest value here, of the smallest modal
        loads that come closest to the force where it acts: above 1 it is beyond these loads. What
        they leave of it, ||f - Phi q|| / ||f||, is strange: it is zero for these loads. An area
        that is no ball counts as one of theirs. What acts on held degrees of freedom does not
        count, see `Problem.acting`.
        """
        own = self.problem.acting(
            force if self.constant_force is None else force - self.constant_force
        )
        fields = torch.where(self.loadable_dofs[..., None], self.modes.vectors, 0.0) * self.q_max
        amplitudes, strange = [], []
        for f in own:
            unit = float(f.abs().max())
            if unit == 0:
                amplitudes.append(0.0)
                strange.append(0.0)
                continue
            acting = f.any(dim=-1)
            shapes, there = fields[acting].flatten(0, 1), f[acting].flatten() / unit
            q = torch.linalg.lstsq(shapes, there[:, None], driver="gelsd").solution
            amplitudes.append(unit * float(q.abs().max()))
            strange.append(float((there - shapes @ q[:, 0]).norm() / there.norm()))
        return force.new_tensor(amplitudes), force.new_tensor(strange)

    def _force(self, point: Array) -> Tensor:
        """Return the force (N, D) of a point (d,)."""
        modes = len(self.q_max)
        centre, radius, amplitude = point[modes : modes + 3]
        q = self.q_max * torch.from_numpy(self.distribution(point[:modes]))
        q = float(self.amplitude(np.asarray(amplitude))) * q
        points = self.problem.points
        places = points[self.loadable_dofs.any(dim=1)]
        low, high = self.patch
        distance = low + (high - low) * float(self.radius(np.asarray(radius)))
        middle = places[int(centre * len(places))]
        inside = (points - middle).norm(dim=1) <= distance * (1 + 1e-9)
        force = torch.where(inside[:, None] & self.loadable_dofs, self.modes.vectors @ q, 0.0)
        return force if self.constant_force is None else force + self.constant_force

    def __getstate__(self) -> dict[str, object]:
        """Pickle with the modes, so that workers need not find them again."""
        self.modes  # noqa: B018
        return self.__dict__
