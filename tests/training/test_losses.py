"""Properties of every loss in conf/loss, and the formula of each."""

import pickle
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

import dpl.fem as fem
from dpl import Sample
from dpl.models import FCNN
from dpl.training import (
    MSE,
    BlendedLoss,
    EnergyNormLoss,
    Loss,
    LossContext,
    LrPlus,
    LrStar,
    PotentialEnergyLoss,
    RMSELoss,
    Surrogate,
)
from dpl.training.losses import residual_norm

LOSSES = sorted((Path(__file__).parents[2] / "conf" / "loss").glob("*.yaml"))


@pytest.fixture(params=LOSSES, ids=lambda path: path.stem)
def loss(request) -> Loss:
    whole = {"loss": OmegaConf.load(request.param), "trainer": {"max_epochs": 10}}
    return instantiate(OmegaConf.create(whole).loss)


@pytest.fixture(scope="module")
def physics(scene):
    return LossContext(scene.problem, scene.loads.largest_force)


@pytest.fixture(scope="module")
def few(batch) -> Sample:
    return Sample(*(column[:4] for column in batch))


@pytest.fixture(scope="module")
def near(scene, few):
    """Predictions with errors of some per cent and without inverted elements."""
    noise = torch.randn(
        few.force.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    return few.displacement + torch.where(scene.problem.free, 1e-3 * noise, 0.0)


@pytest.fixture(scope="module")
def inverted(scene, few):
    """Predictions that invert every element."""
    points = torch.where(scene.problem.free, -1.5 * scene.problem.points, 0.0)
    assert scene.problem.volume_ratio(points[None]) < 0
    return points.expand_as(few.displacement).clone()


@pytest.fixture
def evaluations(monkeypatch):
    """Counts the evaluations of forces, by tensors and by compiled loops, and of energies."""
    counts = []
    for name in ("internal_force", "evaluate", "energy"):
        original = getattr(fem.Problem, name)

        def counted(problem, u, original=original):
            counts.append(len(u))
            return original(problem, u)

        monkeypatch.setattr(fem.Problem, name, counted)
    return counts


@pytest.fixture(scope="module")
def unanswered(few) -> Sample:
    """Loads without reference solutions."""
    return few._replace(displacement=torch.full_like(few.displacement, torch.nan))


def singles(batch) -> list[Sample]:
    return [Sample(*(column[k : k + 1] for column in batch)) for k in range(len(batch.force))]


def gradient(loss, prediction, batch, physics):
    prediction = prediction.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(prediction, batch, physics), prediction)
    return slope


def slopes_along(loss, prediction, batch, physics, step=1e-6):
    """Return directional derivatives of a loss, from finite differences and from its gradient."""
    slope = gradient(loss, prediction, batch, physics)
    random, free = torch.Generator().manual_seed(1), physics.problem.free
    for _ in range(3):
        way = torch.randn(prediction.shape, generator=random, dtype=torch.float64)
        way = torch.where(free, way / way.norm(), 0.0)
        up, down = (float(loss(prediction + s * way, batch, physics)) for s in (step, -step))
        yield (up - down) / (2 * step), float((slope * way).sum())


def test_a_loss_is_minimal_at_the_reference_solution(loss, few, physics, near):
    if isinstance(loss, PotentialEnergyLoss):  # least, but not zero
        exact, off = (loss(u, few, physics) for u in (few.displacement, near))
        assert exact < off
        return
    exact = float(loss(few.displacement, few, physics))
    assert 0 <= exact < 1e-5 * float(loss(near, few, physics))
    assert exact < 1e-6


def test_the_negative_gradient_of_a_loss_is_finite_and_a_descent_direction(
    loss, few, physics, near
):
    value = loss(near, few, physics)
    assert (value.shape, value.dtype) == ((), torch.float64)
    assert float(value) > 0 or isinstance(loss, PotentialEnergyLoss)
    assert all(term.shape == () for term in loss.terms.values())
    logged = {}
    loss.on_train_batch_end(None, SimpleNamespace(log_dict=logged.update), None, None, 0)
    assert set(logged) == {f"loss/{name}" for name in loss.terms}
    assert not any(value.requires_grad for value in logged.values())
    slope = gradient(loss, near, few, physics)
    assert slope.isfinite().all()
    step = 1e-6 / float(slope.norm())
    assert loss(near - step * slope, few, physics) < loss(near, few, physics)


