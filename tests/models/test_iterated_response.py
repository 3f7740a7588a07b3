"""Linear solutions of bodies whose stiffness has three or more terms."""

from functools import partial

import pytest
import torch
from linear_solutions import BEAM, LEFT, SUPPORTS, at_free, exact, relative

from dpl import Sample, Scene
from dpl.fem import (
    Box,
    ConstantFibres,
    FibreReinforced,
    Guccione,
    Load,
    ModalLoads,
    NeoHookeanIsoK2,
    NeoHookeanLn,
    Newton,
    Problem,
    solve,
    symmetries,
)
from dpl.models import FCNN, LinearBase, Unrolled, linear_response
from dpl.models.linear_response import LinearResponse
from dpl.training import RMSELoss, Surrogate

REGIONS = {"core": Box([1.0, 0.2, 0.2], [3.0, 0.8, 0.8])}
ENDS = [-1.0, 0.7, 1.4, 2.7, 5.0]
SLICES = {f"part{k}": Box([ENDS[k], -1, -1], [ENDS[k + 1], 2, 2]) for k in range(4)}
FIBRES = FibreReinforced(
    NeoHookeanIsoK2([0.3, 0.45], [0.5, 2.0]),
    Guccione([0.1, 1.0], 8.0, 2.0, 4.0),
    ConstantFibres([2, 1, 0]),
)
LAWS = {  # law, regions and number of terms
    "a core and Poisson's ratio": (
        {"core": NeoHookeanLn(0.3, [1.0, 50.0]), "other": NeoHookeanLn([0.2, 0.4], [0.5, 2.0])},
        REGIONS,
        3,
    ),
    "two regions with all ranges": (
        {"core": NeoHookeanLn([0.1, 0.4], [1.0, 9.0]), "other": NeoHookeanLn([0.2, 0.45])},
        REGIONS,
        4,
    ),
    "fibres in an isotropic matrix": (FIBRES, None, 3),
    "four parts": (
        {name: NeoHookeanLn(0.3, [1.0, 9.0]) for name in SLICES},
        SLICES,
        4,
    ),
}
THREE = "a core and Poisson's ratio"
PAIRS = [(name, "held") for name in LAWS] + [(THREE, one) for one in list(SUPPORTS)[1:]]


def scene_of(name=THREE, supports="held"):
    law, regions, count = LAWS[name]
    body = Problem.build(BEAM, law, regions=regions, supports=SUPPORTS[supports])
    newton = Newton(body)
    scene = Scene(body, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.1), newton)
    assert len(LinearResponse(scene, []).terms) == count
    return scene


@pytest.fixture(scope="module", params=PAIRS, ids=", ".join)
def scene(request):
    return scene_of(*request.param)


@pytest.fixture(scope="module")
def three():
    return scene_of()


def forces(scene, count=9):
    """Return noise, forces on single nodes, and modal loads, of very different sizes."""
    random = torch.Generator().manual_seed(0)
    force = scene.loads.sample(0, range(count)).force.clone()
    force[0::3] = torch.randn(force[0::3].shape, generator=random, dtype=torch.float64)
    nodes = scene.problem.free.all(dim=1).nonzero()[:, 0]
    for k in range(1, count, 3):
        node = nodes[torch.randint(len(nodes), (1,), generator=random)]
        force[k] = 0.0
        force[k, node] = torch.randn(1, force.shape[2], generator=random, dtype=torch.float64)
    sizes = 10.0 ** -torch.arange(count, dtype=torch.float64)
    return torch.where(scene.problem.free, sizes[:, None, None] * force, 0.0)


def parameters(scene, count=9):
    """Return random parameters, and ends of the ranges."""
    random = torch.Generator().manual_seed(1)
    ranges = scene.loads.parameter_ranges.values()
    values = torch.rand(count, len(ranges), generator=random, dtype=torch.float64)
    values[::2] = values[::2].round()
    return torch.stack([one.at(t) for one, t in zip(ranges, values.T, strict=True)], dim=1)


@pytest.mark.parametrize("group", [True, False], ids=["by parity", "whole"])
def test_the_linear_solution_of_every_force_is_exact_for_all_parameters(scene, group):
    response = LinearResponse(scene, symmetries(scene.problem) if group else [])
    force, own = forces(scene), parameters(scene)
    found = response(at_free(scene, force), own)
    assert relative(found, at_free(scene, exact(scene, force, own))) < 1e-4


def test_tensor_operations_and_compiled_loops_solve_alike(scene):
    response = LinearResponse(scene, symmetries(scene.problem))
    inverse = response.iterated
    right = torch.stack([response._form.parts(row) for row in at_free(scene, forces(scene, 5))])
    law = scene.problem.material.with_parameters(parameters(scene, 5))
    factors = torch.nn.functional.pad(response.terms.factors(law), (0, 1), value=1.0)
    loops, tensors = inverse.by_loops(right, factors), inverse.by_tensors(right, factors)
    assert relative(loops.flatten(1), tensors.flatten(1)) < 1e-6


