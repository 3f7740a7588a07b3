"""The unrolled reduced solver: exact limits, symmetry, compiled loops, storage, training."""

import math
from dataclasses import replace

import lightning as L
import numpy as np
import pytest
import torch

from benchmarks.samples import solved
from dpl import training
from dpl.config import run_folder
from dpl.data import DataModule
from dpl.fem import (
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Prestretched,
    Problem,
    box,
    rectangle,
    relaxed,
)
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.rows import in_rows
from dpl.fem.parity import Parities
from dpl.fem.rom.pod import scatter_fields
from dpl.fem.rom.reduced_stiffness import ReducedStiffness, reduced_terms
from dpl.fem.solvers.rotation_strain import rotated_strain
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import SymmetryGroup
from dpl.inference import Simulator
from dpl.models import Unrolled
from dpl.models.unrolled import feature_loops
from dpl.models.unrolled.compiled import law_arguments
from dpl.models.unrolled.correction import choose_newton, fit_errors
from dpl.models.unrolled.features import rest_stress, unbalanced_stress
from dpl.models.unrolled.fit import choose_cells, modes_of_parity
from dpl.models.unrolled.regression import RIDGES, MapParities, fit_gains, fit_map
from dpl.scene import Scene
from dpl.training import MSE, Surrogate
from tests.laws import ISOTROPIC, LAWS

SMALL = {"rank": 20, "cells": 8, "stages": 2}


def with_residual_stress(mesh):
    """Return mesh and law of a body of which one side has grown by 15 % along x."""
    law = NeoHookeanLn(0.3)
    flat = Problem.build(mesh, law, fixed=Plane(0, 0.0))
    mesh, stretch = relaxed(flat, lambda x: np.eye(3) - 0.15 * x[:, 2:, None] * np.diag([1, 0, 0]))
    return mesh, Prestretched(law, stretch)


BODIES = {  # mesh, law, linear deflection over L, samples
    "a beam": (box((4, 1, 1), (5, 3, 3)), NeoHookeanLn(0.3), 0.2, 40),
    "a range of Poisson's ratios": (box((3, 1, 1), (4, 3, 3)), NeoHookeanLn((0.1, 0.4)), 0.2, 60),
    "a plane body": (rectangle((4, 1), (9, 3)), NeoHookeanLn(0.3), 0.05, 40),
    "residual stress": (box((4, 1, 1), (5, 3, 3)), None, 0.2, 40),  # see `with_residual_stress`
}


def scene_on(mesh, law, deflection=0.2, **options):
    """Return a scene of a body fixed at x = 0."""
    problem = Problem.build(mesh, law, fixed=Plane(0, 0.0), **options)
    newton = Newton(problem, linear="superlu")
    loads = ModalLoads(newton.linear_solver, n_modes=3, deflection=deflection)
    return Scene(problem, loads, newton)


def samples_of(scene, count, seed=0):
    return solved(scene, scene.loads.sample(seed, range(count)))


def fitted(scene, count=40, **options):
    net = Unrolled(scene, **{**SMALL, **options})
    net.fit(samples_of(scene, count), samples_of(scene, 8, seed=1))
    return net


@pytest.fixture(scope="module")
def beam():
    return scene_on(*BODIES["a beam"][:3])


@pytest.fixture(scope="module")
def net(beam):
    return fitted(beam)


def errors(net, samples):
    """Return relative errors (S,)."""
    difference = net(samples.force, samples.parameters) - samples.displacement
    return difference.flatten(1).norm(dim=1) / samples.displacement.flatten(1).norm(dim=1)


@pytest.mark.parametrize("count", [1, 5, 12])
def test_sample_cells_cover_the_body_as_evenly_as_they_lie_apart(beam, count):
    """Gonzalez (1985); the centre of the body counts as one of the cells that are taken."""
    problem = beam.problem
    centres = problem.points[problem.cells].mean(dim=1)
    cells = choose_cells(torch.arange(len(centres))[None], centres, count)
    taken = torch.cat([centres.mean(dim=0)[None], centres[cells]])
    apart = torch.cdist(taken, taken).fill_diagonal_(torch.inf).min()
    assert len(cells) == count
    assert torch.cdist(centres, taken).amin(dim=1).max() <= apart + 1e-12
    images = SymmetryGroup.identity(problem).cell_images(problem)
    images = torch.cat([images, beam.linear.symmetries.cell_images(problem)])
    several = choose_cells(images, centres, count)
    assert len(several) >= count
    assert torch.isin(images[:, several], several).all(), "all images of a cell are taken"


