"""Grasps: the displacement of a patch is prescribed, its forces are found through a network."""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from numpy.typing import ArrayLike
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
from dpl.inference.answer import UNRELIABLE, relative, summarise
from dpl.inference.arguments import as_load, as_numbers
from dpl.inference.grasp_forces import Forces, predicted_forces
from dpl.inference.hybrid import Hybrid
from dpl.inference.request import Candidate, Request
from dpl.inference.training_range import RangeCheck
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

CORRECTED = 3e-4  # change of a displacement below which its correction ends, over its norm [-]
MAX_PATCHES = 2  # patches whose compliance and held body are kept
LARGEST_MOTION = 1e6  # largest translation over L [-] and rotation [rad]
LEAST_MOTION = 1e-280  # smaller ones count as zero: their residuals cannot be computed


@dataclass(frozen=True)
class GraspAnswer:
    """Displacement of a body with a grasped patch, and the forces of the gripper.

    Attributes:
        displacement: (N, D) [m], a NumPy array.
        force: Resultant of the forces of the gripper on the body, (D,) [N] (2D: [N/m]).
        moment: Their moment about the centre of the displaced patch, (3,) [N m], in 2D (1,) [N].
        nodal_force: The forces of the gripper, (N, D) [N]; zero outside of the patch.
        motion_error: Largest distance of a held node from its prescribed place [m].
        residual: Relative residual at all other nodes [-], see `Problem.relative_residual_of`; the
            forces of the gripper count as load.
        error: Estimated relative error of the displacement [-], see `estimate_error`, plus
            `motion_error` over the largest displacement of the body: no bound.
        force_error, moment_error: Estimated errors of `force` and `moment` over their norms [-],
            see `HeldBody.wrench_errors`: no bounds. They can be far larger than `error`. They are
            infinite if `error` is, and large where symmetry makes a resultant zero.
        volume_ratio: min det F [-]; an element is inverted if it is not above 0.
        converged: True if the motion is met exactly, the residual is below the tolerance and no
            element is inverted.
        amplitude, out_of_span: Position of the forces of the gripper relative to the training, see
            `Answer`. A rigid patch has concentrated forces along its edge, which most trainings do
            not contain.
        out_of_distribution: True if the forces are outside the training range and `error` is not
            below 10 %.
        method: "prediction", "corrected", "hybrid" or "full Newton".
        iterations: Predictions of the network and corrections, or linear solves of Newton's method.
        milliseconds: Wall time [ms].
        forces_found: True if the network predicts the motion under forces that were found. False:
            the linear displacement closes the gap of the nearest prediction.
        stopped: True if the budget ended the search for the forces, the correction or Newton's
            method.
        summary: Motion, estimated error, residual and range in words.
    """

    displacement: Any
    force: Any
    moment: Any
    nodal_force: Any
    motion_error: float
    residual: float
    error: float
    force_error: float
    moment_error: float
    volume_ratio: float
    converged: bool
    amplitude: float
    out_of_span: float
    out_of_distribution: bool
    method: str
    iterations: int
    milliseconds: float
    forces_found: bool
    stopped: bool
    summary: str


