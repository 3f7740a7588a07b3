"""Properties of PODNet, and its runs: stored, loaded, evaluated."""

import json
from functools import partial

import pytest
import torch

import dpl.fem as fem
from benchmarks.samples import solved
from dpl import Sample, Scene
from dpl.config import build, run_folder
from dpl.data import Stream
from dpl.fem.symmetry import NO_SYMMETRIES
from dpl.models import PODNet
from dpl.training import MSE, OnLinearSolution, Surrogate
from dpl.training.checkpoints import read

SMALL = {"width": 16, "blocks": 1}
WHOLE = {"rank": 1000, "coordinates": 1000, **SMALL}  # no mode is left out


def prepared(scene, samples, *, seed=0, base=None, group=NO_SYMMETRIES, **options):
    """Return a surrogate in evaluation mode with random weights and fitted bases."""
    torch.manual_seed(seed)
    network = partial(PODNet, **{**SMALL, **options})
    module = Surrogate.from_network(network, MSE(), scene, base=base)
    module.predictor.fit_bases(samples, group)
    return module.eval()


def some(batch, count):
    return Sample(*(column[:count] for column in batch))


def noise(scene, count=4, seed=0):
    """Return forces (count, N, D) on all loadable degrees of freedom, float32."""
    random = torch.Generator().manual_seed(seed)
    force = torch.randn(count, *scene.problem.shape, generator=random)
    return torch.where(scene.loads.loadable_dofs, force, 0.0)


def answer(net, force):
    return net(force, force.new_zeros(len(force), 0))


def moved(samples):
    return samples.displacement.flatten(1)


def left_over(fields, basis):
    """Return the relative residual of the projection of fields (S, n) on a basis (R, n)."""
    return float((fields - fields @ basis.T @ basis).norm() / fields.norm())


# ------------------------------------------------------------------ bases


@pytest.mark.parametrize(("rank", "count"), [(100, 1), (108, 2), (108, 12)])
def test_a_basis_is_orthonormal_and_zero_beyond(scene, batch, count, rank):
    """Holds for any number of snapshots; zero columns are not mixed with modes."""
    module = prepared(scene, some(batch, count), rank=rank)
    basis = module.net.modes.double()
    assert basis.shape == (rank, scene.problem.free.numel())
    assert not basis[:, ~scene.problem.free.flatten()].any()
    gram = basis @ basis.T
    there = gram.diagonal() > 0.5
    assert 0 < int(there.sum()) <= count
    assert there[: int(there.sum())].all(), "the zeros come last"
    assert torch.allclose(gram, torch.diag(there.double()), rtol=0, atol=1e-5)
    for name, buffer in module.net.named_buffers():
        assert buffer.isfinite().all(), name
    force = noise(scene).requires_grad_()
    answer(module.net, force).square().sum().backward()
    slopes = [force.grad, *(weights.grad for weights in module.net.parameters())]
    assert all(slope.isfinite().all() for slope in slopes)


def test_modes_are_ordered_by_size_and_uncorrelated(scene, batch):
    basis = prepared(scene, batch, rank=12).net.modes.double()
    weighted = moved(batch) / moved(batch).norm(dim=1, keepdim=True).sqrt()
    spread = (weighted @ basis.T).T @ (weighted @ basis.T)
    sizes = spread.diagonal()
    assert (sizes.diff() <= 1e-6 * sizes.max()).all()
    assert torch.allclose(spread, torch.diag(sizes), rtol=0, atol=1e-5 * float(sizes.max()))


def test_more_modes_reduce_the_projection_error_to_zero(scene, batch):
    ranks = (2, 4, 8, 1000)
    left = [
        left_over(moved(batch), prepared(scene, batch, rank=k).net.modes.double()) for k in ranks
    ]
    assert left[0] > 1.5 * left[1] > 3 * left[2]
    assert left[3] < 1e-5


def test_the_projection_of_loads_keeps_all_training_loads(scene, batch):
    kept = prepared(scene, batch, **WHOLE).net.projection.double()
    kept = torch.linalg.qr(kept[:, kept.any(dim=0)])[0].T
    assert left_over(batch.force.flatten(1), kept) < 1e-4


def test_bases_with_images_of_the_samples_represent_images(scene, batch):
    """The group is that of `data.symmetry=true`."""
    group = fem.symmetries(scene.problem)
    turned = group.images(batch.displacement, torch.full((len(batch.force),), 5)).flatten(1)
    own, both = (
        prepared(scene, batch, group=members, rank=96).net.modes.double()
        for members in (NO_SYMMETRIES, group)
    )
    assert left_over(turned, both) < 1e-4 < 0.1 * left_over(turned, own)


def test_samples_beyond_the_maximum_number_of_snapshots_are_thinned_out(scene, batch, monkeypatch):
    """Every third of twelve samples is used."""
    monkeypatch.setattr("dpl.training.predictors.MAX_SNAPSHOTS", 4)
    third = Sample(*(column[::3] for column in batch))
    few, expected = (prepared(scene, samples).net for samples in (batch, third))
    assert torch.equal(few.modes, expected.modes)


def test_a_sample_of_zero_displacement_changes_nothing(scene, batch):
    """Its weight is zero; it gives neither NaN nor a mode."""
    still = Sample(*(torch.cat([column, column[:1]]) for column in some(batch, 4)))
    still.force[-1], still.displacement[-1] = 0.0, 0.0
    nets = [prepared(scene, samples, rank=12).net for samples in (still, some(batch, 4))]
    assert all(buffer.isfinite().all() for buffer in nets[0].buffers())
    projectors = [net.modes.double().T @ net.modes.double() for net in nets]
    assert torch.allclose(*projectors, rtol=0, atol=1e-5)


