"""Properties of PODNet.

Properties that hold up to rounding errors are tested in double precision.
"""

import functools
from contextlib import suppress

import pytest
import torch

from dpl import Sample, Scene
from dpl.fem import (
    DirichletBC,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    box,
    rectangle,
    solve,
)
from dpl.models import PODNet
from dpl.models.invariant_basis import InvariantPOD, image_columns, scatter_fields
from dpl.training import MSE, LrStar, PotentialEnergyLoss, Surrogate
from dpl.training.surrogate import scales

SMALL = {"width": 16, "blocks": 1}
WHOLE = {"rank": 1000, "coordinates": 1000, **SMALL}  # no mode is left out


@pytest.fixture(scope="module", autouse=True)
def scales_of_a_scene_once():
    """Caches the scales of a scene, whose computation dominates the run time of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dpl.training.surrogate.scales", functools.cache(scales))
        yield


def prepared(scene, samples, *, seed=0, **options):
    """Return a surrogate in evaluation mode with random weights and fitted bases."""
    torch.manual_seed(seed)
    module = Surrogate(PODNet(scene, **{**SMALL, **options}), MSE(), scene)
    module.fit_bases(samples)
    return module.eval()


def exact(module):
    """Return the network in double precision."""
    return module.double().net


def solved(scene, count):
    load = scene.loads.sample((0, 0), range(count))
    answer = solve(scene.solver, load)
    assert answer.converged.all()
    return Sample(load.force, answer.displacement, load.young)


def some(batch, count):
    return Sample(*(column[:count] for column in batch))


@pytest.fixture(scope="module")
def bar(make_scene):
    """A beam with 48 degrees of freedom, all loadable, and as many modes in its loads."""
    scene = make_scene(nodes=(5, 2, 2))
    assert torch.equal(scene.loads.loadable_dofs, scene.problem.free)
    return scene, solved(scene, 16)


def noise(scene, count=4, seed=0):
    """Return forces (count, N, D) without symmetry on all loadable degrees of freedom."""
    random = torch.Generator().manual_seed(seed)
    force = torch.randn(count, *scene.problem.shape, generator=random, dtype=torch.float64)
    return torch.where(scene.loads.loadable_dofs, force, 0.0)


def asymmetry(net, force):
    """Return the largest relative distance of images of predictions from predictions of images."""
    with torch.no_grad():
        answer = net(force)
        far = [(s.image(answer) - net(s.image(force))).norm() / answer.norm() for s in net.group]
    return float(max(far))


def eye(size):
    return torch.eye(size, dtype=torch.float64)


def read(net):
    """Return the coordinates of a unit force on each loadable degree of freedom, (inputs, C)."""
    units = scatter_fields(torch.eye(int(net.load_dofs.sum())), net.load_dofs)
    return net.encode_loads(net.input_orbits.images(units)).double()


def left_over(basis, net, where):
    """Return the largest projection residual of an image of a mode (R, n)."""
    basis = basis.double()
    images = torch.cat([image_columns(basis, where, net.group, k) for k in range(len(net.group))])
    return float((images - images @ basis.T @ basis).norm(dim=1).max())


# ------------------------------------------------------------------ bases


def gram_of(net):
    """Return the Gram matrix of the modes, (R, R), with 1 or 0 on the diagonal."""
    basis = net.basis.double()
    return basis @ basis.T


@pytest.mark.parametrize("count", [1, 2, 12])
@pytest.mark.parametrize("symmetry", [True, False])
@pytest.mark.parametrize("rank", [100, 108])
def test_a_basis_is_orthonormal_and_zero_beyond(scene, batch, count, symmetry, rank):
    """Holds for any number of snapshots; zero columns are not mixed with modes."""
    net = prepared(scene, some(batch, count), rank=rank, symmetry=symmetry).net
    assert net.basis.shape == (rank, int(scene.problem.free.sum()))
    gram = gram_of(net)
    there = gram.diagonal() > 0.5
    assert 0 < int(there.sum()) <= rank
    assert there[: int(there.sum())].all(), "the zeros come last"
    assert torch.allclose(gram, torch.diag(there.double()), rtol=0, atol=1e-5)


def test_modes_of_a_body_without_symmetry_are_ordered_by_size(scene, batch):
    net = prepared(scene, batch, rank=12, symmetry=False).net
    assert_ordered(net, batch)


def test_modes_are_ordered_by_size(scene, batch):
    """Coordinates are also uncorrelated."""
    assert_ordered(prepared(scene, batch, rank=12).net, batch)


def assert_ordered(net, samples):
    moved = samples.displacement[:, net.free_dofs]
    weighted = moved / moved.norm(dim=1, keepdim=True).sqrt()
    members = range(max(1, len(net.group)))
    images = [image_columns(weighted, net.free_dofs, net.group, k) for k in members]
    found = torch.cat(images)
    coordinates = found @ net.basis.double().T
    spread = coordinates.T @ coordinates
    sizes = spread.diagonal()
    assert (sizes.diff() <= 1e-6 * sizes.max()).all()
    assert torch.allclose(spread, torch.diag(sizes), rtol=0, atol=1e-5 * float(sizes.max()))


def test_a_basis_of_all_modes_represents_every_training_sample(scene, batch):
    net = prepared(scene, batch, **WHOLE).net
    basis = net.basis.double()
    moved = batch.displacement[:, scene.problem.free]
    error = (moved - moved @ basis.T @ basis).norm(dim=1) / moved.norm(dim=1)
    assert float(error.max()) < 1e-5


def test_more_modes_reduce_the_projection_error(scene, batch):
    moved = batch.displacement[:, scene.problem.free]
    left = []
    for rank in (4, 12, 40):
        basis = prepared(scene, batch, rank=rank).net.basis.double()
        left.append(float((moved - moved @ basis.T @ basis).norm() / moved.norm()))
    assert left[0] > 3 * left[1] > 9 * left[2] > 0


def test_whole_families_of_modes_are_invariant_under_the_symmetries(bar):
    """The first four: bending to both sides, stretching, twisting."""
    scene, samples = bar
    net = prepared(scene, samples, rank=4).net
    assert len(net.group) == 8
    assert left_over(net.basis, net, net.free_dofs) < 1e-5


def test_all_modes_of_few_samples_are_invariant_under_the_symmetries(scene, batch):
    net = prepared(scene, some(batch, 2), **WHOLE).net
    assert left_over(net.basis, net, net.free_dofs) < 1e-5


def test_all_modes_of_few_loads_are_invariant_under_the_symmetries(scene, batch):
    net = prepared(scene, some(batch, 2), **WHOLE).net
    kept = read(net)
    kept = kept[:, kept.abs().amax(dim=0) > 1e-5].T
    assert left_over(kept, net, net.load_dofs) < 1e-5


def test_a_basis_of_any_rank_is_invariant_under_the_symmetries(scene, batch):
    for rank in (2, 3, 5, 6, 8, 11):
        net = prepared(scene, batch, rank=rank).net
        assert left_over(net.basis, net, net.free_dofs) < 1e-5, rank


def test_the_basis_of_loads_is_orthonormal_and_represents_them(scene, batch):
    kept = read(prepared(scene, batch, **WHOLE).net)
    kept = kept[:, kept.abs().amax(dim=0) > 1e-5]
    assert torch.allclose(kept.T @ kept, eye(kept.shape[1]), rtol=0, atol=1e-6)
    force = batch.force[:, scene.loads.loadable_dofs]
    assert float((force - force @ kept @ kept.T).norm() / force.norm()) < 1e-5


def test_bases_are_a_function_of_the_samples(scene, batch):
    one, same, other = (
        prepared(scene, samples, seed=seed).net
        for seed, samples in enumerate([batch, batch, some(batch, 8)])
    )
    for name, buffer in one.named_buffers():
        assert torch.equal(buffer, dict(same.named_buffers())[name]), name
    assert not torch.equal(one.basis, other.basis)


def test_samples_beyond_the_maximum_number_of_snapshots_are_thinned_out(scene, batch, monkeypatch):
    """Every third of twelve samples is used."""
    dofs = int(scene.problem.free.sum())
    monkeypatch.setattr("dpl.models.invariant_basis.MAX_BYTES", 4 * 4 * dofs)
    seen = []
    monkeypatch.setattr(
        "dpl.models.invariant_basis.InvariantPOD",
        lambda dofs, group, count: seen.append(count) or InvariantPOD(dofs, group, count),
    )
    net = prepared(scene, batch, rank=20).net
    assert 0 < seen[0] <= 4
    basis = net.basis.double()
    assert torch.allclose(basis @ basis.T, eye(20), rtol=0, atol=1e-5)


# ------------------------------------------------------------------ symmetries


def test_actions_on_inputs_and_outputs_are_a_group_representation(bar):
    """The product of two actions is an action; inverse actions are orthogonal.

    Both hold on the modes; directions that no sample has are zero.
    """
    net = exact(prepared(*bar, **WHOLE))
    order = len(net.group)
    assert order == 8
    for motion in (
        net.input_actions[0],
        net.inverse_output_actions[0],
        *(net.inverse_output_actions.mT @ net.inverse_output_actions),
    ):
        there = torch.diag((motion.diagonal() > 0.5).double())
        assert there.trace() > 16
        assert torch.allclose(motion, there, rtol=0, atol=1e-5)
    for motions in (net.input_actions, net.inverse_output_actions.mT):
        for one in motions:
            far = (motions @ one)[:, None] - motions  # (G, G, r, r)
            nearest = far.flatten(2).norm(dim=2).min(dim=1)
            assert float(nearest.values.max()) < 1e-4 * float(motions.norm(dim=(1, 2)).max())
            assert len(nearest.indices.unique()) == order


@pytest.mark.parametrize("seed", [0, 1])
def test_predictions_have_the_symmetries_exactly(bar, seed):
    scene, samples = bar
    module = prepared(scene, samples, seed=seed, **WHOLE)
    force = noise(scene)
    assert asymmetry(module.net, force.float()) < 1e-4
    with torch.no_grad():
        for parameter in module.net.parameters():
            parameter.normal_(0, 0.1)
    assert asymmetry(module.net, force.float()) < 1e-4
    assert asymmetry(exact(module), force) < 1e-6


def test_predictions_in_training_mode_have_the_symmetries(bar):
    scene, samples = bar
    net = exact(prepared(scene, samples, **WHOLE)).train()
    assert asymmetry(net, noise(scene)) < 1e-6


@pytest.mark.parametrize("loss", [LrStar(), PotentialEnergyLoss()])
def test_a_training_on_fields_learns_no_symmetries(bar, loss):
    """Images of a batch have its loss and its gradient, as `skipped_work` says."""
    scene, samples = bar
    net = PODNet(scene, **{**SMALL, **WHOLE})
    module = Surrogate(net, loss, scene).train()
    module.log = lambda *_, **__: None
    module.fit_bases(samples)
    module.double()
    assert module.encode(samples, net.group) is None
    moved = [net.group[5].image(field) for field in samples[:2]]
    found = []
    for batch in (samples, Sample(*moved, samples.young)):
        module.zero_grad()
        value = module.training_step(batch, 0)
        value.backward()
        slope = torch.cat([weights.grad.flatten() for weights in net.parameters()])
        found.append((float(value.detach()), slope))
    (value, slope), (other, turned) = found
    assert other == pytest.approx(value, rel=1e-5)
    assert float((turned - slope).norm() / slope.norm()) < 1e-4


@pytest.mark.parametrize("symmetry", [True, False])
def test_lower_precision_of_products_does_not_reach_the_bases(scene, batch, symmetry, monkeypatch):
    """As with `trainer.precision=bf16-mixed`: only the layers of the network are rounded."""
    net = prepared(scene, batch, rank=20, symmetry=symmetry).net
    layers = net.network

    def exact_layers(inputs):
        with torch.autocast("cpu", enabled=False):
            return layers(inputs)

    monkeypatch.setattr(net, "network", exact_layers)
    with torch.no_grad():
        expected = net(batch.force.float())
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(net(batch.force.float()), expected)


def test_predictions_have_the_symmetries_for_any_rank(scene, batch):
    for rank in (2, 3, 5, 6, 8, 11):
        net = exact(prepared(scene, batch, rank=rank, coordinates=4))
        assert asymmetry(net, noise(scene)) < 1e-4, rank


def test_predictions_have_the_symmetries_for_any_number_of_coordinates(scene, batch):
    for coordinates in (1, 2, 3, 5, 6, 8, 11):
        net = exact(prepared(scene, batch, rank=12, coordinates=coordinates))
        assert asymmetry(net, noise(scene)) < 1e-4, coordinates


def test_a_rank_that_leaves_no_invariant_mode_raises_an_error(scene, batch):
    """A rank of one splits the pair of bending modes."""
    module = Surrogate(PODNet(scene, rank=1, **SMALL), MSE(), scene)
    with suppress(ValueError):
        module.fit_bases(batch)
        assert module.net.basis.any()


def test_predictions_with_default_options_have_the_symmetries(scene, batch):
    """The defaults are 60 coordinates and 100 modes, see conf/model/pod.yaml."""
    assert asymmetry(exact(prepared(scene, batch)), noise(scene)) < 1e-4


def test_symmetry_false_disables_symmetries(bar):
    scene, samples = bar
    net = exact(prepared(scene, samples, symmetry=False, **WHOLE))
    assert net.group == []
    assert net.input_actions.shape[0] == net.inverse_output_actions.shape[0] == 1
    force, group = noise(scene), PODNet(scene, **SMALL).group
    with torch.no_grad():
        answer = net(force)
        assert torch.equal(answer, net.train()(force))
        far = group[3].image(answer) - net(group[3].image(force))
    assert float(far.norm() / answer.norm()) > 1e-4
    assert len(net.skipped_work()) == len(PODNet(scene, **SMALL).skipped_work()) - 1


def test_skipped_work_contains_the_numbers_of_coordinates_and_symmetries(scene):
    lines = PODNet(scene, rank=20, **SMALL).skipped_work()
    assert lines[0] == f"20 coordinates learnt instead of {int(scene.problem.free.sum())} " + (
        "displacements"
    )
    assert lines[1].startswith("no learning of 8 symmetries")


# ------------------------------------------------------------------ bodies


@pytest.fixture(scope="module")
def plane(make_scene):
    """A cantilever in plane strain, with twenty solved loads."""
    scene = make_scene(mesh=rectangle([100.0, 25.0], [7, 2]))
    return scene, solved(scene, 20)


@pytest.fixture(scope="module")
def skew(make_scene):
    """A body whose cells have no symmetry, with five solved loads."""
    mesh = box([100.0, 30.0, 25.0], [4, 3, 2], "tetra")
    scene = make_scene(mesh=mesh)
    return scene, solved(scene, 5)


def test_predictions_of_a_plane_body_have_its_mirror_symmetry(plane):
    scene, samples = plane
    net = exact(prepared(scene, samples, **WHOLE))
    assert len(net.group) == 2
    force = noise(scene)
    assert net(force).shape == force.shape == (4, 14, 2)
    assert net(force).abs().max() > 0
    assert asymmetry(net, force) < 1e-6


def test_a_body_without_symmetry_is_accepted(skew):
    scene, samples = skew
    net = exact(prepared(scene, samples, rank=5, coordinates=4))
    assert len(net.group) == 1
    assert net.input_actions.shape == (1, 4, 4)
    assert len(net.skipped_work()) == 1
    basis = net.basis
    assert torch.allclose(basis @ basis.T, eye(5), rtol=0, atol=1e-6)
    with torch.no_grad():
        answer = net(noise(scene))
        assert torch.equal(answer, net.train()(noise(scene)))
    assert answer.isfinite().all()
    assert answer.any()


def test_a_body_fixed_in_some_directions_only_is_accepted():
    """Nodes on rails are fixed in some directions only."""
    ends = [(0, [0.0, None, None]), (1, [None, 0.0, None]), (2, [None, None, 0.0])]
    rails = [DirichletBC(Plane(axis, "min"), value) for axis, value in ends]
    mesh = box([100.0, 25.0, 25.0], [5, 2, 2])
    problem = Problem.build(mesh, NeoHookeanLn(0.3), supports=rails)
    solver = Newton(problem, linear="superlu")
    scene = Scene(problem, ModalLoads(solver.linear_solver, n_modes=3, young=4500.0), solver)
    assert (problem.free.any(dim=1) & ~problem.free.all(dim=1)).any()
    module = prepared(scene, solved(scene, 30), **WHOLE)
    answer = exact(module)(noise(scene))
    assert answer.any()
    assert not answer[:, ~problem.free].any()
    assert len(module.net.group) == 2
    assert asymmetry(module.net, noise(scene)) < 1e-5


# ------------------------------------------------------------------ samples


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_snapshots_than_modes_are_accepted(scene, batch, count):
    module = prepared(scene, some(batch, count), rank=100, symmetry=False)
    for name, buffer in module.net.named_buffers():
        assert buffer.isfinite().all(), name
    force = noise(scene).float().requires_grad_()
    answer = module.net(force)
    answer.square().sum().backward()
    assert answer.isfinite().all()
    assert force.grad.isfinite().all()
    for name, parameter in module.net.named_parameters():
        assert parameter.grad.isfinite().all(), name


def test_a_sample_of_zero_displacement_changes_nothing(scene, batch):
    """Its weight is zero; it gives neither NaN nor a mode."""
    still = Sample(*(torch.cat([column, column[:1]]) for column in some(batch, 4)))
    still.force[-1], still.displacement[-1] = 0.0, 0.0
    net = prepared(scene, still, rank=12).net
    usual = prepared(scene, some(batch, 4), rank=12).net
    for name, buffer in net.named_buffers():
        assert buffer.isfinite().all(), name
    projectors = [one.basis.double().T @ one.basis.double() for one in (net, usual)]
    assert torch.allclose(*projectors, rtol=0, atol=1e-5)


def test_rank_and_coordinates_are_limited_by_the_degrees_of_freedom(scene, batch):
    net = prepared(scene, batch, **WHOLE).net
    outputs, inputs = int(scene.problem.free.sum()), int(scene.loads.loadable_dofs.sum())
    assert net.basis.shape == (outputs, outputs)
    assert net.leave.out_features == outputs
    assert net.enter.in_features == inputs


def test_inputs_may_outnumber_modes(scene):
    assert PODNet(scene, rank=7, coordinates=60, **SMALL).enter.in_features == 60


def test_without_bases_the_prediction_is_zero_and_is_fitted_is_false(scene, batch):
    net = PODNet(scene, **SMALL)
    assert not net.fitted
    assert not net(noise(scene).float()).any()
    assert prepared(scene, batch).net.fitted


def test_the_output_for_a_load_does_not_depend_on_its_batch(scene, batch):
    net = exact(prepared(scene, batch))
    force = noise(scene, 5)
    with torch.no_grad():
        parts = torch.cat([net(one[None]) for one in force])
        assert torch.allclose(net(force), parts, rtol=1e-9, atol=1e-12)


def test_gradients_with_respect_to_forces_equal_finite_differences(scene, batch):
    net = exact(prepared(scene, batch, rank=40))
    force, way = noise(scene).requires_grad_(), noise(scene, seed=1)
    weight = noise(scene, seed=2)
    (slope,) = torch.autograd.grad((weight * net(force)).sum(), force)
    step = 1e-5
    with torch.no_grad():
        ends = [float((weight * net(force + s * step * way)).sum()) for s in (1, -1)]
    found = float((slope * way).sum())
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(found, rel=1e-6)
    assert found != 0
    assert not slope[:, ~scene.loads.loadable_dofs].any()


# ------------------------------------------------------------------ options


@pytest.mark.parametrize(
    "options", [{"rank": 0}, {"coordinates": 0}, {"width": 0}, {"blocks": -1}, {"rank": -3}]
)
def test_options_out_of_range_raise_an_error_with_their_name(scene, options):
    (name, number) = next(iter(options.items()))
    with pytest.raises(ValueError, match=f"{name} = {number} must be"):
        PODNet(scene, **options)


def test_a_network_without_blocks_is_accepted(scene, batch):
    net = prepared(scene, batch, blocks=0).net
    assert len(net.blocks) == 0
    assert net(noise(scene).float()).any()


def test_more_width_and_blocks_are_more_parameters(scene):
    def count(**options):
        return sum(
            p.numel() for p in PODNet(scene, rank=10, coordinates=20, **options).parameters()
        )

    for width, blocks in ((16, 0), (16, 3), (24, 2)):
        inner = blocks * 2 * (width * width + width)
        expected = (20 * width + width) + inner + (10 * width + 10)
        assert count(width=width, blocks=blocks) == expected
