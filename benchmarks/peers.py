"""Run time of dpl on scenes that public finite-element codes were timed on.

The scenes are a clamped beam of 39 x 9 x 9 trilinear hexahedra (12,000 degrees of freedom) under a
dead load that is distributed evenly over the 100 nodes of its end face, a propeller of the same
size, a beam of 100,000 degrees of freedom, and thousands of random loads.
"""

import json
import math
import os
import re
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dpl import Scene, fem
from dpl.data.solving.solve import LoadKey
from dpl.data.solving.worker_pool import solve_loads
from dpl.fem.linear import make_backend, select_backend

REFERENCE_BLAS = "reference BLAS"
FAMILIES = {"openblas": "OpenBLAS", "mkl": "MKL", "blis": "BLIS", "atlas": "ATLAS"}
FILE = re.compile(r"lib(c?blas|\w*openblas|mkl_|blis|[st]?atlas)")
FOLDERS = "/usr/lib/*/openblas*/libblas.so.3"  # where Debian puts OpenBLAS as a BLAS


@dataclass(frozen=True)
class Case:
    """A load on the beam."""

    law: fem.Material  # material of the beam
    size: tuple[float, float, float]  # lengths of its sides [m]
    young: float  # Young's modulus [Pa]
    force: float  # total force on the end face along -z [N]
    # displacement of the centre of the end face along x and z [m]; nine codes agree on it
    tip: tuple[float, float]

    def build(self, law: fem.Material | None = None) -> tuple[fem.Problem, fem.Load]:
        """Return the beam, of another law if one is given, and its load."""
        mesh = fem.box(self.size, [40, 10, 10])
        problem = fem.Problem.build(mesh, law or self.law, fixed=fem.Plane(0, "min"))
        end = self.end(problem)
        force = torch.zeros(1, *problem.shape, dtype=torch.float64)
        force[0, end, 2] = -self.force / (len(end) * self.young * problem.length**2)
        return problem, fem.Load(force, torch.tensor([self.young], dtype=torch.float64))

    @staticmethod
    def end(problem: fem.Problem) -> torch.Tensor:
        """Return the nodes of the end face."""
        x = problem.points[:, 0]
        return torch.nonzero(x > x.max() - 1e-9).ravel()

    def error(self, problem: fem.Problem, solution: fem.Solution) -> float:
        """Return the distance of the tip from the reference position, over L [-]."""
        tip = solution.displacement[0, self.end(problem)].mean(dim=0) * problem.length
        return self.tip_error(tip.tolist())

    def tip_error(self, tip: Sequence[float]) -> float:
        """Return the distance of a tip displacement (3,) [m] from the reference, over L [-]."""
        return math.dist((tip[0], tip[2]), self.tip) / self.size[0]


LONG, SHORT = (100.0, 25.0, 25.0), (1.0, 0.25, 0.25)
CASES = {
    "S1": Case(fem.NeoHookeanLn(0.3), LONG, 4500.0, 20100.0, (-9.441053465963, -39.987831598531)),
    "S1s": Case(fem.NeoHookeanLn(0.3), LONG, 4500.0, 430.0, (-0.005639797755, -1.000492546995)),
    "S2": Case(
        fem.SaintVenantKirchhoff(0.3), LONG, 4500.0, 20100.0, (-10.060386181979, -40.012725689017)
    ),
    "S3": Case(fem.NeoHookeanLn(0.3), SHORT, 2.03e11, 1.95e7, (-0.005615149126, -0.099693236807)),
}

# Seconds on one core of an AMD Zen 5, set-up and compilation excluded, median of 3; measured for
# this project in 2026. On another machine compare ratios only, best with a code that is timed
# together with dpl.
PUBLISHED = {
    "dolfinx 0.5.2, MUMPS": (0.682, 0.320, 0.614, 0.422),
    "felupe 11.3, PARDISO wrapped": (0.727, 0.323, 0.764, 0.407),
    "Kratos 10.4, AMGCL": (0.909, 0.460, 0.770, 0.579),
    "NGSolve 6.2.2608": (1.145, 0.560, 1.004, 0.721),
    "felupe 11.3 as shipped": (1.370, 0.496, 1.308, 0.731),
    "SfePy 2026.3, PARDISO wrapped": (1.412, 0.694, 1.245, 0.916),
    "warp.fem 1.19 on CPU, PARDISO": (2.463, 1.187, 2.037, 1.471),
    "torch-fem 0.14, CG + AMG": (2.683, 1.140, 2.091, 1.380),
    "GetFEM 5.4.2, MUMPS": (3.782, 1.779, 3.408, 2.245),
    "JAX-FEM 0.0.11, MUMPS": (4.221, 1.945, 3.667, 2.558),
    "torch-fem 0.14, direct": (4.941, 2.452, 4.292, 3.106),
}


