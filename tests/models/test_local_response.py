"""Local loads: the part of the linear solution that the modes miss is estimated and solved."""

import pytest
import torch

from dpl import Sample
from dpl.models import Unrolled
from dpl.models.local_response import LocalResponse


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


def relative_missing(net, force):
    """Return norms of the missing parts over those of the Galerkin linear solutions, (B,)."""
    loaded = force.flatten(1)[:, net.dofs]
    linear, _ = net.coordinates(loaded, loaded.new_zeros(len(loaded), 0))
    exact = torch.stack([net.scene.linear.solve(f).flatten()[net.dofs] for f in force])
    return (exact - linear @ net.modes.double().T).norm(dim=1) / linear.norm(dim=1)


def is_local(net, force, tol):
    """Return the mask of local loads for a tolerance, (B,)."""
    before, net.local.tol = net.local.tol, tol
    try:
        return net.forward_in_basis(force)[1]
    finally:
        net.local.tol = before


def test_the_estimate_is_within_a_factor_of_three(net, spread):
    missing = relative_missing(net, spread)
    assert float(missing.max() / missing.min()) > 100
    for one, force in zip(missing.tolist(), spread, strict=True):
        tol = one / (1 + one**2) ** 0.5  # relative to the whole linear solution
        assert is_local(net, force[None], tol / 3)
        assert not is_local(net, force[None], 3 * tol)


def test_only_local_loads_are_solved(net, spread, monkeypatch):
    solved, original = [], LocalResponse.solve
    monkeypatch.setattr(LocalResponse, "solve", lambda *args: solved.append(0) or original(*args))
    marked = int(net.forward_in_basis(spread)[1].sum())
    assert 0 < marked < len(spread)
    net(spread)
    assert len(solved) == marked


def test_images_of_a_load_are_local_together(net, spread):
    assert len(net.group) > 1
    masks = [is_local(net, symmetry.image(spread), 0.02) for symmetry in net.group]
    assert masks[0].any()
    assert not masks[0].all()
    assert all(torch.equal(mask, masks[0]) for mask in masks)


def test_a_solve_adds_the_missing_part_of_the_linear_solution(scene, net, spread):
    local = spread[net.forward_in_basis(spread)[1]]
    linear = net.coordinates(local.flatten(1)[:, net.dofs], local.new_zeros(len(local), 0))[0]
    exact = torch.stack([scene.linear.solve(force) for force in local])
    missing = exact.flatten(1)[:, net.dofs] - linear @ net.modes.double().T
    found = (net(local) - net.forward_in_basis(local)[0]).flatten(1)[:, net.dofs]
    size = exact.flatten(1).norm(dim=1)
    assert ((found - missing).norm(dim=1) < 1e-3 * size).all()
    assert (missing.norm(dim=1) > 1e-3 * size).any()


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
    monkeypatch.setattr(LocalResponse, "solve", None)
    assert net(spread).any()
    assert not net.flags_local_loads
