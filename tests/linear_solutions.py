"""Bodies and exact linear solutions of the tests of `dpl.models.linear_response`."""

import torch

from dpl.fem import DirichletBC, Plane, RobinBC, box

BEAM = box((4, 1, 1), (7, 4, 4))
LEFT = Plane(0, 0.0)
SUPPORTS = {
    "held": [DirichletBC(LEFT)],
    "moved": [DirichletBC(LEFT), DirichletBC(Plane(0, 4.0), value=[0.05, None, None])],
    "on a foundation": [DirichletBC(LEFT), RobinBC(Plane(2, 0.0), 0.1)],
}


def exact(scene, force, own):
    """Return displacements K(0)^-1 (f - s) plus the prescribed ones, (B, N, D)."""
    fields = []
    for one, values in zip(force, own, strict=True):
        body = scene.problem.with_parameters(values[None])
        moved = body.tangent_product(torch.zeros_like(one)[None], body.prescribed[None])[0]
        solver = scene.linear.with_parameters(values[None])
        loaded = torch.where(body.free, one - moved - body.force_at_rest, 0.0)
        fields.append(solver.solve_force(loaded) + body.prescribed)
    return torch.stack(fields)


def relative(found, expected):
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1)).max())


def at_free(scene, fields):
    return fields[:, scene.problem.free]