@pytest.mark.parametrize(
    "loss",
    [
        *(RMSELoss(relative=0.8), LrPlus(), PotentialEnergyLoss()),
        EnergyNormLoss(),
    ],
    ids=["rmse", "lr_plus", "energy", "energy norm"],
)
def test_the_gradient_of_a_loss_equals_finite_differences(loss, few, physics, near):
    for expected, found in slopes_along(loss, near, few, physics):
        assert found == pytest.approx(expected, rel=1e-5)


def test_a_loss_and_its_gradient_are_finite_where_elements_are_inverted(
    loss, few, physics, inverted, near
):
    mixed = torch.cat([near[:2], inverted[2:]])
    for prediction in (inverted, mixed):
        value = loss(prediction, few, physics)
        assert value.isfinite()
        assert float(value) > 0
        assert gradient(loss, prediction, few, physics).isfinite().all()


def test_the_loss_of_a_batch_is_the_mean_over_samples_except_for_residual_weights(
    few, physics, near
):
    relative = (
        MSE(relative=True, floor=0.0),
        EnergyNormLoss(floor=0.0),
        PotentialEnergyLoss(floor=0.0),
    )
    rmse = RMSELoss(), RMSELoss(relative=0.8, floor=0.0)
    for loss in (MSE(), LrPlus(), *relative, *rmse):
        parts = [loss(near[k : k + 1], one, physics) for k, one in enumerate(singles(few))]
        whole = loss(near, few, physics)
        assert float(whole) == pytest.approx(float(torch.stack(parts).mean()), rel=1e-12)


@pytest.mark.parametrize("relative", [0.0, 0.5, 0.8, 1.0])
def test_the_relative_exponent_applies_to_the_mean_square_of_a_sample(few, physics, near, relative):
    error = (near - few.displacement).square().mean(dim=(1, 2))
    size = few.displacement.square().mean(dim=(1, 2))
    for loss, expected in (
        (MSE(relative=relative, floor=0.0), (error / size**relative).mean()),
        (RMSELoss(relative=relative, floor=0.0), (error / size**relative).sqrt().mean()),
    ):
        assert float(loss(near, few, physics)) == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.parametrize("kind", [MSE, RMSELoss])
def test_a_floor_limits_the_weight_of_loads_near_zero(few, physics, near, kind):
    """The error of the last sample is fixed while its displacement tends to zero."""
    shrunk = few.displacement.clone()
    shrunk[-1] *= 1e-6
    samples = few._replace(displacement=shrunk)
    off = torch.cat([near[:-1], shrunk[-1:] + (near - few.displacement)[-1:]])
    bare, floored_ = (kind(relative=1.0, floor=f)(off, samples, physics) for f in (0.0, 1e-2))
    assert bare > 1e3 * floored_
    nothing = few._replace(displacement=torch.zeros_like(shrunk))
    assert kind(relative=1.0)(near, nothing, physics).isfinite()


def test_the_gradient_of_rmse_loss_does_not_vanish_with_the_error(few, physics, near):
    error = near - few.displacement
    sizes = {}
    for kind in (RMSELoss, MSE):
        large, small = (
            gradient(kind(), few.displacement + s * error, few, physics).norm() for s in (1, 1e-4)
        )
        sizes[kind] = float(small / large)
    assert sizes[RMSELoss] == pytest.approx(1.0, rel=1e-3)
    assert sizes[MSE] == pytest.approx(1e-4, rel=1e-3)
    slope = gradient(RMSELoss(relative=0.8), few.displacement, few, physics)
    assert not slope.any(), "it is zero at the reference solution, and finite"


@pytest.mark.parametrize(
    ("loss", "evaluated"),
    [(MSE(), []), (LrStar(), [4]), (LrPlus(), [4, 4, 4])],
)
def test_a_loss_evaluates_finite_elements_no_more_than_its_gradient_needs(
    loss, evaluated, few, physics, near, evaluations
):
    """The gradient of a residual takes two more evaluations than the residual."""
    gradient(loss, near, few, physics)
    assert evaluations == evaluated
    evaluations.clear()
    with torch.no_grad():
        loss(near, few, physics)
    assert evaluations == evaluated[:1]


