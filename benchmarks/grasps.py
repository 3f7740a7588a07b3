"""Measure random grasps of a trained run: python scripts/grasps.py run=runs/beam.

Errors, reactions and times of the network and of Newton's method.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from benchmarks import CONF
from benchmarks.study import METHOD_COLOURS, picture, record
from dpl import Scene, config
from dpl.commands.cli import command
from dpl.fem import Load, RigidPatch, Sphere
from dpl.inference import Gripper
from dpl.models.unrolled.correction import MAX_STEPS
from dpl.system.threads import one_thread
from dpl.training import TrainedSurrogate

RADII = 0.05, 0.15  # smallest and largest radius of a patch over L [-]
LOADS = 32  # training loads whose largest energy is that of the largest grasp
MAX_TRIES = 20  # patches that are drawn for each grasp
SINGULAR = 1e-9  # smallest over largest stiffness of a patch that can be turned [-]
HALVINGS = 6  # of the amplitude of the grasps whose errors are drawn against it
MET = 1e-3  # distance of a node from its prescribed place that counts as met [-]
WRONG = 0.01  # relative error of a displacement from which it must be reported [-]
REPORTED = 1 / 3  # smallest ratio of an estimated error to the error that counts as a report [-]
CHECKED = 10  # frames from one to the next whose error is computed
LATE = 1.2  # time over the budget that counts as late [-]
BUDGETS = None, 5.0, 10.0, 14.0, 30.0  # of the frames of a hand [ms]
NEWTON = "Newton from rest to 1e-6"
TOL = 1e-6  # relative residual of the methods that iterate to a tolerance [-]
REFERENCE_TOL = 1e-9  # relative residual of the solutions that errors are relative to [-]


@dataclass(frozen=True)
class Grasp:
    """A patch and its motion."""

    region: Sphere  # the patch
    translation: list[float]  # (3,) [m]
    rotation: list[float]  # rotation vector, (3,) [rad]

    def scaled(self, factor: float) -> "Grasp":
        """Return the grasp with a motion of `factor` times the size."""
        moved = [[factor * x for x in part] for part in (self.translation, self.rotation)]
        return Grasp(self.region, *moved)


@dataclass(frozen=True)
class Row:
    """Errors and times of a method for many grasps."""

    method: str  # "prediction", "corrected", "hybrid to 1e-6" or "Newton from rest to 1e-6"
    count: int  # number of grasps
    # part of the grasps with forces under which the network predicts the motion [%]; 100 for
    # Newton's method from rest
    found: float
    motion_met: float  # part of the grasps with all held nodes within 1e-3 L of their places [%]
    # rel_L2_median, rel_L2_p95, rel_L2_worst: relative L2 errors of displacements [-]
    rel_L2_median: float
    rel_L2_p95: float
    rel_L2_worst: float
    # force_median, force_p95, force_worst: relative errors of the resultant force [-]
    force_median: float
    force_p95: float
    force_worst: float
    moment_p95: float  # error of the moment, over the moment plus force times radius [-]
    converged: float  # part of the grasps that converge to the tolerance of the method [%]
    silent: int  # grasps with an error above `WRONG` that the estimated error does not report
    # mean number of linear solves; of the network, of predictions and corrections
    iterations: float
    # p50_ms, p99_ms: times of a grasp of a patch that is prepared, one thread [ms]
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True)
class Amplitude:
    """Errors of predictions for grasps of one amplitude."""

    amplitude: float  # factor on the motions [-]
    # median over the grasps of the error of the displacement, its norm over that at the amplitude 1
    # [-]
    error: float
    linear: float  # the same of the linear solution


@dataclass(frozen=True)
class Hand:
    """Times and errors of the frames of a hand that makes the motion of a grasp."""

    budget_ms: float | None  # wall time of a frame [ms]; None: no budget
    frames: int  # number of frames
    first_ms: float  # time of the first frame of a patch, which prepares it [ms]
    p50_ms: float  # times of the others [ms]
    p99_ms: float
    cpu_p50_ms: float  # processor times of the others, without those of other programs [ms]
    cpu_p99_ms: float
    late: float  # part of the frames that take more than `LATE` times the budget [%]
    cpu_late: float  # part of the frames whose processor time is that long [%]
    # rel_L2_median, rel_L2_worst: relative L2 errors of every `CHECKED`th displacement [-]
    rel_L2_median: float
    rel_L2_worst: float


def random_grasps(scene: Scene, count: int, seed: int = 0) -> Iterator[Grasp]:
    """Yield grasps of patches around random nodes of the loadable boundary of a body in 3D.

    Motions are isotropic in the linear energy norm: soft directions have large displacements. The
    linear energy is at most that of the largest of `LOADS` training loads.
    """
    rng, problem = np.random.default_rng(seed), scene.problem
    loads = scene.loads.sample((seed, 9), range(LOADS)).force
    largest = max(float((f * scene.linear.solve(f)).sum()) for f in loads)
    loaded = scene.loads.loadable_dofs.all(dim=1) & problem.boundary
    centres = np.flatnonzero(loaded.numpy())
    places = (problem.points.numpy() + problem.origin) * problem.length
    found = 0
    for _ in range(MAX_TRIES * count):
        radius = rng.uniform(*RADII) * problem.length
        region = Sphere(places[rng.choice(centres)].tolist(), radius)
        patch = RigidPatch.of(scene.linear, region, [True] * 3)
        values, vectors = np.linalg.eigh(rigid_stiffness(patch))
        if values[0] < SINGULAR * values[-1]:  # fewer than three nodes, or all on one line
            continue
        direction = rng.standard_normal(6)
        direction *= math.sqrt(largest) * rng.uniform() / np.linalg.norm(direction)
        motion = vectors @ (vectors.T @ direction / np.sqrt(values))
        yield Grasp(region, (problem.length * motion[:3]).tolist(), motion[3:].tolist())
        found += 1
        if found == count:
            return
    raise ValueError(f"only {found} of {count} patches of this mesh can be turned; refine it")


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


class Reference(NamedTuple):
    """Solution of Newton's method."""

    displacement: Tensor  # (N, D) [-]
    force: Tensor  # forces of the gripper, (N, D) [-]
    iterations: int  # linear solves
    milliseconds: float  # wall time [ms]


