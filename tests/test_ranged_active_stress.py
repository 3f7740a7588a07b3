"""Active stress with a range: each load has its own tension, and all share one K(0)."""

import pytest
import torch
from torch.testing import assert_close

from dpl import Sample, Scene
from dpl.data import OfflineData, Store
from dpl.data.storage.integrity import verify
from dpl.fem import (
    ActiveStress,
    ConstantFibres,
    FollowerPressure,
    Load,
    NeoHookeanLn,
    Newton,
    Plane,
    PointLoads,
    Problem,
    box,
    solve,
)
from dpl.inference import Simulator
from dpl.models import FCNN, Unrolled
from dpl.models.linear_base import LinearBase
from dpl.training import MSE, PotentialEnergyLoss, Surrogate

YOUNG = 2e4
OBLIQUE = ConstantFibres([1.0, 0.5, 0.0])
AIR = FollowerPressure(Plane(2, "min"), [20.0, 200.0], name="air")
CONSTANT = ActiveStress(300.0, directions=ConstantFibres([0.0, 0.0, 1.0]))


def muscle(tension):
    return ActiveStress(tension, directions=OBLIQUE, name="muscle")


def body(*loads):
    """Return a clamped bar under follower loads [Pa]."""
    mesh = box([0.4, 0.1, 0.1], [7, 3, 3])
    fixed = Plane(0, "min")
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=fixed, follower_loads=loads, young=YOUNG)


def scene_on(problem):
    solver = Newton(problem, tol=1e-10)
    loads = PointLoads(solver.linear_solver, deflection=0.1, young=YOUNG)
    return Scene(problem, loads, solver)


@pytest.fixture(scope="module")
def scene():
    return scene_on(body(muscle([0.0, 4e3]), CONSTANT))


@pytest.fixture(scope="module")
def load(scene):
    return scene.loads.sample(0, range(4))


@pytest.fixture(scope="module")
def solution(scene, load):
    return solve(scene.solver, load)


def own_body(parameters):
    return body(muscle(float(parameters)), CONSTANT)


def test_each_load_is_solved_with_its_own_tension(scene, load, solution):
    assert scene.loads.parameter_ranges == {"muscle": (0.0, 4e3)}
    assert solution.converged.all()
    assert load.parameters.std() > 100
    for one, found in zip(load.unbatch(), solution.displacement, strict=True):
        own = Newton(own_body(one.parameters), tol=1e-10)
        expected = solve(own, Load(one.force, one.young)).displacement[0]
        assert_close(found, expected, rtol=0, atol=1e-12)
        assert scene.linear.with_parameters(one.parameters).factor is scene.linear.factor


def test_a_batch_is_its_members(scene, load, solution):
    together = scene.problem.with_parameters(load.parameters)
    u = 1.1 * solution.displacement
    for k, one in enumerate(load.unbatch()):
        alone = own_body(one.parameters)
        assert_close(together.energy(u)[k], alone.energy(u[k, None])[0])
        ratios = together.relative_residual(u, load.force)
        assert_close(ratios[k], alone.relative_residual(u[k, None], one.force)[0])


def test_ranges_of_pressure_and_tension_keep_their_order(load):
    """Values belong to names, in whichever order the two kinds of loads are given."""
    for loads in ((AIR, muscle([0.0, 4e3])), (muscle([0.0, 4e3]), CONSTANT, AIR)):
        problem = body(*loads)
        values = {"air": 50.0, "muscle": 2e3}
        assert set(problem.parameter_ranges) == set(values)
        chosen = torch.tensor([[values[name] for name in problem.parameter_ranges]]).double()
        found = problem.with_parameters(chosen).force_at_rest
        fixed = [FollowerPressure(Plane(2, "min"), 50.0), muscle(2e3)]
        expected = body(*fixed, *(CONSTANT,) * (len(loads) - 2)).force_at_rest
        assert_close(found, expected, rtol=1e-12, atol=1e-18)
        rest = problem.ranged_force_at_rest(chosen)[0]
        assert_close(rest, body(*fixed).force_at_rest, rtol=1e-9, atol=1e-15)


def test_the_linear_base_of_a_network_is_the_linear_solution(scene, load):
    found = LinearBase(scene).solve(load)
    bodies = [Newton(own_body(one.parameters)).linear_solver for one in load.unbatch()]
    expected = torch.stack([own.solve(f) for own, f in zip(bodies, load.force, strict=True)])
    assert (found - expected).norm() < 1e-5 * expected.norm()


def test_the_identity_of_a_scene_contains_tension_directions_and_cells(scene):
    prints = {scene.fingerprint, scene_on(body(CONSTANT)).fingerprint}
    prints.add(scene_on(body(muscle([0.0, 5e3]), CONSTANT)).fingerprint)
    prints.add(scene_on(body(muscle(4e3), CONSTANT)).fingerprint)
    across = ActiveStress([0.0, 4e3], directions=ConstantFibres([1, 0, 0]), name="muscle")
    prints.add(scene_on(body(across, CONSTANT)).fingerprint)
    assert len(prints) == 5
    assert scene_on(body(muscle([0.0, 4e3]), CONSTANT)).fingerprint == scene.fingerprint
    supports = dict(scene.describe())["supports"]
    assert "active stress in 24 cells, muscle from 0 to 4000 Pa" in supports


def test_unrolled_refuses_an_active_stress(scene):
    with pytest.raises(ValueError, match="has no active stress"):
        Unrolled(scene, rank=4, cells=4, stages=1)


def test_the_energy_loss_has_the_equilibrium_as_its_minimum(scene, load, solution):
    surrogate = Surrogate(FCNN(scene, width=8, base="linear"), PotentialEnergyLoss(), scene)
    batch = Sample(load.force, solution.displacement, *load[1:])
    exact = solution.displacement.clone().requires_grad_()
    loss = surrogate.loss(exact, batch, surrogate.physics)
    (slope,) = torch.autograd.grad(loss, exact)
    moved = (1.2 * solution.displacement).requires_grad_()
    other = surrogate.loss(moved, batch, surrogate.physics)
    (far,) = torch.autograd.grad(other, moved)
    assert slope.norm() < 1e-5 * far.norm()
    assert other > loss


def test_data_network_and_simulator_take_the_tension(scene, tmp_path):
    data = OfflineData(scene, folder=str(tmp_path / "set"), train=16, val=4, test=4, workers=0)
    data.prepare_data()
    assert [flaw for _, flaw in verify(Store(tmp_path / "set", scene, 0)) if flaw] == []
    test = data.samples("test")
    assert ((test.parameters >= 0) & (test.parameters <= 4e3)).all()
    surrogate = Surrogate(FCNN(scene, width=8, base="linear"), MSE(), scene)
    answer = Simulator(surrogate)(**scene.si_inputs(test.load), tol=1e-8)
    assert answer.converged.all()
    assert_close(answer.displacement / scene.length, test.displacement, rtol=0, atol=1e-8)
    force = scene.si_inputs(test.load)["force"][0]
    tension = {"muscle": float(test.parameters[0])}
    named = Simulator(surrogate)(force, parameters=tension, tol=1e-8)
    assert_close(named.displacement, answer.displacement[0], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="muscle"):
        Simulator(surrogate)(force)