def test_residual_losses_are_the_formulas_of_their_terms(scene, few, physics, near):
    """The residual is relative to the largest modal force; that of L_r^* is a constant weight."""
    problem = scene.problem
    forces = problem.internal_force(near) - few.force
    expected = [float(f[problem.free].norm()) / scene.loads.largest_force for f in forces]
    norms, error = (
        residual_norm(near, few, physics),
        (near - few.displacement).square().mean((1, 2)),
    )
    assert norms.tolist() == pytest.approx(expected, rel=1e-10)
    plain = gradient(MSE(), near, few, physics)
    formulas = [
        (LrStar(), error.mean() * norms.mean(), norms.mean() * plain),
        *((LrPlus(weight=w), error.mean() + w * norms.mean(), None) for w in (0.0, 1.0, 2.5)),
    ]
    for loss, expected, slope in formulas:
        assert float(loss(near, few, physics)) == pytest.approx(float(expected), rel=1e-12)
        found = {name: float(term) for name, term in loss.terms.items()}
        parts = {"error": float(error.mean()), "residual": float(norms.mean())}
        assert found == pytest.approx(parts, rel=1e-12)
        if slope is not None:
            assert torch.allclose(gradient(loss, near, few, physics), slope, rtol=1e-12)
    exact = fem.solve(scene.solver, few.load).displacement  # where the residual is almost zero
    assert gradient(LrPlus(), exact, few, physics).isfinite().all()


def test_a_limit_keeps_one_rough_sample_from_dominating_a_batch(few, physics, near):
    rough = torch.cat([-30 * near[:1], near[1:]])
    norms = residual_norm(rough, few, physics)
    assert norms.max() > 10 * norms.median()
    error = RMSELoss(relative=1.0, floor=0.0)
    loss = LrStar(error=error, limit=3.0)
    expected = error.errors(rough, few).mean() * norms.clamp(max=3 * norms.median()).mean()
    assert float(loss(rough, few, physics)) == pytest.approx(float(expected), rel=1e-12)


def test_an_inverted_sample_has_the_largest_residual_and_no_gradient(few, physics, near, inverted):
    mixed = torch.cat([near[:3], inverted[3:]])
    norms = residual_norm(mixed, few, physics)
    sound = residual_norm(near, few, physics)[:3]
    assert norms.tolist() == pytest.approx([*sound.tolist(), float(sound.max())], rel=1e-12)
    assert residual_norm(inverted, few, physics).tolist() == [1.0] * 4
    u = mixed.clone().requires_grad_()
    residual_norm(u, few, physics).sum().backward()
    assert not u.grad[3].any()
    assert all(u.grad[k].any() for k in range(3))


@pytest.mark.parametrize(
    ("build", "reported"),
    [
        (lambda: MSE(relative=-0.1), "relative = -0.1 must lie between 0 and 1"),
        (lambda: RMSELoss(relative=1.1), "relative = 1.1 must lie between 0 and 1"),
        (lambda: MSE(floor=2.0), "floor = 2.0 must lie between 0 and 1"),
        (lambda: EnergyNormLoss(floor=-0.1), "floor"),
        (lambda: PotentialEnergyLoss(floor=float("nan")), "floor"),
        (lambda: LrPlus(weight=-1.0), "weight"),
        (lambda: BlendedLoss(MSE(), MSE(), epochs=0), "epochs"),
        (lambda: BlendedLoss(MSE(), MSE(), epochs=1, start=-1), "start"),
    ],
)
def test_options_out_of_range_raise_an_error(build, reported):
    with pytest.raises(ValueError, match=reported):
        build()


# ------------------------------------------------------------------ the energy norm of the error