def references(scene: Scene, patch: RigidPatch, grasp: Grasp) -> list[Reference] | None:
    """Return the solutions of Newton's method from rest to 1e-6 and to `REFERENCE_TOL`.

    None if it does not converge.
    """
    goal = patch.displacement([x / scene.length for x in grasp.translation], grasp.rotation)
    newton = patch.newton(scene.newton, goal)
    load = Load(torch.zeros(1, *scene.problem.shape).double(), torch.ones(1).double())
    found, guess = [], None
    for tol in (TOL, REFERENCE_TOL):
        begin = time.perf_counter()
        *_, state = replace(newton, tol=tol).iterate(load, guess=guess)
        taken = 1e3 * (time.perf_counter() - begin)
        if not bool(state.converged):
            return None
        guess = state.displacement
        internal = newton.problem.evaluate(guess).internal[0]
        force = torch.where(patch.held, internal, 0.0)
        found.append(Reference(guess[0], force, int(state.iterations), taken))
    return found


def measure(
    gripper: Gripper, grasps: Sequence[Grasp], done: Callable[[int], None] = lambda k: None
) -> tuple[list[Row], int]:
    """Return a row for each method, and the number of grasps without a reference solution."""
    scene = gripper.scene
    raw = Gripper(gripper.surrogate, steps=0)
    options = {
        "prediction": (raw, None),
        "corrected": (gripper, None),
        "hybrid to 1e-6": (gripper, TOL),
    }
    found: dict[str, list[list[float]]] = {name: [] for name in (*options, NEWTON)}
    unit = float(scene.loads.moduli[0]) * scene.force_unit
    for k, grasp in enumerate(grasps):
        patch = gripper.patch([grasp.region], [[True] * 3], torch.zeros(1, 0).double())
        if (known := references(scene, patch, grasp)) is None:
            continue
        for one in (gripper, raw):  # times are those of a patch that is prepared
            one.patch([grasp.region], [[True] * 3], torch.zeros(1, 0).double()).compliance_factor  # noqa: B018
        rest, exact = known
        size = grasp.region.radius / scene.length
        own = _errors(patch, size, (rest.displacement, rest.force), exact)
        found[NEWTON].append([*own, 0.0, 1.0, own[0], rest.iterations, rest.milliseconds, 1.0])
        for name, (method, tol) in options.items():
            answer = method(grasp.region, grasp.translation, grasp.rotation, tol=tol)
            u, force = answer.displacement / scene.length, answer.nodal_force / unit
            own = _errors(patch, size, (torch.from_numpy(u), torch.from_numpy(force)), exact)
            quality = [answer.motion_error / scene.length, answer.converged, answer.error]
            work = [answer.iterations, answer.milliseconds, answer.forces_found]
            found[name].append([*own, *quality, *work])
        done(k + 1)
    return [_row(name, np.array(rows)) for name, rows in found.items()], len(grasps) - len(
        found[NEWTON]
    )


