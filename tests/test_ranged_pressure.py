"""Follower pressures with a range: each load has its own, and all share one K(0)."""

import pytest
import torch
from torch.testing import assert_close

from dpl import Sample, Scene
from dpl.data import OfflineData, Store
from dpl.data.storage.integrity import verify
from dpl.fem import (
    FollowerPressure,
    LinearSolver,
    Load,
    NeoHookeanLn,
    Newton,
    Plane,
    PointLoads,
    Problem,
    box,
    solve,
    symmetries,
)
from dpl.fem.postprocess.energy import RestStiffness
from dpl.inference import Simulator
from dpl.models import FCNN, Unrolled
from dpl.models.linear_base import LinearBase
from dpl.training import MSE, PotentialEnergyLoss, Surrogate

YOUNG = 2e4
BELOW, END = Plane(2, "min"), Plane(0, "max")
AIR = FollowerPressure(BELOW, [20.0, 200.0], name="air")
CONSTANT = FollowerPressure(END, 30.0)


def body(*pressures, poisson=0.3):
    """Return a clamped bar under pressures [Pa]."""
    law = NeoHookeanLn(poisson)
    mesh = box([0.4, 0.1, 0.1], [7, 3, 3])
    return Problem.build(mesh, law, fixed=Plane(0, "min"), follower_loads=pressures, young=YOUNG)


def scene_on(problem, deflection=0.1):
    solver = Newton(problem, tol=1e-10)
    loads = PointLoads(solver.linear_solver, deflection=deflection, young=YOUNG)
    return Scene(problem, loads, solver)


@pytest.fixture(scope="module")
def scene():
    return scene_on(body(AIR, CONSTANT))


@pytest.fixture(scope="module")
def load(scene):
    return scene.loads.sample(0, range(4))


@pytest.fixture(scope="module")
def solution(scene, load):
    return solve(scene.solver, load)


def fixed_body(parameters, *, poisson=0.3):
    return body(FollowerPressure(BELOW, float(parameters)), CONSTANT, poisson=poisson)


def test_each_load_is_solved_with_its_own_pressure(scene, load, solution):
    assert solution.converged.all()
    assert load.parameters.std() > 10
    for one, found in zip(load.unbatch(), solution.displacement, strict=True):
        own = Newton(fixed_body(one.parameters), tol=1e-10)
        expected = solve(own, Load(one.force, one.young)).displacement[0]
        assert_close(found, expected, rtol=0, atol=1e-12)


def test_all_pressures_share_one_factor(scene, load):
    linear = scene.linear
    for one in load.unbatch():
        assert linear.with_parameters(one.parameters).factor is linear.factor
    assert linear.reference.factor is linear.factor


def test_law_and_pressure_have_ranges_at_once(load):
    scene = scene_on(body(AIR, CONSTANT, poisson=[0.2, 0.4]))
    assert list(scene.loads.parameter_ranges) == ["poisson", "air"]
    mixed = Load(load.force[:1], load.young[:1], torch.tensor([[0.25, 100.0]]).double())
    found = solve(scene.solver, mixed).displacement
    own = Newton(fixed_body(100.0, poisson=0.25), tol=1e-10)
    assert_close(found, solve(own, Load(*mixed[:2])).displacement, rtol=0, atol=1e-12)
    linear = LinearBase(scene).solve(mixed)[0]
    exact = own.linear_solver.solve(mixed.force[0])
    assert (linear - exact).norm() < 1e-4 * exact.norm()
    field = torch.where(scene.problem.free, solution_like(scene), 0.0)[None]
    products = [
        RestStiffness(p).product(field, *rest)
        for p, rest in ((scene.problem, [mixed.parameters]), (own.problem, []))
    ]
    assert (products[0] - products[1]).norm() < 1e-6 * products[1].norm()


def solution_like(scene):
    random = torch.Generator().manual_seed(1)
    return torch.rand(scene.problem.shape, generator=random, dtype=torch.float64)


