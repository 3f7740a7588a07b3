"""Networks that learn the nonlinear displacement: base = linear."""

import pytest
import torch

import dpl
from dpl.fem import (
    Load,
    rectangle,
    solve,
    symmetries,
)
from dpl.models import CNN, FCNN, GNN, LinearBase, PODNet, Unrolled
from dpl.models.reduced_samples import ReducedDataset
from dpl.training import MSE, RMSELoss, Surrogate
from dpl.training.linear_samples import LinearBatch, LinearSamples

NETS = {"fcnn": (FCNN, {"width": 16}), "cnn": (CNN, {"channels": 2}), "gnn": (GNN, {"width": 4})}
POD = {"rank": 30, "coordinates": 20, "width": 16, "blocks": 1}


class OwnNet(torch.nn.Module):
    """A network of a user, which names the base and its inputs."""

    base = "linear"
    extra_inputs = ("amplitude", "parameters")

    def __init__(self, scene):
        super().__init__()
        self.layer = torch.nn.Linear(scene.problem.shape[1], scene.problem.shape[1])

    def forward(self, field, amplitude, parameters):
        numbers = 1 / (1 + amplitude) + parameters.sum(dim=1)
        return self.layer(field) * numbers[:, None, None].to(field)


@pytest.fixture(params=[*NETS, "own"])
def surrogate_of(request):
    """Builds the surrogate of a scene with a network of each kind, with a linear base."""

    def build(scene, seed=0):
        torch.manual_seed(seed)
        kind, options = NETS.get(request.param, (OwnNet, None))
        net = kind(scene) if options is None else kind(scene, base="linear", **options)
        return Surrogate(net, RMSELoss(relative=1.0, floor=0.0), scene).eval()

    return build


@pytest.fixture(scope="module")
def bodies(make_scene):
    """Scenes in 2D and 3D, with hexahedra, tetrahedra and triangles."""
    return {
        "hexahedra": make_scene(),
        "tetrahedra": make_scene(cell="tetra"),
        "triangles": make_scene(mesh=rectangle((4.0, 1.0), (7, 4), "triangle")),
        "range of the law": make_scene(poisson=(0.2, 0.4)),
    }


def relative(one, other):
    return (one - other).flatten(1).norm(dim=1) / other.flatten(1).norm(dim=1)


@pytest.mark.parametrize("body", ["hexahedra", "tetrahedra", "triangles", "range of the law"])
def test_the_difference_from_the_linear_solution_is_quadratic_in_the_load(
    surrogate_of, bodies, body
):
    scene = bodies[body]
    surrogate = surrogate_of(scene)
    load = scene.loads.sample((0, 0), range(3))
    sizes = []
    with torch.no_grad():
        for factor in (1e-3, 1e-4):
            small = Load(factor * load.force, load.young, load.parameters)
            linear = surrogate.base.solve(small)
            sizes.append((surrogate.predict(small) - linear).flatten(1).norm(dim=1))
    assert torch.allclose(sizes[0] / sizes[1], torch.full((3,), 100.0).double(), rtol=0.02)
    assert (sizes[0] < 0.01 * 1e-3 * surrogate.predict(load).flatten(1).norm(dim=1)).all()


def test_the_linear_solution_is_that_of_the_linear_solver(bodies):
    for scene in bodies.values():
        load = scene.loads.sample((0, 0), range(3))
        expected = next(iter(scene.linear.iterate(load))).displacement
        assert relative(LinearBase(scene).solve(load), expected).max() < 1e-4


def test_the_amplitude_is_the_size_of_the_linear_solution(scene, batch):
    base, scale = LinearBase(scene), torch.tensor(0.5).double()
    linear = base.solve(batch.load)
    field, amplitude = base.scale_inputs(linear, scale)
    free = scene.problem.free
    assert torch.allclose(field[:, free].square().mean(dim=1), torch.ones(len(field)).double())
    assert torch.allclose(0.5 * amplitude[:, None, None] * field, linear)