def _errors(
    patch: RigidPatch, radius: float, found: tuple[Tensor, Tensor], exact: Reference
) -> list[float]:
    """Return the relative errors of displacement, force and moment."""
    ours = patch.wrench(found[1], found[0])
    theirs = patch.wrench(exact.force, exact.displacement)
    force, moment = theirs.force.norm(), theirs.moment.norm()
    return [
        float((found[0] - exact.displacement).norm() / exact.displacement.norm()),
        float((ours.force - theirs.force).norm() / force),
        float((ours.moment - theirs.moment).norm() / (moment + radius * force)),
    ]


def _row(method: str, values: np.ndarray) -> Row:
    """Return the row of a method from its numbers, (count, 9), in the order of `measure`."""
    error, force, moment, motion, converged, estimate, iterations, taken, predicted = values.T
    silent = (error > WRONG) & ~(estimate > REPORTED * error)
    return Row(
        method=method,
        count=len(values),
        found=100 * float(predicted.mean()),
        motion_met=100 * float((motion <= MET).mean()),
        rel_L2_median=median(error.tolist()),
        rel_L2_p95=float(np.quantile(error, 0.95)),
        rel_L2_worst=float(error.max()),
        force_median=median(force.tolist()),
        force_p95=float(np.quantile(force, 0.95)),
        force_worst=float(force.max()),
        moment_p95=float(np.quantile(moment, 0.95)),
        converged=100 * float(converged.mean()),
        silent=int(silent.sum()),
        iterations=float(iterations.mean()),
        p50_ms=float(np.quantile(taken, 0.5)),
        p99_ms=float(np.quantile(taken, 0.99)),
    )


def against_amplitude(gripper: Gripper, grasps: Sequence[Grasp]) -> list[Amplitude]:
    """Return the median errors of predictions at decreasing amplitudes; slope two is expected.

    Grasps without a reference solution are left out.
    """
    raw, scene = Gripper(gripper.surrogate, steps=0), gripper.scene
    factors = [2.0**-k for k in range(HALVINGS + 1)]
    errors: dict[float, list[tuple[float, float]]] = {factor: [] for factor in factors}
    for grasp in grasps:
        size = 0.0
        for factor in factors:
            part = grasp.scaled(factor)
            patch = raw.patch([grasp.region], [[True] * 3], torch.zeros(1, 0).double())
            if (known := references(scene, patch, part)) is None:
                break
            exact = known[-1].displacement
            size = size or float(exact.norm())
            u = torch.from_numpy(raw(part.region, part.translation, part.rotation).displacement)
            goal = patch.displacement([x / scene.length for x in part.translation], part.rotation)
            linear = scene.linear.solve(patch.at(patch.stiffness_times(goal)))
            off = (u / scene.length - exact).norm(), (linear - exact).norm()
            errors[factor].append((float(off[0]) / size, float(off[1]) / size))
    columns = {factor: zip(*pairs, strict=True) for factor, pairs in errors.items() if pairs}
    return [Amplitude(factor, *map(median, both)) for factor, both in columns.items()]


def moving_hands(
    surrogate: TrainedSurrogate,
    grasps: Sequence[Grasp],
    budgets: Sequence[float | None],
    *,
    steps: int,
    frames: int,
) -> list[Hand]:
    """Return times and errors of a hand for each budget that makes each grasp in equal frames.

    The patch of each grasp is new, so that its first frame prepares it.
    """
    scene = surrogate.scene
    grippers = [Gripper(surrogate, steps=steps, warm=True) for _ in budgets]
    first, times = ([list[tuple[float, float]]() for _ in budgets] for _ in range(2))
    errors = [list[float]() for _ in budgets]
    for grasp, k in itertools.product(grasps, range(1, frames + 1)):
        part = grasp.scaled(k / frames)
        found = []
        for i, gripper in enumerate(grippers):
            begin = time.perf_counter(), time.thread_time()
            answer = gripper(part.region, part.translation, part.rotation, budget_ms=budgets[i])
            wall, processor = time.perf_counter() - begin[0], time.thread_time() - begin[1]
            (times if k > 1 else first)[i].append((1e3 * wall, 1e3 * processor))
            found.append(answer.displacement / scene.length)
        patch = grippers[0].patch([grasp.region], [[True] * 3], torch.zeros(1, 0).double())
        if k % CHECKED == 0 and (known := references(scene, patch, part)) is not None:
            exact = known[-1].displacement.numpy()
            for own, u in zip(errors, found, strict=True):
                own.append(float(np.linalg.norm(u - exact) / np.linalg.norm(exact)))
    columns = zip(budgets, first, times, errors, strict=True)
    return [_hand(*column) for column in columns]


