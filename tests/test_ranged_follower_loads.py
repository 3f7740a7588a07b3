"""Follower loads with a range: each load has its own value, and all share one K(0)."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from dpl import Sample, Scene, fem
from dpl.data import DataModule, Store
from dpl.data.storage.integrity import verify
from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.postprocess.energy import RestStiffness
from dpl.inference import Simulator
from dpl.models import FCNN, Unrolled
from dpl.models.linear_response import LinearResponse
from dpl.training import MSE, PotentialEnergyLoss, Surrogate

YOUNG = 2e4
BELOW, END = fem.Plane(2, "min"), fem.Plane(0, "max")
OBLIQUE = fem.ConstantFibres([1.0, 0.5, 0.0])
FIXED_PRESSURE = fem.FollowerPressure(END, 30.0)
FIXED_TENSION = fem.ActiveStress(300.0, directions=fem.ConstantFibres([0.0, 0.0, 1.0]))


def air(value):
    return fem.FollowerPressure(BELOW, value, name="air")


def muscle(value):
    return fem.ActiveStress(value, directions=OBLIQUE, name="muscle")


def tendon(value):
    points = [[0.0, 0.05, 0.09], [0.2, 0.05, 0.09], [0.4, 0.05, 0.09]]
    return fem.FollowerCable(points, value, name="tendon")


# the load with a range, its range, and a load without one
KINDS = {
    "air": (air, [20.0, 200.0], FIXED_PRESSURE),
    "muscle": (muscle, [0.0, 4e3], FIXED_TENSION),
    "tendon": (tendon, [0.0, 2.0], FIXED_PRESSURE),
}


def body(*loads, poisson=0.3):
    """Return a clamped bar under follower loads [Pa, N]."""
    mesh = fem.box([0.4, 0.1, 0.1], [7, 3, 3])
    fixed, law = fem.Plane(0, "min"), fem.NeoHookeanLn(poisson)
    return fem.Problem.build(mesh, law, fixed=fixed, follower_loads=loads, young=YOUNG)


def scene_on(problem):
    solver = fem.Newton(problem, tol=1e-10)
    loads = fem.PointLoads(solver.linear_solver, deflection=0.1, young=YOUNG)
    return Scene(problem, loads, solver)


@pytest.fixture(scope="module", params=KINDS)
def name(request):
    """Name of the range of each kind of follower load."""
    return request.param


@pytest.fixture(scope="module")
def scene(name):
    return ranged_scene(name)


def ranged_scene(name):
    make, ends, constant = KINDS[name]
    return scene_on(body(make(ends), constant))


def own_body(name, parameters, *, poisson=0.3):
    """Return the body with a number in place of the range."""
    make, _, constant = KINDS[name]
    return body(make(float(parameters)), constant, poisson=poisson)


@pytest.fixture(scope="module")
def load(scene):
    return scene.loads.sample(0, range(4))


@pytest.fixture(scope="module")
def solution(scene, load):
    return fem.solve(scene.solver, load)


def test_a_range_may_be_logarithmic():
    """The values of loads are uniform in their logarithm."""
    load = fem.FollowerPressure(BELOW, {"low": 0.1, "high": 1e3, "distribution": "log"}, name="air")
    scene = scene_on(body(load))
    drawn = scene.loads.sample(0, range(200)).parameters[:, 0]
    assert scene.problem.parameter_ranges["air"].is_log
    assert drawn.log10().mean().item() == pytest.approx(1.0, abs=0.3)
    with pytest.raises(ValueError, match=r"follower_loads.air: value.* above 0 for a logarithmic"):
        body(replace(load, value={"low": 0.0, "high": 1e3, "distribution": "log"}))


def test_each_load_is_solved_with_its_own_value(name, scene, load, solution):
    low, high = KINDS[name][1]
    assert scene.loads.parameter_ranges == {name: (low, high)}
    assert solution.converged.all()
    assert load.parameters.std() > 0.05 * (high - low)
    for one, found in zip(load.unbatch(), solution.displacement, strict=True):
        own = fem.Newton(own_body(name, one.parameters), tol=1e-10)
        expected = fem.solve(own, fem.Load(one.force, one.young)).displacement[0]
        assert_close(found, expected, rtol=0, atol=1e-12)


def test_all_values_share_one_factor(scene, load):
    linear = scene.linear
    for one in load.unbatch():
        assert linear.with_parameters(one.parameters).factor is linear.factor
    assert linear.reference.factor is linear.factor


def test_law_and_pressure_have_ranges_at_once():
    scene = scene_on(body(air([20.0, 200.0]), FIXED_PRESSURE, poisson=[0.2, 0.4]))
    load = ranged_scene("air").loads.sample(0, [0])
    assert list(scene.loads.parameter_ranges) == ["poisson", "air"]
    mixed = fem.Load(load.force, load.young, torch.tensor([[0.25, 100.0]]).double())
    found = fem.solve(scene.solver, mixed).displacement
    own = fem.Newton(own_body("air", 100.0, poisson=0.25), tol=1e-10)
    assert_close(found, fem.solve(own, fem.Load(*mixed[:2])).displacement, rtol=0, atol=1e-12)
    linear = LinearResponse(scene).solutions(mixed)[0]
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


def test_a_batch_is_its_members(name, scene, load, solution):
    together = scene.problem.with_parameters(load.parameters)
    u = 1.1 * solution.displacement
    for k, one in enumerate(load.unbatch()):
        alone = own_body(name, one.parameters)
        assert_close(together.energy(u)[k], alone.energy(u[k, None])[0])
        ratios = together.relative_residual(u, load.force)
        assert_close(ratios[k], alone.relative_residual(u[k, None], one.force)[0])


def test_ranges_of_pressure_and_tension_keep_their_order():
    """Values belong to names, in whichever order the two kinds of loads are given."""
    for loads in (
        (air([20.0, 200.0]), muscle([0.0, 4e3])),
        (muscle([0.0, 4e3]), FIXED_TENSION, air([20.0, 200.0])),
    ):
        problem = body(*loads)
        values = {"air": 50.0, "muscle": 2e3}
        assert set(problem.parameter_ranges) == set(values)
        chosen = torch.tensor([[values[name] for name in problem.parameter_ranges]]).double()
        found = problem.with_parameters(chosen).force_at_rest
        fixed = [air(50.0), muscle(2e3)]
        expected = body(*fixed, *(FIXED_TENSION,) * (len(loads) - 2)).force_at_rest
        assert_close(found, expected, rtol=1e-12, atol=1e-18)
        constant = replace(problem, follower_loads=problem.follower_loads.constant)
        assert_close(
            found - constant.force_at_rest, body(*fixed).force_at_rest, rtol=1e-9, atol=1e-15
        )


def test_the_linear_base_of_a_network_is_the_linear_solution(name, scene, load):
    found = LinearResponse(scene).solutions(load)
    bodies = [fem.LinearSolver(own_body(name, one.parameters)) for one in load.unbatch()]
    expected = torch.stack([own.solve(f) for own, f in zip(bodies, load.force, strict=True)])
    assert (found - expected).norm() < 5e-5 * expected.norm()


def test_a_load_without_its_value_is_refused(name, scene, load):
    with pytest.raises(ValueError, match=rf"0 parameters and the body has ranges of \['{name}'\]"):
        fem.solve(scene.solver, fem.Load(load.force, load.young))
    assert scene.problem.internal_force(torch.zeros_like(load.force)).isnan().any()


def test_two_ranges_of_one_name_are_refused():
    with pytest.raises(ValueError, match="two ranges have the name air; set another"):
        body(air([20.0, 200.0]), fem.FollowerPressure(END, [0.0, 1.0], name="air"))


def test_the_identity_of_a_scene_contains_tension_directions_and_cells():
    scene = ranged_scene("muscle")
    prints = {scene.fingerprint, scene_on(body(FIXED_TENSION)).fingerprint}
    prints.add(scene_on(body(muscle([0.0, 5e3]), FIXED_TENSION)).fingerprint)
    prints.add(scene_on(body(muscle(4e3), FIXED_TENSION)).fingerprint)
    across = fem.ActiveStress([0.0, 4e3], directions=fem.ConstantFibres([1, 0, 0]), name="muscle")
    prints.add(scene_on(body(across, FIXED_TENSION)).fingerprint)
    assert len(prints) == 5
    assert scene_on(body(muscle([0.0, 4e3]), FIXED_TENSION)).fingerprint == scene.fingerprint
    supports = dict(scene.describe())["supports"]
    assert "active stress in 24 cells, muscle from 0 to 4000 Pa" in supports


def test_the_identity_of_a_scene_contains_points_tension_and_size():
    """Fixed tensions over E L^2 identify a scene; values of a range are in newtons."""

    def print_of(value, length=0.4, points=((0.0, 0.5, 0.9), (1.0, 0.5, 0.9)), young=YOUNG):
        mesh = fem.box([length, length / 4, length / 4], [7, 3, 3])
        place = (length * np.array(points) * [1, 0.25, 0.25]).tolist()
        problem = fem.Problem.build(
            mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"), young=young,
            follower_loads=[fem.FollowerCable(place, value, name="tendon")],
        )  # fmt: skip
        solver = fem.Newton(problem)
        return Scene(problem, fem.PointLoads(solver.linear_solver, young=young), solver)

    usual = print_of(1.0).fingerprint
    assert print_of(8.0, length=0.8, young=2 * YOUNG).fingerprint == usual
    other = ((0.0, 0.5, 0.9), (0.5, 0.5, 0.9), (1.0, 0.5, 0.9))
    ranged = [1.0, 2.0]
    scenes = [print_of(2.0), print_of(1.0, points=other), print_of(ranged), print_of(ranged, 0.8)]
    assert len({usual, *(scene.fingerprint for scene in scenes)}) == 5
    assert "follower cable of 1 segments, tendon from 1 to 2 N" in scenes[2].describe()[1][1]


def test_symmetries_are_those_for_any_pressures():
    """Pressures of one range below and above would balance at their centres."""
    above = fem.FollowerPressure(fem.Plane(2, "max"), [20.0, 200.0], name="above")
    assert len(fem.symmetries(body(air([20.0, 200.0])))) == 2
    assert len(fem.symmetries(body(air([20.0, 200.0]), above))) == 2


def test_sizes_of_loads_do_not_depend_on_follower_loads(scene):
    alone = scene_on(body())
    assert scene.loads.sizes == pytest.approx(alone.loads.sizes, rel=1e-12)


@pytest.fixture(scope="module")
def net(scene):
    """A model that is fitted to 40 loads, and 8 other loads."""
    loads = [scene.loads.sample(seed, range(count)) for seed, count in ((1, 40), (2, 8), (3, 8))]
    states = [fem.solve(scene.solver, load).displacement for load in loads]
    fitted, held, other = (
        Sample(load.force, u, load.young, load.parameters)
        for load, u in zip(loads, states, strict=True)
    )
    net = Unrolled(scene, rank=12, cells=16, stages=2)
    net.fit(fitted, held)
    return net, other


def test_unrolled_is_much_nearer_than_the_linear_solution(scene, name, net):
    """Less near for a cable, whose force on its middle point is zero at rest."""
    net, other = net
    found = net(other.force, other.parameters) - other.displacement
    linear = LinearResponse(scene).solutions(other.load) - other.displacement
    bound = 0.2 if name == "tendon" else 0.03
    assert found.flatten(1).norm(dim=1).mean() < bound * linear.flatten(1).norm(dim=1).mean()


def test_compiled_and_tensor_predictions_agree(net):
    net, other = net
    compiled = net(other.force, other.parameters)
    tensors = net(other.force.clone().requires_grad_(), other.parameters)
    assert_close(compiled, tensors.detach(), rtol=1e-4, atol=1e-6)


def test_newton_in_the_modes_has_the_stiffness_of_follower_loads(scene, net):
    """The sampled tangents of a body with and without them differ by their derivatives."""
    net, other = net
    correction = net.correction()
    body = scene.problem.with_parameters(other.parameters[:1])
    bare = replace(body, follower_loads=NO_LOADS)
    u, white = other.displacement[0], correction.tangent.rows.T.reshape(-1, *body.shape)
    found = correction.tangent.at(body, u) - correction.tangent.at(bare, u)
    steps = torch.from_numpy(white).double()
    change = body.follower_loads.force(u + 1e-4 * steps) - body.follower_loads.force(
        u - 1e-4 * steps
    )
    expected = torch.einsum("ind,jnd->ij", steps, change / 2e-4)
    assert_close(torch.from_numpy(found), (expected + expected.T) / 2, rtol=1e-4, atol=1e-6)


def test_newton_in_the_modes_brings_predictions_closer(net):
    net, other = net
    guess = net(other.force, other.parameters)
    *_, last = net.correction().iterate(other.load, guess=guess)
    before, after = (
        (u - other.displacement).flatten(1).norm(dim=1) for u in (guess, last.displacement)
    )
    assert after.mean() < before.mean()


def everywhere(points):
    return points[:, 0] >= 0


@pytest.mark.parametrize(
    "one", [fem.FollowerPressure(everywhere, [20.0, 200.0]), muscle([0.0, 4e3]), tendon([0.0, 2.0])]
)
def test_the_energy_loss_has_the_equilibrium_as_its_minimum(one):
    """A closed surface has a potential, for all values of its range; a tension always has."""
    scene = scene_on(body(one))
    assert scene.problem.has_potential
    network = partial(FCNN, width=8)
    surrogate = Surrogate.from_network(network, PotentialEnergyLoss(), scene, base="linear")
    samples = scene.loads.sample(0, range(3))
    found = fem.solve(scene.solver, samples)
    batch = Sample(samples.force, found.displacement, *samples[1:])
    exact = found.displacement.clone().requires_grad_()
    loss = surrogate.loss(exact, batch, surrogate.physics)
    (slope,) = torch.autograd.grad(loss, exact)
    moved = (1.2 * found.displacement).requires_grad_()
    other = surrogate.loss(moved, batch, surrogate.physics)
    (far,) = torch.autograd.grad(other, moved)
    assert slope.norm() < 1e-5 * far.norm()
    assert other > loss


def test_data_network_and_simulator_take_the_value(name, scene, tmp_path):
    data = DataModule(scene, folder=str(tmp_path / "set"), train=4, val=2, test=2, workers=0)
    data.prepare_data()
    assert [flaw for _, flaw in verify(Store(tmp_path / "set", scene, 0)) if flaw] == []
    test = data.samples("test")
    low, high = KINDS[name][1]
    assert ((test.parameters >= low) & (test.parameters <= high)).all()
    surrogate = Surrogate.from_network(partial(FCNN, width=8), MSE(), scene, base="linear")
    answer = Simulator(surrogate)(**scene.si_inputs(test.load), tol=1e-8)
    assert answer.converged.all()
    assert_close(answer.displacement / scene.length, test.displacement, rtol=0, atol=1e-8)
    force = scene.si_inputs(test.load)["force"][0]
    named = Simulator(surrogate)(force, parameters={name: float(test.parameters[0])}, tol=1e-8)
    assert_close(named.displacement, answer.displacement[0], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=name):
        Simulator(surrogate)(force)