def test_a_zero_load_moves_nothing_and_has_finite_gradients(surrogate_of, scene, batch):
    surrogate = surrogate_of(scene)
    load = Load(torch.zeros_like(batch.force[:2]).requires_grad_(), batch.young[:2])
    answer = surrogate.predict(load)
    assert torch.equal(answer, torch.zeros_like(answer))
    answer.sum().backward()
    assert load.force.grad.isfinite().all()


def test_gradients_with_respect_to_the_force_are_those_of_differences(surrogate_of, scene, batch):
    surrogate = surrogate_of(scene).double()
    force = batch.force[:1].clone().requires_grad_()
    step = torch.randn(force.shape, generator=torch.Generator().manual_seed(0)).double()
    step = torch.where(scene.problem.free, 1e-5 * step * force.abs().max(), 0.0)

    def work(force):
        return surrogate.predict(Load(force, batch.young[:1])).square().sum()

    work(force).backward()
    with torch.no_grad():
        expected = (work(force + step) - work(force - step)) / 2
    assert torch.isclose((force.grad * step).sum(), expected, rtol=1e-4)


def test_training_uses_the_linear_solutions_that_were_computed_before(scene, batch, monkeypatch):
    surrogate = Surrogate(FCNN(scene, width=8, base="linear"), MSE(relative=1.0), scene)
    surrogate.log = lambda *_, **__: None
    group = symmetries(scene.problem)
    samples = surrogate.encode(batch, group)
    assert isinstance(samples, LinearSamples)
    assert len(samples) == len(group) * len(batch.force)
    every = samples.__getitems__(list(range(len(samples))))
    assert isinstance(every, LinearBatch)
    expected = surrogate.base.solve(every.sample.load)
    assert relative(every.linear.double(), expected).max() < 1e-5
    direct = surrogate.training_step(every.sample, 0)
    monkeypatch.setattr(LinearBase, "solve", None)
    assert torch.isclose(surrogate.training_step(every, 0), direct, rtol=1e-5)


@pytest.mark.parametrize("name", NETS)
def test_training_reduces_the_error_of_small_and_large_loads(name, scene, batch):
    torch.manual_seed(0)
    kind, options = NETS[name]
    net = kind(scene, base="linear", **options)
    surrogate = Surrogate(net, RMSELoss(relative=1.0, floor=0.0), scene)
    small = solve(scene.solver, Load(0.1 * batch.force[:4], batch.young[:4])).displacement
    force = torch.cat([batch.force[:4], 0.1 * batch.force[:4]])
    both = batch._replace(
        force=force,
        displacement=torch.cat([batch.displacement[:4], small]),
        young=batch.young[:8],
        parameters=batch.parameters[:8],
    )
    surrogate.log = lambda *_, **__: None
    optimizer = torch.optim.Adam(surrogate.parameters(), lr=3e-3)
    before = relative(LinearBase(scene).solve(both.load), both.displacement).view(2, 4).mean(dim=1)
    for _ in range(100):
        optimizer.zero_grad()
        surrogate.training_step(both, 0).backward()
        optimizer.step()
    with torch.no_grad():
        after = relative(surrogate.predict(both.load), both.displacement).view(2, 4).mean(dim=1)
    assert (after < 0.9 * before).all()


@pytest.mark.parametrize("loss", [MSE(), RMSELoss(relative=1.0, floor=0.0)], ids=["mse", "rmse"])
def test_training_in_coordinates_has_the_loss_of_training_on_fields(scene, batch, loss):
    torch.manual_seed(0)
    net = PODNet(scene, base="linear", symmetry=False, **POD)
    surrogate = Surrogate(net, loss, scene).train()
    surrogate.log = lambda *_, **__: None
    surrogate.fit_bases(batch)
    reduced = surrogate.encode(batch)
    assert isinstance(reduced, ReducedDataset)
    own = reduced.__getitems__(list(range(len(batch.force))))
    in_coordinates = surrogate.training_step(own, 0)
    assert torch.isclose(in_coordinates, surrogate.training_step(batch, 0), rtol=1e-4)


