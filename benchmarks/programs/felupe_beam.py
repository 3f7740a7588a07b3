"""The four scenes of `benchmarks.peers` in felupe: its own laws and Newton from zero, one step.

A program of its own, for a Python that has felupe 11 (python3 -m venv, pip install felupe):

    python scripts/benchmark.py reference_codes.felupe=path/to/python

SuperLU, felupe's default, solves the linear systems or, where pypardiso is installed beside it,
PARDISO for symmetric indefinite matrices, as felupe's guide to external solvers has it: each solve
analyses the matrix again.

Reads scenes as JSON from standard input, writes seconds, iterations, the tip and a note of
each, and the shared libraries that are loaded, as JSON.
"""

import json
import os
import sys
import time

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)

import felupe as fem
import numpy as np
from scipy.sparse import csr_matrix, triu
from scipy.sparse.linalg import spsolve

try:
    from pypardiso import PyPardisoSolver
except ImportError:
    LINEAR, linear = "SuperLU", spsolve
else:
    LINEAR, pardiso = "PARDISO", PyPardisoSolver(mtype=-2)

    def linear(K: csr_matrix, right: np.ndarray) -> np.ndarray:
        """Return the solution of a linear system, K of any inertia."""
        return pardiso.solve(triu(K, format="csr"), right)


def solved(scene: dict) -> dict:
    """Return how long a scene takes, median of `repeats`, and what comes out."""
    size = scene["size"]
    mesh = fem.Cube(b=size, n=tuple(n + 1 for n in scene["cells"]))
    field = fem.Field(fem.RegionHexahedron(mesh), dim=3).as_container()
    E, nu = scene["young"], scene["poisson"]
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    if scene["law"] == "NeoHookeanLn":
        law = fem.NeoHookeCompressible(mu=mu, lmbda=lam)
    else:  # Hooke's law between S and the Green-Lagrange strain
        law = fem.MaterialStrain(fem.linear_elastic, framework="total-lagrange", λ=lam, μ=mu)
    body = fem.SolidBody(law, field)
    end = np.flatnonzero(np.isclose(mesh.points[:, 0], size[0]))
    load = fem.PointLoad(field, end, values=[0.0, 0.0, -scene["force"] / len(end)])
    clamp = {"clamp": fem.Boundary(field[0], fx=0.0)}
    fixed, free = fem.dof.partition(field, clamp)
    total = scene["force"] / np.sqrt(len(end))

    def check(dx: np.ndarray, x: fem.FieldContainer, f: np.ndarray, ftol: float, **_) -> tuple:
        # felupe's own check is relative to the reactions
        residual = np.linalg.norm(f[free]) / total
        return np.linalg.norm(dx), residual, residual < ftol

    def newton() -> fem.tools.NewtonResult:
        field[0].fill(0.0)
        body.results.statevars.fill(0.0)  # MaterialStrain adds to the strain and stress in there
        return fem.newtonraphson(
            items=[body, load],
            dof0=fixed,
            dof1=free,
            solver=linear,
            check=check,
            tol=1e-8,
            maxiter=30,
            verbose=0,
        )

    seconds = []
    iterations = newton().iterations
    for _ in range(scene["repeats"]):
        start = time.perf_counter()
        answer = newton()
        seconds.append(time.perf_counter() - start)
    return {
        "seconds": float(np.median(seconds)),
        "iterations": iterations,
        "tip": answer.x[0].values[end].mean(axis=0).tolist(),
        "note": f"felupe {fem.__version__}, {LINEAR}",
    }


def libraries() -> list[str]:
    """Return the paths of the shared libraries that this process has loaded."""
    with open("/proc/self/maps") as maps:
        return sorted({line.split(maxsplit=5)[5].strip() for line in maps if ".so" in line})


times = {name: solved(scene) for name, scene in json.load(sys.stdin).items()}
print(json.dumps({"libraries": libraries(), "times": times}))
