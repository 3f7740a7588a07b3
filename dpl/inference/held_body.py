"""A body whose patch a gripper holds: predicted forces, correction, equilibrium and errors."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from dpl.fem import (
    AndersonSolver,
    Load,
    Newton,
    RigidPatch,
    Solution,
    estimate_error,
    evaluate_solution,
)
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.inference.hybrid import Hybrid
from dpl.inference.request import Candidate, Request

MOTION_TOL = 1e-3  # largest error of a motion that is accepted, over its size [-]
MAX_ITER = 16  # predictions for a motion
MEMORY = 8  # iterations from which Anderson's method extrapolates
CORRECTED = 3e-4  # estimated error of a displacement below which its correction ends [-]
LEAST_RATE = 0.3  # smallest contraction of errors that this estimate assumes [-]
CONTRACTION = 0.5  # ratio of residuals below which a correction contracts [-]


@dataclass(frozen=True, eq=False)
class HeldBody:
    """A body whose patch is held at its goal."""

    patch: RigidPatch
    goal: Tensor  # displacement of the patch, (m,) [-]
    turns: Tensor  # rotations of its parts there, (P, D, D)
    load: Load  # other forces on the body, B = 1, without parameters of the law
    newton: Newton  # with the patch as a moved support

    def at_rest(self) -> Candidate:
        """Return the body at rest, without a force of the gripper."""
        problem, tol = self.patch.problem, self.newton.tol
        state = evaluate_solution(problem, problem.prescribed[None], self.load, tol)
        missed = float(self.patch.at(self.goal).norm(dim=1).max())
        return Candidate("rest", state, math.inf, motion_error=missed, force=0 * self.goal)

    def predicted_forces(
        self,
        predict: Callable[[Tensor], Tensor],
        start: Tensor,
        *,
        scale: float,
        tol: float,
        max_iter: int,
        is_over: Callable[[], bool],
    ) -> tuple[Tensor, Tensor, int, bool]:
        """Return forces of the gripper under which the predicted patch is displaced to the goal.

        `predict` gives a displacement (N, D) [-] under forces of the gripper (N, D) [-]. The
        result is the forces, (m,) [-], the displacement, (N, D) [-], the number of predictions (at
        least one), and whether the gap between the predicted patch and the goal is below `tol`
        times the prescribed motion or `scale`, that without the gripper, whichever is larger.

        The forces are unknowns at all held degrees of freedom. Each iteration adds the forces that
        close the gap between predicted and prescribed displacement in the linear body; Anderson's
        method extrapolates. The prediction with the smallest gap is the result.

        Forces keep their direction while the body moves. An equilibrium that is stable only as long
        as the gripper holds the patch, such as a column that it shortens beyond buckling, is not
        found.

        Source: Anderson (1965), J. ACM 12; Walker, Ni (2011), SIAM J. Numer. Anal. 49 (as a least
        squares problem of differences).
        """
        patch = self.patch
        size = max(scale, float(self.goal.abs().max()))
        energy = patch.compliance_factor.mT  # |L^T f| is the energy norm of forces
        best, nearest = (torch.zeros_like(start), torch.zeros_like(patch.problem.points)), math.inf
        forces: list[Tensor] = []
        steps: list[Tensor] = []
        force = start
        for count in range(1, max_iter + 1):  # noqa: B007  # the number is returned
            field = predict(patch.at(force))
            gap = self.goal - patch.of_field(field)
            largest = float(gap.abs().max())
            found = largest <= tol * size
            if found or largest < nearest:
                best, nearest = (force, field), largest
            if found or not math.isfinite(largest) or is_over():
                break
            forces = [*forces[-MEMORY:], force]
            steps = [*steps[-MEMORY:], patch.stiffness_times(gap)]
            force = force + steps[-1]
            if len(steps) > 1:
                changes = torch.stack(steps).diff(dim=0).mT
                moves = torch.stack(forces).diff(dim=0).mT
                mix = torch.linalg.lstsq(energy @ changes, energy @ steps[-1][:, None]).solution
                force = force - ((moves + changes) @ mix)[:, 0]
        return *best, count, found

    def with_errors(self, candidate: Candidate, request: Request) -> Candidate:
        """Return a candidate with the forces of the gripper and its errors, estimated if in time.

        A correction that has contracted to `CORRECTED` has its own estimate, see `corrected`.
        """
        patch, state, u = self.patch, candidate.state, candidate.state.displacement
        force = candidate.force
        if force is None:
            force = patch.of_field(state.internal[0] - self.load.force[0])
        missed = float(patch.at(self.goal - patch.of_field(u[0])).norm(dim=1).max())
        candidate = candidate._replace(force=force, motion_error=missed)
        if candidate.known_error < CORRECTED or request.over("errors"):
            return candidate
        with request.durations.timed("errors"):
            found = estimate_error(self.newton.linear_solver, self.load, u, state.evaluation)
        largest = max(float(u.norm(dim=2).max()), 1e-300)
        return candidate._replace(
            state=state.unstable() if found.is_indefinite else state,
            error=found.error + missed / largest,
        )

    def moved(self, field: Tensor, frames: CorotatedFactor | None = None) -> Tensor:
        """Return a displacement (N, D) [-], in the frames of its nodes, with the patch at goal."""
        frames = frames or self.patch.linear.corotational.at(field[None])
        return self.patch.moved(field, self.goal, frames)

    def wrench_errors(
        self, candidate: Candidate, frames: CorotatedFactor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the estimated relative errors of forces and moments of the parts, (P,) each [-].

        The estimates compare them with the forces that balance the stresses, plus the work of the
        residual by unit motions of the parts, plus the linear forces that move the patch to its
        goal. The work is the reaction of the correction that the residual causes (Betti).
        """
        patch, u = self.patch, candidate.state.displacement[0]
        assert candidate.force is not None
        if frames is None or not candidate.known_error < math.inf:
            unknown = torch.full((len(patch.parts),), math.inf, dtype=torch.float64)
            return unknown, unknown
        balance = candidate.state.internal[0] - self.load.force[0]
        reaction = patch.of_field(balance)
        if candidate.motion_error:
            reaction = reaction + patch.stiffness_times(self.goal - patch.of_field(u))
        rest = self.newton.problem.acting(balance)
        change = patch.work(rest, frames, self.turns)
        found, balanced = (patch.wrench(patch.at(f), u) for f in (candidate.force, reaction))
        errors = []
        for own, expected, added in zip(found, balanced, change, strict=True):
            size = own.norm(dim=1).clamp(min=1e-300)
            error = (expected + added - own).norm(dim=1) / size
            errors.append(error.nan_to_num(math.inf, math.inf))
        return errors[0], errors[1]

    def corrected(
        self, guess: Tensor, steps: int, request: Request, carried: float = 0.0
    ) -> Candidate | None:
        """Return the iterate of least residual from a guess (N, D); None if that is inverted.

        Iterations with the corotated factor of K(0) end with the budget, or when the error is below
        `CORRECTED`: the last change times the ratio of the residuals after and before it, if this
        ratio is below `CONTRACTION`. Soft errors contract more slowly than residuals, so that the
        ratio counts as at least `LEAST_RATE`. The first iteration may leave them as they are: the
        error of the state from which the patch was moved to the guess, `carried`, is added.
        """
        valid: list[Solution] = []
        error = math.inf
        iterates = AndersonSolver(self.newton, max_iter=steps).iterate(self.load, guess=guess[None])
        with request.durations.timed("guess"):  # takes less than a step
            first = next(iterates)
        for state in chain([first], request.durations.each("step", iterates)):
            if not bool(state.volume_ratio > 0):
                break
            valid.append(state)
            if len(valid) > 1:
                before, u = valid[-2], state.displacement
                ratio = float(state.residual / before.residual)
                change = float((u - before.displacement).norm() / u.norm())
                error = change * (max(ratio, LEAST_RATE) if ratio < CONTRACTION else 1.0)
                error += carried if len(valid) == 2 else 0.0
                if ratio < CONTRACTION and error < CORRECTED:
                    break
            if len(valid) <= steps and request.over("step"):
                break
        best = min(valid, key=lambda one: float(one.residual), default=None)
        return None if best is None else Candidate("corrected", best, error)

    def equilibrium(self, start: Candidate, request: Request) -> Candidate:
        """Return the equilibrium by Newton's method from a candidate, else from rest.

        The budget ends it at the last state.
        """
        hybrid = Hybrid(lambda load: start.state.displacement, self.newton)
        for last in request.durations.each("Newton", hybrid.iterate(self.load)):
            if not last.converged and request.over("Newton", "errors"):
                break
        method = "hybrid" if bool(last.from_guess) else "full Newton"
        found = Candidate(method, last, forces_found=start.forces_found)
        return self.with_errors(found, request)