def test_pod_on_the_linear_solution_has_the_symmetries_of_the_body(scene, batch):
    torch.manual_seed(0)
    surrogate = Surrogate(PODNet(scene, base="linear", **POD), MSE(), scene).eval()
    surrogate.fit_bases(batch)
    group = symmetries(scene.problem)
    assert len(group) > 1
    which = torch.arange(len(group))[: len(batch.force)]
    force = batch.force[: len(which)]
    with torch.no_grad():
        turned = surrogate.predict(Load(group.images(force, which), batch.young[: len(which)]))
        expected = group.images(surrogate.predict(Load(force, batch.young[: len(which)])), which)
    assert relative(turned, expected).max() < 1e-4


@pytest.mark.parametrize("base", ["none", "linear"])
@pytest.mark.parametrize("name", NETS)
def test_half_precision_products_change_a_prediction_by_their_rounding(name, base, scene, batch):
    """As with `trainer.precision=bf16-mixed`; a bfloat16 number has 8 digits, in base 2."""
    torch.manual_seed(0)
    kind, options = NETS[name]
    surrogate = Surrogate(kind(scene, base=base, **options), MSE(), scene).eval()
    linear = LinearBase(scene).solve(batch.load) if base == "linear" else 0.0
    with torch.no_grad():
        exact = surrogate.predict(batch.load) - linear
        with torch.autocast("cpu", torch.bfloat16):
            rounded = surrogate.predict(batch.load) - linear
    assert rounded.dtype == torch.float64
    assert 0 < relative(rounded, exact).max() < 0.1


def test_a_checkpoint_has_the_weights_only(surrogate_of, scene, batch):
    one, other = surrogate_of(scene, 0), surrogate_of(scene, 1)
    assert not any(name.startswith("base") for name in one.state_dict())
    other.load_state_dict(one.state_dict())
    with torch.no_grad():
        assert torch.equal(one.predict(batch.load), other.predict(batch.load))


@pytest.mark.parametrize("kind", [kind for kind, _ in NETS.values()])
def test_an_unknown_base_is_refused(scene, kind):
    with pytest.raises(ValueError, match="base = quadratic must be one of none, linear"):
        kind(scene, base="quadratic")


def test_what_excludes_a_base_is_refused(scene):
    with pytest.raises(ValueError, match="young = true requires base = none"):
        FCNN(scene, young=True, base="linear")
    net = Unrolled(scene)
    net.base = "linear"
    with pytest.raises(ValueError, match="Unrolled requires base = none"):
        Surrogate(net, MSE(), scene)
    with pytest.raises(ValueError, match="amplitude is an input"):
        CNN(scene, channels=2, base="linear")(torch.zeros(1, *scene.problem.shape))


def test_without_a_base_nothing_is_solved(scene, batch, monkeypatch):
    monkeypatch.setattr(LinearBase, "solve", None)
    surrogate = Surrogate(GNN(scene, width=4), MSE(), scene)
    assert surrogate.base is None
    assert surrogate.encode(batch) is None
    assert surrogate.predict(batch.load).isfinite().all()


@pytest.mark.parametrize("data", ["offline", pytest.param("online", marks=pytest.mark.slow)])
def test_a_run_is_loaded_and_evaluated(script, tiny, tmp_path, data):
    sizes = ["data.val=2", "data.test=2", "data.batch_size=4", "data.workers=0"]
    sizes += {"offline": ["data.train=4", "data.symmetry=true"], "online": ["data.batches=2"]}[data]
    short = ["model.width=4", "trainer.max_epochs=1", "trainer.check_val_every_n_epoch=1"]
    options = [*tiny, "experiment=gnn_linear", f"data={data}", *sizes, *short, "run=run"]
    trained = script("train", *options, cwd=tmp_path)
    assert trained.status == 0, trained.err
    simulator = dpl.load(tmp_path / "run")
    surrogate = simulator.surrogate
    assert surrogate.net.base == "linear"
    load = surrogate.scene.loads.sample((0, 0), range(1))
    with torch.no_grad():
        assert surrogate.predict(load).isfinite().all()