@pytest.mark.parametrize("name", BODIES)
def test_it_is_much_nearer_than_the_linear_solution(name):
    mesh, law, deflection, count = BODIES[name]
    body = with_residual_stress(mesh) if law is None else (mesh, law)
    scene = scene_on(*body, deflection)
    net, unseen = fitted(scene, count), samples_of(scene, 12, seed=2)
    pairs = zip(unseen.force, unseen.displacement, strict=True)
    solve_linear = scene.linear.reference.solve
    linear = torch.stack([(solve_linear(f) - u).norm() / u.norm() for f, u in pairs])
    assert errors(net, unseen).median() < 0.2 * linear.median()
    if scene.loads.parameter_ranges:
        with pytest.raises(ValueError, match="parameters are an input"):
            net(unseen.force)
    else:
        assert errors(net, unseen).max() < 0.3 * linear.max()


def test_nearly_incompressible_bodies_are_predicted_like_compressible_ones():
    """Of a law with Poisson's ratio 0.499 the features would have nearly three times the error."""
    mesh, found = box((3, 1, 1), (7, 3, 3)), []
    for poisson in (0.3, 0.499):
        scene = scene_on(mesh, NeoHookeanLn(poisson), mean_dilatation=True)
        net = Unrolled(scene, rank=40, cells=16, stages=3)
        net.fit(samples_of(scene, 60), samples_of(scene, 12, seed=1))
        found.append(errors(net, samples_of(scene, 20, seed=2)))
    assert found[1].median() < 1.2 * found[0].median()


@pytest.mark.parametrize("size", [1e-2, 1e-9])
def test_small_loads_have_the_linear_solution(beam, net, size):
    force = size * beam.loads.sample(3, range(4)).force
    exact = torch.stack([beam.linear.solve(one) for one in force])
    error = (net(force) - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)
    assert error.max() < 2 * size + 1e-6  # the factor is float32
    assert not net(0 * force).any()


def test_images_of_loads_have_images_of_answers(beam, net):
    force = beam.loads.sample(4, range(3)).force
    answer = net(force)
    for symmetry in net.group:
        turned = net(symmetry.image(force))
        assert (turned - symmetry.image(answer)).norm() < 1e-5 * answer.norm()


def test_compiled_and_tensor_predictions_agree(beam, net):
    load = beam.loads.sample(5, range(3)).force
    with torch.enable_grad():
        tensors = net(load.clone().requires_grad_())
    assert (net(load) - tensors).norm() < 1e-5 * tensors.norm()  # float32 factors


@pytest.mark.parametrize("law", [NeoHookeanLn(0.3), NeoHookeanLn((0.1, 0.4))])
def test_a_batch_on_two_threads_is_predicted_like_its_members(law):
    """The loads are of several laws, and some of them act on few nodes."""
    scene = scene_on(box((3, 1, 1), (4, 3, 3)), law)
    net = fitted(scene, 20, rank=8, cells=4, stages=1)
    load = scene.loads.sample(5, range(6))
    load.force[::2, :-1] = 0.0
    pairs = zip(load.force.split(1), load.parameters.split(1), strict=True)
    single = torch.cat([net(*pair) for pair in pairs])
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        batch = net(load.force, load.parameters)
    finally:
        torch.set_num_threads(before)
    assert torch.allclose(batch, single, rtol=1e-10, atol=1e-12 * float(single.abs().max()))


def test_gradients_with_respect_to_forces(beam, net):
    force = beam.loads.sample(6, range(1)).force.requires_grad_()
    direction = torch.randn(force.shape, generator=torch.Generator().manual_seed(0)).double()
    direction *= force.detach().norm() / direction.norm()
    (gradient,) = torch.autograd.grad(net(force).square().sum(), force)
    step = 1e-3  # the factor is float32
    ends = [net(force.detach() + s * step * direction).square().sum() for s in (1, -1)]
    assert float((gradient * direction).sum()) == pytest.approx(
        float(ends[0] - ends[1]) / (2 * step), rel=1e-3
    )


def test_loads_far_out_of_range_stay_finite(beam, net):
    force = 20 * beam.loads.sample(7, range(5)).force
    assert net(force).isfinite().all()


def test_weights_are_stored_with_the_sizes_of_the_fit(beam, net):
    other = Unrolled(beam, **SMALL)
    assert not other.is_fitted
    other.load_state_dict(net.state_dict())
    force = beam.loads.sample(8, range(3)).force
    assert other.is_fitted
    assert torch.equal(other(force), net(force))