def _hand(
    budget_ms: float | None,
    first: list[tuple[float, float]],
    times: list[tuple[float, float]],
    errors: list[float],
) -> Hand:
    """Return the row of a hand from wall and processor times [ms] and relative errors."""
    late = 100 * (np.array(first + times) > LATE * (budget_ms or math.inf)).mean(axis=0)
    (p50, cpu_p50), (p99, cpu_p99) = np.quantile(times, [0.5, 0.99], axis=0).tolist()
    return Hand(
        budget_ms=budget_ms,
        frames=len(first) + len(times),
        first_ms=median(wall for wall, _ in first),
        p50_ms=p50,
        p99_ms=p99,
        cpu_p50_ms=cpu_p50,
        cpu_p99_ms=cpu_p99,
        late=float(late[0]),
        cpu_late=float(late[1]),
        rel_L2_median=median(errors) if errors else math.nan,  # no reference solution
        rel_L2_worst=max(errors, default=math.nan),
    )


def slope(rows: Sequence[Amplitude]) -> float:
    """Return the slope of the errors of predictions against the amplitude, both logarithmic."""
    x, y = np.log([[row.amplitude, row.error] for row in rows]).T
    return float(np.polyfit(x, y, 1)[0])


def draw(rows: Sequence[Amplitude], path: Path) -> None:
    """Draw the errors of predictions and of linear solutions against the amplitude."""
    x = np.array([row.amplitude for row in rows])
    colour, grey = (METHOD_COLOURS[name] for name in ("unrolled", "linear"))
    with picture(path) as figure:
        ax = figure.subplots()
        ax.loglog(x, [row.linear for row in rows], "s-", color=grey, label="linear solution")
        ax.loglog(x, [row.error for row in rows], "o-", color=colour, label="prediction")
        ax.loglog(x, rows[0].error * x**2, ":", color=colour, label="slope 2")
        ax.set(xlabel="amplitude of the motion [-]", ylabel="error of the displacement [-]")
        ax.grid(visible=True)
        ax.legend()


KEYS = (
    (str, "name"),
    (int, "count", 1, 10**6),
    (int, "seed", 0, 10**9),
    (int, "amplitudes hands", 1, 10**4),
    (int, "frames", 10, 10**6),
)


@command("grasps", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure random grasps: motion, displacement, reactions, estimated error and times."""
    _, surrogate = config.load_run(cfg.run)
    if surrogate.scene.problem.shape[1] != 3:
        raise config.ConfigError(f"run = {cfg.run} must have a body in 3D")
    gripper, stem = Gripper(surrogate, steps=MAX_STEPS), Path(cfg.folder) / cfg.name
    every = list(random_grasps(surrogate.scene, cfg.count, cfg.seed))

    def say(number: int) -> None:
        if number % 50 == 0:
            print(f"{number} of {cfg.count} grasps", flush=True)

    with one_thread():
        rows, unknown = measure(gripper, every, say)
        amplitudes = against_amplitude(gripper, every[: cfg.amplitudes])
        some = every[: cfg.hands]
        hands = moving_hands(surrogate, some, BUDGETS, steps=MAX_STEPS, frames=cfg.frames)
    record(hands, stem.with_name(f"{cfg.name}_hand"), f"{cfg.hands} grasps as motions of a hand")
    record(rows, stem, f"{cfg.count - unknown} random grasps, 1 thread")
    record(amplitudes, stem.with_name(f"{cfg.name}_amplitude"), None, draw)
    print(f"without a solution by Newton's method from rest, left out: {unknown}")
    print(f"slope of the error of the network in the amplitude: {slope(amplitudes):.2f}")
