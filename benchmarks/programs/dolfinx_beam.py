"""The scenes of `benchmarks.peers` in dolfinx with MUMPS: plain Newton from zero, one step.

A program of its own, for the Python that has dolfinx 0.5 (Debian 12: python3-dolfinx):

    python scripts/benchmark.py reference_codes.dolfinx=/usr/bin/python3

Reads scenes as JSON from standard input, writes seconds, iterations and the tip of each,
and the shared libraries that are loaded, as JSON.
"""

import json
import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from petsc4py import PETSc


def solved(scene: dict) -> dict:
    """Return how long a scene takes, median of `repeats`, and what comes out."""
    size, cells = scene["size"], scene["cells"]
    body = mesh.create_box(
        MPI.COMM_WORLD, [np.zeros(3), np.array(size)], cells, mesh.CellType.hexahedron
    )
    space = fem.VectorFunctionSpace(body, ("CG", 1))
    u, du, v = fem.Function(space), ufl.TrialFunction(space), ufl.TestFunction(space)
    E, nu = scene["young"], scene["poisson"]
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    F = ufl.Identity(3) + ufl.grad(u)
    C, J = F.T * F, ufl.det(F)
    if scene["law"] == "NeoHookeanLn":
        energy = mu / 2 * (ufl.tr(C) - 3) - mu * ufl.ln(J) + lam / 2 * ufl.ln(J) ** 2
    else:
        strain = (C - ufl.Identity(3)) / 2
        energy = lam / 2 * ufl.tr(strain) ** 2 + mu * ufl.inner(strain, strain)
    total = energy * ufl.dx(metadata={"quadrature_degree": 3})
    slope = ufl.derivative(total, u, v)
    options = {"cffi_extra_compile_args": ["-O3", "-march=native"]}
    residual = fem.form(slope, jit_params=options)
    tangent = fem.form(ufl.derivative(slope, u, du), jit_params=options)
    held = fem.locate_dofs_geometrical(space, lambda x: np.isclose(x[0], 0))
    clamp = fem.dirichletbc(np.zeros(3), held, space)
    end = fem.locate_dofs_geometrical(space, lambda x: np.isclose(x[0], size[0]))
    load = np.zeros_like(u.x.array)
    load[3 * end + 2] = -scene["force"] / len(end)
    fixed = (3 * held[:, None] + np.arange(3)).ravel()
    K = fem.petsc.create_matrix(tangent)
    R = fem.petsc.create_vector(residual)
    solver = PETSc.KSP().create(MPI.COMM_WORLD)
    solver.setOperators(K)
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")
    step = R.duplicate()

    def newton() -> int:
        u.x.array[:] = 0.0
        for iteration in range(31):
            with R.localForm() as local:
                local.set(0.0)
            fem.petsc.assemble_vector(R, residual)
            R.array[:] -= load
            R.array[fixed] = 0.0
            if np.linalg.norm(R.array) < 1e-8 * np.linalg.norm(load):
                return iteration
            K.zeroEntries()
            fem.petsc.assemble_matrix(K, tangent, bcs=[clamp])
            K.assemble()
            solver.solve(R, step)
            u.x.array[:] -= step.array
        return -1

    seconds = []
    iterations = newton()
    for _ in range(scene["repeats"]):
        start = time.perf_counter()
        newton()
        seconds.append(time.perf_counter() - start)
    tip = u.x.array.reshape(-1, 3)[end].mean(axis=0)
    return {"seconds": float(np.median(seconds)), "iterations": iterations, "tip": tip.tolist()}


def libraries() -> list[str]:
    """Return the paths of the shared libraries that this process has loaded."""
    with open("/proc/self/maps") as maps:
        return sorted({line.split(maxsplit=5)[5].strip() for line in maps if ".so" in line})


times = {name: solved(scene) for name, scene in json.load(sys.stdin).items()}
print(json.dumps({"libraries": libraries(), "times": times}))
