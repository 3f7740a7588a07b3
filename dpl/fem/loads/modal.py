"""Random modal loads on random areas of the boundary, and eigenmodes of K(0).

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.2.2: f = Phi q with a few
eigenmodes of K(0), restricted to random areas of the boundary.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh
from torch import Tensor

from dpl.fem.linear.interface import SingularMatrix, full_matrix
from dpl.fem.loads.family import SurfaceLoads
from dpl.fem.loads.fit import amplitudes, project
from dpl.fem.loads.sampling import Array, Quantile, constant, symmetric_uniform, uniform01
from dpl.fem.loads.sized import MIN_DEFLECTION
from dpl.fem.options import option
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver

TESTED = np.linspace(0.0, 1 - 2.0**-53, 1001)  # numbers at which distributions are examined
SAME = 1e-6  # eigenvalues closer than this, relatively, are one eigenspace
CLUSTER = 0.05  # eigenvalues closer than this belong to one family and are excited together


class Modes(NamedTuple):
    """Lowest eigenpairs of K(0) on the free degrees of freedom.

    Attributes:
        values: Eigenvalues, ascending, (M,) [-].
        vectors: Orthonormal eigenvectors, zero where held, (N, D, M) [-].
    """

    values: Tensor
    vectors: Tensor


@dataclass(frozen=True, eq=False)
class ModalLoads(SurfaceLoads):
    """Random loads f = Phi q on random areas of the boundary.

    The modal load q of each mode is a random number of `distribution` times its largest value. For
    the softest mode the largest value is the one whose linear solution moves some node by
    `deflection`; for the others it scales with the eigenvalue to the power `eigenvalue_exponent`.
    The force is multiplied by a random amplitude and set to 0 outside the boundary nodes within a
    random distance of a random node.

    Attributes:
        n_modes: Smallest number of modes. A cluster of close eigenvalues is never divided, so that
            there may be a few more.
        deflection: Largest linear deflection of the softest mode over L [-].
        patch_radius: Smallest and largest radius of the loaded area over L [-].
        distribution: Quantile function of q over its largest value, per mode, in [-1, 1].
        eigenvalue_exponent: Exponent of the eigenvalue in the largest q of a mode: 0.5 for equal
            energies, 1 for equal deflections, 0 for equal forces.
        radius: Quantile function of the radius, from 0 (smallest) to 1 (largest).
        amplitude: Quantile function of the factor on the whole force, in [0, 1].
        modes: Numbers of the modes, ascending, counted from 0 for the softest; None for the first
            `n_modes`. These modes and no others are excited, also if other modes have the same
            eigenvalue: the basis of an eigenspace is fixed, see `eigenmodes`, so that a number
            names the same mode on every machine.
    """

    n_modes: int = option("", default=5, least=1)
    deflection: float = option("times L", default=0.4, least=MIN_DEFLECTION, most=10.0)
    patch_radius: Sequence[float] = option("times L", default=(0.0, 1.0), least=0.0)
    distribution: Quantile = symmetric_uniform
    eigenvalue_exponent: float = option("", default=0.5, least=-1.0, most=2.0)
    radius: Quantile = uniform01
    amplitude: Quantile = constant
    modes: Sequence[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        modes = [0] if self.modes is None else self.modes
        whole = all(isinstance(k, int) and not isinstance(k, bool) and k >= 0 for k in modes)
        if not (modes and whole and all(a < b for a, b in pairwise(modes))):
            raise ValueError(
                f"modes = {list(modes)} must be ascending whole numbers, 0 or more, or null"
            )
        for name, low in (("distribution", -1.0), ("radius", 0.0), ("amplitude", 0.0)):
            drawn = getattr(self, name)(TESTED)
            if not ((drawn >= low) & (drawn <= 1)).all():
                raise ValueError(f"{name} draws numbers outside [{low:g}, 1]")

    @cached_property
    def eigenmodes(self) -> Modes:
        """Modes that are excited."""
        if self.modes is None:
            return eigenmodes(self.linear, self.n_modes)
        last = self.problem.pattern.size // 3 - 1
        if self.modes[-1] > last:
            raise ValueError(f"modes = {list(self.modes)} must lie between 0 and {last}")
        values, vectors = eigenmodes(self.linear, self.modes[-1] + 1)
        chosen = list(self.modes)
        return Modes(values[chosen], vectors[..., chosen].contiguous())

    @cached_property
    def q_max(self) -> Tensor:
        """Largest modal loads, (M,) [-]."""
        values, vectors = self.eigenmodes
        softest = self.deflection * values[0] / vectors[..., 0].norm(dim=1).max()
        return softest * (values / values[0]) ** self.eigenvalue_exponent

    @cached_property
    def modal_forces(self) -> Tensor:
        """Mode times its largest modal load, zero on degrees of freedom without load, (N, D, M)."""
        return torch.where(self.loadable_dofs[..., None], self.eigenmodes.vectors, 0.0) * self.q_max

    @property
    def largest_force(self) -> float:
        """||Phi q_max|| [-], the scale of residuals in the losses of the paper."""
        return float(self.q_max.norm())

    @property
    def n_force(self) -> int:
        """M + 3: modal loads, then centre, radius and amplitude."""
        return len(self.q_max) + 3

    def force_at(self, point: Array) -> Tensor:
        centre, radius, amplitude = point[-3:]
        q = self.q_max * torch.from_numpy(self.distribution(point[:-3]))
        q = float(self.amplitude(np.asarray(amplitude))) * q
        points = self.problem.points
        centres = points[self.loadable_dofs.any(dim=1)]
        low, high = self.patch_radius
        largest = low + (high - low) * float(self.radius(np.asarray(radius)))
        distance = (points - centres[int(centre * len(centres))]).norm(dim=1)
        inside = distance <= largest * (1 + 1e-9)
        return torch.where(inside[:, None] & self.loadable_dofs, self.eigenmodes.vectors @ q, 0.0)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes (B,) and relative residuals (B,) of a least-squares fit of Phi q.

        The fit is over the nodes on which a force acts, so that the loaded area need not be a ball.
        The amplitude is max |q / q_max|: above 1 the force is larger than any load of this family,
        or, if `distribution` or `amplitude` leave out a part of [-1, 1], lies outside its range.
        The residual ||f - Phi q|| / ||f|| is 0 for loads of this family.
        """
        shapes, span = self.modal_forces.numpy(), self._span
        return project(shapes, self.own_force(force), span, lambda q: amplitudes(q, *span, 1.0))

    @cached_property
    def _span(self) -> tuple[float, float]:
        """Smallest and largest q / q_max that can be drawn."""
        q, factor = self.distribution(TESTED), self.amplitude(TESTED)
        ends = [float(a * b) for a in (q.min(), q.max()) for b in (factor.min(), factor.max())]
        return min(ends), max(ends)

    def identity(self) -> dict[str, Any]:
        """Return the options that decide the loads: `modes` if they are given, else `n_modes`."""
        unused = "modes" if self.modes is None else "n_modes"
        return {name: value for name, value in super().identity().items() if name != unused}

    def skipped_work(self) -> list[str]:
        """Return a note where a cluster of eigenvalues adds modes."""
        count = len(self.eigenmodes.values)
        if self.modes is not None or count == self.n_modes:
            return []
        return [f"{count} modes instead of {self.n_modes}: a cluster of eigenvalues is kept whole"]