def test_a_batch_is_its_members(scene, load, solution):
    together = scene.problem.with_parameters(load.parameters)
    u = 1.1 * solution.displacement
    for k, one in enumerate(load.unbatch()):
        alone = fixed_body(one.parameters)
        assert_close(together.energy(u)[k], alone.energy(u[k, None])[0])
        ratios = together.relative_residual(u, load.force)
        assert_close(ratios[k], alone.relative_residual(u[k, None], one.force)[0])


def test_the_linear_base_of_a_network_is_the_linear_solution(scene, load):
    found = LinearBase(scene).solve(load)
    bodies = [LinearSolver(fixed_body(one.parameters)) for one in load.unbatch()]
    expected = torch.stack([own.solve(f) for own, f in zip(bodies, load.force, strict=True)])
    assert (found - expected).norm() < 1e-5 * expected.norm()


def test_a_load_without_its_pressure_is_refused(scene, load):
    with pytest.raises(ValueError, match=r"0 parameters and the body has ranges of \['air'\]"):
        solve(scene.solver, Load(load.force, load.young))
    assert scene.problem.internal_force(torch.zeros_like(load.force)).isnan().any()


def test_two_ranges_of_one_name_are_refused():
    with pytest.raises(ValueError, match="two ranges have the name air; set another"):
        body(AIR, FollowerPressure(END, [0.0, 1.0], name="air"))


def test_symmetries_are_those_for_any_pressures():
    """Pressures of one range below and above would balance at their centres."""
    above = FollowerPressure(Plane(2, "max"), [20.0, 200.0], name="above")
    assert len(symmetries(body(AIR))) == 2
    assert len(symmetries(body(AIR, above))) == 2


def test_sizes_of_loads_do_not_depend_on_the_pressure(scene):
    alone = scene_on(body())
    assert scene.loads.sizes == pytest.approx(alone.loads.sizes, rel=1e-12)


def test_models_without_an_input_for_it_are_refused_by_key(scene):
    with pytest.raises(ValueError, match="follower pressure"):
        Unrolled(scene, rank=4, cells=4, stages=1)
    deaf = FCNN(scene, width=8)
    deaf.extra_inputs = ()
    with pytest.raises(ValueError, match=r"forces\.air\.value is a range, .* has no input"):
        Surrogate(deaf, MSE(), scene)


def test_the_energy_of_a_batch_has_the_force_of_the_pressure_as_its_gradient(load):
    """A closed surface has a potential, for all values of its range."""
    scene = scene_on(body(FollowerPressure(everywhere, [20.0, 200.0])))
    assert scene.problem.has_potential
    surrogate = Surrogate(FCNN(scene, width=8, base="linear"), PotentialEnergyLoss(), scene)
    samples = scene.loads.sample(0, range(3))
    found = solve(scene.solver, samples)
    batch = Sample(samples.force, found.displacement, *samples[1:])
    exact = found.displacement.clone().requires_grad_()
    loss = surrogate.loss(exact, batch, surrogate.physics)
    (slope,) = torch.autograd.grad(loss, exact)
    moved = (1.2 * found.displacement).requires_grad_()
    other = surrogate.loss(moved, batch, surrogate.physics)
    (far,) = torch.autograd.grad(other, moved)
    assert slope.norm() < 1e-5 * far.norm()
    assert other > loss


def everywhere(points):
    return points[:, 0] >= 0


def test_data_network_and_simulator_take_the_pressure(scene, tmp_path):
    data = OfflineData(scene, folder=str(tmp_path / "set"), train=16, val=4, test=4, workers=0)
    data.prepare_data()
    assert [flaw for _, flaw in verify(Store(tmp_path / "set", scene, 0)) if flaw] == []
    test = data.samples("test")
    assert ((test.parameters >= 20) & (test.parameters <= 200)).all()
    surrogate = Surrogate(FCNN(scene, width=8, base="linear"), MSE(), scene)
    answer = Simulator(surrogate)(**scene.si_inputs(test.load), tol=1e-8)
    assert answer.converged.all()
    assert_close(answer.displacement / scene.length, test.displacement, rtol=0, atol=1e-8)
    force = scene.si_inputs(test.load)["force"][0]
    named = Simulator(surrogate)(force, parameters={"air": float(test.parameters[0])}, tol=1e-8)
    assert_close(named.displacement, answer.displacement[0], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="air"):
        Simulator(surrogate)(force)