@dataclass(frozen=True)
class Time:
    """Median time of a task."""

    case: str  # name of the task
    seconds: float  # median wall time [s]
    iterations: float = float("nan")  # mean number of Newton iterations; NaN where there are none
    note: str = ""  # further numbers


def median(task: Callable[[], object], repeats: int) -> float:
    """Return the median wall time of a task [s]; the first call is not timed."""
    task()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def beams(linear: str, repeats: int) -> dict[str, Time]:
    """Return the time of each case with a backend."""
    rows = {}
    for name, case in CASES.items():
        problem, load = case.build()
        newton = fem.Newton(problem, linear=linear)
        answer = fem.solve(newton, load)
        if not answer.converged or (error := case.error(problem, answer)) > 1e-8:
            raise ArithmeticError(f"{name}: residual {float(answer.residual):.1e}, not the answer")
        seconds = median(partial(fem.solve, newton, load), repeats)
        note = f"tip to {error:.0e} L, residual {float(answer.residual):.0e}"
        rows[name] = Time(f"dpl, {linear}", seconds, int(answer.iterations), note)
    return rows


def time_reference_code(python: str, program: Path, repeats: int) -> dict[str, Time]:
    """Return the time of each case in another code, run by another Python interpreter.

    The program first lists its shared libraries. Where it uses the reference BLAS and Debian's
    OpenBLAS is installed, it runs with OpenBLAS; the notes name the BLAS.
    """
    cases = {
        name: {
            "size": case.size,
            "cells": [39, 9, 9],
            "young": case.young,
            "poisson": 0.3,
            "law": type(case.law).__name__,
            "force": case.force,
            "repeats": repeats,
        }
        for name, case in CASES.items()
    }
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")} | threads
    used = name_of_blas(_run_program(python, program, {}, environment)["libraries"])
    if used == REFERENCE_BLAS and (folder := optimised_blas()):
        before = environment.get("LD_LIBRARY_PATH")
        environment["LD_LIBRARY_PATH"] = f"{folder}:{before}" if before else folder
        used = name_of_blas(_run_program(python, program, {}, environment)["libraries"])
    if used in (None, REFERENCE_BLAS):
        reason = "the reference BLAS, which is several times slower" if used else "no known BLAS"
        raise OSError(
            f"{program.name} with {python}: it uses {reason}; install OpenBLAS "
            "for it (Debian: libopenblas0-pthread)"
        )
    rows = {}
    for name, row in _run_program(python, program, cases, environment)["times"].items():
        error = CASES[name].tip_error(row["tip"])
        if not error <= 1e-8:
            raise OSError(f"{program.name} with {python}: {name}: tip {error:.1e} L off")
        note = ", ".join(filter(None, [f"tip to {error:.0e} L", row.get("note"), used]))
        rows[name] = Time(program.stem, row["seconds"], row["iterations"], note)
    return rows


def name_of_blas(libraries: Sequence[str]) -> str | None:
    """Return the name of the BLAS among shared libraries; None if there is none among them.

    Netlib's reference BLAS is named wherever it is loaded, whatever else is. Debian gives every
    BLAS the file name `libblas.so.3`; the folder tells them apart.
    """
    found = set()
    for library in libraries:
        path = Path(library)
        if not FILE.match(path.name):
            continue
        words = f"{path.parent.name} {path.name}".lower()
        found.add(next((title for key, title in FAMILIES.items() if key in words), REFERENCE_BLAS))
    return REFERENCE_BLAS if REFERENCE_BLAS in found else " and ".join(sorted(found)) or None


