"""Scene = body + loads + reference solver: the one object that is built once and handed on."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from dpl.fem import (
    LinearSolver,
    Load,
    LoadFamily,
    Newton,
    ParameterRange,
    Problem,
    ReferenceSolver,
    solve,
)
from dpl.fem.identity import plain, sha256_of
from dpl.fem.linear.backends import factorisation_work
from dpl.fem.solvers.solution import as_column

CORRECTOR_STREAM = 6  # stream of the loads on which the corrector is chosen
DESCRIPTION_STREAM = 7  # stream of the loads by which the load family is described
FEW = 32  # loads of this stream
CELLS = {  # scikit-fem's names of shapes and those of bodies, in the plural
    "Hexahedral": "hexahedra",
    "Tetrahedral": "tetrahedra",
    "Quadrilateral": "quadrilaterals",
    "Triangular": "triangles",
}
MAX_MEAN_STEPS = 8  # of conjugate gradients, on average, with a factor that is near the tangent
SOFTENED = 0.5  # eigenvalue over that at rest below which a load softens the body [-]
MIN_FACTORISATION_WORK = 6e7  # multiply-adds that take as long as conjugate gradients in Newton


class _Sample(NamedTuple):
    force: Tensor
    displacement: Tensor
    young: Tensor
    parameters: Tensor


class Sample(_Sample):
    """Loads with their displacements; a batch is the same with a leading B.

    Attributes:
        force: (B, N, D) [-].
        displacement: (B, N, D) [-].
        young: (B,) [Pa].
        parameters: Values of `Problem.parameter_ranges`, (B, P); may be left out if there are none.
    """

    __slots__ = ()

    def __new__(
        cls, force: Tensor, displacement: Tensor, young: Tensor, parameters: Tensor | None = None
    ) -> "Sample":
        """Take the columns; parameters may be (B,) or (B, P)."""
        return super().__new__(cls, force, displacement, young, as_column(young, parameters))

    @property
    def load(self) -> Load:
        """The loads alone."""
        return Load(self.force, self.young, self.parameters)


@dataclass(frozen=True, eq=False)
class Scene:
    """A body, its loads and the solver that computes its solutions.

    Attributes:
        problem: Body, dimensionless.
        loads: Load family.
        solver: Reference solver, which computes the solutions of data sets and comparisons.
    """

    problem: Problem
    loads: LoadFamily
    solver: ReferenceSolver

    def __post_init__(self) -> None:
        self.problem.check_residual_stress()
        if self.problem.has_one_modulus:
            for young in self.loads.moduli:
                self.problem.check_modulus(young)

    @property
    def linear(self) -> LinearSolver:
        """Linear solver with the one factor of K(0) of the scene."""
        return self.solver.linear_solver

    @cached_property
    def newton(self) -> Newton:
        """Reference solver if that is Newton's method, else Newton's method of its tolerance."""
        if isinstance(self.solver, Newton):
            return self.solver
        linear = self.linear
        return Newton(self.problem, self.solver.tol, linear=linear.linear, linear_solver=linear)

    @cached_property
    def corrector(self) -> Newton:
        """Newton's method as it continues from a prediction.

        It preconditions with the corotated factor of K(0) in place of new factors where that makes
        conjugate gradients short and a factorisation takes longer than they do.
        """
        is_dear = factorisation_work(self.problem.pattern) > MIN_FACTORISATION_WORK
        corotational = is_dear and self.is_compact
        return replace(self.newton, corotational=corotational, abandon_indefinite_guess=True)

    @cached_property
    def is_compact(self) -> bool:
        """True if the corotated factor of K(0) is near the tangents under a few random loads.

        It is on compact bodies, seldom on thin ones. The mean number of steps of conjugate
        gradients decides.
        """
        steps = [self._linear(load).count_iterations(u) for load, u in self._typical_states]
        return sum(steps) <= MAX_MEAN_STEPS * len(steps)

    @cached_property
    def is_softened(self) -> bool:
        """True if one of a few random loads lowers an eigenvalue of the tangent below `SOFTENED`.

        The eigenvalues are relative to K(0) in the rotated frames of the nodes.
        """
        states = self._typical_states
        values = (self._linear(load).smallest_ritz_value(u) for load, u in states)
        return min(values, default=1.0) < SOFTENED

    @cached_property
    def _typical_states(self) -> list[tuple[Load, Tensor]]:
        """A few random loads and their equilibria (1, N, D) [-]; none if the law is unknown."""
        if not self.problem.material.is_known:
            return []
        loads = self.loads.sample((0, CORRECTOR_STREAM), range(3)).unbatch()
        return [(load, solve(self.solver, load).displacement) for load in loads]

    def _linear(self, load: Load) -> LinearSolver:
        return self.linear.with_parameters(load.parameters)

    @property
    def length(self) -> float:
        """L, longest side of the body [m]."""
        return self.problem.length

    @property
    def force_unit(self) -> float:
        """L^(D-1) [m^2 in 3D, m in 2D]: forces are this times E times the dimensionless ones."""
        return self.length ** (self.problem.shape[1] - 1)

    def load_of(self, force: Tensor, young: Tensor, parameters: Tensor | None = None) -> Load:
        """Return nodal forces (B, N, D) [N] (2D: [N/m]) on bodies of moduli (B,) [Pa] as a load.

        On a body with an elastic foundation or with follower loads the moduli must be that of the
        body, see `Problem.check_modulus`, which this function does not call. Parameters are values
        of `Problem.parameter_ranges`, (B,) or (B, P), if there are any.
        """
        dimensionless = force.double() / (young.double()[:, None, None] * self.force_unit)
        parameters = None if parameters is None else parameters.double()
        return Load(dimensionless, young.double(), parameters)

    def si_inputs(self, load: Load) -> dict[str, Tensor]:
        """Return the arguments of `load_of` that give a load, by name."""
        inputs = {
            "force": load.force * (load.young * self.force_unit)[:, None, None],
            "young": load.young,
        }
        return inputs | ({"parameters": load.parameters} if load.parameters.shape[1] else {})

    def identity(self) -> dict[str, object]:
        """Return everything that decides a sample, as plain data; arrays as their SHA-256.

        Sizes and Young's moduli are absent: u/L depends on f/(E L^2) alone. Coordinates count to
        1e-9 L. Real parameters are floats, so that 1 and 1.0 make one scene.
        """
        problem, points = self.problem, self.problem.points.numpy()
        # Not rounded: the halves among dyadic coordinates would flip with the last bit.
        lattice = np.floor((points - points.min(axis=0)) * 1e9 + 0.3).astype(np.int64)
        loads = problem.follower_loads.identity()
        functions = problem.volume_functions
        units = {*problem.follower_loads.units.values()}  # parameters of samples are in SI units
        if units:
            loads["young"] = problem.young
        if units - {"Pa"}:
            loads["length"] = problem.length
        return {
            "points": sha256_of(lattice),
            "cells": plain(problem.cells),
            "free": plain(problem.free),
            "degree": problem.degree,
            "mean_dilatation": functions is not None and {"functions": functions.shape[-1]},
            "prescribed": plain(problem.prescribed),
            "springs": plain(problem.springs or ()),
            "law": problem.material.identity(),
            "loads": self.loads.identity(),
            "solver": self.solver.identity(),
            **loads,
        }

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of `identity`, in hexadecimal."""
        return hashlib.sha256(json.dumps(self.identity(), sort_keys=True).encode()).hexdigest()

    def matches(self, identity: Any) -> bool:
        """Return True if a stored identity equals that of this scene, both as read from JSON."""
        return bool(_plain(identity) == _plain(self.identity()))

    def differences(self, identity: Any) -> list[str]:
        """Return the differences of a stored identity, a line each; entries it lacks are equal."""
        return _differences(_plain(identity), _plain(self.identity()))

    def describe(self) -> list[tuple[str, str]]:
        """Return names and values of the body, its supports, its law and its loads."""
        problem, loads, law = self.problem, self.loads, self.problem.material
        sides = (problem.points.amax(dim=0) - problem.points.amin(dim=0)) * self.length
        cells = CELLS[problem.mesh.elem.refdom.name]
        fixed = int((~problem.free).any(dim=1).sum())
        moved = "moved" if problem.moved_supports else "fixed"
        springs = "" if problem.springs is None else ", an elastic foundation"
        for part in problem.follower_loads.parts:
            springs += f", {part.describe()}"
        for name, unit in problem.follower_loads.units.items():
            low, high = problem.follower_loads.ranges[name]
            springs += f", {name} from {low:.4g} to {high:.4g} {unit}"
        # constants of the law in the centre of their ranges; magnitudes of nodal forces are added
        load = loads.sample((0, DESCRIPTION_STREAM), range(FEW))
        force = load.force.norm(dim=2).sum(dim=1) * load.young * self.force_unit
        largest, unit, bends = float(force.max()), "N" if problem.shape[1] == 3 else "N/m", ""
        if not problem.moved_supports:
            u = self.linear.reference.solve(load.force[int(force.argmax())])
            deflection = self.length * u.norm(dim=1).max()
            bends = f", linear deflection {float(deflection):.3g} m"
        return [
            (
                "body",
                f"{' x '.join(f'{side:.4g}' for side in sides.tolist())} m, "
                f"{problem.shape[0]:,} nodes, {len(problem.cells):,} {cells}, "
                f"{problem.points.numel():,} degrees of freedom",
            ),
            ("supports", f"{fixed:,} nodes {moved}{springs}"),
            ("law", f"{law.describe()}, {law.describe_rest(loads.moduli)}{_scale(loads.moduli)}"),
            ("loads", f"{type(loads).__name__}; the largest of {FEW}: {largest:.3g} {unit}{bends}"),
        ]

    def skipped_work(self) -> list[str]:
        """Return one line for each computation that this scene does not need."""
        problem, loads = self.problem, self.loads
        cells, points = len(problem.cells), problem.dV.shape[1]
        low, high = loads.moduli
        young = f"E = {low:.4g} Pa"
        if low != high:
            young = f"E from {low:.4g} to {high:.4g} Pa{_scale(loads.moduli)}"
        lines = [f"no E input, no samples per E: u/L depends on f/(E L^2) only ({young})"]
        for name, ends in problem.material.parameter_ranges.items():
            lines.append(
                f"one set of modes and scales for {name} = {ends[0]:.4g} to {ends[1]:.4g}, those "
                f"of {ends.middle:.4g}; each load has its own, an input, and a K(0) of its own"
            )
        if problem.follower_loads.ranges:
            names = ", ".join(problem.follower_loads.ranges)
            lines.append(f"one K(0) for all values of {names}: it is that without follower loads")
        if problem.springs is None:
            lines.append("no springs, nothing of theirs assembled")
        if problem.discretisation.equal_cells:
            lines.append(f"one set of shape gradients for {cells} equal cells")
        if points == 1:
            lines.append(f"one quadrature point for each of {cells} cells: gradients are constant")
        lines.append(
            f"{len(problem.pattern.indices):,} tangent entries of "
            f"{2 * len(problem.pattern.indices) - problem.pattern.size:,}: "
            "symmetric, pattern and ordering analysed once"
        )
        if not problem.material.parameter_ranges:
            lines.append(
                "K(0) factorised once for modes, linear solutions and every first Newton step"
            )
        lines.append("no factorisation for loads whose linear solution meets the tolerance")
        return lines + loads.skipped_work()


def _scale(moduli: ParameterRange) -> str:
    return ", uniform in log E" if moduli.is_log else ""


def _plain(identity: Any) -> Any:
    """Return an identity as it is read from a file: lists for tuples."""
    return json.loads(json.dumps(identity))


def _differences(theirs: Any, ours: Mapping[str, Any], path: str = "") -> list[str]:
    lines = []
    for key, a in theirs.items() if isinstance(theirs, Mapping) else ():
        place, b = f"{path}{key}", ours.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += _differences(a, b, f"{place}.")
        elif plain(a) != b and a != b:
            digest = isinstance(a, str) and len(a) == 64
            lines.append(f"{place}: " + ("differ" if digest else f"{a} there, {b} here"))
    return lines
