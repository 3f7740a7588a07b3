"""Laws of `dpl.data.solving.solve`: a load solved is a function of scene, stream and number."""

import pickle
import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from set_files import fields_of as content

from dpl.data.solving import solve
from dpl.data.solving.solve import LoadKey, failed_load, solve_load
from dpl.fem import Load, Newton

SEED = (5, 0)


@pytest.fixture(scope="module")
def jobs():
    return [LoadKey(SEED, index) for index in range(8)]


def test_a_solution_does_not_depend_on_the_loads_solved_before(scene, jobs):
    forwards = [content(solve_load(scene, job)) for job in jobs]
    backwards = [content(solve_load(scene, job)) for job in jobs[::-1]]
    assert backwards[::-1] == forwards


def test_a_solution_does_not_depend_on_the_scene_object_its_size_and_stiffness(
    scene, make_scene, jobs
):
    twin = make_scene(size=(1.0, 0.25, 0.25), young=2e11)
    assert content(solve_load(make_scene(), jobs[3])) == content(solve_load(scene, jobs[3]))
    assert (
        content(solve_load(twin, jobs[3]))["force"] == content(solve_load(scene, jobs[3]))["force"]
    )


@pytest.fixture
def newton_starts(monkeypatch):
    """The list of loads that Newton's method solves, extended by each solve."""
    found, iterate = [], Newton.iterate

    def counted(newton, load, **options):
        found.append(load)
        return iterate(newton, load, **options)

    monkeypatch.setattr(Newton, "iterate", counted)
    return found


def test_loads_of_compact_bodies_are_solved_without_newton(make_scene, jobs, newton_starts):
    scene = make_scene(deflection=0.1)
    assert scene.is_compact
    rest = [solve.solve(scene.solver, solve._draw(scene, job)[0]) for job in jobs]
    del newton_starts[:]
    for job, one in zip(jobs, rest, strict=True):
        found, expected = solve_load(scene, job), one.displacement[0].numpy()
        size = np.linalg.norm(expected)
        assert np.linalg.norm(found.displacement - expected) < 1e-6 * size
        assert found.accepted == bool(one.stable)
        assert found.residual < scene.solver.tol
    assert not newton_starts


@dataclass(frozen=True, eq=False)
class OwnSolver:
    """A reference solver that is not Newton's method."""

    newton: Newton
    problem = property(lambda self: self.newton.problem)
    tol = property(lambda self: self.newton.tol)
    linear_solver = property(lambda self: self.newton.linear_solver)

    def iterate(self, load):
        return self.newton.iterate(load)

    def identity(self):
        return {"name": "own"}


@pytest.mark.parametrize("why", ["slender", "unknown stability", "no convergence", "own solver"])
def test_the_solver_of_the_scene_solves_the_other_loads(make_scene, jobs, why, monkeypatch):
    own = make_scene()
    expected = solve.solve(own.solver, solve._draw(own, jobs[0])[0])
    vars(own)["is_compact"] = why != "slender"
    if why == "unknown stability":
        monkeypatch.setattr(solve, "MIN_RITZ_VALUE", np.inf)
    if why == "no convergence":
        nan = torch.full_like(expected.displacement, torch.nan)
        monkeypatch.setattr(solve, "warped_solution", lambda *_: nan)
    if why == "own solver":
        own = replace(own, solver=OwnSolver(own.solver))
    found = solve_load(own, jobs[0])
    assert np.array_equal(found.displacement, expected.displacement[0])
    assert found.iterations == int(expected.iterations)


def test_the_solver_of_the_scene_decides_on_an_unstable_equilibrium(make_scene):
    """Under axial pressure far above the critical one the straight column is unstable."""
    column = make_scene(size=(16.0, 1.0, 1.0), nodes=(17, 3, 3), n_modes=1)
    ends = column.problem.points[:, 0] == column.problem.points[:, 0].max()
    force = torch.zeros(1, *column.problem.shape, dtype=torch.float64)
    force[0, ends, 0] = -3e-5 / ends.sum()
    load = Load(force, torch.ones(1).double())
    vars(column)["is_compact"] = True
    assert not solve.solve(column.newton, load).stable
    assert solve._without_tangents(column, load) is None


