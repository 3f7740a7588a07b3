"""Patches of the boundary that grippers hold: rigid motions, compliance, the held body."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import chain
from typing import NamedTuple, Self

import numpy as np
import skfem
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.interface import Array, Factor
from dpl.fem.mesh.regions import Region, nodes_in
from dpl.fem.problem import Evaluation, Problem
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.newton import Newton

RTOL = 1e-6  # relative residual of the linear solutions that give the compliance [-]
RIGID = 0.1  # part of a displacement of the patch that is no rigid motion and is neglected [-]
FACING = 0.966  # smallest cosine, of 15 degrees, between a facet's normal and the axis it faces [-]
UNITS = torch.eye(3, dtype=torch.float64)
CROSS = torch.linalg.cross(UNITS[:, None], UNITS[None])  # x @ CROSS[k] is the product e_k x x


class Wrench(NamedTuple):
    """Forces (P, D) [-], and moments (P, 3), in 2D (P, 1) [-], about the displaced centres."""

    force: Tensor
    moment: Tensor


@dataclass(frozen=True, eq=False)
class RigidPatch:
    """Nodes of the boundary that move as P rigid bodies, in all directions or in some.

    Attributes:
        linear: Linear solver of the body without grippers.
        held: Degrees of freedom whose displacement is prescribed, (N, D), boolean.
        parts: Masks of the nodes of each rigid body, (P, N).
    """

    linear: LinearSolver
    held: Tensor
    parts: Tensor

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
        return cls(linear, held, held.any(dim=1)[None])

    @classmethod
    def union(cls, patches: Sequence[Self]) -> Self:
        """Return several patches of one body as one, whose parts have their own motions.

        Raises:
            ValueError: Two patches have a node in common.
        """
        if len(patches) == 1:
            return patches[0]
        parts = torch.cat([patch.parts for patch in patches])
        if (parts.sum(dim=0) > 1).any():
            raise ValueError("region: two patches have a node in common; grasp them apart")
        held = torch.stack([patch.held for patch in patches]).any(dim=0)
        return cls(patches[0].linear, held, parts)

    @property
    def problem(self) -> Problem:
        """The body without the gripper."""
        return self.linear.problem

    @cached_property
    def nodes(self) -> Tensor:
        """Mask of the held nodes, (N,)."""
        return self.held.any(dim=1)

    def displacement(self, translation: ArrayLike, rotation: ArrayLike) -> Tensor:
        """Return the displacement of the held degrees of freedom, (m,) [-].

        The translations (P, D) [-] are those of the means of the held nodes. The rotation vectors
        about them are (P, 3), in 2D the angles, (P, 1) [rad]. One part may leave out P.
        """
        dim = self.held.shape[1]
        translations = torch.as_tensor(translation, dtype=torch.float64).reshape(-1, dim)
        gradients = rotation_gradients(torch.as_tensor(rotation, dtype=torch.float64), dim)
        field = torch.zeros(self.held.shape, dtype=torch.float64)
        for nodes, moved, gradient in zip(self._numbers, translations, gradients, strict=True):
            field[nodes] = arms_of(self.problem.points[nodes]) @ gradient.mT + moved
        return self.of_field(field)

    @cached_property
    def _numbers(self) -> list[Tensor]:
        """Numbers of the nodes of each part, (k,)."""
        return [part.nonzero()[:, 0] for part in self.parts]

    @cached_property
    def rigid_motions(self) -> Tensor:
        """Displacements (m, P R) by unit translations and rotations of the parts, one by one."""
        dim, columns = self.held.shape[1], []
        for nodes in self._numbers:
            arms = arms_of(self.problem.points[nodes])
            turned = [arms @ product[:dim, :dim] for product in CROSS[0 if dim == 3 else 2 :]]
            for one in (*torch.eye(dim, dtype=torch.float64), *turned):
                field = torch.zeros(self.held.shape, dtype=torch.float64)
                field[nodes] = one
                columns.append(self.of_field(field))
        return torch.stack(columns, dim=1)

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

    @cached_property
    def preparation(self) -> Iterator[None]:
        """Short steps that compute all that motions need; a second loop continues the first."""
        return chain(self._compliance_steps, self._field_steps())

    @property
    def is_prepared(self) -> bool:
        """True if the steps of the preparation are made."""
        return len(self._fields) == self.rigid_motions.shape[1]

    @cached_property
    def _compliance_steps(self) -> Iterator[None]:
        """Steps that compute the compliance."""
        size = len(self.problem.discretisation.free_numbers)
        factor = self.linear.float32_factor
        return factor.compliance_steps(self.places, self._compliance, size, RTOL)

    @cached_property
    def _compliance(self) -> Array:
        """Linear displacements of the patch by unit forces on it, (m, m), once computed."""
        return np.zeros((len(self.places),) * 2)

    @cached_property
    def compliance_factor(self) -> Tensor:
        """Cholesky factor of the linear displacements of the patch by forces on it, (m, m)."""
        for _ in self._compliance_steps:
            pass
        compliance = torch.from_numpy(self._compliance)
        return torch.linalg.cholesky((compliance + compliance.mT) / 2)

    def _field_steps(self) -> Iterator[None]:
        """Compute the rigid fields one by one."""
        problem, factor = self.problem, self.linear.float32_factor
        for force in torch.cholesky_solve(self.rigid_motions, self.compliance_factor).T:
            self._fields.append(factor.solve(problem.restrict(self.at(force))))
            yield

    @cached_property
    def _fields(self) -> list[Array]:
        """The rigid fields that are computed, (n,) each."""
        return []

    @cached_property
    def rigid_fields(self) -> Array:
        """Linear displacements of the body by `rigid_motions`, (P R, n)."""
        for _ in self.preparation:
            pass
        return np.stack(self._fields)

    @cached_property
    def _stiffness(self) -> Tensor:
        """Forces on the linear body at rest by `rigid_motions`, in the same order, (P R, P R)."""
        motions = self.rigid_motions
        matrix = motions.mT @ torch.cholesky_solve(motions, self.compliance_factor)
        return (matrix + matrix.mT) / 2

    def stiffness(self, turns: Tensor) -> Tensor:
        """Return forces and moments by translations and rotations of the parts, (P R, P R) [-].

        They are those of the linear body, turned with the patch: each part by its rotation, (P, D,
        D). The matrix is symmetric.
        """
        about = turns if turns.shape[1] == 3 else turns.new_ones(len(turns), 1, 1)
        pairs = zip(turns, about, strict=True)
        frame = torch.block_diag(*(matrix for pair in pairs for matrix in pair))
        return frame @ self._stiffness @ frame.mT

    def work(self, force: Tensor, frames: CorotatedFactor, turns: Tensor) -> Wrench:
        """Return the work of nodal forces (N, D) [-] by unit motions of the parts.

        The fields are `rigid_fields` in rotated frames of the nodes, and the motions those of parts
        that are turned, (P, D, D).
        """
        dim = force.shape[1]
        works = self.rigid_fields @ frames.local(self.problem.restrict(force))
        along, about = torch.from_numpy(works.reshape(len(turns), -1, 1)).split(dim, dim=1)
        about = turns @ about if dim == 3 else about
        return Wrench((turns @ along)[..., 0], about[..., 0])

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

    def moved(self, displacement: Tensor, goal: Tensor, frames: CorotatedFactor) -> Tensor:
        """Return a displacement (N, D) whose patch is at a goal (m,), from one near it [-].

        The difference is a linear displacement in rotated frames of the nodes. It is a sum of
        `rigid_fields` if the parts move by rigid motions, up to `RIGID` of the distance: a support
        that jumps by the rest is at the goal, and the next correction removes its stresses.
        """
        problem = self.problem
        missing = problem.restrict(self.at(goal - self.of_field(displacement)))
        gap = torch.from_numpy(frames.local(missing)[self.places])
        motions = self._motions_of @ gap
        rest = gap - self.rigid_motions @ motions
        if float(rest.abs().max()) <= RIGID * float(gap.abs().max()):
            moved = displacement + problem.extend(
                frames.turned(motions.numpy() @ self.rigid_fields)
            )
            return moved + self.at(goal - self.of_field(moved))
        force = problem.restrict(self.at(self.stiffness_times(gap)))
        added = frames.turned(self.linear.float32_factor.solve(force))
        return displacement + problem.extend(added)

    @cached_property
    def _motions_of(self) -> Tensor:
        """Least-squares motions by displacements of the patch, (P R, m)."""
        return torch.linalg.pinv(self.rigid_motions)

    def wrench(self, force: Tensor, displacement: Tensor) -> Wrench:
        """Return the resultants of forces (N, D) [-] on the parts at a displacement (N, D) [-]."""
        resultants, moments = [], []
        i, j = ([1, 2, 0], [2, 0, 1]) if force.shape[1] == 3 else ([0], [1])
        for part in self._numbers:
            own, arms = force[part], arms_of(self.problem.points[part] + displacement[part])
            products = arms.mT @ own
            resultants.append(own.sum(dim=0))
            moments.append(products[i, j] - products[j, i])
        return Wrench(torch.stack(resultants), torch.stack(moments))


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


def rotation_gradients(vectors: Tensor, dim: int) -> Tensor:
    """Return R - I, (P, D, D), of rotations R by vectors (P, 3), in 2D by angles (P, 1) [rad].

    The rounding of R itself would exceed a small rotation. With the unit quaternion (q, c) and the
    matrix Q of the product with q, R - I = 2 (c Q + Q Q).
    """
    vectors = vectors.reshape(-1, 3 if dim == 3 else 1)
    half = 0.5 * vectors.norm(dim=1)[:, None, None]
    Q = torch.tensordot(pad(vectors, (3 - vectors.shape[1], 0)), CROSS, dims=1).mT
    Q = 0.5 * torch.sinc(half / math.pi) * Q
    return (2 * (half.cos() * Q + Q @ Q))[:, :dim, :dim]


def arms_of(points: Tensor) -> Tensor:
    """Return points (k, D) relative to their mean."""
    return points - points.mean(dim=0)


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