def test_the_surrogate_predicts_in_si_units(beam, net):
    module = Surrogate(net, MSE(), beam)
    load = beam.loads.sample(9, range(2))
    assert torch.allclose(module.predict(load), net(load.force), rtol=0, atol=1e-15)
    with pytest.raises(TypeError, match="has no gradient descent"):
        module.configure_optimizers()


def test_fewer_maps_where_they_do_not_help(beam):
    assert len(fitted(beam, 6, stages=30).maps) < 30


def test_a_run_is_trained_and_loaded_and_neither_resumed_nor_fitted_to_a_stream(
    script, tiny_training, tmp_path
):
    folder = tmp_path / "run"
    options = [one for one in tiny_training if not one.startswith("model.")]
    done = script("train", "model=unrolled", *options, f"run={folder}", cwd=tmp_path)
    assert not done.status, done.err
    simulator = run_folder.load(folder)
    scene = simulator.scene
    load = scene.loads.sample(0, range(1))
    answer = simulator(**scene.si_inputs(load))
    assert answer.volume_ratio > 0
    assert simulator.surrogate.net.is_fitted
    resumed = script("train", f"run={folder}", "ckpt_path=last", cwd=tmp_path)
    assert resumed.status
    assert "ckpt_path: Unrolled is fitted in one step and cannot be resumed" in resumed.err
    options = [one for one in options if not one.startswith("data.train")]
    stream = script("train", "model=unrolled", "data=online", *options, "run=b", cwd=tmp_path)
    assert stream.status
    assert "data: Unrolled is fitted to solved loads; set data=offline" in stream.err


# ---------------------------------------------------------------- parts


def test_rotated_strain_is_the_polar_form():
    random = torch.Generator().manual_seed(0)
    H = 0.4 * torch.randn(50, 3, 3, generator=random).double()
    W, e = (H - H.mT) / 2, (H + H.mT) / 2
    eye = torch.eye(3).double()
    expected = torch.linalg.matrix_exp(W) @ (eye + e) - eye - H
    assert (rotated_strain(in_rows(H)) - in_rows(expected)).abs().max() < 1e-9
    small = rotated_strain(in_rows(1e-9 * H))
    assert (small / 1e-18 - in_rows(W @ W / 2 + W @ e)).abs().max() < 1e-6


@pytest.mark.parametrize("name", [*ISOTROPIC, "guccione"])  # others: no stress in compression
def test_unbalanced_stress_is_of_second_order(name):
    H = 1e-6 * torch.randn(1, 4, 3, 3, generator=torch.Generator().manual_seed(0)).double()
    rest = LAWS[name].rest_stress(H[:, :, None])[:, :, 0]
    assert unbalanced_stress(LAWS[name], in_rows(H), in_rows(rest)).abs().max() < 1e-9


@pytest.mark.parametrize("name", ["linear_elastic", "mooney_rivlin_k2"])
def test_the_compiled_stress_of_small_strains_and_of_two_invariants_is_that_of_the_tensors(name):
    """The rest of a compiled prediction does not depend on the law; a compilation takes 80 MB."""
    random, law = torch.Generator().manual_seed(0), LAWS[name]
    H, linear = 0.2 * torch.randn(2, 9, SIMD_WIDTH, generator=random).double()
    rest, out = rest_stress(law, linear[None]), np.empty((18, SIMD_WIDTH))
    expected = unbalanced_stress(law, H[None], rest)[0].numpy()
    key, constants, finite = law_arguments(law)
    lanes, work = np.tile(constants.T, SIMD_WIDTH), np.zeros((100, SIMD_WIDTH))
    feature_loops.unbalanced_stress(key, lanes, finite, H.numpy(), linear.numpy(), work, out)
    assert np.abs(out - expected).max() < 1e-12 * np.abs(expected).max()


def test_reduced_stiffness_is_that_of_any_law_of_a_range(beam):
    problem = Problem.build(box((4, 1, 1), (5, 3, 3)), NeoHookeanLn((0.1, 0.45)), fixed=Plane(0, 0))
    modes = torch.linalg.qr(torch.randn(int(problem.free.sum()), 5).double())[0]
    terms = StiffnessTerms.of(problem)
    reduced = ReducedStiffness(reduced_terms(terms, modes), terms)
    fields, right = torch.zeros(5, *problem.shape).double(), torch.randn(3, 5).double()
    fields[:, problem.free] = modes.T
    for law in (NeoHookeanLn(0.1), NeoHookeanLn(0.45)):
        body, factors = replace(beam.problem, material=law), terms.factors(law)
        product = body.tangent_product(torch.zeros_like(fields), fields)[:, body.free]
        exact = modes.T @ product.T
        assert (reduced.at(factors)[0, :, :-1] - exact).abs().max() < 1e-12
        inverse = torch.from_numpy(reduced.inverse(factors)[0])
        assert torch.allclose(inverse @ exact, torch.eye(5).double(), atol=1e-10)
        expected = torch.linalg.solve(exact, right.T).T
        assert (reduced.solve(factors, right) - expected).norm() < 1e-10 * expected.norm()