def optimised_blas(pattern: str = FOLDERS) -> str | None:
    """Return a folder whose `libblas.so.3` is OpenBLAS, for `LD_LIBRARY_PATH`; None without one."""
    found = sorted(Path("/").glob(pattern.lstrip("/")))
    return str(found[0].parent) if found else None


def _run_program(
    python: str, program: Path, cases: Mapping[str, object], environment: Mapping[str, str]
) -> dict[str, Any]:
    """Return the output of a program: its shared libraries and the times by case."""
    done = subprocess.run(
        [python, str(program)],
        input=json.dumps(cases),
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode:
        reason = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise OSError(f"{program.name} with {python}: {reason[-1]}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


@dataclass(frozen=True)
class EnergyAlone(fem.Material):
    """A law that is the energy of another law and nothing else: derivatives are automatic."""

    law: fem.Material

    def energy(self, H: torch.Tensor) -> torch.Tensor:
        """Return the energy density, see `Material.energy`."""
        return self.law.energy(H)


def pieces(repeats: int) -> list[Time]:
    """Return the times of the parts of a Newton iteration of case S1."""
    problem, load = CASES["S1"].build()
    u = fem.solve(fem.Newton(problem, tol=1e-4), load).displacement
    gap = problem.update_strain_gap(None, 1.0, 0.1 * u)
    values = problem.linearise(u).tangent[0].numpy()
    right = problem.restrict(load.force[0])
    rows = [
        Time("residual and min det F, compiled", median(partial(problem.evaluate, u), repeats)),
        Time("residual, tensors", median(partial(problem.internal_force, u), repeats)),
        Time("tangent and residual, compiled", median(partial(problem.linearise, u), repeats)),
        Time("the same, mixed points", median(partial(problem.linearise, u, gap), repeats)),
        Time("tangent, tensors", median(partial(problem.tangent, u), repeats)),
    ]
    slow = CASES["S1"].build(EnergyAlone(problem.material))[0]
    for name, call in (("residual", slow.evaluate), ("tangent and residual", slow.linearise)):
        seconds = median(partial(call, u), repeats)
        rows.append(Time(f"{name}, by the energy alone", seconds))
    for name in ("band32", "band", "pardiso", "superlu"):
        try:
            solver = make_backend(problem.pattern, name)
        except ValueError:  # not installed
            continue
        factor = solver.factorise(values)
        seconds = median(partial(solver.factorise, values), repeats)
        rows.append(Time(f"factorisation, {name}", seconds))
        seconds = median(partial(factor.solve, right), repeats)
        rows.append(Time(f"solve to 1e-12, {name}", seconds))
    return rows


def propeller_scene(linear: str = "auto", deflection: float = 0.055) -> Scene:
    """Return the propeller of NH-ln, fixed at its bore, with deflections up to L / 10."""
    problem = fem.Problem.build(fem.propeller(), fem.NeoHookeanLn(0.3), fixed=fem.Tag("bore"))
    newton = fem.Newton(problem, linear=linear)
    return Scene(
        problem, fem.ModalLoads(newton.linear_solver, n_modes=10, deflection=deflection), newton
    )


def beam_scene(law: fem.Material | Mapping[str, fem.Material], **options: Any) -> Scene:
    """Return the paper's beam with its loads, deflections up to 0.4 L."""
    problem = fem.Problem.build(
        fem.box(LONG, [40, 10, 10]), law, fixed=fem.Plane(0, "min"), **options
    )
    newton = fem.Newton(problem)
    return Scene(
        problem, fem.ModalLoads(newton.linear_solver, deflection=0.4, young=4500.0), newton
    )


def fibre_scene() -> Scene:
    """Return the paper's beam with oblique fibres of Guccione's law, nearly incompressible.

    Each load has its own stiffness of the fibres, 0.1 to 1, and bulk modulus, 10 to 1e4.
    """
    law = fem.FibreReinforced(
        fem.VolumetricK4({"low": 10.0, "high": 1e4, "distribution": "log"}),
        fem.Guccione({"low": 0.1, "high": 1.0, "distribution": "log"}, 8.0, 2.0, 4.0),
        fem.ConstantFibres([2.0, 1.0, 0.0]),
    )
    return beam_scene(law, mean_dilatation=True)


def inclusion_scene() -> Scene:
    """Return the paper's beam with a core, 1 to 1,000 times as stiff, another one for each load."""
    stiff = {"low": 1.0, "high": 1e3, "distribution": "log"}
    laws = {"core": fem.NeoHookeanLn(0.3, stiff), "other": fem.NeoHookeanLn(0.3)}
    return beam_scene(laws, regions={"core": fem.Box([25.0, 7.5, 7.5], [75.0, 17.5, 17.5])})


def propellers(linear: str, loads: int) -> Time:
    """Return the median time of a random load on the propeller."""
    scene = propeller_scene(linear)
    batch = scene.loads.sample(0, range(loads))
    singles = batch.unbatch()
    fem.solve(scene.solver, singles[0])
    answers = [fem.solve(scene.solver, load) for load in singles]
    seconds = statistics.median(float(answer.seconds) for answer in answers)
    reached = sorted(float(a.displacement.norm(dim=-1).max()) for a in answers)
    good = sum(bool(a.converged) for a in answers)
    name = select_backend(linear, scene.problem.pattern)
    note = f"{good}/{loads} converged, deflections {reached[0]:.3f} to {reached[-1]:.3f} L"
    iterations = statistics.mean(int(a.iterations) for a in answers)
    return Time(f"propeller, {name}", seconds, iterations, note)


def large(linear: str) -> Time:
    """Return the time of one Newton iteration on 100,548 degrees of freedom, and its memory."""
    mesh = fem.box([1.0, 0.25, 0.25], [76, 21, 21])
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"))
    newton = fem.Newton(problem, linear=linear, tol=1e-8)
    force = torch.zeros(1, *problem.shape, dtype=torch.float64)
    end = Case.end(problem)
    force[0, end, 2] = -1e-4 / len(end)
    states = newton.iterate(fem.Load(force, torch.ones(1, dtype=torch.float64)))
    start = time.perf_counter()
    next(states), next(states)
    first = time.perf_counter() - start
    times = []
    while True:
        start = time.perf_counter()
        if (state := next(states, None)) is None:
            break
        times.append(time.perf_counter() - start)
        last = state
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    note = (
        f"first one, with analysis and K(0), {first:.1f} s; peak {peak:.1f} GB; "
        f"residual {float(last.residual):.0e} after {int(last.iterations)}"
    )
    return Time(f"100,548 degrees of freedom, {linear}: one iteration", max(times), note=note)


@dataclass(frozen=True)
class Robustness:
    """Random loads of a body that are solved; iterations and times are of loads in one step."""

    body: str  # name of the body
    loads: int  # number of loads
    in_one_step: int  # number of loads that are solved in one load step
    with_load_steps: int  # number of loads that are solved in one load step or more
    no_stable_solution: int  # number of loads for which the solver states a reason, and no solution
    iterations: float  # mean number of iterations
    seconds: float  # median wall time [s]
    min_det_F: float  # smallest det F [-]
    largest_deflection: float  # largest nodal displacement over L [-]


def robustness(
    scenes: Mapping[str, Callable[[], Scene]], loads: int, workers: int
) -> Iterator[Robustness]:
    """Yield how many random loads of each scene are solved, in one step and with load steps."""
    for name, build in scenes.items():
        scene = build()
        once = replace(scene, solver=replace(scene.newton, min_load_step=0.9))
        jobs = [LoadKey((0, 0), k) for k in range(loads)]
        first = list(solve_loads(once, jobs, workers=workers))
        failed = [o.job for o in first if not o.accepted]
        second = list(solve_loads(scene, failed, workers=workers)) if failed else []
        done = [o for o in first if o.accepted]
        yield Robustness(
            body=name,
            loads=loads,
            in_one_step=len(done),
            with_load_steps=len(done) + sum(o.accepted for o in second),
            no_stable_solution=sum(not o.accepted for o in second),
            iterations=statistics.mean(o.iterations for o in done),
            seconds=statistics.median(o.seconds for o in done),
            min_det_F=min(o.volume_ratio for o in done),
            largest_deflection=max(
                float(np.linalg.norm(o.displacement, axis=1).max()) for o in done
            ),
        )