@dataclass(frozen=True, eq=False)
class HeldBody:
    """A body whose patch is held at its goal.

    Attributes:
        patch: The patch.
        goal: Its displacement, (m,) [-].
        load: Other forces on the body, B = 1, without parameters of the law.
        newton: Newton's method with the patch as a moved support.
    """

    patch: RigidPatch
    goal: Tensor
    load: Load
    newton: Newton

    def with_errors(self, candidate: Candidate) -> Candidate:
        """Return a candidate with the forces of the gripper, its motion and estimated errors."""
        patch, u = self.patch, candidate.state.displacement
        evaluation = self.newton.problem.evaluate(u)
        missed = float(patch.at(self.goal - patch.of_field(u[0])).norm(dim=1).max())
        found = estimate_error(self.newton.linear_solver, self.load, u, evaluation)
        force = candidate.force
        if force is None:
            force = patch.of_field(evaluation.internal[0] - self.load.force[0])
        return candidate._replace(
            state=candidate.state.unstable() if found.is_indefinite else candidate.state,
            force=force,
            motion_error=missed,
            error=found.error + missed / max(float(u.norm(dim=2).max()), 1e-300),
            correction=found.correction,
        )

    def wrench_errors(self, candidate: Candidate) -> tuple[float, float]:
        """Return the estimated relative errors of force and moment of the gripper [-].

        The estimates compare them with those of the corrected displacement: the correction behind
        the estimated error of the displacement is added, and the linear forces that move the patch
        to its goal. They cost one residual.
        """
        if candidate.correction is None:
            return math.inf, math.inf
        patch, u = self.patch, candidate.state.displacement
        better = u + candidate.correction
        reaction = self.newton.problem.evaluate(better).internal - self.load.force
        moved = patch.stiffness_times(self.goal - patch.of_field(u[0]))
        expected = patch.wrench(patch.at(patch.of_field(reaction[0]) + moved), better[0])
        assert candidate.force is not None
        found = patch.wrench(patch.at(candidate.force), u[0])
        pairs = zip(found, expected, strict=True)
        sizes = [(float((a - b).norm()), float(a.norm())) for a, b in pairs]
        force, moment = (e / max(size, 1e-300) if e >= 0 else math.inf for e, size in sizes)
        return force, moment

    def candidates(self, forces: Forces, steps: int, request: Request) -> Iterator[Candidate]:
        """Yield the prediction under the forces, corrected if possible, and the equilibrium.

        The equilibrium is that of Newton's method from the corrected prediction, or from rest where
        that does not lead to a solution.

        Args:
            forces: Forces of the gripper by the network.
            steps: Largest number of iterations of the correction; 0: the prediction is not
                corrected.
            request: Its budget ends correction and Newton's method; their last states are yielded.
        """
        newton, field, count = self.newton, forces.field, forces.predictions
        guess = torch.where(newton.problem.free, field, newton.problem.prescribed)[None]
        best = self._corrected(guess, steps, request) if steps else None
        if best is None:
            state = evaluate_solution(
                newton.problem, field[None], self.load, newton.tol, from_guess=True
            )
            state = state._replace(iterations=state.iterations + count)
            yield Candidate("prediction", state, force=forces.force)
        else:
            guess = best.displacement
            yield Candidate("corrected", best._replace(iterations=best.iterations + count))
        clock = time.perf_counter()
        for last in Hybrid(lambda load: guess, newton).iterate(self.load):
            now = time.perf_counter()
            pace, clock = now - clock, now
            if not last.converged and request.over(pace):
                break
        yield Candidate("hybrid" if bool(last.from_guess) else "full Newton", last)

    def _corrected(self, guess: Tensor, steps: int, request: Request) -> Solution | None:
        """Return the iterate of least residual from a guess (1, N, D); None if that is inverted.

        Iterations with the corotated factor of K(0) end when the displacement changes by less than
        `CORRECTED`.
        """
        valid: list[Solution] = []
        for state in AndersonSolver(self.newton, max_iter=steps).iterate(self.load, guess=guess):
            if not bool(state.volume_ratio > 0):
                break
            valid.append(state)
            last = [one.displacement for one in valid[-2:]]
            if len(valid) > 1 and (last[1] - last[0]).norm() < CORRECTED * last[1].norm():
                break
            if len(valid) <= steps and request.over():
                break
        return min(valid, key=lambda one: float(one.residual), default=None)