def test_energy_norm_loss_is_the_squared_energy_norm_of_the_error(scene, few, physics, near):
    problem, rest = scene.problem, torch.zeros_like(near)

    def work(field):
        return (field * problem.tangent_product(rest, field)).sum(dim=(1, 2))

    error, size = work(near - few.displacement), work(few.displacement)
    expected = float((error / size).mean())
    assert float(EnergyNormLoss(floor=0.0)(near, few, physics)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kind", [EnergyNormLoss, PotentialEnergyLoss])
def test_energy_losses_assemble_one_tangent(kind, few, physics, near, evaluations, monkeypatch):
    made = []
    linearise = fem.Problem.linearise
    monkeypatch.setattr(fem.Problem, "linearise", lambda *a: made.append(1) or linearise(*a))
    loss = kind()
    for _ in range(3):
        gradient(loss, near, few, physics)
    assert len(made) == 1
    assert not evaluations or kind is PotentialEnergyLoss


def test_a_loss_replaces_the_stiffness_of_another_problem(few, physics, near, make_scene):
    used, other = EnergyNormLoss(), make_scene(poisson=0.45)
    used(near, few, physics)
    there = LossContext(other.problem, physics.largest_force)
    assert float(used(near, few, there)) == float(EnergyNormLoss()(near, few, there))
    assert float(used(near, few, there)) != float(used(near, few, physics))


@pytest.mark.parametrize("loss", [EnergyNormLoss(), PotentialEnergyLoss()])
def test_a_loss_is_pickled_without_its_matrices(loss, few, physics, near):
    value = loss(near, few, physics)
    twin = pickle.loads(pickle.dumps(loss))
    assert set(vars(twin._rest)) == {"problem"}
    assert float(twin(near, few, physics)) == pytest.approx(float(value), rel=1e-12)


# ------------------------------------------------------------------ the energy, without answers


def test_potential_energy_loss_reads_no_reference_solution_and_weights_samples_alone(
    few, unanswered, physics, near, inverted
):
    loss = PotentialEnergyLoss()
    assert loss(near, unanswered, physics) == loss(near, few, physics)
    slopes = gradient(loss, near, unanswered, physics)
    mixed = torch.cat([near[:3], inverted[3:]])
    mixed_slopes = gradient(loss, mixed, unanswered, physics)
    assert torch.equal(mixed_slopes[:3], slopes[:3]), "an inverted sample does not change others"
    assert mixed_slopes.isfinite().all()
    assert (mixed_slopes[3] * inverted[3]).sum() > 0, "downhill is towards rest"


def test_potential_energy_loss_is_relative_to_the_work_of_the_linear_solution(
    scene, few, physics, near
):
    problem = scene.problem
    total = problem.energy(near) - (few.force * near).sum(dim=(1, 2))
    linear = torch.stack([scene.linear.solve(force) for force in few.force])
    work = (few.force * linear).sum(dim=(1, 2)) / 2
    found = float(PotentialEnergyLoss(floor=0.0)(near, few, physics))
    assert found == pytest.approx(float((total / work).mean()), rel=1e-9)


def test_losses_are_finite_for_zero_loads(few, physics, near):
    still = Sample(0 * few.force, 0 * few.displacement, few.young)
    for loss in (PotentialEnergyLoss(), EnergyNormLoss(), MSE(relative=True), LrPlus(), LrStar()):
        for u in (near, 0 * near):
            assert loss(u, still, physics).isfinite()
            assert gradient(loss, u, still, physics).isfinite().all()


def test_an_inverted_sample_has_the_linear_strain_energy(scene, few, physics, inverted):
    """It is u^T K(0) u / 2 over the work of the linear solution."""
    problem = scene.problem
    image = problem.tangent_product(torch.zeros_like(inverted), inverted)
    linear = torch.stack([scene.linear.solve(force) for force in few.force])
    work = (few.force * linear).sum(dim=(1, 2)) / 2
    expected = (inverted * image).sum(dim=(1, 2)) / 2 / work
    found = float(PotentialEnergyLoss(floor=0.0)(inverted, few, physics))
    assert found == pytest.approx(float(expected.mean()), rel=1e-9)
    slope = gradient(PotentialEnergyLoss(floor=0.0), inverted, few, physics)
    expected = torch.where(problem.free, image, 0.0) / work[:, None, None] / len(work)
    assert torch.allclose(slope, expected, rtol=1e-9, atol=1e-12 * float(expected.abs().max()))


def test_potential_energy_loss_has_no_minimum_with_inverted_elements(few, make_scene):
    scene = make_scene(law=fem.SaintVenantKirchhoff)
    physics = LossContext(scene.problem, torch.tensor(1.0, dtype=torch.float64))
    mirrored = torch.zeros_like(few.displacement)
    mirrored[:] = -2 * scene.problem.points * torch.tensor([1.0, 0.0, 0.0])  # no strain at all
    still = few._replace(force=0 * few.force)
    assert float(scene.problem.energy(mirrored).abs().max()) < 1e-12
    assert float(PotentialEnergyLoss()(mirrored, still, physics)) > 0.01


def test_energies_are_zero_at_rest(few, make_scene):
    scene = make_scene(law=fem.StableNeoHookean)
    physics = LossContext(scene.problem, torch.tensor(1.0, dtype=torch.float64))
    assert float(scene.problem.energy(0 * few.force)[0].abs()) > 0.01
    assert float(PotentialEnergyLoss()(0 * few.force, few, physics)) == pytest.approx(0, abs=1e-9)


def test_springs_are_part_of_the_energy(few):
    mesh, bed = fem.box([100.0, 25.0, 25.0], [5, 3, 3]), fem.RobinBC(fem.Plane(2, "min"), 1e-3)
    law = fem.SaintVenantKirchhoff(0.3)
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), supports=[bed])
    physics = LossContext(problem, torch.tensor(1.0, dtype=torch.float64))
    exact = fem.solve(
        fem.Newton(problem, linear="superlu"), fem.Load(few.force, few.young)
    ).displacement
    off = exact + torch.where(problem.free, 1e-3, 0.0)
    slopes = [gradient(PotentialEnergyLoss(), u, few, physics).norm() for u in (exact, off)]
    assert slopes[0] < 1e-6 * slopes[1]


