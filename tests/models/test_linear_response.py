"""Linear solutions of all loads by nested static condensation: compiled, as tensors, in ranges."""

from functools import partial

import pytest
import torch
from linear_solutions import BEAM, SUPPORTS, at_free, exact, relative

from dpl import Sample, Scene
from dpl.fem import (
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Problem,
    solve,
    symmetries,
)
from dpl.models import Unrolled, linear_response
from dpl.models.linear_response import LinearResponse


@pytest.fixture(params=SUPPORTS, scope="module")
def supports(request):
    return SUPPORTS[request.param]


def scene_of(supports, poisson=0.3, **options):
    body = Problem.build(BEAM, NeoHookeanLn(poisson), supports=supports, **options)
    newton = Newton(body)
    return Scene(body, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.1), newton)


def nodal_forces(scene, count=6):
    """Return forces on single nodes of the boundary, of very different sizes."""
    force = torch.zeros(count, *scene.problem.shape, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    nodes = scene.loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    chosen = nodes[torch.randperm(len(nodes), generator=random)[:count]]
    for k, node in enumerate(chosen):
        vector = torch.randn(force.shape[2], generator=random, dtype=torch.float64)
        force[k, node] = 10.0 ** -(3 * k) * vector
    return torch.where(scene.problem.free, force, 0.0)


@pytest.mark.parametrize("group", [True, False], ids=["by parity", "whole"])
def test_the_linear_solution_of_every_force_is_exact(supports, group):
    scene = scene_of(supports)
    response = LinearResponse(scene, symmetries(scene.problem) if group else [])
    force = nodal_forces(scene)
    none = force.new_zeros(len(force), 0)
    found = response(at_free(scene, force), none)
    assert relative(found, at_free(scene, exact(scene, force, none))) < 1e-5


@pytest.mark.parametrize("poisson", [(0.2, 0.4), (-0.3, 0.0), (0.0, 0.49)])
def test_it_is_exact_for_all_poissons_ratios_of_a_range(supports, poisson):
    scene = scene_of(supports, poisson)
    response = LinearResponse(scene, symmetries(scene.problem))
    force = nodal_forces(scene)
    ratios = torch.linspace(*poisson, len(force), dtype=torch.float64)[:, None]
    found = response(at_free(scene, force), ratios)
    assert relative(found, at_free(scene, exact(scene, force, ratios))) < 2e-4


def test_locking_elements_do_not_change_the_bound_of_ranges():
    scene = scene_of(SUPPORTS["held"], (0.1, 0.45), mean_dilatation=True)
    response = LinearResponse(scene, symmetries(scene.problem))
    force = nodal_forces(scene)
    ratios = torch.linspace(0.1, 0.45, len(force), dtype=torch.float64)[:, None]
    found = response(at_free(scene, force), ratios)
    assert relative(found, at_free(scene, exact(scene, force, ratios))) < 2e-4


def test_a_zero_force_has_a_zero_solution():
    scene = scene_of(SUPPORTS["held"])
    loaded = torch.zeros(2, int(scene.problem.free.sum()), dtype=torch.float64)
    assert not LinearResponse(scene, [])(loaded, loaded.new_zeros(2, 0)).any()


def test_batches_in_parts_are_like_whole_ones(monkeypatch):
    scene = scene_of(SUPPORTS["held"])
    loaded = at_free(scene, nodal_forces(scene))
    response = LinearResponse(scene, [])
    whole = response(loaded, loaded.new_zeros(6, 0))
    monkeypatch.setattr(linear_response, "MAX_VALUES", 1)
    assert relative(response(loaded, loaded.new_zeros(6, 0)), whole) < 1e-6


def test_blocks_are_float64_where_float32_is_not_accurate_enough(monkeypatch):
    scene = scene_of(SUPPORTS["held"])
    assert LinearResponse(scene, []).blocks.values.dtype == "float32"
    monkeypatch.setattr(linear_response, "MAX_ROUNDING", 0.0)
    response = LinearResponse(scene, [])
    force = nodal_forces(scene)
    none = force.new_zeros(len(force), 0)
    found = response(at_free(scene, force), none)
    assert response.blocks.values.dtype == "float64"
    assert relative(found, at_free(scene, exact(scene, force, none))) < 1e-11


def test_the_solution_is_differentiable():
    """K(0)^-1 is symmetric: the gradient of g u with respect to f is the solution of g."""
    scene = scene_of(SUPPORTS["moved"])
    response = LinearResponse(scene, symmetries(scene.problem))
    force = nodal_forces(scene)
    loaded = at_free(scene, force).requires_grad_()
    none = force.new_zeros(len(force), 0)
    random = torch.Generator().manual_seed(1)
    weight = torch.randn(loaded.shape, generator=random, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weight * response(loaded, none)).sum(), loaded)
    at_rest = response(torch.zeros_like(weight), none)
    assert relative(gradient, response(weight, none) - at_rest) < 1e-4


def fitted(scene, count=20):
    load = scene.loads.sample(0, range(count))
    states = solve(scene.solver, load).displacement
    samples = Sample(load.force, states, load.young, load.parameters)
    net = Unrolled(scene, rank=20, cells=8, stages=1)
    net.fit(samples, samples)
    return net


@pytest.mark.parametrize("poisson", [0.3, (0.2, 0.4)], ids=["law", "range"])
def test_compiled_predictions_of_local_loads_equal_the_tensor_operations(supports, poisson):
    scene = scene_of(supports, poisson)
    net = fitted(scene)
    force = nodal_forces(scene)
    own = torch.full((6, len(scene.loads.parameter_ranges)), 0.27, dtype=torch.float64)
    compiled = net(force, own)
    tensors = net(force.clone().requires_grad_(), own).detach()
    assert relative(compiled.flatten(1), tensors.flatten(1)) < 1e-5


def test_a_small_local_load_has_the_linear_solution():
    scene = scene_of(SUPPORTS["held"])
    force = 1e-9 * nodal_forces(scene)
    expected = exact(scene, force, force.new_zeros(6, 0))
    assert relative(fitted(scene)(force).flatten(1), expected.flatten(1)) < 1e-4


def test_images_of_a_load_have_the_images_of_its_solution():
    scene = scene_of(SUPPORTS["held"])
    group = symmetries(scene.problem)
    force = nodal_forces(scene)
    response = partial(LinearResponse(scene, group), parameters=force.new_zeros(6, 0))
    assert len(group) == 8
    for symmetry in group:
        image = response(at_free(scene, symmetry.image(force)))
        field = torch.zeros_like(force)
        field[:, scene.problem.free] = response(at_free(scene, force))
        assert relative(image, at_free(scene, symmetry.image(field))) < 1e-5
