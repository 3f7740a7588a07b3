"""Laws with ranges: each load is solved, stored, evaluated and learnt with its own values."""

import json
import pickle
from dataclasses import dataclass, replace

import pytest
import torch

from dpl import DataSetError, Sample, fem
from dpl.config import build as run
from dpl.data import DataModule, Store, Stream
from dpl.data.storage.integrity import check_shard, verify
from dpl.data.storage.shard import read_shard
from dpl.evaluation import evaluate
from dpl.evaluation.report import measure
from dpl.fem.materials.tensors import green_lagrange
from dpl.inference import Hybrid
from dpl.models import CNN, FCNN, GNN, PODNet, Unrolled
from dpl.training import (
    MSE,
    EnergyNormLoss,
    LossContext,
    LrPlus,
    PotentialEnergyLoss,
    Surrogate,
    fit,
    relative_errors,
)

SPAN = [0.2, 0.4]


@pytest.fixture(scope="module")
def wide(make_scene):
    """The tiny scene, its Poisson's ratio from a range."""
    return make_scene(poisson=SPAN)


@pytest.fixture(scope="module")
def _folder(wide, tmp_path_factory):
    folder = str(tmp_path_factory.mktemp("wide") / "set")
    DataModule(wide, folder=folder, train=96, val=8, test=24, workers=0).prepare_data()
    return folder


@pytest.fixture
def sets(wide, _folder):
    return DataModule(wide, folder=_folder, train=96, val=8, test=24, batch_size=16, workers=0)


@pytest.fixture
def few(sets):
    return Sample(*(column[:4] for column in sets.samples("train")))


def values(*numbers):
    """Return the parameters of one load, (1, P)."""
    return torch.tensor([numbers], dtype=torch.float64)


def member(batch, k):
    return Sample(*(column[k : k + 1] for column in batch))


# ------------------------------------------------------------------ the law and the body


def test_a_batch_of_a_law_that_is_its_energy_has_the_moduli_of_its_members():
    @dataclass(frozen=True)
    class Own(fem.Material):
        ranged = ("stiffness",)
        stiffness: float

        def energy(self, H):
            return self.value("stiffness") * green_lagrange(H).square().sum((-2, -1))

    law = Own((1.0, 2.0)).with_parameters(torch.tensor([[1.25], [1.75]]).double())
    assert law.mu.tolist() == [[[1.25]], [[1.75]]]
    assert law.lam.tolist() == [[[0.0]], [[0.0]]]
    assert law.rest_moduli.tolist() == [[1.25, 0.0], [1.75, 0.0]]


def test_a_batch_is_its_members_each_a_body_of_its_own(make_scene):
    """By compiled loops and by tensors: forces, energies, rounding."""
    scene = make_scene(poisson=SPAN)
    load = scene.loads.sample((0, 0), range(3))
    u = fem.solve(scene.solver, load).displacement
    body = scene.problem.with_parameters(load.parameters)
    for k in range(3):
        one = make_scene(poisson=float(load.parameters[k])).problem
        alone = u[k : k + 1]
        for name in ("energy", "internal_force", "roundoff_bound"):
            found, expected = getattr(body, name)(u)[k], getattr(one, name)(alone)[0]
            assert torch.allclose(found, expected, rtol=1e-12, atol=1e-18), name
        assert torch.equal(body.evaluate(u).internal[k], one.evaluate(alone).internal[0])
        product = body.tangent_product(u, u)[k]
        assert torch.allclose(product, one.tangent_product(alone, alone)[0], rtol=1e-9, atol=1e-15)


def test_nothing_is_compiled_or_analysed_again(wide, monkeypatch):
    loads = wide.loads.sample((0, 0), range(6))
    fem.solve(wide.solver, fem.Load(*(column[:1] for column in loads)))
    monkeypatch.setattr("dpl.fem.assembly.sparsity.Pattern.build", None)
    monkeypatch.setattr("dpl.fem.solvers.linear.make_backend", None)
    monkeypatch.setattr("dpl.fem.assembly.kernels.Kernels.__init__", None)
    monkeypatch.setattr("dpl.fem.assembly.kernels.Path", None)
    assert fem.solve(wide.solver, loads).converged.all()


# ------------------------------------------------------------------ truth