# ------------------------------------------------------------------ from one loss to another


def test_a_blended_loss_is_the_weighted_sum_of_its_parts(few, physics, near):
    first, second = MSE(relative=True), EnergyNormLoss()
    loss = BlendedLoss(first, second, epochs=4, start=2)
    seen = []
    for epoch in range(8):
        loss.on_train_epoch_start(SimpleNamespace(current_epoch=epoch), None)
        seen.append(loss.weight)
        parts = [float(part(near, few, physics)) for part in (first, second)]
        expected = (1 - loss.weight) * parts[0] + loss.weight * parts[1]
        assert float(loss(near, few, physics)) == pytest.approx(expected, rel=1e-12)
        assert float(loss.terms["weight"]) == loss.weight
    assert seen == [0, 0, 0, 0.25, 0.5, 0.75, 1, 1]


def test_both_parts_of_a_blended_loss_follow_the_epochs_and_none_is_evaluated_for_nothing(
    few, physics, near, evaluations
):
    loss = BlendedLoss(MSE(), BlendedLoss(MSE(), LrPlus(weight=2.0), epochs=4), epochs=2)
    assert loss.second.weight == 0.0
    loss(near, few, physics)
    assert evaluations == []
    assert set(loss.terms) == {"weight", "first"}
    seen = []
    for epoch in (1, 3, 4, 5):
        loss.on_train_epoch_start(SimpleNamespace(current_epoch=epoch), None)
        seen.append(loss.second.weight)
    assert seen == [0.25, 0.75, 1.0, 1.0]
    loss(near, few, physics)
    assert evaluations == [4]
    parts = {"weight", "second", "second/error", "second/residual"}
    assert set(loss.terms) == {"weight", "second", *(f"second/{part}" for part in parts)}
    assert MSE.saves == ("no finite-element evaluation in training: the loss has no residual term",)
    assert BlendedLoss(MSE(), LrStar(), epochs=1).saves == ()
    assert BlendedLoss(MSE(), MSE(relative=True), epochs=1).saves == MSE.saves


def test_a_trainer_changes_and_logs_the_weight(scene, data, tmp_path):
    module = Surrogate(
        FCNN(scene, width=8), BlendedLoss(MSE(), PotentialEnergyLoss(), epochs=2), scene
    )
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    trainer = L.Trainer(
        accelerator="cpu", max_epochs=2, enable_checkpointing=False, default_root_dir=tmp_path,
        **quiet,
    )  # fmt: skip
    trainer.fit(module, datamodule=data)
    assert float(trainer.callback_metrics["loss/weight"]) == 0.5
