"""Laws of every loss in conf/loss, and the paper's formulas."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dpl.fem.problem import Problem
from dpl.fem.solution import solve
from dpl.losses import MSE, Loss, LrPlus, LrStar, Physics, residual_norm
from dpl.scene import Sample

LOSSES = sorted((Path(__file__).parents[1] / "conf" / "loss").glob("*.yaml"))


@pytest.fixture(params=LOSSES, ids=lambda path: path.stem)
def loss(request) -> Loss:
    return instantiate(OmegaConf.load(request.param))


@pytest.fixture(scope="module")
def physics(scene):
    return Physics(scene.problem, torch.tensor(scene.loads.largest_force, dtype=torch.float64))


@pytest.fixture(scope="module")
def few(batch) -> Sample:
    return Sample(*(column[:4] for column in batch))


@pytest.fixture(scope="module")
def near(scene, few):
    """Predictions some per cent off, which invert nothing."""
    noise = torch.randn(
        few.force.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    return few.displacement + torch.where(scene.problem.free, 1e-3 * noise, 0.0)


@pytest.fixture(scope="module")
def inverted(scene, few):
    """Predictions that turn every element inside out."""
    points = torch.where(scene.problem.free, -1.5 * scene.problem.points, 0.0)
    assert scene.problem.volume_ratio(points[None]) < 0
    return points.expand_as(few.displacement).clone()


@pytest.fixture
def evaluations(monkeypatch):
    """Counts of evaluated internal forces, by tensors and by compiled loops."""
    counts = []

    def count(name):
        original = getattr(Problem, name)

        def counted(problem, displacement):
            counts.append(len(displacement))
            return original(problem, displacement)

        monkeypatch.setattr(Problem, name, counted)

    count("internal_force")
    count("evaluate")
    return counts


def gradient(loss, prediction, batch, physics):
    prediction = prediction.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(prediction, batch, physics), prediction)
    return slope


def test_a_loss_vanishes_at_the_exact_answer(loss, few, physics, near):
    exact = float(loss(few.displacement, few, physics))
    assert 0 <= exact < 1e-5 * float(loss(near, few, physics))
    assert exact < 1e-6


def test_a_loss_is_a_positive_scalar_in_double_precision(loss, few, physics, near):
    value = loss(near, few, physics)
    assert value.shape == ()
    assert value.dtype == torch.float64
    assert float(value) > 0


def test_a_loss_has_a_finite_gradient_that_leads_downhill(loss, few, physics, near):
    slope = gradient(loss, near, few, physics)
    assert slope.isfinite().all()
    step = 1e-6 / float(slope.norm())
    assert loss(near - step * slope, few, physics) < loss(near, few, physics)


def test_a_loss_and_its_gradient_are_finite_where_elements_are_inverted(
    loss, few, physics, inverted, near
):
    mixed = torch.cat([near[:2], inverted[2:]])
    for prediction in (inverted, mixed):
        value = loss(prediction, few, physics)
        assert value.isfinite()
        assert float(value) > 0
        assert gradient(loss, prediction, few, physics).isfinite().all()


def test_a_loss_logs_what_it_is_made_of(loss, few, physics, near):
    loss(near, few, physics)
    assert all(term.shape == () for term in loss.terms.values())
    logged = {}
    module = SimpleNamespace(log_dict=logged.update)
    loss.on_train_batch_end(None, module, None, None, 0)
    assert set(logged) == {f"loss/{name}" for name in loss.terms}
    assert not any(value.requires_grad for value in logged.values())


def test_a_batch_is_the_mean_of_its_members_unless_the_residual_weighs_it(few, physics, near):
    singles = [Sample(*(column[k : k + 1] for column in few)) for k in range(4)]
    for loss in (MSE(), LrPlus(), LrStar(per_sample=True)):
        parts = [loss(near[k : k + 1], single, physics) for k, single in enumerate(singles)]
        whole = loss(near, few, physics)
        assert float(whole) == pytest.approx(float(torch.stack(parts).mean()), rel=1e-12)


def test_mse_is_the_mean_square_over_degrees_of_freedom(few, physics, near):
    expected = (near - few.displacement).numpy().ravel()
    assert float(MSE()(near, few, physics)) == pytest.approx((expected**2).mean(), rel=1e-12)


def test_mse_evaluates_no_finite_element(few, physics, near, evaluations):
    gradient(MSE(), near, few, physics)
    assert evaluations == []
    assert MSE().plan() == ["no finite-element evaluation in training: the loss knows no residual"]


def test_residual_losses_evaluate_finite_elements_once_a_batch(few, physics, near, evaluations):
    for loss in (LrStar(), LrStar(per_sample=True), LrPlus()):
        evaluations.clear()
        gradient(loss, near, few, physics)
        assert evaluations == [4]


def test_the_residual_is_over_the_largest_modal_force(scene, few, physics, near):
    problem = scene.problem
    forces = problem.internal_force(near) - few.force
    expected = [float(f[problem.free].norm()) / scene.loads.largest_force for f in forces]
    assert residual_norm(near, few, physics).tolist() == pytest.approx(expected, rel=1e-10)


def test_the_residual_of_an_inverted_sample_is_the_largest_of_its_batch(
    few, physics, near, inverted
):
    mixed = torch.cat([near[:3], inverted[3:]])
    norms = residual_norm(mixed, few, physics)
    if not physics.problem.residual(inverted[3:], few.force[3:]).isfinite().all():
        assert float(norms[3]) == float(norms[:3].max())
    everything = torch.full_like(near, torch.nan)
    assert residual_norm(everything, few, physics).tolist() == [1.0] * 4


def test_lr_star_is_mse_times_the_mean_residual(few, physics, near):
    error = (near - few.displacement).square().mean(dim=(1, 2))
    norms = residual_norm(near, few, physics)
    assert float(LrStar()(near, few, physics)) == pytest.approx(float(error.mean() * norms.mean()))
    each = LrStar(per_sample=True)(near, few, physics)
    assert float(each) == pytest.approx(float((error * norms).mean()))


def test_the_gradient_of_lr_star_is_the_residual_times_that_of_mse(few, physics, near):
    norms = residual_norm(near, few, physics)
    plain = gradient(MSE(), near, few, physics)
    assert torch.allclose(gradient(LrStar(), near, few, physics), norms.mean() * plain, rtol=1e-12)
    each = gradient(LrStar(per_sample=True), near, few, physics)
    assert torch.allclose(each, norms[:, None, None] * plain, rtol=1e-12)


def test_lr_plus_is_mse_plus_the_weighted_residual(few, physics, near):
    error = float(MSE()(near, few, physics))
    norm = float(residual_norm(near, few, physics).mean())
    for weight in (0.0, 1.0, 2.5):
        value = float(LrPlus(weight=weight)(near, few, physics))
        assert value == pytest.approx(error + weight * norm, rel=1e-12)


def test_the_gradient_of_lr_plus_is_that_of_finite_differences(scene, few, physics, near):
    loss = LrPlus()
    slope = gradient(loss, near, few, physics)
    random = torch.Generator().manual_seed(1)
    for _ in range(3):
        way = torch.randn(near.shape, generator=random, dtype=torch.float64)
        way = torch.where(scene.problem.free, way / way.norm(), 0.0)
        step = 1e-6
        up, down = (float(loss(near + s * way, few, physics)) for s in (step, -step))
        assert (up - down) / (2 * step) == pytest.approx(float((slope * way).sum()), rel=1e-5)


def test_lr_plus_at_the_answer_has_the_slope_of_no_kink(scene, few, physics):
    """The norm's slope is bounded also where the residual is all but zero."""
    exact = solve(scene.solver, few.load).displacement
    assert gradient(LrPlus(), exact, few, physics).isfinite().all()


def test_the_weight_rises_over_the_warmup():
    loss = LrPlus(weight=2.0, warmup_epochs=4)
    assert loss.weight == 0.0
    seen = []
    for epoch in range(6):
        loss.on_train_epoch_start(SimpleNamespace(current_epoch=epoch), None)
        seen.append(loss.weight)
    assert seen == [0.0, 0.5, 1.0, 1.5, 2.0, 2.0]


def test_without_a_warmup_the_weight_stays():
    loss = LrPlus(weight=2.0)
    loss.on_train_epoch_start(SimpleNamespace(current_epoch=0), None)
    assert loss.weight == 2.0


@pytest.mark.parametrize("options", [{"weight": -1.0}, {"warmup_epochs": -1}])
def test_negative_options_are_refused_by_name(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        LrPlus(**options)
