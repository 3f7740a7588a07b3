"""Random grasps of a body: errors, reactions and times of a network and of Newton's method."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from dpl import Scene, Simulator
from dpl.fem import Load, Sphere, solve
from dpl.fem.solvers.rigid_patch import RigidPatch
from dpl.inference import GraspAnswer
from dpl.inference.grasp import Gripper
from dpl.visualization import DPI, STYLE

RADII = 0.05, 0.15  # smallest and largest radius of a patch over L [-]
LOADS = 32  # training loads whose largest energy is that of the largest grasp
HALVINGS = 6  # of the amplitude of the grasps whose errors are drawn against it
WRONG = 0.01  # relative error of a displacement from which it must be reported [-]
REPORTED = 1 / 3  # smallest ratio of an estimated error to the error that counts as a report [-]
REFERENCE_TOL = 1e-9  # relative residual of the solutions that errors are relative to [-]


@dataclass(frozen=True)
class Grasp:
    """A patch and its motion.

    Attributes:
        region: The patch.
        translation: (3,) [m].
        rotation: Rotation vector, (3,) [rad].
    """

    region: Sphere
    translation: list[float]
    rotation: list[float]

    def scaled(self, factor: float) -> "Grasp":
        """Return the grasp with a motion of `factor` times the size."""
        moved = [[factor * x for x in part] for part in (self.translation, self.rotation)]
        return Grasp(self.region, *moved)


@dataclass(frozen=True)
class Row:
    """Errors and times of a method for many grasps.

    Attributes:
        method: "network", "corrected", "hybrid to 1e-6" or "Newton from rest to 1e-6".
        count: Number of grasps.
        motion_worst: Largest distance of a held node from its prescribed place over L [-].
        rel_L2_median, rel_L2_worst: Relative L2 errors of displacements [-].
        force_median, force_worst: Relative errors of the resultant force [-].
        moment_worst: Largest error of the moment, over the moment plus force times radius [-].
        converged: Part of the grasps that converge to the tolerance of the method [%].
        silent: Grasps with an error above `WRONG` that the estimated error does not report.
        iterations: Mean number of linear solves; of the network, of predictions and corrections.
        p50_ms, p99_ms: Times of a grasp of a patch that is prepared, one thread [ms].
    """

    method: str
    count: int
    motion_worst: float
    rel_L2_median: float
    rel_L2_worst: float
    force_median: float
    force_worst: float
    moment_worst: float
    converged: float
    silent: int
    iterations: float
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True)
class Amplitude:
    """Errors of predictions for grasps of one amplitude.

    Attributes:
        amplitude: Factor on the motions [-].
        error: Median over the grasps of the error of the displacement, its norm over that at the
            amplitude 1 [-].
        linear: The same of the linear solution.
    """

    amplitude: float
    error: float
    linear: float


def random_grasps(scene: Scene, count: int, seed: int = 0) -> Iterator[Grasp]:
    """Yield grasps of patches around random nodes of the loadable boundary of a body in 3D.

    Motions are isotropic in the linear energy norm: soft directions have large displacements. The
    linear energy is at most that of the largest of `LOADS` training loads.

    Args:
        scene: The body and its training loads.
        count: Number of grasps.
        seed: Of the random numbers.
    """
    rng, problem = np.random.default_rng(seed), scene.problem
    loads = scene.loads.sample((seed, 9), range(LOADS)).force
    largest = max(float((f * scene.linear.solve(f)).sum()) for f in loads)
    centres = np.flatnonzero(scene.loads.loadable_dofs.all(dim=1).numpy())
    places = (problem.points.numpy() + problem.origin) * problem.length
    for _ in range(count):
        radius = rng.uniform(*RADII) * problem.length
        region = Sphere(places[rng.choice(centres)].tolist(), radius)
        patch = RigidPatch.of(scene.linear, region, [True] * 3)
        direction = rng.standard_normal(6)
        direction *= math.sqrt(largest) * rng.uniform() / np.linalg.norm(direction)
        values, vectors = np.linalg.eigh(rigid_stiffness(patch))
        motion = vectors @ (vectors.T @ direction / np.sqrt(values))
        yield Grasp(region, (problem.length * motion[:3]).tolist(), motion[3:].tolist())


def rigid_stiffness(patch: RigidPatch) -> np.ndarray:
    """Return the linear stiffness of a patch against rigid motions, (6, 6) [-]."""
    small, zero = 1e-6, [0.0] * 3
    units = (small * np.eye(3)).tolist()
    motions = [patch.displacement(t, zero) for t in units]
    motions += [patch.displacement(zero, w) for w in units]
    fields = torch.stack(motions, dim=1) / small
    forces = torch.stack([patch.stiffness_times(field) for field in fields.T], dim=1)
    stiffness: np.ndarray = (fields.T @ forces).numpy()
    return (stiffness + stiffness.T) / 2


def reference(scene: Scene, grasp: Grasp, tol: float = REFERENCE_TOL) -> tuple[Tensor, Tensor, int]:
    """Return displacement (N, D) [-], forces of the gripper (N, D) [-] and linear solves.

    Computed by Newton's method from rest.

    Raises:
        RuntimeError: It does not converge.
    """
    patch = RigidPatch.of(scene.linear, grasp.region, [True] * 3)
    goal = patch.displacement([x / scene.length for x in grasp.translation], grasp.rotation)
    newton = replace(patch.newton(scene.newton, goal), tol=tol)
    rest = torch.zeros(1, *scene.problem.shape, dtype=torch.float64)
    state = solve(newton, Load(rest, torch.ones(1, dtype=torch.float64)))
    if not bool(state.converged):
        raise RuntimeError("no equilibrium found")
    internal = newton.problem.evaluate(state.displacement).internal[0]
    return state.displacement[0], torch.where(patch.held, internal, 0.0), int(state.iterations)


def measure(
    simulator: Simulator, grasps: Sequence[Grasp], done: Callable[[int], None] = lambda k: None
) -> tuple[list[Row], int]:
    """Return a row for each method, and the number of grasps without a reference solution.

    Args:
        simulator: Simulator of a scene in 3D.
        grasps: The grasps.
        done: Called with the number of grasps that are finished.
    """
    scene = simulator.scene
    network = Gripper(simulator.surrogate, steps=0)
    calls: dict[str, Callable[[Grasp], GraspAnswer]] = {
        "network": lambda g: network(g.region, g.translation, g.rotation),
        "corrected": lambda g: simulator.grasp(g.region, g.translation, g.rotation),
        "hybrid to 1e-6": lambda g: simulator.grasp(g.region, g.translation, g.rotation, tol=1e-6),
    }
    found: dict[str, list[list[float]]] = {
        name: [] for name in (*calls, "Newton from rest to 1e-6")
    }
    unknown = 0
    for k, grasp in enumerate(grasps):
        try:
            exact, forces, _ = reference(scene, grasp)
            begin = time.perf_counter()
            displacement, own, iterations = reference(scene, grasp, 1e-6)
            taken = 1e3 * (time.perf_counter() - begin)
        except RuntimeError:
            unknown += 1
            continue
        for name, call in calls.items():
            call(grasp)  # prepares the patch
            answer = call(grasp)
            u = torch.from_numpy(answer.displacement) / scene.length
            unit = float(scene.loads.young_range[0]) * scene.force_unit
            row = _errors(
                scene, grasp, (u, torch.from_numpy(answer.nodal_force) / unit), (exact, forces)
            )
            quality = [answer.motion_error / scene.length, answer.converged, answer.error]
            found[name].append([*row, *quality, answer.iterations, answer.milliseconds])
        row = _errors(scene, grasp, (displacement, own), (exact, forces))
        found["Newton from rest to 1e-6"].append([*row, 0.0, 1.0, row[0], iterations, taken])
        done(k + 1)
    return [_row(name, np.array(rows)) for name, rows in found.items()], unknown


def _errors(
    scene: Scene, grasp: Grasp, found: tuple[Tensor, Tensor], exact: tuple[Tensor, Tensor]
) -> list[float]:
    """Return the relative errors of displacement, force and moment."""
    patch = RigidPatch.of(scene.linear, grasp.region, [True] * 3)
    ours, theirs = (patch.wrench(forces, u) for u, forces in (found, exact))
    force, moment = theirs.force.norm(), theirs.moment.norm()
    radius = grasp.region.radius / scene.length
    return [
        float((found[0] - exact[0]).norm() / exact[0].norm()),
        float((ours.force - theirs.force).norm() / force),
        float((ours.moment - theirs.moment).norm() / (moment + radius * force)),
    ]


def _row(method: str, values: np.ndarray) -> Row:
    """Return the row of a method from its numbers, (count, 8), in the order of `measure`."""
    error, force, moment, motion, converged, estimate, iterations, taken = values.T
    silent = (error > WRONG) & ~(estimate > REPORTED * error)
    return Row(
        method=method,
        count=len(values),
        motion_worst=float(motion.max()),
        rel_L2_median=median(error.tolist()),
        rel_L2_worst=float(error.max()),
        force_median=median(force.tolist()),
        force_worst=float(force.max()),
        moment_worst=float(moment.max()),
        converged=100 * float(converged.mean()),
        silent=int(silent.sum()),
        iterations=float(iterations.mean()),
        p50_ms=float(np.quantile(taken, 0.5)),
        p99_ms=float(np.quantile(taken, 0.99)),
    )


def against_amplitude(simulator: Simulator, grasps: Sequence[Grasp]) -> list[Amplitude]:
    """Return the median errors of predictions at decreasing amplitudes; slope two is expected.

    Args:
        simulator: Simulator of a scene in 3D.
        grasps: The grasps at the amplitude 1.
    """
    scene, network = simulator.scene, Gripper(simulator.surrogate, steps=0)
    rows = []
    for factor in (2.0**-k for k in range(HALVINGS + 1)):
        errors, linear = [], []
        for grasp in grasps:
            whole = reference(scene, grasp)[0].norm()
            small = grasp.scaled(factor)
            exact = reference(scene, small)[0]
            answer = network(small.region, small.translation, small.rotation)
            u = torch.from_numpy(answer.displacement) / scene.length
            errors.append(float((u - exact).norm() / whole))
            patch = RigidPatch.of(scene.linear, small.region, [True] * 3)
            goal = patch.displacement([x / scene.length for x in small.translation], small.rotation)
            own = scene.linear.solve(patch.at(patch.stiffness_times(goal)))
            linear.append(float((own - exact).norm() / whole))
        rows.append(Amplitude(factor, median(errors), median(linear)))
    return rows


def slope(rows: Sequence[Amplitude]) -> float:
    """Return the slope of the errors of predictions against the amplitude, both logarithmic."""
    x, y = np.log([[row.amplitude, row.error] for row in rows]).T
    return float(np.polyfit(x, y, 1)[0])


def draw(rows: Sequence[Amplitude], file: Path) -> None:
    """Draw the errors of predictions and of linear solutions against the amplitude.

    Args:
        rows: Rows of `against_amplitude`.
        file: Of the picture.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    x = np.array([row.amplitude for row in rows])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.2, 3.0), layout="constrained")
        ax = figure.subplots()
        ax.loglog(x, [row.linear for row in rows], "s-", color="0.6", label="linear solution")
        ax.loglog(x, [row.error for row in rows], "o-", color="black", label="network")
        ax.loglog(x, rows[0].error * x**2, ":", color="black", label="slope 2")
        ax.set_xlabel("amplitude of the motion [-]")
        ax.set_ylabel("error of the displacement [-]")
        ax.legend()
        figure.savefig(file, dpi=DPI)