@pytest.mark.parametrize("mean_dilatation", [False, True])
def test_the_truth_of_a_sample_is_that_of_a_body_with_its_poissons_ratio(
    sets, wide, mean_dilatation
):
    batch = sets.samples("train")
    assert batch.parameters.shape == (96, 1)
    assert len(batch.parameters.unique()) == 96
    assert SPAN[0] <= float(batch.parameters.min()) < 0.22
    assert 0.38 < float(batch.parameters.max()) <= SPAN[1]
    problem, tol = wide.problem, wide.solver.tol

    def solved(law: fem.Material, load: fem.Load) -> torch.Tensor:
        mesh, fixed = problem.mesh.scaled(problem.length), ~problem.free.numpy()
        body = fem.Problem.build(mesh, law, fixed=fixed, mean_dilatation=mean_dilatation)
        return fem.solve(fem.Newton(body, linear="superlu"), load).displacement[0]

    for k in range(2):
        load = member(batch, k).load
        law = fem.NeoHookeanLn(float(batch.parameters[k]))
        expected = solved(law, fem.Load(load.force, load.young))
        found = solved(problem.material, load) if mean_dilatation else batch.displacement[k]
        assert (found - expected).norm() < tol * expected.norm()


def test_poissons_ratio_is_a_function_of_stream_and_index_and_moves_no_other_number(wide, scene):
    one, other = wide.loads.sample((3, 0), [0, 5]), wide.loads.sample((3, 0), [5])
    assert torch.equal(one.parameters[1:], other.parameters)
    fixed = scene.loads.points((3, 0), [0, 5])
    assert torch.equal(wide.loads.points((3, 0), [0, 5])[:, :-1], fixed)
    assert torch.equal(wide.loads.young_at(torch.rand(2, wide.loads.n_random)), one.young)


def test_every_solver_takes_each_load_with_its_own(wide, few):
    exact = few.displacement
    for solver in (wide.solver, Hybrid(lambda load: 0 * load.force, wide.solver)):
        assert torch.allclose(fem.solve(solver, few.load).displacement, exact, rtol=0, atol=1e-9)
    linear = fem.solve(wide.linear, few.load).displacement
    for k in range(4):
        one = wide.linear.with_parameters(few.parameters[k, None]).solve(few.force[k])
        assert torch.equal(linear[k], one)
    assert not torch.allclose(linear[0], wide.linear.reference.solve(few.force[0]), rtol=1e-3)


def test_a_load_with_other_parameters_than_the_body_is_refused(wide, scene, few):
    silent = fem.Load(few.force, few.young)
    for solver in (wide.solver, wide.linear):
        with pytest.raises(ValueError, match=r"has 0 parameters and .* ranges of \['poisson'\]"):
            fem.solve(solver, silent)
    for body, load, words in (
        (wide, silent, r"0 columns; the body has ranges of \['poisson'\]"),
        (scene, few.load, r"1 columns; the body has ranges of \[\]"),
    ):
        with pytest.raises(ValueError, match=f"Load.parameters has {words}"):
            Surrogate(FCNN(body, width=4), MSE(), body).predict(load)


def test_exact_answers_are_differentiable_in_the_parameters(wide, few):
    exact, load, step = fem.DifferentiableSolve(replace(wide.solver, tol=1e-12)), few.load, 1e-5

    def size(parameters):
        return exact(load._replace(parameters=parameters)).square().sum(dim=(1, 2))

    parameters = load.parameters.clone().requires_grad_()
    size(parameters).sum().backward()
    change = size(load.parameters + step) - size(load.parameters - step)
    slope = parameters.grad[:, 0].numpy()
    assert slope == pytest.approx((change / (2 * step)).numpy(), rel=1e-5)


def test_a_scene_with_a_range_goes_to_another_process(wide):
    twin = pickle.loads(pickle.dumps(wide))
    assert twin.fingerprint == wide.fingerprint
    assert torch.equal(
        twin.loads.sample((0, 0), [2]).parameters, wide.loads.sample((0, 0), [2]).parameters
    )


# ------------------------------------------------------------------ identity, data


def test_only_a_range_shows_in_the_identity(scene, wide, make_scene):
    assert json.loads(json.dumps(scene.identity()["law"])) == {
        "name": "NeoHookeanLn",
        "poisson": 0.3,
    }
    assert json.loads(json.dumps(wide.identity()["law"]))["poisson"] == SPAN
    assert set(scene.identity()) == set(wide.identity())
    assert set(scene.identity()["loads"]) == set(wide.identity()["loads"])
    others = [make_scene(poisson=span).fingerprint for span in ([0.2, 0.41], [0.21, 0.4])]
    assert len({scene.fingerprint, wide.fingerprint, *others}) == 4
    assert make_scene(poisson=tuple(SPAN)).fingerprint == wide.fingerprint


def test_the_data_set_keeps_poissons_ratios_where_loads_have_their_own(sets, data, wide):
    kept = sets.store.load("train", 96)
    assert torch.equal(
        kept.parameters, wide.loads.sample(sets.store.stream("train"), range(96)).parameters
    )
    assert [flaw for _, flaw in verify(sets.store) if flaw] == []
    assert data.samples("train").parameters.shape == (12, 0)