class Gripper:
    """Grasps of a body, with the last patches and the forces of the last grasp.

    Attributes:
        surrogate: The surrogate that predicts displacements.
        steps: Largest number of corrections of a prediction.
    """

    def __init__(self, surrogate: TrainedSurrogate, *, steps: int) -> None:
        """Store the surrogate; a patch is prepared when it is grasped for the first time."""
        self.surrogate, self.steps = surrogate, steps
        self._patches: OrderedDict[bytes, RigidPatch] = OrderedDict()
        self._last: tuple[RigidPatch, Tensor] | None = None

    @property
    def scene(self) -> Scene:
        """The scene of the surrogate."""
        return self.surrogate.scene

    def __call__(
        self,
        region: Any,
        translation: Sequence[float | None],
        rotation: ArrayLike | None = None,
        *,
        force: ArrayLike | Tensor | None = None,
        young: float | None = None,
        parameters: Mapping[str, float] | ArrayLike | None = None,
        tol: float | None = None,
        budget_ms: float | None = None,
        warm: bool = False,
        sliding: bool = False,
    ) -> GraspAnswer:
        """Return the displacement of the body while a gripper moves a patch of its boundary.

        The nodes of the patch move as a rigid body. The forces of the gripper are found through
        predictions of the network, see `predicted_forces`. With a tolerance, Newton's method solves
        the equilibrium of the body with the patch as a moved support, from this prediction.

        Args:
            region: The patch: a region of `dpl.fem` in the coordinates of the mesh, or a mask of
                nodes (N,). Nodes inside the body and supports are not grasped.
            translation: Displacement of the mean of the patch, (D,) [m]. None leaves a direction
                free: the patch slides along it without friction.
            rotation: Rotation vector about the mean of the patch, (3,), in 2D the angle [rad]; none
                if left out.
            force: Further nodal forces, (N, D) [N] (2D: [N/m]); the constant forces of the scene if
                left out.
            young: Young's modulus [Pa]; optional if the scene has only one.
            parameters: A value for each range of the law, by its name or as an array (P,).
            tol: Relative residual of the result [-]; None: the prediction of the network.
            budget_ms: Wall time [ms]. No prediction is started after it, and no iteration of Newton
                that would exceed it. A new patch is prepared and one prediction made in any case.
            warm: Begin with the forces of the last call if it grasped the same patch.
            sliding: Hold the largest part of the patch that faces one way along a coordinate axis,
                along this axis alone, as a flat plate does that is lubricated and does not lift
                off. Components of the motion across have no effect.

        Raises:
            ValueError: An argument has a wrong shape or is out of range, the patch has no node that
                is free to move, or a patch that slides faces no axis.
        """
        begin = time.perf_counter()
        request = replace(Request.checked(tol, budget_ms, None, warm=warm), begin=begin)
        load = self._load(force, young, parameters)
        patch, path = self._patch(region, translation, rotation, load, sliding=sliding)
        with one_thread(), torch.inference_mode():
            newton = patch.newton(self.scene.corrector, path(1.0))
            newton = newton if request.tol is None else replace(newton, tol=request.tol)
            start = self._last[1] if warm and self._last and self._last[0] is patch else None
            scale = self._motion_without(patch, load)
            predict = partial(self._predict, load)
            forces = predicted_forces(
                patch, path, predict, start, scale=scale, is_over=request.over
            )
            self._last = patch, forces.force
            # the body of Newton's method has the parameters
            body = HeldBody(patch, path(1.0), Load(load.force, load.young), newton)
            every = map(body.with_errors, body.candidates(forces, self.steps, request))
            best = next(every)
            if request.tol is not None and not best.is_exact and not request.over():
                best = min(best, next(every), key=lambda one: (not one.is_exact, one.known_error))
            return self._reported(body, load, best, request, found=forces.found)

    def _load(self, force: Any, young: Any, parameters: Any) -> Load:
        """Return the other forces on the body as a load, B = 1."""
        scene = self.scene
        if force is not None:
            given = as_numbers("force", force)
            if given.ndim != 2:
                raise ValueError(f"force: its shape is {tuple(given.shape)}; give one load (N, D)")
            return as_load(scene, given, young, parameters)
        rest = torch.zeros(scene.problem.shape, dtype=torch.float64)
        load = as_load(scene, rest, young, parameters)
        if (constant := scene.loads.constant_force) is None:
            return load
        modulus = scene.loads.moduli[0]  # by which the constant force is divided
        return load._replace(force=constant[None] * (modulus / load.young))

    def _patch(
        self, region: Any, translation: Any, rotation: Any, load: Load, *, sliding: bool
    ) -> tuple[RigidPatch, Callable[[float], Tensor]]:
        """Return the patch and the displacement (m,) [-] of its held degrees of freedom.

        The latter is a function of the part of the motion in [0, 1].
        """
        scene, dim = self.scene, self.scene.problem.shape[1]
        moves = list(translation)
        if len(moves) != dim:
            raise ValueError(f"translation = {moves} must be {dim} lengths [m], None where free")
        lengths = as_numbers("translation", [0.0 if x is None else x for x in moves])
        count = 3 if dim == 3 else 1
        turn = as_numbers("rotation", [0.0] * count if rotation is None else rotation).reshape(-1)
        motion = torch.cat([lengths / scene.length, turn])
        if len(turn) != count or not (motion.abs() <= LARGEST_MOTION).all():
            raise ValueError(
                f"translation = {moves}, rotation = {turn.tolist()} must be {dim} lengths [m] and "
                f"{count} angles [rad], all finite and at most {LARGEST_MOTION:g} L and rad"
            )
        motion = motion.where(motion.abs() >= LEAST_MOTION, 0.0)
        directions = [x is not None for x in moves]
        patch = self.patch(region, directions, load.parameters, sliding=sliding)
        return patch, lambda part: patch.displacement(
            (part * motion[:dim]).tolist(), (part * motion[dim:]).tolist()
        )

    def patch(
        self,
        region: Any,
        directions: Sequence[bool],
        parameters: Tensor,
        *,
        sliding: bool = False,
    ) -> RigidPatch:
        """Return a patch, one of the last `MAX_PATCHES` or a new one; see `RigidPatch.of`.

        `parameters` are those of the law, (1, P).
        """
        linear = self.scene.linear.with_parameters(parameters)
        patch = RigidPatch.of(linear, region, directions, sliding=sliding)
        key = patch.held.numpy().tobytes() + parameters.numpy().tobytes()
        patch = self._patches.setdefault(key, patch)
        self._patches.move_to_end(key)
        if len(self._patches) > MAX_PATCHES:
            self._patches.popitem(last=False)
        return patch

    def _motion_without(self, patch: RigidPatch, load: Load) -> float:
        """Return the largest displacement of the patch without the gripper, predicted [-]."""
        if not bool(load.force.any()):
            return 0.0
        size = float(patch.of_field(self.surrogate.predict(load)[0]).abs().max())
        return size if math.isfinite(size) else 0.0

    def _predict(self, load: Load, own: Tensor) -> Tensor:
        """Return the displacement (N, D) [-] under a load and forces of the gripper (N, D) [-]."""
        return self.surrogate.predict(load._replace(force=load.force + own))[0]

    def _reported(
        self, body: HeldBody, load: Load, held: Candidate, request: Request, *, found: bool
    ) -> GraspAnswer:
        """Return a candidate as an answer in SI units; `found` is whether its forces are."""
        scene, state = self.scene, held.state
        unit = float(load.young) * scene.force_unit
        assert held.force is not None
        nodal, error = body.patch.at(held.force), held.known_error
        wrench = body.patch.wrench(nodal, state.displacement[0])
        force_error, moment_error = body.wrench_errors(held)
        (place,) = RangeCheck.of(self.surrogate, load._replace(force=load.force + nodal))
        amplitude, out_of_span, outside = place
        outside = outside and not error < UNRELIABLE
        words = summarise(state, held.is_exact, error, amplitude, out_of_span, outside)
        words += f"; force within about {relative(force_error)}, moment {relative(moment_error)}"
        if request.spent:
            words += f"; stopped by the budget of {request.budget_ms:g} ms"
        missed = held.motion_error * scene.length
        return GraspAnswer(
            displacement=scene.length * state.displacement[0].numpy(),
            force=unit * wrench.force.numpy(),
            moment=unit * scene.length * wrench.moment.numpy(),
            nodal_force=unit * nodal.numpy(),
            motion_error=missed,
            residual=float(state.residual),
            error=error,
            force_error=force_error,
            moment_error=moment_error,
            volume_ratio=float(state.volume_ratio),
            converged=held.is_exact,
            amplitude=amplitude,
            out_of_span=out_of_span,
            out_of_distribution=outside,
            method=held.method,
            iterations=int(state.iterations),
            milliseconds=1e3 * (time.perf_counter() - request.begin),
            forces_found=found,
            stopped=request.spent,
            summary=f"motion error {missed:.1e} m; {words}",
        )
