"""Grasps: the displacement of a patch is prescribed, its forces are found through a network."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dpl.fem import Load, RigidPatch, evaluate_solution
from dpl.fem.solvers.corotational import CorotatedFactor
from dpl.fem.solvers.rigid_patch import rotation_gradients
from dpl.inference.answer import UNRELIABLE, Answer, RangeCheck, answer_of, relative
from dpl.inference.arguments import as_load, as_numbers
from dpl.inference.held_body import MAX_ITER, MOTION_TOL, HeldBody
from dpl.inference.request import FINISH, Candidate, Durations, Request
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

CORRECTED_GAP = 1e-2  # error of a motion at which its prediction is corrected, over its size [-]
CORRECTED_ITER = 3  # predictions for a motion if the last one is corrected
ACCURATE = 3e-3  # estimated error from which a motion is made in more parts [-]
PARTS = 1, 2, 4, 8  # factors on the number of parts, which follow each other
MAX_PARTS = 32  # smallest number of parts of the largest rotations
MAX_TURN = math.radians(30)  # largest rotation of a part of a motion [rad]
MAX_PREDICTED_TURN = math.radians(60.1)  # largest rotation that is predicted [rad]
MAX_PATCHES = 2  # patches whose compliance and held body are kept
LARGEST_MOTION = 1e6  # largest translation over L [-] and rotation [rad]
LEAST_MOTION = 1e-280  # smaller ones count as zero: their residuals cannot be computed


@dataclass(frozen=True, kw_only=True)
class GraspAnswer(Answer):
    """Displacement of a body with a grasped patch, and the forces of the gripper, as NumPy arrays.

    The fields of `Answer` have these meanings:

    - `residual` is that of all nodes that are not held; the forces of the gripper count as load.
    - `error` is the estimated error of the held body plus `motion_error` over the largest
      displacement: no bound. Where the budget leaves no time for the estimate, it is that of the
      last correction, or infinite.
    - `converged` requires that the motion is met exactly, too.
    - `amplitude` and `out_of_span` are those of the forces of the gripper. A rigid patch has
      concentrated forces along its edge, which most trainings do not contain. A grasp is therefore
      `out_of_distribution` only if `error` is not below 10 %, too.
    - `method` is "prediction", "corrected", "hybrid" or "full Newton"; "rest" while the budgets of
      the calls have not sufficed to prepare the patch.
    - `iterations` counts predictions, corrections and linear solves of Newton's method.

    Attributes:
        force: Resultant of the forces of the gripper on the body, (D,) [N] (2D: [N/m]). Of several
            patches, this and the following have a first axis P.
        moment: Their moment about the centre of the displaced patch, (3,) [N m], in 2D (1,) [N].
        nodal_force: The forces of the gripper, (N, D) [N]; zero outside of the patch.
        motion_error: Largest distance of a held node from its prescribed place [m].
        force_error, moment_error: Estimated errors of `force` and `moment` over their norms [-],
            see `HeldBody.wrench_errors`: no bounds. They can be far larger than `error`. They are
            infinite if `error` is, and large where symmetry makes a resultant zero.
        stiffness: Forces and moments of the patches by their translations and rotations about their
            centres, (P R, P R), R = 6, in 2D 3 [N/m, N, N m]: that of the linear body, turned with
            each patch, symmetric, and exact at rest.
        forces_found: True if the network predicts the motion under forces that were found, or if
            the state of the last call was continued. False: the linear displacement closes the gap
            of the nearest prediction, or the motion was made in parts.
        stopped: True if the budget ended the preparation of the patch, the search for the forces,
            the correction, the estimate of the error or Newton's method.
    """

    force: Any
    moment: Any
    nodal_force: Any
    motion_error: float
    force_error: Any
    moment_error: Any
    stiffness: Any
    forces_found: bool
    stopped: bool


class Grip(NamedTuple):
    """A state of a grasped body, from which the next motion of its patch starts."""

    patch: RigidPatch
    motion: Tensor  # translations over L [-] and rotation vectors [rad], (P, R)
    force: Tensor  # of the gripper at held degrees of freedom, (m,) [-]
    field: Tensor  # displacement, (N, D) [-]
    error: float = 0.0  # its estimated relative error [-]
    frames: CorotatedFactor | None = None  # with the rotations of the nodes there, if computed


@dataclass(frozen=True, eq=False)
class Gripper:
    """Grasps of a body, with the last patches and the state of the last grasp.

    Grippers from `dataclasses.replace(gripper, warm=True)` have these in common.

    Attributes:
        surrogate: The surrogate that predicts displacements.
        steps: Largest number of corrections of a prediction.
        warm: Begin with the state of the last grasp if it was of the same patch: the answer is the
            last displacement, moved with the patch and corrected, if that is accurate.
        sliding: Hold the largest part of a patch that faces one way along a coordinate axis, along
            this axis alone, as a flat plate does that is lubricated and does not lift off.
            Components of the motion across have no effect.
    """

    surrogate: TrainedSurrogate
    _: KW_ONLY
    steps: int
    warm: bool = False
    sliding: bool = False
    _patches: dict[bytes, RigidPatch] = field(default_factory=dict, repr=False)
    _last: list[Grip] = field(default_factory=list, repr=False)  # at most one
    _durations: Durations = field(default_factory=Durations, repr=False)

    def __post_init__(self) -> None:
        self.scene.problem.material.require_known("grasp")

    @property
    def scene(self) -> Scene:
        """The scene of the surrogate."""
        return self.surrogate.scene

    def __call__(
        self,
        region: Any,
        translation: Sequence[Any],
        rotation: Any = None,
        *,
        force: ArrayLike | Tensor | None = None,
        young: float | None = None,
        parameters: Mapping[str, float] | ArrayLike | None = None,
        tol: float | None = None,
        budget_ms: float | None = None,
    ) -> GraspAnswer:
        """Return the displacement of the body while a gripper moves a patch of its boundary.

        The nodes of the patch move as a rigid body. The forces of the gripper are found through
        predictions of the network (`HeldBody.predicted_forces`); the prediction is corrected
        (`HeldBody.corrected`). Large rotations, and motions whose correction is not near
        equilibrium, are made in parts from rest, each of which is corrected. With a tolerance,
        Newton's method solves the equilibrium of the body with the patch as a moved support, from
        this state.

        Lists of P regions, translations and rotations grasp several patches at the same time.

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
            tol: Relative residual of the result [-]; None: the corrected prediction.
            budget_ms: Wall time [ms]. No prediction, correction and iteration is started that would
                exceed it, see `Durations`. The body is at rest in the answer until a new patch is
                prepared, for which each call uses its budget.

        Raises:
            ValueError: An argument has a wrong shape or is out of range, the patch has no node that
                is free to move, a patch that slides faces no axis, or two patches have a node in
                common.
        """
        request = Request(tol, budget_ms, None, self._durations)
        load = self._load(force, young, parameters)
        is_one = not isinstance(region, (list, tuple))
        regions, translations, turns = region, translation, rotation
        if is_one:
            regions, translations, turns = [region], [translation], [rotation]
        turns = [None] * len(regions) if turns is None else turns
        if not 0 < len(regions) == len(translations) == len(turns):
            counts = len(regions), len(translations), len(turns)
            raise ValueError(f"region, translation, rotation: their lengths {counts} must be equal")
        motions, directions = zip(*map(self._motion, translations, turns), strict=True)
        motion = torch.stack(motions)
        patch = self.patch(regions, directions, load.parameters)
        last = self._last.pop() if self._last else None
        with one_thread(), torch.inference_mode():
            body = self._held(patch, motion, load, request)
            if not self._is_prepared(patch, request):
                with self._durations.timed(FINISH):
                    return self._reported(body, load, body.at_rest(), request, is_one=is_one)
            if last is not None and not (self.warm and last.patch is patch):
                last = None
            best: Candidate | None = None
            stage = "start" if last is None else "state"  # which takes less
            states = self._states(body, motion, load, last, request)
            for candidate in self._durations.each(stage, states):
                candidate = body.with_errors(candidate, request)
                if best is None or candidate.known_error < best.known_error:
                    best = candidate
                if best.known_error <= ACCURATE or request.over("start", "errors"):
                    break
            assert best is not None
            reached = best  # also with a tolerance, so that a hand does not depend on comparisons
            if request.tol is not None and not best.is_exact and not request.over("Newton"):
                solved = body.equilibrium(best, request)
                best = min(best, solved, key=lambda one: (not one.is_exact, one.known_error))
            with self._durations.timed(FINISH):
                frames = patch.linear.corotational.at(best.state.displacement)
                is_near = request.spent or reached.known_error <= UNRELIABLE
                if is_near and reached.force is not None:
                    field = reached.state.displacement[0]
                    error = reached.known_error
                    self._last.append(Grip(patch, motion, reached.force, field, error, frames))
                return self._reported(body, load, best, request, frames, is_one=is_one)

    def _is_prepared(self, patch: RigidPatch, request: Request) -> bool:
        """Prepare a patch as far as the budget allows; return True if the call can go on."""
        if patch.is_prepared:
            return True
        for _ in self._durations.each("preparation", patch.preparation):
            if request.over("preparation"):
                return False
        return not request.over("start")

    def _held(self, patch: RigidPatch, motion: Tensor, load: Load, request: Request) -> HeldBody:
        """Return the body with a patch at a motion; its law has the parameters of the load."""
        dim = patch.held.shape[1]
        goal = patch.displacement(motion[:, :dim], motion[:, dim:])
        turns = rotation_gradients(motion[:, dim:], dim) + torch.eye(dim)
        newton = patch.newton(self.scene.corrector, goal)
        newton = newton if request.tol is None else replace(newton, tol=request.tol)
        return HeldBody(patch, goal, turns, Load(load.force, load.young), newton)

    def _states(
        self, body: HeldBody, motion: Tensor, load: Load, last: Grip | None, request: Request
    ) -> Iterator[Candidate]:
        """Yield states at a motion, from the last state, the prediction and, in parts, from rest.

        Large rotations are not predicted unless nothing else leads to a state.
        """
        patch = body.patch
        rest = Grip(patch, 0 * motion, 0 * body.goal, torch.zeros(patch.held.shape).double())
        is_predicted = not self.steps or self._parts(motion) * MAX_TURN < MAX_PREDICTED_TURN
        if last is not None and self.steps:
            parts = self._parts(motion - last.motion)
            if state := self._in_parts(body, last, motion, parts, load, request):
                yield state._replace(forces_found=True)
        if is_predicted:
            yield self._predicted(body, load, last or rest, request)
        for doubled in PARTS if self.steps else ():
            parts = doubled * self._parts(motion)
            if state := self._in_parts(body, rest, motion, parts, load, request):
                yield state
        if not is_predicted:
            yield self._predicted(body, load, rest, request)

    def _parts(self, motion: Tensor) -> int:
        """Return the number of parts with rotations of at most `MAX_TURN`, if they are not many."""
        turn = float(motion[:, self.scene.problem.shape[1] :].norm(dim=1).max())
        return min(max(math.ceil(turn / MAX_TURN), 1), MAX_PARTS)

    def _in_parts(
        self, end: HeldBody, start: Grip, motion: Tensor, parts: int, load: Load, request: Request
    ) -> Candidate | None:
        """Return the state after a motion in equal parts; None if one is inverted or time is up."""
        field, error, frames = start.field, start.error, start.frames
        count, change = 0, motion - start.motion
        for k in range(1, parts + 1):
            body = end
            if k < parts:
                body = self._held(end.patch, start.motion + (k / parts) * change, load, request)
            found = body.corrected(body.moved(field, frames), self.steps, request, error)
            if found is None or (k < parts and request.over("step")):
                return None
            field, error, frames = found.state.displacement[0], found.known_error, None
            count += int(found.state.iterations)
            best = found._replace(state=found.state._replace(iterations=torch.tensor([count])))
        return best

    def _predicted(self, body: HeldBody, load: Load, start: Grip, request: Request) -> Candidate:
        """Return the corrected prediction.

        Where its forces are not found, the linear displacement that closes the gap of the patch is
        added to a prediction that is not corrected, and the forces of this displacement to its own.
        """
        patch, newton = body.patch, body.newton
        begin = start.force + patch.stiffness_times(body.goal - patch.of_field(start.field))

        def predict(own: Tensor) -> Tensor:
            with request.durations.timed("prediction"):
                return self.surrogate.predict(load._replace(force=load.force + own))[0]

        scale = 0.0  # largest displacement of the patch without the gripper, predicted [-]
        if bool(load.force.any()):
            scale = float(patch.of_field(self.surrogate.predict(load)[0]).abs().max())
        tol, most = (CORRECTED_GAP, CORRECTED_ITER) if self.steps else (MOTION_TOL, MAX_ITER)
        force, field, count, is_found = body.predicted_forces(
            predict, begin, scale=scale if math.isfinite(scale) else 0.0,
            tol=tol, max_iter=most, is_over=lambda: request.over("prediction", "errors"),
        )  # fmt: skip
        best = None
        if self.steps:
            best = body.corrected(body.moved(field), self.steps, request)
        if best is None:
            if not is_found:
                added = patch.stiffness_times(body.goal - patch.of_field(field))
                field = field + patch.linear.solve_force(patch.at(added))
                force = force + added
            state = evaluate_solution(
                newton.problem, field[None], body.load, newton.tol, from_guess=True
            )
            best = Candidate("prediction", state, force=force)
        state = best.state._replace(iterations=best.state.iterations + count)
        return best._replace(state=state, forces_found=is_found)

    def _load(self, force: Any, young: Any, parameters: Any) -> Load:
        """Return the other forces on the body as a load, B = 1."""
        scene = self.scene
        if force is None:
            constant, rest = scene.loads.constant_force, torch.zeros(scene.problem.shape)
            unit = scene.loads.moduli[0] * scene.force_unit  # of the constant force
            force = rest if constant is None else unit * constant
        given = as_numbers("force", force)
        if given.ndim != 2:
            raise ValueError(f"force: its shape is {tuple(given.shape)}; give one load (N, D)")
        return as_load(scene, given, young, parameters)

    def _motion(self, translation: Any, rotation: Any) -> tuple[Tensor, list[bool]]:
        """Return translation over L with rotation [rad], and the directions that are held."""
        dim = self.scene.problem.shape[1]
        moves = list(translation)
        if len(moves) != dim:
            raise ValueError(f"translation = {moves} must be {dim} lengths [m], None where free")
        lengths = as_numbers("translation", [0.0 if x is None else x for x in moves])
        count = 3 if dim == 3 else 1
        turn = as_numbers("rotation", [0.0] * count if rotation is None else rotation).reshape(-1)
        motion = torch.cat([lengths / self.scene.length, turn])
        if len(turn) != count or not (motion.abs() <= LARGEST_MOTION).all():
            raise ValueError(
                f"translation = {moves}, rotation = {turn.tolist()} must be {dim} lengths [m] and "
                f"{count} angles [rad], all finite and at most {LARGEST_MOTION:g} L and rad"
            )
        motion = motion.where(motion.abs() >= LEAST_MOTION, 0.0)
        return motion, [x is not None for x in moves]

    def patch(
        self, regions: Sequence[Any], directions: Sequence[Sequence[bool]], parameters: Tensor
    ) -> RigidPatch:
        """Return the union of patches, one of the last `MAX_PATCHES` or a new one.

        See `RigidPatch.of` for regions and directions. `parameters` are those of the law, (1, P).
        """
        linear = self.scene.linear.with_parameters(parameters)
        own = zip(regions, directions, strict=True)
        each = [RigidPatch.of(linear, *one, sliding=self.sliding) for one in own]
        patch = RigidPatch.union(each)
        key = b"".join(one.held.numpy().tobytes() for one in each) + parameters.numpy().tobytes()
        patch = self._patches[key] = self._patches.pop(key, patch)  # the most recent is the last
        if len(self._patches) > MAX_PATCHES:
            del self._patches[next(iter(self._patches))]
        return patch

    def _reported(
        self, body: HeldBody, load: Load, held: Candidate, request: Request,
        frames: CorotatedFactor | None = None, *, is_one: bool,
    ) -> GraspAnswer:  # fmt: skip
        """Return a candidate as an answer in SI units."""
        scene, state = self.scene, held.state
        unit, dim = float(load.young) * scene.force_unit, scene.problem.shape[1]
        assert held.force is not None
        patch, nodal = body.patch, body.patch.at(held.force)
        parts = *patch.wrench(nodal, state.displacement[0]), *body.wrench_errors(held, frames)
        force, moment, *errors = (part[0] if is_one else part for part in parts)
        count = 6 if dim == 3 else 3
        arms = torch.where(torch.arange(count * len(patch.parts)) % count < dim, 1.0, scene.length)
        stiffness = math.nan * arms.outer(arms)  # while the patch is not prepared
        if held.method != "rest":
            stiffness = unit / scene.length * arms.outer(arms) * patch.stiffness(body.turns)
        (place,) = RangeCheck.of(self.surrogate, load._replace(force=load.force + nodal))
        place = place._replace(outside=place.outside and not held.known_error < UNRELIABLE)
        fields = vars(answer_of(held, place, request, scene))
        missed = held.motion_error * scene.length
        words = f"motion error {missed:.1e} m; {fields['summary']}"
        within = [relative(float(error.max())) for error in errors]
        words += f"; force within about {within[0]}, moment {within[1]}"
        if request.spent:
            words += f"; stopped by the budget of {request.budget_ms:g} ms"
        numpy = {"displacement": fields["displacement"].numpy(), "summary": words}
        return GraspAnswer(
            **(fields | numpy),
            force=unit * force.numpy(),
            moment=unit * scene.length * moment.numpy(),
            nodal_force=unit * nodal.numpy(),
            motion_error=missed,
            force_error=errors[0].numpy()[()],
            moment_error=errors[1].numpy()[()],
            stiffness=stiffness.numpy(),
            forces_found=held.forces_found,
            stopped=request.spent,
        )