def test_without_bases_the_prediction_is_zero(scene, batch):
    net = PODNet(scene, **SMALL)
    assert not net.is_fitted
    assert not answer(net, noise(scene)).any()
    assert prepared(scene, batch).net.is_fitted


# ------------------------------------------------------------------ predictions


@pytest.mark.parametrize("base", [None, "linear"])
def test_lower_precision_of_products_does_not_reach_the_bases(scene, batch, base):
    """As with `trainer.precision=bf16-mixed`: only the layers of the network are rounded."""
    module = prepared(scene, batch, rank=20, base=base, width=1)
    module.net.leave.weight.data.zero_()  # the bias of the last layer is not rounded
    with torch.no_grad():
        expected = module.predict(batch.load)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = module.predict(batch.load)
    assert expected.any()
    assert (rounded - expected).norm() < 5e-3 * expected.norm()


def test_a_body_fixed_in_some_directions_only_is_accepted():
    """Nodes on rails are fixed in some directions only."""
    ends = [(0, [0.0, None, None]), (1, [None, 0.0, None]), (2, [None, None, 0.0])]
    rails = [fem.DirichletBC(fem.Plane(axis, "min"), value) for axis, value in ends]
    mesh = fem.box([100.0, 25.0, 25.0], [5, 2, 2])
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), supports=rails)
    solver = fem.Newton(problem, linear="superlu")
    scene = Scene(problem, fem.ModalLoads(solver.linear_solver, n_modes=3, young=4500.0), solver)
    samples = solved(scene, scene.loads.sample((0, 0), range(8)))
    found = answer(prepared(scene, samples, **WHOLE).net, noise(scene))
    assert found.any()
    assert not found[:, ~problem.free].any()


def test_sizes_are_limited_by_the_degrees_of_freedom_and_need_not_be_equal(scene):
    net = PODNet(scene, **WHOLE)
    assert net.leave.out_features == int(scene.problem.free.sum())
    assert net.enter.in_features == int(scene.loads.loadable_dofs.sum())
    assert PODNet(scene, rank=7, coordinates=60, **SMALL).enter.in_features == 60
    line = f"20 coordinates learnt instead of {int(scene.problem.free.sum())} displacements"
    assert PODNet(scene, rank=20, **SMALL).skipped_work() == [line]


# ------------------------------------------------------------------ runs


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("pod")


@pytest.fixture
def overrides(tiny_training):
    """The command line of a run of four epochs on the tiny scene."""

    def overrides(name, *more):
        small = ["model=pod", "model.rank=100", "model.blocks=1", "model.coordinates=8"]
        recipe = ["optimizer=muon", "loss=rmse", "data.symmetry=true", "data.folder=data"]
        return [*tiny_training, *small, *recipe, "trainer.max_epochs=4", f"run={name}", *more]

    return overrides


@pytest.fixture
def trained(script, overrides, home):
    """The folder of an uninterrupted run."""
    if not (home / "whole").exists():
        ended = script("train", *overrides("whole"), cwd=home)
        assert ended.status == 0, ended.err
    return home / "whole"


def alike(one, other):
    """Return True if tensors are equal bit for bit, by name."""
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def test_a_loaded_run_has_the_same_bases_and_predictions(trained, home, monkeypatch):
    """Its bases are those of the training samples and their images."""
    monkeypatch.chdir(home)
    cfg, module = run_folder.load_run(trained)
    saved = read(trained / "checkpoints" / "best.safetensors")["state_dict"]
    assert isinstance(module.net, PODNet)
    assert module.net.is_fitted
    assert alike(saved, dict(module.state_dict()))
    data = build.instantiate(cfg, "data", scene=module.scene)
    expected = build.build_surrogate(cfg, module.scene)
    expected.predictor.fit_bases(data.samples("train"), fem.symmetries(module.scene.problem))
    assert alike(dict(expected.net.named_buffers()), dict(module.net.named_buffers()))
    test = data.samples("test")
    with torch.no_grad():
        found = module.predict(test.load)
        assert torch.equal(found, run_folder.load_run(trained)[1].predict(test.load))
    rows = json.loads((trained / "evaluation.json").read_text())
    (network,) = (row for row in rows if row["solver"] == "prediction")
    error = (found - test.displacement).flatten(1)
    e_mean = float(error.norm(dim=1).mean()) / error.shape[1]
    assert network["errors"]["e_mean"] == pytest.approx(e_mean, rel=1e-5)


def test_a_stream_fits_the_bases_to_the_validation_loads(script, overrides, home, trained):
    kept = [o for o in overrides("stream") if "data.train" not in o]
    more = ["data=online", "data.train.batches=2", "data.train.new_per_round=4"]
    more.append("model.base=linear")
    ended = script("train", *kept, *more, "trainer.max_epochs=2", cwd=home)
    assert ended.status == 0, ended.err
    cfg, module = run_folder.load_run(home / "stream")
    data = build.instantiate(cfg, "data", scene=module.scene)
    assert isinstance(data.source, Stream)
    assert isinstance(module.predictor, OnLinearSolution)
    expected = build.build_surrogate(cfg, module.scene)
    expected.predictor.fit_bases(data.samples("val"), fem.symmetries(module.scene.problem))
    assert alike(dict(expected.net.named_buffers()), dict(module.net.named_buffers()))
    weights = [dict(one.net.named_parameters()) for one in (expected, module)]
    assert not alike(*weights), "it has learnt"
    assert json.loads((home / "stream" / "evaluation.json").read_text())
