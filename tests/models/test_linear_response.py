"""Linear solutions of all loads and parameters: compiled, as tensors, and their derivatives."""

from functools import partial

import pytest
import torch
from linear_solutions import BEAM, SUPPORTS, at_free, exact, relative

from benchmarks.samples import solved
from dpl import Scene, fem
from dpl.fem import NeoHookeanLn
from dpl.fem.solvers import parity_factor
from dpl.models import FCNN, LinearResponse, Unrolled, linear_response
from dpl.training import RMSELoss, Surrogate

REGIONS = {"core": fem.Box([1.0, 0.2, 0.2], [3.0, 0.8, 0.8])}
ENDS = [-1.0, 0.7, 1.4, 2.7, 5.0]
SLICES = {f"part{k}": fem.Box([ENDS[k], -1, -1], [ENDS[k + 1], 2, 2]) for k in range(4)}
LAWS = {  # law, regions and number of terms
    "no range": (NeoHookeanLn(0.3), None, 2),
    "Poisson's ratio": (NeoHookeanLn([0.2, 0.4]), None, 2),
    "negative ratios": (NeoHookeanLn([-0.3, 0.0]), None, 2),
    "nearly incompressible": (NeoHookeanLn([0.0, 0.49]), None, 2),
    "a stiff core": (
        {"core": NeoHookeanLn(0.3, [1.0, 100.0]), "other": NeoHookeanLn(0.3)},
        REGIONS,
        2,
    ),
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
    "fibres in an isotropic matrix": (
        fem.FibreReinforced(
            fem.NeoHookeanIsoK2([0.3, 0.45], [0.5, 2.0]),
            fem.Guccione([0.1, 1.0], 8.0, 2.0, 4.0),
            fem.ConstantFibres([2, 1, 0]),
        ),
        None,
        3,
    ),
    "four parts": ({name: NeoHookeanLn(0.3, [1.0, 9.0]) for name in SLICES}, SLICES, 4),
}
SMALL = {"rank": 20, "cells": 8, "stages": 1}
PLAIN, RANGE, THREE = "no range", "Poisson's ratio", "a core and Poisson's ratio"
HARD = "negative ratios", "nearly incompressible", "a stiff core", "fibres in an isotropic matrix"
PAIRS = [(PLAIN, "moved"), (RANGE, "moved"), (RANGE, "on a foundation")]
PAIRS += [(name, "held") for name in (*HARD, THREE)]
RANGES = [(RANGE, "moved"), (RANGE, "on a foundation"), (THREE, "moved")]


def scene_on(law, regions=None, supports="held", **options):
    supports = SUPPORTS[supports]
    body = fem.Problem.build(BEAM, law, regions=regions or {}, supports=supports, **options)
    newton = fem.Newton(body)
    return Scene(body, fem.ModalLoads(newton.linear_solver, n_modes=3, deflection=0.1), newton)


def scene_of(name=THREE, supports="held", **options):
    return scene_on(*LAWS[name][:2], supports, **options)


@pytest.fixture(scope="module", params=PAIRS, ids=", ".join)
def scene(request):
    return scene_of(*request.param)


def response_of(scene):
    return LinearResponse(scene, fem.symmetries(scene.problem))


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
    columns = [one.at(t) for one, t in zip(ranges, values.T, strict=True)]
    return torch.stack(columns, dim=1) if columns else values


@pytest.mark.parametrize("group", [True, False], ids=["by parity", "whole"])
def test_the_linear_solution_of_every_force_is_exact_for_all_parameters(scene, group):
    response = LinearResponse(scene, fem.symmetries(scene.problem) if group else [])
    force, own = forces(scene), parameters(scene)
    found = response(at_free(scene, force), own)
    error = relative(found, at_free(scene, exact(scene, force, own)))
    assert error < (1e-4 if own.shape[1] else 5e-5)


def test_the_stiffness_has_the_expected_number_of_terms():
    counts = {name: len(response_of(scene_of(name)).terms) for name in LAWS}
    assert counts == {name: count for name, (_, _, count) in LAWS.items()}


def test_tensor_operations_and_compiled_loops_solve_alike(scene):
    response = response_of(scene)
    right = [response.form.parts(one).flatten() for one in at_free(scene, forces(scene, 5))]
    law = scene.problem.material.with_parameters(parameters(scene, 5))
    factors = response.terms.factors(law).expand(5, -1)
    pair = torch.stack(right), torch.nn.functional.pad(factors, (0, 1), value=1.0)
    assert relative(response.solve(*pair), response.by_tensors(*pair)) < 2e-6  # in float32


def test_locking_elements_do_not_change_the_bound():
    scene = scene_of("nearly incompressible", mean_dilatation=True)
    force, own = forces(scene), parameters(scene)
    found = response_of(scene)(at_free(scene, force), own)
    assert relative(found, at_free(scene, exact(scene, force, own))) < 1e-4


