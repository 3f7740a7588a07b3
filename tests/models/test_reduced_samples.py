"""Training in reduced coordinates equals training on fields.

A symmetric network takes the mean over the images of a load on fields, and images as samples in
coordinates. Both are the same without symmetry only.
"""

import functools

import pytest
import torch

from dpl import Sample
from dpl.models import FCNN, PODNet
from dpl.models.linear_base import sampled_solutions
from dpl.models.reduced_samples import ReducedDataset, ReducedSamples
from dpl.training import MSE, LrStar, RMSELoss, Surrogate

SMALL = {"width": 16, "blocks": 1}
CASES = pytest.mark.parametrize(
    "options", [{}, {"rank": 4, "coordinates": 4}], ids=["all modes", "few modes"]
)


@pytest.fixture(scope="module", autouse=True)
def scales_of_a_scene_once():
    """Caches the solutions for the scales, which dominate the run time of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        cached = functools.cache(sampled_solutions)
        patch.setattr("dpl.training.surrogate.sampled_solutions", cached)
        yield


@pytest.fixture
def build(scene, batch, monkeypatch):
    """Builds surrogates in training mode with random weights and fitted bases; logs nothing."""
    monkeypatch.setattr(Surrogate, "log", lambda *_, **__: None)

    def build(options, loss=None):
        torch.manual_seed(0)
        module = Surrogate(PODNet(scene, **SMALL, **options), loss or MSE(), scene)
        module.fit_bases(batch)
        return module.train()

    return build


def encoded(module, samples):
    """Return the samples in coordinates, without their images."""
    return module.encode(samples).__getitems__(list(range(len(samples.force))))


def gradients(module, batch):
    module.zero_grad()
    loss = module.training_step(batch, 0)
    loss.backward()
    slope = torch.cat([p.grad.double().flatten() for p in module.parameters()])
    return float(loss.detach()), slope


# ------------------------------------------------------------------ squared errors


@CASES
def test_squared_errors_of_coordinates_plus_projection_errors_equal_those_of_fields(
    build, batch, options
):
    """Parseval: the basis is orthonormal."""
    module = build({**options, "symmetry": False})
    part = encoded(module, batch)
    with torch.no_grad():
        field = (module.predict(batch.load) - batch.displacement) / module.displacement_scale
        learnt = module.net.network(part.inputs)
    found = (learnt - part.targets).square().sum(dim=1) + part.squared_error
    assert torch.allclose(found, field.square().sum(dim=(1, 2)), rtol=1e-4)


@CASES
def test_mean_square_is_that_of_whole_displacements(build, batch, options):
    module = build(options)
    size = encoded(module, batch).mean_square * module.displacement_scale**2
    assert torch.allclose(size, batch.displacement.square().mean(dim=(1, 2)), rtol=1e-9)


@CASES
def test_targets_are_the_least_squares_coordinates(build, batch, options):
    """The projection error is minimal, and zero with all modes."""
    module = build(options)
    part = encoded(module, batch)
    assert (part.squared_error >= 0).all()
    left = (part.squared_error / (part.squared_error + part.targets.square().sum(dim=1))).max()
    assert (left > 1e-4) == bool(options), left


@pytest.mark.parametrize("count", [1, 2])
def test_squared_errors_are_exact_with_fewer_snapshots_than_modes(build, scene, batch, count):
    module = build({"symmetry": False})
    few = Sample(*(column[:count] for column in batch))
    module.fit_bases(few)
    part = encoded(module, batch)
    with torch.no_grad():
        field = (module.predict(batch.load) - batch.displacement) / module.displacement_scale
        learnt = module.net.network(part.inputs)
    found = (learnt - part.targets).square().sum(dim=1) + part.squared_error
    assert torch.allclose(found, field.square().sum(dim=(1, 2)), rtol=1e-4)


# ------------------------------------------------------------------ training


@CASES
@pytest.mark.parametrize("loss", [MSE(), MSE(relative=0.5), RMSELoss(relative=0.8, floor=1e-4)])
def test_the_loss_in_coordinates_equals_the_loss_of_fields(build, batch, options, loss):
    module = build({**options, "symmetry": False}, loss)
    with torch.no_grad():
        found = float(module.training_step(encoded(module, batch), 0))
        assert found == pytest.approx(float(module.training_step(batch, 0)), rel=1e-4)


@CASES
def test_the_gradient_in_coordinates_equals_that_of_fields(build, batch, options):
    """The projection error is constant and has no gradient."""
    module = build({**options, "symmetry": False}, MSE(relative=0.5))
    (_, found), (_, expected) = (
        gradients(module, part) for part in (encoded(module, batch), batch)
    )
    assert float((found - expected).norm() / expected.norm()) < 1e-3


@CASES
def test_the_gradient_of_rmse_loss_in_coordinates_equals_that_of_fields(build, batch, options):
    module = build({**options, "symmetry": False}, RMSELoss())
    (_, found), (_, expected) = (
        gradients(module, part) for part in (encoded(module, batch), batch)
    )
    assert float((found - expected).norm() / expected.norm()) < 1e-3


def test_a_step_in_coordinates_evaluates_no_field(build, batch, monkeypatch):
    module = build({})
    part = encoded(module, batch)
    monkeypatch.setattr(PODNet, "forward", None)
    before = [p.clone() for p in module.parameters()]
    optimizer = torch.optim.SGD(module.parameters(), lr=1.0)
    module.training_step(part, 0).backward()
    optimizer.step()
    assert not all(map(torch.equal, module.parameters(), before))


def test_only_losses_of_squared_errors_train_in_coordinates(build, scene, batch):
    assert build({}, LrStar()).encode(batch) is None
    assert Surrogate(FCNN(scene, width=8), MSE(), scene).encode(batch) is None
    assert isinstance(build({}, RMSELoss()).encode(batch), ReducedDataset)


def test_skipped_work_mentions_coordinates_where_they_are_used(build):
    reported = "no fields in training from disk: the loss is computed in coordinates"
    assert reported in build({}).skipped_work()
    assert reported in build({}, RMSELoss()).skipped_work()
    assert reported not in build({}, LrStar()).skipped_work()


# ------------------------------------------------------------------ images


def test_images_of_coordinates_are_coordinates_of_images(make_scene):
    """All modes are kept, so that no family is split."""
    scene = make_scene(nodes=(5, 2, 2))
    force = scene.loads.sample((0, 0), range(16)).force
    linear = torch.stack([scene.linear.solve(one) for one in force])
    bent = linear + 0.1 * linear.roll(1, dims=0)  # what a law may answer; encoding knows none
    samples = Sample(force, bent, torch.full((16,), 4500.0, dtype=torch.float64))
    torch.manual_seed(0)
    net = PODNet(scene, rank=48, coordinates=48, **SMALL)
    module = Surrogate(net, MSE(), scene)
    module.fit_bases(samples)
    whole = module.encode(samples)
    assert len(whole) == 8 * 16
    for k in range(8):
        which = torch.full((16,), k)
        moved = Sample(*(net.group.images(f, which) for f in samples[:2]), samples.young)
        part = whole.__getitems__(list(range(16 * k, 16 * k + 16)))
        for found, expected in zip(part, encoded(module, moved), strict=True):
            size = float(expected.abs().max())
            assert torch.allclose(found, expected, rtol=1e-3, atol=1e-4 * max(size, 1e-3))


def test_without_symmetry_there_is_one_image(build, batch):
    assert len(build({"symmetry": False}).encode(batch)) == 12


def test_the_first_images_are_the_inputs_of_the_network(build, batch):
    module, seen = build({"rank": 4, "coordinates": 4}), []
    module.net.symmetrised_output = lambda inputs: (
        seen.append(inputs) or torch.zeros(len(inputs), 4)
    )
    module.predict(batch.load)
    whole = module.encode(batch)
    part = whole.__getitems__(list(range(12)))
    assert torch.allclose(part.inputs, seen[0], rtol=1e-4, atol=1e-5)
    assert len(whole) == 96


def test_batches_are_fetched_in_any_order():
    random = torch.Generator().manual_seed(0)
    parts = [torch.randn(3, 2, generator=random), torch.randn(3, 4, generator=random)]
    numbers = torch.arange(3.0), torch.arange(3.0, 6.0), torch.arange(6.0, 9.0)
    turn = torch.stack([torch.eye(2), torch.tensor([[0.0, 1.0], [-1.0, 0.0]])])
    samples = ReducedDataset(
        ReducedSamples(*parts, *numbers), turn, torch.stack([torch.eye(4), -torch.eye(4)])
    )
    assert len(samples) == 6
    batch = samples.__getitems__([5, 0, 3])
    assert torch.allclose(batch.inputs[0], parts[0][2] @ turn[1])
    assert torch.equal(batch.inputs[1], parts[0][0])
    assert torch.equal(batch.targets, torch.stack([-parts[1][2], parts[1][0], -parts[1][0]]))
    assert batch.squared_error.tolist() == [2.0, 0.0, 0.0]
    assert batch.mean_square.tolist() == [5.0, 3.0, 3.0]
    assert batch.factor.tolist() == [8.0, 6.0, 6.0]


def test_the_data_module_computes_images_if_the_network_has_no_symmetry(build, scene, data, batch):
    data.symmetry = True
    module = build({"symmetry": False})
    data.trainer = type("Trainer", (), {"lightning_module": module, "global_rank": 0})()
    data.trainer.world_size = 1
    assert len(data.train_dataloader().dataset) == 8 * 12