def test_a_data_set_of_another_range_is_refused(sets, make_scene, scene):
    for other, ours in ((scene, r"0\.3"), (make_scene(poisson=[0.2, 0.3]), r"\[0\.2, 0\.3\]")):
        reported = rf"another scene.*law\.poisson: \[0\.2, 0\.4\] there, {ours} here"
        with pytest.raises(DataSetError, match=reported):
            Store(sets.store.folder, other, 0).load("train", 4)


def test_a_shard_with_or_without_poissons_ratios_is_read_as_such_only(sets, data):
    for module, *shape in ((sets, 8), (data, 7, 1)):
        with pytest.raises(ValueError, match="parameters has shape"):
            read_shard(module.store.shards()[0].path, (45, 3), *shape)


def test_verify_finds_other_poissons_ratios(sets):
    first = sets.store.shards()[0]
    shard = sets.store.read(first.path)
    stream = sets.store.stream(first.split)
    assert check_shard(sets.scene, stream, shard) == ""
    shard["parameters"] = shard["parameters"].flip(0)
    assert "other parameters" in check_shard(sets.scene, stream, shard)


def test_images_and_streams_carry_poissons_ratios(wide, sets, tmp_path):
    sizes = {"val": 1, "test": 1, "workers": 0, "batch_size": 8}
    stream = DataModule(wide, folder=str(tmp_path), train=Stream(batches=1), symmetry=True, **sizes)
    stored = DataModule(
        wide, folder=str(sets.store.folder), train=16, symmetry=True, workers=0, batch_size=8
    )
    for module in (stream, stored):
        batch = next(iter(module.train_dataloader()))
        assert batch.parameters.shape == (8, 1)
        assert residual(wide, batch.displacement, batch).max() < 1e-8


# ------------------------------------------------------------------ losses, metrics


PHYSICS = {
    "lr_plus": LrPlus,
    "stiffness": lambda: EnergyNormLoss(floor=0.0),
    "energy": lambda: PotentialEnergyLoss(floor=0.0),
}


@pytest.mark.parametrize("name", PHYSICS)
def test_a_physics_loss_judges_each_sample_as_the_body_that_it_is(few, wide, make_scene, name):
    near = (few.displacement * 1.05).requires_grad_()
    physics = Surrogate(FCNN(wide, width=4), MSE(), wide).physics
    whole = PHYSICS[name]()(near, few, physics)
    (slope,) = torch.autograd.grad(whole, near)
    values, slopes = [], []
    for k in range(4):
        one = make_scene(poisson=float(few.parameters[k]))
        body = LossContext(one.problem, physics.largest_force)
        alone = near[k : k + 1].detach().requires_grad_()
        sample = member(few, k)._replace(parameters=few.parameters[:1, :0])
        values.append(PHYSICS[name]()(alone, sample, body))
        slopes.append(torch.autograd.grad(values[-1], alone)[0])
    assert float(whole) == pytest.approx(float(torch.stack(values).mean()), rel=1e-5)
    expected = torch.cat(slopes) / 4
    assert torch.allclose(slope, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()))


def residual(scene, displacement, batch):
    """Return the relative residuals of displacements (B, N, D), each with its parameters, (B,)."""
    problem = scene.problem.with_parameters(batch.parameters)
    return problem.relative_residual(displacement, batch.force)


def test_the_truth_has_no_residual_and_no_other_poissons_ratio_has_none(wide, few):
    assert residual(wide, few.displacement, few).max() < 1e-8
    other = few._replace(parameters=few.parameters.flip(0))
    assert residual(wide, few.displacement, other).min() > 1e-3


# ------------------------------------------------------------------ networks


def median_error(module, test):
    """Return the median relative L2 error."""
    with torch.no_grad():
        return float(relative_errors(module.predict(test.load), test).median())


def by_poisson(module, sample, span=SPAN):
    """Return the displacements of one load at both ends of the range."""
    load = fem.Load(
        sample.force.repeat(2, 1, 1), sample.young.repeat(2), torch.tensor(span).double()
    )
    with torch.no_grad():
        return module.predict(load)


