"""Equilibrium of a body with residual stress and without loads."""

import math
import warnings
from dataclasses import replace
from functools import cached_property
from typing import Any

import skfem
import torch
from torch import Tensor

from dpl.fem.assembly.discretisation import geometry
from dpl.fem.assembly.elements import basis_of
from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.materials.prestretched import EYE, Prestretched, Stretch
from dpl.fem.problem import Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.newton import LoadStepping, Newton
from dpl.fem.solvers.solution import LEAST_TOL, Load

MIN_STEP = 2.0**-8  # part of the prestretch below which the relaxation is given up [-]
CLOSE = 1e-14  # displacement below which the body is at rest [-]
MAX_ITER = 30  # Newton iterations for a part


class _Unbalanced(Problem):
    """A body whose residual stress is not in equilibrium at u = 0."""

    @cached_property
    def force_at_rest(self) -> Tensor:
        return self.evaluate(torch.zeros(1, *self.shape, dtype=torch.float64)).internal[0]


def relaxed(problem: Problem, stretch: Stretch) -> tuple[skfem.Mesh, Tensor]:
    """Return the mesh [m] of a body in equilibrium with a prestretch, and its prestretch there.

    The body is held by its supports and has no loads: elastic foundations, follower loads and
    prescribed displacements do not count. The prestretch grows in parts, and the mesh moves with
    the body. With the results u = 0 is an equilibrium, up to rounding:

        mesh, stretch = relaxed(problem, stretch)
        stressed = Problem.build(mesh, Prestretched(law, stretch), fixed=~problem.free.numpy())

    Args:
        problem: The body with the law of its stress-free material; its mesh must have the nodes of
            its displacement.
        stretch: The prestretch G of the body held in the shape of its mesh, see `Prestretched`.

    Returns:
        The mesh, whose cells, nodes and tags have the same order, and G (E, Q, 3, 3) [-].

    Raises:
        ValueError: No stable equilibrium was found, or an argument is invalid.
    """
    if problem.mesh.doflocs.shape[1] != len(problem.points):
        raise ValueError("mesh must be quadratic for degree = 2; use from_mesh of skfem's MeshHex2")
    law = Prestretched(problem.material, stretch).on(problem.basis, problem.length, problem.origin)
    held = torch.zeros_like(problem.prescribed)
    body = replace(problem, springs=None, follower_loads=NO_LOADS, prescribed=held)
    F, steps, total = EYE[None, None], LoadStepping(MIN_STEP), torch.zeros(())
    before = change = math.inf
    # again on the new mesh: curved tetrahedra have other points, mean dilatation other functions
    while steps.factor < 1 or CLOSE < change < before / 2:
        part = EYE + steps.target * (law.field - EYE)
        u = _displacement(body, replace(law, stretch=F @ part))
        if u is None:
            steps.reject()
            if steps.exhausted:
                raise ValueError(
                    f"stretch: no stable equilibrium was found for more than {steps.factor:.3g} of "
                    "it; reduce it"
                )
            continue
        basis = basis_of(
            replace(body.mesh, doflocs=body.mesh.doflocs + u[0].numpy().T), body.degree
        )
        is_mean = body.volume_functions is not None
        body = replace(body, **geometry(basis, body.degree, mean_dilatation=is_mean))
        total, before, change = total + u, change, float(u.abs().max())
        F = torch.linalg.inv(EYE - body.discretisation.gradient(total)[0])
        steps.accept()
    return body.mesh_in_metres, F @ law.field


def _displacement(body: Problem, law: Prestretched) -> Tensor | None:
    """Return u (1, N, D) [-] under a prestretch, from the linear solution of the unstretched law.

    None if no stable equilibrium is found: growth in a fixed shape can make K(0) indefinite.
    """
    parts: dict[str, Any] = {**body.__getstate__(), "material": law}
    stressed = _Unbalanced(**parts)
    guess = LinearSolver(body).solve(-stressed.force_at_rest)[None]
    load = Load(torch.zeros_like(guess), torch.ones(1, dtype=torch.float64))
    newton = Newton(stressed, LEAST_TOL, min_load_step=0.9, max_total_iter=MAX_ITER)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the residual is that of rounding
        *_, last = newton.iterate(load, guess=guess)
    return last.displacement if last.stable else None
