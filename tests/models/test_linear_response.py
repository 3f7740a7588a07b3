"""Linear solutions: exact by a factor; in modes, with a solve for local loads."""

import pytest
import torch

from dpl import Sample, Scene
from dpl.fem import DirichletBC, ModalLoads, NeoHookeanLn, Newton, Plane, Problem, box, solve
from dpl.fem.rom.reduced_problem import support_force
from dpl.models import Unrolled, linear_response
from dpl.models.linear_response import LinearResponse


@pytest.fixture(scope="module")
def spread(scene, batch):
    """Forces on the whole boundary and on few nodes, dimensionless, (14, N, D)."""
    return torch.cat([batch.force, sparse(scene, 2), sparse(scene, 60)])


def sparse(scene, count, seed=0):
    """Return a force (1, N, D) on some loadable degrees of freedom."""
    random = torch.Generator().manual_seed(seed)
    places = scene.loads.loadable_dofs.flatten().nonzero()[:, 0]
    places = places[torch.randperm(len(places), generator=random)[:count]]
    force = torch.zeros(scene.problem.free.numel(), dtype=torch.float64)
    force[places] = 1e-4 * torch.randn(count, generator=random, dtype=torch.float64)
    return force.view(1, *scene.problem.shape)


def fitted(scene, batch, tol):
    net = Unrolled(scene, rank=20, cells=8, stages=1, linear_tol=tol)
    held_out = Sample(*(column[-3:] for column in batch))
    net.fit(batch, held_out)
    return net


@pytest.fixture(scope="module")
def net(scene, batch):
    return fitted(scene, batch, 5e-4)


def in_modes(net, force):
    """Return linear solutions in modes at free degrees of freedom, and the mask of local loads."""
    loaded = force.flatten(1)[:, net.dofs]
    return net.linear.in_modes(loaded, loaded.new_zeros(len(loaded), 0))


def exact_solutions(scene, net, force):
    return torch.stack([scene.linear.solve(f).flatten()[net.dofs] for f in force])


def relative_missing(net, force):
    """Return norms of the missing parts over those of the Galerkin linear solutions, (B,)."""
    linear, _ = in_modes(net, force)
    return (exact_solutions(net.scene, net, force) - linear).norm(dim=1) / linear.norm(dim=1)


def is_local(net, force, tol):
    """Return the mask of local loads for a tolerance, (B,)."""
    before, net.linear.tol = net.linear.tol, tol
    try:
        return in_modes(net, force)[1]
    finally:
        net.linear.tol = before


def test_the_estimate_is_within_a_factor_of_three(net, spread):
    missing = relative_missing(net, spread)
    assert float(missing.max() / missing.min()) > 100
    for one, force in zip(missing.tolist(), spread, strict=True):
        tol = one / (1 + one**2) ** 0.5  # relative to the whole linear solution
        assert is_local(net, force[None], tol / 3)
        assert not is_local(net, force[None], 3 * tol)


def test_only_local_loads_are_solved(net, spread, monkeypatch):
    solved, original = [], LinearResponse.solve

    def counted(response, loaded, parameters):
        solved.extend(loaded)
        return original(response, loaded, parameters)

    monkeypatch.setattr(LinearResponse, "solve", counted)
    marked = int(net.forward_in_basis(spread)[1].sum())
    assert 0 < marked < len(spread)
    net(spread)
    assert len(solved) == marked
    for force in spread:
        net(force[None])
    assert len(solved) == 2 * marked


def test_images_of_a_load_are_local_together(net, spread):
    assert len(net.group) > 1
    masks = [is_local(net, symmetry.image(spread), 0.02) for symmetry in net.group]
    assert masks[0].any()
    assert not masks[0].all()
    assert all(torch.equal(mask, masks[0]) for mask in masks)


def test_a_solve_replaces_the_linear_solution_in_modes(scene, net, spread):
    local = spread[net.forward_in_basis(spread)[1]]
    exact, linear = exact_solutions(scene, net, local), in_modes(net, local)[0]
    found = (net(local) - net.forward_in_basis(local)[0]).flatten(1)[:, net.dofs]
    size = exact.norm(dim=1)
    assert ((found - (exact - linear)).norm(dim=1) < 1e-3 * size).all()
    assert ((exact - linear).norm(dim=1) > 1e-3 * size).any()