@pytest.mark.parametrize(("count", "images"), [(12, 1), (18, 2), (40, 1), (40, 2)])
def test_a_map_is_the_prior_and_a_ridge_regression_and_knows_its_errors_on_unseen_rows(
    count, images
):
    """Also with fewer rows than features, and with a feature that is rounding error."""
    random = torch.Generator().manual_seed(0)
    features = torch.randn(count, 2, 1, 3, 3, generator=random).double()
    features[:, 1, 0, 2, 2] *= 1e-12
    targets, weights = torch.randn(count, 4, generator=random).double(), torch.rand(count).double()
    prior = torch.randn(18, 4, generator=random).double()
    nothing = torch.arange(2)[None], torch.zeros(4, dtype=torch.int64)  # the identity alone
    symmetry = MapParities(Parities.of(SymmetryGroup(), 3), *nothing)
    found, left_out = fit_map(features, targets, weights, symmetry, prior, images)
    X, Y = weights[:, None] * features.flatten(1), weights[:, None] * targets
    scale = X.norm(dim=0)
    scale[-1] = torch.inf

    def ridge_fit(kept, ridge):
        A = X[kept] / scale
        gram = A.T @ A + 18 * ridge * torch.eye(18).double()
        rest = Y[kept] - X[kept] @ prior
        return prior + torch.linalg.solve(gram, A.T @ rest) / scale[:, None]

    every = torch.arange(count)
    changes = [(ridge_fit(every, ridge) - found).norm() for ridge in RIDGES]
    ridge = RIDGES[int(torch.stack(changes).argmin())]
    assert min(changes) < 1e-5 * found.norm()
    for k in range(count):
        others = every[every % (count // images) != k % (count // images)]
        expected = targets[k] - features[k].flatten() @ ridge_fit(others, ridge)
        assert left_out[k] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_fields_of_definite_parity(beam, net):
    group, parities = net.group, Parities.of(net.group, 3)
    assert len(parities.members) == 4
    fields = scatter_fields(net.modes.double().T, beam.problem.free)
    for k, g in enumerate(parities.members.tolist()):
        factors = parities.characters[net.parity, k]
        assert torch.equal(group[g].image(fields), factors[:, None, None] * fields)


def test_modes_are_the_best_of_all_images(beam, net):
    free, random = beam.problem.free, torch.Generator().manual_seed(0)
    snapshots = torch.randn(5, int(free.sum()), generator=random).double()
    modes, _ = modes_of_parity(net.linear, snapshots, 12)
    assert modes.T @ modes == pytest.approx(torch.eye(12), abs=1e-6)
    fields = scatter_fields(snapshots, free)
    images = torch.cat([symmetry.image(fields)[:, free] for symmetry in net.group])
    best = float(torch.linalg.svdvals(images).square()[:12].sum())
    assert float((images @ modes).square().sum()) == pytest.approx(best, rel=1e-6)


def test_the_fit_includes_newton_in_the_modes(beam, net):
    """Its modes, cells and remaining error are stored; its steps lower the error."""
    again = Unrolled(beam, **SMALL)
    again.load_state_dict(net.state_dict())
    solvers = net.correction(), again.correction()
    samples = samples_of(beam, 6, seed=3)
    sims = [Simulator(Surrogate(one, MSE(), beam)) for one in (net, again)]
    for sim, one in zip(sims, solvers, strict=True):
        assert torch.equal(sim.newton.vectors, one.vectors)
    force = samples.force * beam.force_unit
    first, second = (sim(force, error=1e-12) for sim in sims)
    assert torch.equal(first.displacement, second.displacement)
    plain = sims[0](force, error=10.0)
    truth = beam.length * samples.displacement

    def error(answer):
        return ((answer.displacement - truth).flatten(1).norm(dim=1)).mean()

    assert error(first) < error(plain)
    assert (first.error < plain.error).all(), "the hybrid goes on"


def test_newton_estimates_errors_also_where_it_improves_nothing(beam, net):
    samples = samples_of(beam, 8, seed=1)
    modes, exact = net.newton_modes.double(), samples.displacement
    parity = torch.zeros(modes.shape[1])
    solver, _ = choose_newton(beam.problem, (modes, parity), samples, exact, samples, exact)
    for load, u in zip(samples.load.unbatch(), exact, strict=True):
        assert next(solver.states(load, guess=u[None])).error < 1e-6


def test_gains_are_the_matrix_of_linear_targets_and_keep_parities():
    random = torch.Generator().manual_seed(0)
    steps, matrix = (torch.randn(n, 5, generator=random).double() for n in (40, 5))
    parity = torch.tensor([0, 1, 0, 3, 1])
    matrix *= parity[:, None] == parity
    targets, weights = steps @ matrix.T, torch.rand(40, generator=random).double() + 0.1
    gains = fit_gains(steps, targets, weights, parity)
    assert gains == pytest.approx(matrix, abs=1e-4)
    assert not fit_gains(steps, torch.zeros(40, 5).double(), weights, parity).any()


def test_a_surrogate_is_fitted_without_a_trainer(beam, tmp_path):
    data = DataModule(beam, folder=tmp_path, train=12, val=4, test=2, workers=0)
    surrogate = Surrogate(Unrolled(beam, **SMALL), MSE(), beam)
    e_mean = training.fit(surrogate, data)
    assert surrogate.net.is_fitted
    assert e_mean == training.closed_form.errors_on(surrogate, data.val_dataloader())["val/e_mean"]
    assert e_mean < 1e-4
    with pytest.raises(TypeError, match=r"call dpl\.training\.fit"):
        L.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu").fit(surrogate, data)


@pytest.fixture(scope="module")
def calibrated(beam):
    """A model with enough held-out loads for its estimated errors."""
    net = Unrolled(beam, **{**SMALL, "cells": 16})
    net.fit(samples_of(beam, 80), samples_of(beam, 40, seed=1))
    return net


def test_gains_lower_the_errors_that_a_step_leaves(beam, calibrated):
    unseen, solver = samples_of(beam, 30, seed=12), calibrated.correction()

    def left(gains):
        steps = replace(solver, gains=gains, error_tol=1e-9, max_iter=1)
        *_, last = steps.iterate(unseen.load, guess=calibrated(unseen.force))
        return (last.displacement - unseen.displacement).flatten(1).norm(dim=1).mean()

    assert left(calibrated.newton_gains) < 0.95 * left(None)


def test_errors_are_estimated_within_a_factor_and_never_far_below(beam, calibrated):
    """On loads that no fit has seen; tensors and compiled loops estimate alike."""
    unseen, net = samples_of(beam, 30, seed=12), calibrated
    fields, estimated = net.forward_with_errors(unseen.force)
    assert torch.equal(fields, net(unseen.force))
    ratio = estimated[:, 0] / errors(net, unseen)
    assert ratio.min() > 1 / 3
    assert ratio.median() < 10
    with torch.enable_grad():
        _, tensors = net.forward_with_errors(unseen.force.clone().requires_grad_())
    assert torch.allclose(tensors, estimated, rtol=1e-3)


def test_the_estimated_error_of_small_loads_is_not_below_rounding(beam, calibrated):
    for size in (1e-3, 1e-9, 1e-150, 1e-280):
        _, found = calibrated.forward_with_errors(size * beam.loads.sample(3, range(4)).force)
        assert (found > 1e-6).all()
        assert (found[:, 0] < 1e-1).all()


def test_regression_finds_powers_and_counts_its_residuals():
    random = torch.Generator().manual_seed(0)
    sizes = torch.randn(200, 4, generator=random).double().exp()
    noise = (0.3 * torch.randn(200, generator=random).double()).exp()
    errors = 0.01 * sizes[:, 3] * sizes[:, 1] ** 2 / sizes[:, 0]
    factor, exponents = fit_errors(sizes, errors * noise)
    assert exponents == pytest.approx([-1, 2, 0, 1], abs=0.1)
    assert factor.exp() == pytest.approx(0.01 * math.exp(2.5 * 0.3), rel=0.2)
    assert fit_errors(sizes, errors)[0].exp() == pytest.approx(0.01, rel=0.1)


def test_stored_errors_far_below_measured_ones_are_not_used(beam, net):
    again, samples = Unrolled(beam, **SMALL), samples_of(beam, 4, seed=3)
    again.load_state_dict({**net.state_dict(), "error_factors": net.error_factors - 27.6})
    measured, stored = (one.forward_with_errors(samples.force)[1][:, 0] for one in (again, net))
    assert (measured > errors(net, samples) / 20).all()
    assert (measured < 2 * stored).all()