@pytest.mark.parametrize("name", [PLAIN, RANGE, THREE])
def test_a_batch_is_solved_like_its_members(name, monkeypatch):
    scene = scene_of(name)
    response = response_of(scene)
    loaded, own = at_free(scene, forces(scene)), parameters(scene)
    whole = response(loaded, own)
    members = [response(loaded[k : k + 1], own[k : k + 1]) for k in range(len(loaded))]
    assert relative(torch.cat(members), whole) < 1e-6  # larger batches multiply in float32
    monkeypatch.setattr(linear_response, "MAX_VALUES", 1)
    monkeypatch.setattr(LinearResponse, "solve", LinearResponse.by_tensors)  # as on a GPU
    assert relative(response(loaded, own), whole) < 1e-6


def test_blocks_are_float64_where_rounded_ones_are_not_accurate_enough(monkeypatch):
    scene = scene_of(PLAIN)
    assert LinearResponse(scene, []).blocks.values.dtype == "int16"
    monkeypatch.setattr(parity_factor, "MAX_ROUNDING", 0.0)
    response = LinearResponse(scene, [])
    force, none = forces(scene), parameters(scene)
    found = response(at_free(scene, force), none)
    assert response.blocks.values.dtype == "float64"
    assert relative(found, at_free(scene, exact(scene, force, none))) < 1e-11


@pytest.mark.parametrize("name", [PLAIN, THREE])
def test_a_zero_force_has_a_zero_solution_and_a_gradient(name):
    scene = scene_of(name)
    loaded = torch.zeros(1, int(scene.problem.free.sum()), dtype=torch.float64, requires_grad=True)
    found = response_of(scene)(loaded, parameters(scene, 1))
    assert not found.any()
    (gradient,) = torch.autograd.grad(found.sum(), loaded)
    assert gradient.isfinite().all()
    assert gradient.any()


@pytest.mark.parametrize(("name", "supports"), [(PLAIN, "moved"), (THREE, "held")])
def test_gradients_with_respect_to_forces_are_solutions(name, supports):
    """K(0)^-1 is symmetric: the gradient of g u with respect to f is the solution of g."""
    scene = scene_of(name, supports)
    response, own = response_of(scene), parameters(scene)
    loaded = at_free(scene, forces(scene)).requires_grad_()
    weight = torch.randn(loaded.shape, generator=torch.Generator().manual_seed(1)).double()
    (gradient,) = torch.autograd.grad((weight * response(loaded, own)).sum(), loaded)
    at_rest = response(torch.zeros_like(weight), own)
    assert relative(gradient, response(weight, own) - at_rest) < 1e-4


@pytest.mark.parametrize(("name", "supports"), RANGES)
def test_gradients_with_respect_to_parameters_are_those_of_differences(name, supports):
    scene = scene_of(name, supports)
    response = response_of(scene)
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


def test_images_of_a_load_have_the_images_of_its_solution():
    scene = scene_of(PLAIN)
    group, force = fem.symmetries(scene.problem), forces(scene)
    response, none = response_of(scene), parameters(scene)
    assert len(group) == 8
    field = torch.zeros_like(force)
    field[:, scene.problem.free] = response(at_free(scene, force), none)
    for symmetry in group:
        image = response(at_free(scene, symmetry.image(force)), none)
        assert relative(image, at_free(scene, symmetry.image(field))) < 5e-5


@pytest.mark.parametrize(
    ("name", "supports"),
    [(PLAIN, "moved"), (RANGE, "held"), (RANGE, "on a foundation"), (THREE, "held")],
)
def test_compiled_predictions_equal_tensors_and_are_linear_for_small_loads(name, supports):
    scene = scene_of(name, supports)
    samples = solved(scene, scene.loads.sample(0, range(20)))
    net, force, own = Unrolled(scene, **SMALL), 0.01 * forces(scene), parameters(scene)
    net.fit(samples, samples)
    assert net._is_compiled(force, own)
    compiled = net(force, own)
    tensors = net(force.clone().requires_grad_(), own).detach()
    assert relative(compiled.flatten(1), tensors.flatten(1)) < 1e-5
    if supports == "held":  # a moved support bends the body without a force
        small = 1e-7 * force
        assert relative(net(small, own).flatten(1), exact(scene, small, own).flatten(1)) < 1e-4


def test_networks_take_this_linear_solution_as_their_base():
    three = scene_of()
    load = three.loads.sample(0, range(4))
    expected = next(iter(three.linear.iterate(load))).displacement
    assert relative(LinearResponse(three).solutions(load).flatten(1), expected.flatten(1)) < 1e-4
    torch.manual_seed(0)
    loss, network = RMSELoss(relative=1.0, floor=0.0), partial(FCNN, width=16)
    surrogate = Surrogate.from_network(network, loss, three, base="linear")
    small = fem.Load(1e-7 * load.force, load.young, load.parameters)
    with torch.no_grad():
        found = surrogate.predict(small)
    assert relative(found.flatten(1), 1e-7 * expected.flatten(1)) < 1e-3


@pytest.mark.parametrize("other", [NeoHookeanLn(0.3), NeoHookeanLn([0.2, 0.4])])
def test_stiffnesses_that_differ_too_much_are_refused_before_any_training(other):
    laws = {"core": NeoHookeanLn(0.3, [1.0, 1e9]), "other": other}
    scene = scene_on(laws, REGIONS)
    for build in (Unrolled, LinearResponse):
        with pytest.raises(ValueError, match=r"core.young.* takes more than 200 steps.*base=null"):
            build(scene)