def test_a_small_banded_factor_is_applied_to_every_load(scene, batch, spread):
    """The compiled loops solve by parity, the tensor operations with the whole factor."""
    net = fitted(scene, batch, None)
    assert net.linear.is_exact
    assert len(net.linear.group) > 1
    assert len(net.linear.compiled().factor.order) < int(scene.problem.free.sum()) / 2
    small = 1e-6 * spread
    exact = exact_solutions(scene, net, small)
    for answer in (net(small), torch.cat([net(one[None]) for one in small])):
        error = (answer.flatten(1)[:, net.dofs] - exact).norm(dim=1)
        assert (error < 1e-4 * exact.norm(dim=1)).all()
    with torch.enable_grad():
        tensors = net(spread.clone().requires_grad_()).detach()
    compiled = torch.cat([net(one[None]) for one in spread])
    assert (compiled - tensors).norm() < 1e-5 * tensors.norm()


def test_modes_are_used_where_float32_is_not_accurate_enough(scene, batch, monkeypatch):
    monkeypatch.setattr(linear_response, "MAX_ROUNDING", 0.0)
    net = fitted(scene, batch, None)
    assert not net.linear.is_exact
    assert fitted(scene, batch, 0.0).linear.is_exact, "as demanded"
    again = Unrolled(scene, rank=20, cells=8, stages=1)
    assert again.linear.is_exact
    again.load_state_dict(net.state_dict())
    assert not again.linear.is_exact
    force = batch.force[:2]
    assert torch.equal(again(force), net(force))


def test_predictions_of_local_and_other_loads_do_not_depend_on_the_batch(net, spread):
    order = torch.randperm(len(spread), generator=torch.Generator().manual_seed(1))
    parts = torch.cat([net(one[None]) for one in spread[order]])
    size = float(parts.abs().max())
    assert torch.allclose(net(spread[order]), parts, rtol=1e-6, atol=1e-7 * size)


def test_gradients_of_local_loads_equal_finite_differences(scene, batch):
    net = fitted(scene, batch, 0.0)  # every load is local
    force = sparse(scene, 60).requires_grad_()
    random = torch.Generator().manual_seed(2)
    way = torch.where(force.detach() != 0, force.detach().abs().max(), 0.0)
    way = way * torch.randn(force.shape, generator=random, dtype=torch.float64)
    weight = torch.randn(force.shape, generator=random, dtype=torch.float64)
    (slope,) = torch.autograd.grad((weight * net(force)).sum(), force)
    with torch.no_grad():
        up, down = ((weight * net(force + s * 1e-2 * way)).sum() for s in (1, -1))
    assert float((slope * way).sum()) == pytest.approx(float(up - down) / 2e-2, rel=1e-2)


def test_with_infinite_tolerance_nothing_is_solved(scene, batch, spread, monkeypatch):
    net = fitted(scene, batch, torch.inf)
    monkeypatch.setattr(LinearResponse, "solve", None)
    assert net(spread).any()
    assert not net.flags_local_loads


@pytest.mark.parametrize("tol", [None, 5e-4])
def test_a_moved_support_is_part_of_the_linear_solution(tol):
    moved = DirichletBC(region=Plane(0, 4.0), value=[0.05, None, None])
    body = Problem.build(
        box((4, 1, 1), (5, 3, 3)), NeoHookeanLn(0.3), fixed=Plane(0, 0.0), supports=[moved]
    )
    newton = Newton(body)
    scene = Scene(body, ModalLoads(newton.linear_solver, n_modes=3, deflection=0.1), newton)
    load = scene.loads.sample(0, range(20))
    states = solve(newton, load).displacement
    samples = Sample(load.force, states, load.young, load.parameters)
    net = fitted(scene, samples, tol)
    force = load.force[:4]
    loaded = force.flatten(1)[:, net.dofs]
    linear = body.prescribed.repeat(4, 1, 1)
    linear.view(4, -1)[:, net.dofs] = net.linear(loaded, loaded.new_zeros(4, 0))
    balance = body.tangent_product(torch.zeros_like(linear), linear) - force
    size = force.flatten(1).norm(dim=1) + support_force(body).norm()
    assert (balance[:, body.free].norm(dim=1) < (1e-5 if tol is None else 0.1) * size).all()
    compiled = torch.cat([net(one[None]) for one in force])
    with torch.enable_grad():
        tensors = net(force.clone().requires_grad_()).detach()
    assert (compiled - tensors).norm() < 1e-5 * tensors.norm()
