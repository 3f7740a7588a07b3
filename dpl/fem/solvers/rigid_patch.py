"""A patch of the boundary that a gripper holds: its rigid motion, its compliance, the held body."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.interface import Array, Factor
from dpl.fem.mesh.regions import Region, nodes_in
from dpl.fem.problem import Evaluation, Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.newton import Newton

RTOL = 1e-6  # relative residual of the linear solutions that give the compliance [-]
FACING = 0.966  # smallest cosine, of 15 degrees, between a facet's normal and the axis it faces [-]


class Wrench(NamedTuple):
    """Force (D,) [-] of a gripper, and moment (3,), in 2D (1,) [-], about the displaced centre."""

    force: Tensor
    moment: Tensor


@dataclass(frozen=True, eq=False)
class RigidPatch:
    """Nodes of the boundary that move together as a rigid body, in all directions or in some.

    Attributes:
        linear: Linear solver of the body without the gripper.
        held: Degrees of freedom whose displacement is prescribed, (N, D), boolean.
    """

    linear: LinearSolver
    held: Tensor

    @classmethod
    def of(
        cls,
        linear: LinearSolver,
        region: Region | NDArray[np.bool_],
        directions: Sequence[bool],
        *,
        sliding: bool = False,
    ) -> Self:
        """Return the patch of the nodes of the boundary in a region.

        Args:
            linear: Linear solver of the body.
            region: The region, in the coordinates of the mesh, or a mask of nodes (N,).
            directions: Directions that the gripper holds, (D,); the patch slides along the others.
            sliding: Hold the largest flat part of the patch along its normal alone, see
                `flat_part`.

        Raises:
            ValueError: The region has no free node of the boundary, no direction is held, or a
                sliding patch has no flat part.
        """
        problem, inside = linear.problem, region
        if not isinstance(inside, np.ndarray):
            inside = nodes_in(inside, problem.basis, problem.length, problem.origin)
        elif inside.dtype != bool or inside.shape != problem.shape[:1]:
            raise ValueError(
                f"region: an array of {inside.dtype}, {inside.shape}, must be a mask of bool, "
                f"({problem.shape[0]},)"
            )
        nodes, held_axes = torch.from_numpy(inside) & problem.boundary, list(directions)
        if sliding:
            nodes, axis = flat_part(problem, nodes)
            held_axes = [held and i == axis for i, held in enumerate(directions)]
        if not any(held_axes):
            raise ValueError("translation: the gripper must hold the patch in a direction")
        held = nodes[:, None] & torch.tensor(held_axes) & problem.free
        if not held.any():
            raise ValueError("region: no node of the boundary in it is free to move")
        return cls(linear, held)

    @property
    def problem(self) -> Problem:
        """The body without the gripper."""
        return self.linear.problem

    @cached_property
    def nodes(self) -> Tensor:
        """Mask of the held nodes, (N,)."""
        return self.held.any(dim=1)

    def displacement(self, translation: Sequence[float], rotation: Sequence[float]) -> Tensor:
        """Return the displacement of the held degrees of freedom, (m,) [-].

        The translation (D,) [-] is that of the mean of the held nodes. The rotation vector about it
        is (3,), in 2D the angle, (1,) [rad].
        """
        points = self.problem.points[self.nodes]
        arms = points - points.mean(dim=0)
        dim = points.shape[1]
        vector = rotation if dim == 3 else [0.0, 0.0, *rotation]
        quaternion = torch.from_numpy(Rotation.from_rotvec(vector).as_quat())
        axis, cosine = quaternion[None, :3], quaternion[3]
        arms = pad(arms, (0, 3 - dim))
        # (R - I) r without the rounding of R, which exceeds a small rotation
        across = torch.linalg.cross(axis, arms)
        turned = 2 * (cosine * across + torch.linalg.cross(axis, across))
        moved = turned[:, :dim] + torch.tensor(translation, dtype=torch.float64)
        return moved[self.held[self.nodes]]

    def at(self, values: Tensor) -> Tensor:
        """Return the nodal field, (N, D), with values (m,) at held degrees of freedom, else 0."""
        field = torch.zeros(self.held.numel(), dtype=torch.float64)
        return field.index_copy(0, self._dofs, values).view(self.held.shape)

    def of_field(self, field: Tensor) -> Tensor:
        """Return the values, (m,), of a nodal field (N, D) at held degrees of freedom."""
        return field.reshape(-1)[self._dofs]

    @cached_property
    def _dofs(self) -> Tensor:
        """Numbers of the held degrees of freedom, (m,); a mask takes longer."""
        return self.held.flatten().nonzero()[:, 0]

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """Numbers of the held ones among the free degrees of freedom, (m,)."""
        return np.flatnonzero(self.held[self.problem.free].numpy())

    @property
    def missing_rows(self) -> int:
        """Number of rows of the compliance that are not computed."""
        return len(self.places) - sum(map(len, self._rows))

    def prepare(self, *, one: bool = False) -> None:
        """Compute the rows of the compliance that are left, or the next one."""
        places = self.places[len(self.places) - self.missing_rows :][: 1 if one else None]
        right = np.zeros((len(places), self.problem.pattern.size))
        right[np.arange(len(places)), places] = 1.0
        factor = self.linear.float32_factor  # a block of one row takes longer than one solve
        rows = factor.solve(right[0], RTOL)[None] if one else factor.solve_many(right, RTOL)
        self._rows.append(torch.from_numpy(rows[:, self.places]))

    @cached_property
    def _rows(self) -> list[Tensor]:
        """Rows of the compliance that are computed, (k, m) each."""
        return []

    @cached_property
    def compliance_factor(self) -> Tensor:
        """Cholesky factor of the linear displacements of the patch by forces on it, (m, m)."""
        if self.missing_rows:
            self.prepare()
        compliance = torch.cat(self._rows)
        return torch.linalg.cholesky((compliance + compliance.mT) / 2)

    def stiffness_times(self, displacement: Tensor) -> Tensor:
        """Return the forces, (m,), whose linear solution displaces the patch by (m,) [-]."""
        return torch.cholesky_solve(displacement[:, None], self.compliance_factor)[:, 0]

    def newton(self, corrector: Newton, displacement: Tensor) -> Newton:
        """Return Newton's method for the body with the patch displaced by (m,) [-].

        The options are those of the corrector, Newton's method of the body. The preconditioner of
        the held body is computed once.
        """
        held = self._held_linear
        body = replace(held.problem, prescribed=self.problem.prescribed + self.at(displacement))
        linear = replace(held, problem=body, parent=held)  # shares the preconditioner
        return replace(corrector, problem=body, linear_solver=linear)

    @cached_property
    def _held_linear(self) -> LinearSolver:
        """Linear solver of the body with the patch held at rest."""
        parts = {each.name: getattr(self.problem, each.name) for each in fields(Problem)}
        parts |= {"free": self.problem.free & ~self.held, "discretisation": None}
        body = _HeldProblem(**parts, whole=self.problem)
        iterates = self.linear.float32_factor.negative_pivots is None
        factor = None if iterates else _HeldFactor(self)
        return LinearSolver(body, self.linear.tol, self.linear.linear, approximate=factor)

    def moved(self, displacement: Tensor, goal: Tensor) -> Tensor:
        """Return a displacement (N, D) whose patch is at a goal (m,), from one near it [-].

        The difference is a linear displacement in the rotated frames of the nodes.
        """
        problem, dim = self.problem, displacement.shape[1]
        frames = self.linear.corotational.at(displacement[None]).rotations
        turns = torch.from_numpy(frames)[:, :dim, :dim]
        missing = self.at(goal - self.of_field(displacement))
        gap = (turns.mT @ missing[..., None])[..., 0]
        force = problem.restrict(self.at(self.stiffness_times(self.of_field(gap))))
        added = problem.extend(self.linear.float32_factor.solve(force))
        return displacement + (turns @ added[..., None])[..., 0]

    def wrench(self, force: Tensor, displacement: Tensor) -> Wrench:
        """Return the resultant of nodal forces (N, D) [-] on the patch at a displacement (N, D)."""
        forces = force[self.nodes]
        place = (self.problem.points + displacement)[self.nodes]
        missing = 3 - place.shape[1]
        arms, pulls = pad(place - place.mean(dim=0), (0, missing)), pad(forces, (0, missing))
        moment = torch.linalg.cross(arms, pulls).sum(dim=0)
        return Wrench(forces.sum(dim=0), moment[2:] if missing else moment)


@dataclass(frozen=True, eq=False)
class _HeldProblem(Problem):
    """A body with a held patch; its own pattern and loops are made when a tangent is needed."""

    whole: Problem = field(kw_only=True, repr=False)  # without the gripper: the same inner forces

    def evaluate(self, displacement: Tensor) -> Evaluation:
        """Return internal force and min det F, without derivatives."""
        return self.whole.evaluate(displacement)


@dataclass(frozen=True, eq=False)
class _HeldFactor(Factor):
    """K(0)^-1 of a body with a held patch, from the factor of the body without the gripper.

    A first solve moves the patch; the second one has the forces that bring it back to its place.
    """

    patch: RigidPatch  # the patch
    negative_pivots: int = 0

    def solve(self, right: Array, rtol: float = 1e-12) -> Array:
        """Return x, (n,), with K x = right, in the accuracy of float32."""
        patch, factor = self.patch, self.patch.linear.float32_factor
        held = np.zeros(len(right) + len(patch.places), dtype=bool)
        held[patch.places] = True
        force = np.zeros(len(held))
        force[~held] = right
        moved = torch.from_numpy(factor.solve(force)[held])
        force[held] = -patch.stiffness_times(moved).numpy()
        return factor.solve(force)[~held]


def flat_part(problem: Problem, nodes: Tensor) -> tuple[Tensor, int]:
    """Return the largest part of a patch that faces one way along an axis, (N,), and the axis.

    It consists of the facets whose normals are within 15 degrees of the axis: the part of the
    patch, a mask of nodes (N,), that a flat plate across the axis touches.
    """
    basis, mesh = problem.basis, problem.mesh
    corners = nodes.numpy()[basis.nodal_dofs[0]]
    facets = mesh.boundary_facets()
    facets = facets[corners[mesh.facets[:, facets]].all(axis=0)]
    areas = np.zeros((len(facets), 2 * mesh.dim()))
    if len(facets):  # scikit-fem interprets an empty set as the whole boundary
        boundary = skfem.FacetBasis(mesh, basis.elem, facets=facets)
        weighted = np.asarray(boundary.normals) * boundary.dx
        total, area = weighted.sum(axis=2).T, boundary.dx.sum(axis=1)[:, None]
        both = np.hstack([total, -total])
        areas = np.where(both >= FACING * area, area, 0.0)
    if not areas.any():
        raise ValueError(
            "sliding: no facet of the patch is within 15 degrees across x, y or z; grasp another "
            "part, or enlarge the patch"
        )
    way = int(areas.sum(axis=0).round(12).argmax())
    inside = np.zeros(len(nodes), dtype=bool)
    inside[basis.get_dofs(facets[areas[:, way] > 0]).all()] = True
    return torch.from_numpy(inside) & nodes, way % mesh.dim()