def eigenmodes(linear: LinearSolver, count: int) -> Modes:
    """Return the lowest modes, those of the last family all: `count` or a few more.

    Shift-invert Lanczos around zero with the stored factor of K(0). The same problem gives the
    same vectors: within an eigenspace the basis is the one that leans on the fields 1, x, y, z,
    x^2, ... in turn, with positive sign.

    Args:
        linear: The body, held, with the factor of its K(0).
        count: How many modes at least.

    Raises:
        ValueError: `count` is not between 1 and a third of the degrees of freedom, or the body is
            free to move.
        SingularMatrix: The moduli are so far apart that rounding leaves no mode.
    """
    linear = linear.reference
    problem = linear.problem
    size = problem.pattern.size
    if not 1 <= count <= size // 3:
        raise ValueError(f"n_modes = {count} must lie between 1 and {size // 3}")
    if loose := problem.unconstrained_rigid_body_modes():
        raise ValueError(f"{len(loose)} rigid modes are unconstrained: {', '.join(loose)}")
    stiffness = full_matrix(problem.pattern, problem.stiffness_at_rest().numpy())
    inverse = LinearOperator((size, size), matvec=linear.factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    requested = min(count + 8, size - 2)
    try:
        values, vectors = eigsh(stiffness, requested, sigma=0.0, OPinv=inverse, v0=start, tol=1e-12)
    except ArpackError as error:
        raise SingularMatrix("its modes cannot be found") from error
    order = np.argsort(values)
    values, vectors = values[order], vectors[:, order]
    while count < requested and values[count] - values[count - 1] < CLUSTER * values[count]:
        count += 1
    probes = _probes(problem)
    cuts = np.flatnonzero(np.diff(values) > SAME * values[1:]) + 1
    for low, high in pairwise([0, *cuts.tolist(), len(values)]):
        vectors[:, low:high] = _leaning(vectors[:, low:high], probes)
    fields = torch.stack([problem.extend(vector) for vector in vectors[:, :count].T], dim=-1)
    return Modes(torch.from_numpy(values[:count]), fields)


def _probes(problem: Problem) -> Array:
    """Return fields (n, P): monomials up to degree 2 in each component, then fixed noise."""
    x = problem.points - problem.points.mean(dim=0)
    x, dim = x / x.abs().max(), x.shape[1]
    monomials = [torch.ones(len(x), dtype=torch.float64), *x.T]
    monomials += [x[:, i] * x[:, j] for i in range(dim) for j in range(i, dim)]
    axes = torch.eye(dim, dtype=torch.float64)
    fields = [problem.restrict(m[:, None] * axis) for m in monomials for axis in axes]
    noise = np.random.default_rng(1).standard_normal((len(fields[0]), 4))
    return np.column_stack([*fields, noise])


def _leaning(basis: Array, probes: Array) -> Array:
    """Return the basis of span(basis), (n, m), whose k-th vector is the k-th new probe in it."""
    sizes = np.linalg.norm(probes, axis=0)  # 0 of x^2 where all x are 0
    shadows = basis.T @ (probes / np.where(sizes > 0, sizes, 1.0))  # (m, P)
    chosen = np.zeros((len(shadows), 0))
    for shadow in shadows.T:
        rest = shadow - chosen @ (chosen.T @ shadow)
        if np.linalg.norm(rest) > 1e-4:
            rest -= chosen @ (chosen.T @ rest)
            chosen = np.column_stack([chosen, rest / np.linalg.norm(rest)])
        if chosen.shape[1] == len(shadows):
            break
    return basis @ chosen