@pytest.mark.parametrize(
    "build",
    [
        lambda scene: FCNN(scene, width=8),
        lambda scene: CNN(scene, channels=2),
        lambda scene: GNN(scene, width=4),
        lambda scene: PODNet(scene, rank=20, coordinates=8, width=16, blocks=1),
    ],
    ids=["fcnn", "cnn", "gnn", "pod"],
)
def test_every_network_hears_poissons_ratio_and_a_batch_is_its_members(build, wide, sets, few):
    torch.manual_seed(0)
    module = Surrogate(build(wide), MSE(), wide).eval()
    if module.predictor.lacks_bases:
        module.predictor.fit_bases(sets.samples("train"))
    low, high = by_poisson(module, member(few, 0))
    assert (low - high).norm() > 1e-4 * low.norm()
    with torch.no_grad():
        whole = module.predict(few.load)
        parts = torch.cat([module.predict(one) for one in few.load.unbatch()])
    assert torch.allclose(whole, parts, rtol=1e-4, atol=1e-6 * float(whole.abs().max()))


def test_small_loads_are_answered_linearly_at_every_poissons_ratio(wide, sets, few):
    net = Unrolled(wide, rank=90, cells=8, stages=1, symmetry=False)
    net.fit(sets.samples("train"), sets.samples("val"))
    module = Surrogate(net, MSE(), wide).eval()
    light = few._replace(force=1e-4 * few.force)
    exact = fem.solve(wide.linear, light.load).displacement
    with torch.no_grad():
        found = module.predict(light.load)
    reference = torch.stack([wide.linear.reference.solve(force) for force in light.force])

    def error(field):
        return float(((field - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)).max())

    assert error(found) < 1e-3
    assert error(found) < error(reference) / 20


def test_a_solver_with_ranges_is_fitted_and_evaluated(wide, sets, tmp_path, monkeypatch):
    module = Surrogate(Unrolled(wide, rank=60, cells=16, stages=1), MSE(), wide)
    fit(module, sets)
    module.eval()
    test = sets.samples("test")
    linear = fem.solve(wide.linear, test.load).displacement
    reported = median_error(module, test)
    assert reported < float(relative_errors(linear, test).median()) / 2
    assert reported < median_error(module, test._replace(parameters=0 * test.parameters + 0.3)) / 2
    solvers = {}
    monkeypatch.setattr(
        "dpl.evaluation.report.measure",
        lambda named, *rest: solvers.update(named) or measure(named, *rest),
    )
    rows = evaluate(module, Sample(*(column[:6] for column in test)), tmp_path)
    assert {row.solver: row.converged for row in rows}["paper's hybrid to 1e-6"] == 6
    linear_solvers = [
        solvers["linear"],
        solvers["Newton, tol=1e-3"].linear_solver,
        solvers["Newton, tol=1e-6"].linear_solver,
        solvers["paper's hybrid to 1e-6"].newton.linear_solver,
        solvers["sim(force, tol=1e-6)"].simulator.scene.linear,
    ]
    assert len(set(map(id, linear_solvers))) == 5, "no solver reuses a factor of another one"


# ------------------------------------------------------------------ configuration


def test_a_range_is_an_option_of_the_law(scene_of):
    scene = scene_of("mesh.nodes=[5,3,3]", "material.poisson=[0.2,0.4]", "solver.linear=superlu")
    assert scene.loads.parameter_ranges == {"poisson": (0.2, 0.4)}
    assert any("0.2 to 0.4" in line for line in scene.skipped_work())


def test_a_wrong_range_ends_with_one_line_that_names_the_key(scene_of):
    for given, reported in (
        ("[0.4,0.2]", r"material: poisson = \[0.4, 0.2\] must be a range"),
        ("[0.2,0.5]", r"material: poisson = 0.5 must lie between -1 and 0.5"),
        ("[0.2]", r"material: poisson = \[0.2\] must be a range"),
        ("[a,b]", r"material.poisson = \['a', 'b'\] must be a number or a list"),
    ):
        with pytest.raises(run.ConfigError, match=reported):
            scene_of("mesh.nodes=[5,3,3]", f"material.poisson={given}")


def test_a_law_of_rubber_takes_a_range_of_poissons_ratio(scene_of):
    for law in ("yeoh_k2", "mooney_rivlin_k2"):
        scene = scene_of("mesh.nodes=[5,3,3]", f"material={law}", "material.poisson=[0.2,0.4]")
        assert scene.problem.parameter_ranges == {"poisson": (0.2, 0.4)}
        one = scene.problem.with_parameters(torch.tensor([[0.25]])).material
        assert float(one.poisson_ratio) == pytest.approx(0.25)


def test_a_law_refuses_ranges_of_constants_that_it_cannot_draw(scene_of):
    for law, key in (("ogden_k2", "poisson"), ("linear_elastic", "bulk")):
        reported = rf"material\.{key}.*(must be a number|no such option)"
        with pytest.raises(run.ConfigError, match=reported):
            scene_of(f"material={law}", f"++material.{key}=[0.2,0.4]")
