"""Forces of a gripper that move a patch as prescribed, found through predictions of a network."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem import RigidPatch

MOTION_TOL = 1e-3  # largest error of a motion that is accepted, over its size [-]
MAX_ITER = 16  # predictions for one part of a motion
PARTS = 2, 4, 8  # numbers of parts into which a motion is divided if that is necessary
MEMORY = 8  # iterations from which Anderson's method extrapolates


def never() -> bool:
    """Return False: the time is not limited."""
    return False


class Forces(NamedTuple):
    """Forces of a gripper with the prediction of a network under them.

    Attributes:
        force: At held degrees of freedom, (m,) [-].
        field: Displacement, (N, D) [-].
        gap: Largest entry of the difference between the predicted patch and the goal [-].
        predictions: Number of predictions that were made.
        found: True if the gap is below the tolerance. Otherwise `predicted_forces` has closed it.
    """

    force: Tensor
    field: Tensor
    gap: float
    predictions: int
    found: bool


def predicted_forces(
    patch: RigidPatch,
    path: Callable[[float], Tensor],
    predict: Callable[[Tensor], Tensor],
    start: Tensor | None = None,
    *,
    scale: float = 0.0,
    is_over: Callable[[], bool] = never,
) -> Forces:
    """Return forces of the gripper that move the patch as prescribed, through a network.

    The forces of the whole motion are sought first. If they are not found, the motion is divided
    into 2, 4 and 8 parts; the forces of each part start those of the next. If the network predicts
    the motion under no forces, the linear displacement that closes the gap is added to the nearest
    prediction, and its forces to those of the prediction.

    Forces keep their direction while the body moves. An equilibrium that is stable only as long as
    the gripper holds the patch, such as a column that it shortens beyond buckling, is not found.

    Args:
        patch: The patch.
        path: Function from a part of the motion in [0, 1] to the displacement of the held degrees
            of freedom, (m,) [-].
        predict: Function from the forces of the gripper (N, D) [-] to a displacement (N, D) [-].
        start: Forces to start from, (m,); the linear ones if left out.
        scale: Size of the motion of the patch without the gripper [-]; errors are relative to it or
            to the prescribed motion, whichever is larger.
        is_over: Returns True if no further prediction may be made; there is always one.
    """
    scale = max(scale, float(path(1.0).abs().max()))
    first = patch.stiffness_times(path(1.0)) if start is None else start
    best = balanced_forces(patch, path(1.0), predict, first, scale, is_over)
    total = best.predictions
    for parts in PARTS:
        if best.found:
            break
        force = patch.stiffness_times(path(1 / parts))
        for k in range(1, parts + 1):
            if is_over():
                break
            last = balanced_forces(patch, path(k / parts), predict, force, scale, is_over)
            total, force = total + last.predictions, last.force * (k + 1) / k
        else:
            best = min(best, last, key=lambda one: one.gap)
    best = best._replace(predictions=total)
    return best if best.found else closed(patch, path(1.0), best)


def closed(patch: RigidPatch, goal: Tensor, forces: Forces) -> Forces:
    """Return forces and displacement plus the linear ones that move the patch to its goal.

    Args:
        patch: The patch.
        goal: Displacement of the held degrees of freedom, (m,) [-].
        forces: Forces with their prediction.
    """
    added = patch.stiffness_times(goal - patch.of_field(forces.field))
    field = forces.field + patch.linear.solve_force(patch.at(added))
    return forces._replace(force=forces.force + added, field=field)


def balanced_forces(
    patch: RigidPatch,
    goal: Tensor,
    predict: Callable[[Tensor], Tensor],
    force: Tensor,
    scale: float,
    is_over: Callable[[], bool] = never,
) -> Forces:
    """Return forces of the gripper under which the predicted patch is displaced by the goal.

    The forces are unknowns at all held degrees of freedom. Each iteration adds the forces that
    close the gap between predicted and prescribed displacement in the linear body; Anderson's
    method extrapolates. Iterations end when the gap is at most `MOTION_TOL` times the scale, or
    after `MAX_ITER`; the result has the smallest gap.

    Source: Anderson (1965), J. ACM 12; Walker, Ni (2011), SIAM J. Numer. Anal. 49 (as a least
    squares problem of differences).

    Args:
        patch, predict, scale, is_over: See `predicted_forces`.
        goal: Displacement of the held degrees of freedom, (m,) [-].
        force: Forces to start from, (m,) [-].
    """
    energy = patch.compliance_factor.mT  # |L^T f| is the energy norm of forces
    rest = torch.zeros_like(patch.problem.points)
    best = Forces(torch.zeros_like(force), rest, math.inf, 0, False)
    forces: list[Tensor] = []
    steps: list[Tensor] = []
    for count in range(1, MAX_ITER + 1):
        field = predict(patch.at(force))
        gap = goal - patch.of_field(field)
        size = float(gap.abs().max())
        found = size <= MOTION_TOL * scale
        better = found or size < best.gap
        best = (
            Forces(force, field, size, count, found) if better else best._replace(predictions=count)
        )
        if found or not math.isfinite(size) or is_over():
            break
        forces, steps = [*forces[-MEMORY:], force], [*steps[-MEMORY:], patch.stiffness_times(gap)]
        force = force + steps[-1]
        if len(steps) > 1:
            changes = torch.stack(steps).diff(dim=0).mT
            moves = torch.stack(forces).diff(dim=0).mT
            mix = torch.linalg.lstsq(energy @ changes, energy @ steps[-1][:, None]).solution
            force = force - ((moves + changes) @ mix)[:, 0]
    return best
