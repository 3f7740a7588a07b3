"""Taylor-Hood elements: quadratic displacements and continuous linear pressures.

An independent reference for nearly incompressible bodies of triangles or tetrahedra. Mesh,
supports and nodal forces are those of a `Problem`; law, energy and assembly share nothing with dpl.

Source: Taylor, Hood (1973), Comput. Fluids 1; Sussman, Bathe (1987), Comput. Struct. 26.
"""

from typing import NamedTuple

import numpy as np
import skfem
import torch
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from torch import Tensor
from torch.func import grad, hessian, vmap
from torch.nn.functional import pad

from benchmarks.verification.bodies import Array
from dpl import fem

CHUNK = 256  # cells whose energy is differentiated at a time
PARTS = 3  # of the load, one after the other; all but the last have a step or two
SMALL_STEP = 1e-9  # largest last change of displacements over L and pressures over E


class TaylorHood(NamedTuple):
    """Displacements over L and their forces (N, D), and pressures over E (M,) of a linear basis."""

    displacement: Tensor
    force: Tensor
    basis: skfem.Basis
    pressure: Array

    def pressure_at(self, points: Array) -> Array:
        """Return the pressure over E at points (D, ...) over L of the undeformed body."""
        values = self.basis.probes(points.reshape(len(points), -1)) @ self.pressure
        return np.asarray(values).reshape(points.shape[1:])


def taylor_hood(problem: fem.Problem, poisson: float, loads: Tensor | None = None) -> TaylorHood:
    """Return the equilibrium of NHiso-k2 by Newton's method, with load steps.

    The energy of a cell, stationary in u and q, is the integral of mu/2 (J^(-2/3) I1 - 3)
    + q (J - 1) - q^2 / (2 kappa), with J = 1 + q / kappa in the end; the pressure is p = -q.

    Args:
        problem: Body of quadratic triangles or tetrahedra, for mesh and supports.
        poisson: Poisson's ratio.
        loads: Dead nodal forces, (N, D) [-].
    """
    mu, kappa = 1 / (2 * (1 + poisson)), 1 / (3 * (1 - 2 * poisson))
    (nodes, dim), mesh = problem.shape, problem.mesh
    linear = skfem.ElementTriP1() if dim == 2 else skfem.ElementTetP1()
    u_basis = skfem.Basis(mesh, problem.basis.elem, intorder=4)
    q_basis = u_basis.with_element(linear)
    dN = torch.from_numpy(np.stack([b[0].grad for b in u_basis.basis]).transpose(2, 3, 0, 1))
    psi = torch.from_numpy(np.stack([np.asarray(b[0]) for b in q_basis.basis]).transpose(1, 2, 0))
    psi, dV = psi.expand(*dN.shape[:2], -1), torch.from_numpy(u_basis.dx)
    dofs = (dim * u_basis.element_dofs[:, None] + np.arange(dim)[:, None]).reshape(-1, len(dN))
    numbers = np.concatenate([dofs, dim * nodes + q_basis.element_dofs]).T
    size, split = dim * nodes + q_basis.N, len(dofs)

    def energy(x: Tensor, dN: Tensor, psi: Tensor, dV: Tensor) -> Tensor:
        H = x[:split].reshape(-1, dim).mT @ dN
        F = torch.eye(3, dtype=x.dtype) + pad(H, [0, 3 - dim] * 2)
        # second derivatives of torch.linalg.det are NaN at F = I
        q, J = psi @ x[split:], (F[:, 0] * torch.linalg.cross(F[:, 1], F[:, 2])).sum(-1)
        shear = J ** (-2 / 3) * F.square().sum((-2, -1)) - 3
        return ((mu / 2 * shear + q * (J - 1) - q * q / (2 * kappa)) * dV).sum()

    x, force, free = np.zeros(size), np.zeros(size), np.ones(size, dtype=bool)
    free[: dim * nodes] = problem.free.numpy().ravel()
    given = problem.prescribed.numpy().ravel()[~free[: dim * nodes]]
    if loads is not None:
        force[: dim * nodes] = loads.numpy().ravel()
    shape = (*numbers.shape, numbers.shape[1])
    rows, columns = (
        np.broadcast_to(a, shape).ravel() for a in (numbers[:, :, None], numbers[:, None])
    )
    for part in np.linspace(1 / PARTS, 1, PARTS):
        x[~free], step = part * given, np.full(1, np.inf)
        while not np.abs(step).max() < (SMALL_STEP if part == 1 else 1.0):
            cells = torch.from_numpy(x[numbers]), dN, psi, dV
            internal = np.zeros(size)
            np.add.at(internal, numbers, vmap(grad(energy), chunk_size=CHUNK)(*cells).numpy())
            if np.isnan(internal).any():  # J < 0 at a point
                step = step / 2
                if not np.isfinite(step).all():
                    raise ArithmeticError("Taylor-Hood elements are inverted; use more parts")
                x[free] -= step
                continue
            entries = vmap(hessian(energy), chunk_size=CHUNK)(*cells).numpy().ravel()
            matrix = coo_array((entries, (rows, columns)), (size, size)).tocsr()[free][:, free]
            factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A")
            step = factor.solve((part * force - internal)[free])
            x[free] += step
    u, own = (torch.from_numpy(a[: dim * nodes].reshape(nodes, dim)) for a in (x, internal))
    return TaylorHood(u, own, q_basis, -x[dim * nodes :])