def test_residual_and_volume_ratio_belong_to_the_returned_displacement(scene, jobs):
    for job in jobs:
        one = solve_load(scene, job)
        force, displacement = torch.from_numpy(one.force), torch.from_numpy(one.displacement)
        ratio = scene.problem.relative_residual(displacement[None], force[None])
        assert one.job == job
        assert np.array_equal(one.force, scene.loads.sample(SEED, [job.number]).force[0])
        assert np.array_equal(one.point, scene.loads.points(SEED, [job.number])[0])
        assert one.amplitude == pytest.approx(float(force.norm()) / scene.loads.largest_force)
        assert one.accepted
        assert float(ratio) == pytest.approx(one.residual, rel=1e-6, abs=1e-14)
        assert one.residual < scene.solver.tol
        assert one.volume_ratio > 0
        assert one.load_factor == 1
        assert one.iterations > 0
        assert one.seconds > 0
        assert one.reason == ""


def test_a_load_without_a_solution_is_rejected_with_the_fraction_that_has_one(hard):
    found = [solve_load(hard, LoadKey(SEED, index)) for index in range(6)]
    rejected = [one for one in found if not one.accepted]
    assert rejected, "SVK bears six loads of ten times L: choose harder ones"
    for one in rejected:
        assert one.reason
        assert 0 <= one.load_factor < 1
        displacement = torch.from_numpy(one.displacement)[None]
        part = one.load_factor * torch.from_numpy(one.force)[None]
        if one.load_factor:
            assert hard.problem.relative_residual(displacement, part) < hard.solver.intermediate_tol
            assert hard.problem.volume_ratio(displacement) > 0


def test_a_failed_load_has_its_force_and_no_displacement(scene, jobs):
    one, solved = (
        failed_load(scene, jobs[1], "the lights went out", seconds=3.0),
        solve_load(scene, jobs[1]),
    )
    assert one.job == jobs[1]
    assert one.reason == "the lights went out"
    assert one.seconds == 3.0
    assert not one.accepted
    assert one.load_factor == 0
    assert not one.displacement.any()
    assert one.displacement.shape == solved.displacement.shape
    for name in ("force", "point", "amplitude"):
        assert np.array_equal(getattr(one, name), getattr(solved, name))


def test_solved_loads_are_pickled_without_tensors(scene, jobs):
    for one in (solve_load(scene, jobs[0]), failed_load(scene, jobs[0], "gone")):
        for value in one:
            assert isinstance(value, LoadKey | np.ndarray | float | int | str)
        assert repr(content(pickle.loads(pickle.dumps(one)))) == repr(
            content(one)
        )  # nan is not nan


def test_the_number_of_threads_may_change_between_loads(tmp_path, environment):
    """PARDISO reads past its plan where threads are limited between analysis and factorisation."""
    pytest.importorskip("pypardiso")
    code = """
import torch
from threadpoolctl import threadpool_limits
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.fem.materials.neo_hookean import NeoHookeanLn
from dpl.fem import Plane, box
from dpl.fem.loads.modal import ModalLoads
from dpl.fem.solvers.newton import Newton
from dpl.fem.problem import Problem
from dpl.scene import Scene

torch.set_num_threads(2)
mesh = box([4.0, 1.0, 1.0], [17, 5, 5])
newton = Newton(Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min")), linear="pardiso")
scene = Scene(newton.problem, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.01), newton)
solve_load(scene, LoadKey((0, 0), 0))
with threadpool_limits(1):
    assert solve_load(scene, LoadKey((0, 0), 1)).accepted
"""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment(threads=2),
        capture_output=True,
    )
    assert ended.returncode == 0, ended.stderr.decode()[-500:] or f"signal {-ended.returncode}"