def test_a_batch_is_solved_like_its_members(three, monkeypatch):
    response = LinearResponse(three, symmetries(three.problem))
    loaded, own = at_free(three, forces(three)), parameters(three)
    whole = response(loaded, own)
    members = [response(loaded[k : k + 1], own[k : k + 1]) for k in range(len(loaded))]
    assert torch.equal(torch.cat(members), whole)
    monkeypatch.setattr(linear_response, "MAX_VALUES", 1)
    assert torch.equal(response(loaded, own), whole)


def test_a_zero_force_has_a_zero_solution_and_a_gradient(three):
    response = LinearResponse(three, symmetries(three.problem))
    loaded = torch.zeros(1, int(three.problem.free.sum()), dtype=torch.float64, requires_grad=True)
    found = response(loaded, parameters(three, 1))
    assert not found.any()
    (gradient,) = torch.autograd.grad(found.sum(), loaded)
    assert gradient.isfinite().all()
    assert gradient.any()


@pytest.mark.parametrize("supports", ["held", "moved"])
def test_gradients_with_respect_to_forces_are_solutions(supports):
    """K(0)^-1 is symmetric: the gradient of g u with respect to f is the solution of g."""
    scene = scene_of(supports=supports)
    response = LinearResponse(scene, symmetries(scene.problem))
    own = parameters(scene)
    loaded = at_free(scene, forces(scene)).requires_grad_()
    weight = torch.randn(loaded.shape, generator=torch.Generator().manual_seed(1)).double()
    (gradient,) = torch.autograd.grad((weight * response(loaded, own)).sum(), loaded)
    at_rest = response(torch.zeros_like(weight), own)
    assert relative(gradient, response(weight, own) - at_rest) < 1e-4


@pytest.mark.parametrize("supports", list(SUPPORTS))
def test_gradients_with_respect_to_parameters_are_those_of_differences(supports):
    scene = scene_of(supports=supports)
    response = LinearResponse(scene, symmetries(scene.problem))
    loaded = at_free(scene, scene.loads.sample(0, range(2)).force)
    ranges = scene.loads.parameter_ranges.values()
    own = torch.tensor([[one.at(0.4) for one in ranges], [one.at(0.6) for one in ranges]]).double()
    own.requires_grad_()

    def work(own):
        return (response(loaded, own) * loaded).sum()

    (gradient,) = torch.autograd.grad(work(own), own)
    for k in range(own.shape[1]):
        step = torch.zeros_like(own)
        step[:, k] = 1e-2 * own[:, k].detach()
        with torch.no_grad():
            expected = (work(own + step) - work(own - step)) / 2
        assert torch.isclose((gradient * step).sum(), expected, rtol=0.01)


def fitted(scene, count=20):
    load = scene.loads.sample(0, range(count))
    states = solve(scene.solver, load).displacement
    samples = Sample(load.force, states, load.young, load.parameters)
    net = Unrolled(scene, rank=20, cells=8, stages=1)
    net.fit(samples, samples)
    return net


@pytest.mark.parametrize("supports", list(SUPPORTS))
def test_compiled_predictions_equal_the_tensor_operations(supports):
    scene = scene_of(supports=supports)
    net, force, own = fitted(scene), 0.01 * forces(scene), parameters(scene)
    assert net._is_compiled(force, own)
    compiled = net(force, own)
    tensors = net(force.clone().requires_grad_(), own).detach()
    assert relative(compiled.flatten(1), tensors.flatten(1)) < 1e-5


def test_a_small_load_has_the_linear_solution(three):
    net, force, own = fitted(three), 1e-9 * forces(three), parameters(three)
    assert relative(net(force, own).flatten(1), exact(three, force, own).flatten(1)) < 1e-4


def test_predictions_are_better_than_the_linear_solution(three):
    net, load = fitted(three, 40), three.loads.sample(1, range(8))
    truth = solve(three.solver, load).displacement.flatten(1)
    linear = next(iter(three.linear.iterate(load))).displacement.flatten(1)
    found = net(load.force, load.parameters).flatten(1)
    assert (found - truth).norm(dim=1).median() < 0.5 * (linear - truth).norm(dim=1).median()


def test_networks_take_this_linear_solution_as_their_base(three):
    load = three.loads.sample(0, range(4))
    expected = next(iter(three.linear.iterate(load))).displacement
    assert relative(LinearBase(three).solve(load).flatten(1), expected.flatten(1)) < 1e-4
    torch.manual_seed(0)
    loss = RMSELoss(relative=1.0, floor=0.0)
    surrogate = Surrogate.from_network(partial(FCNN, width=16), loss, three, base="linear")
    small = Load(1e-7 * load.force, load.young, load.parameters)
    with torch.no_grad():
        found = surrogate.predict(small)
    assert relative(found.flatten(1), 1e-7 * expected.flatten(1)) < 1e-3


def test_stiffnesses_that_differ_too_much_are_refused_before_any_training():
    laws = {"core": NeoHookeanLn(0.3, [1.0, 1e9]), "other": NeoHookeanLn([0.2, 0.4])}
    body = Problem.build(BEAM, laws, regions=REGIONS, fixed=LEFT)
    newton = Newton(body)
    scene = Scene(body, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.1), newton)
    for build in (Unrolled, LinearBase):
        with pytest.raises(ValueError, match="takes more than 200 steps"):
            build(scene)
