"""Networks that learn the nonlinear displacement: base = linear; whitening of their inputs."""

from functools import partial

import pytest
import torch

from dpl.fem import Load, rectangle, solve, symmetries
from dpl.models import CNN, FCNN, GNN, Inputs, LinearResponse
from dpl.models.linear_base import FieldWhitening, partial_whitening, sampled_solutions
from dpl.training import MSE, RMSELoss, Scaled, Surrogate
from dpl.training.predictors import LinearSamples


class OwnNet(torch.nn.Module):
    """A network of a user, which has no line about the base."""

    def __init__(self, scene, inputs):
        super().__init__()
        self.layer = torch.nn.Linear(scene.problem.shape[1], scene.problem.shape[1])
        self.scalars = torch.nn.Linear(inputs.scalars, 1)

    def forward(self, field, scalars):
        return self.layer(field) * self.scalars(scalars)[:, :, None]


NETS = {
    "fcnn": (FCNN, {"width": 16}),
    "cnn": (CNN, {"channels": 2}),
    "gnn": (GNN, {"width": 4}),
    "own": (OwnNet, {}),
}


def build(name, scene, base="linear", *, seed=0):
    torch.manual_seed(seed)
    kind, options = NETS[name]
    network, loss = partial(kind, **options), RMSELoss(relative=1.0, floor=0.0)
    surrogate = Surrogate.from_network(network, loss, scene, base=base).eval()
    surrogate.log = lambda *_, **__: None
    return surrogate


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


@pytest.mark.parametrize(
    ("body", "name"),
    [
        *[("hexahedra", "fcnn"), ("tetrahedra", "cnn"), ("triangles", "gnn")],
        ("range of the law", "own"),
    ],
)
def test_the_difference_from_the_linear_solution_is_quadratic_in_the_load(bodies, body, name):
    scene = bodies[body]
    surrogate = build(name, scene)
    load = scene.loads.sample((0, 0), range(3))
    sizes = []
    with torch.no_grad():
        for factor in (1e-3, 1e-4):
            small = Load(factor * load.force, load.young, load.parameters)
            linear = surrogate.predictor.base.solutions(small)
            sizes.append((surrogate.predict(small) - linear).flatten(1).norm(dim=1))
    assert torch.allclose(sizes[0] / sizes[1], torch.full((3,), 100.0).double(), rtol=0.02)
    assert (sizes[0] < 0.01 * 1e-3 * surrogate.predict(load).flatten(1).norm(dim=1)).all()


def test_the_linear_solution_is_that_of_the_linear_solver(bodies):
    for scene in bodies.values():
        load = scene.loads.sample((0, 0), range(3))
        expected = next(iter(scene.linear.iterate(load))).displacement
        assert relative(LinearResponse(scene).solutions(load), expected).max() < 1e-4


def test_the_amplitude_is_the_size_of_the_linear_solution(scene, batch):
    predictor = build("own", scene).predictor
    linear = predictor.base.solutions(batch.load)
    field, amplitude = predictor.normalise(linear)
    free = scene.problem.free
    assert torch.allclose(field[:, free].square().mean(dim=1), torch.ones(len(field)).double())
    size = predictor.displacement_scale * amplitude[:, None, None]
    assert torch.allclose(size * field, linear)


@pytest.mark.parametrize("name", NETS)
def test_a_zero_load_moves_nothing_and_has_finite_gradients(name, scene, batch):
    load = Load(torch.zeros_like(batch.force[:2]).requires_grad_(), batch.young[:2])
    answer = build(name, scene).predict(load)
    assert torch.equal(answer, torch.zeros_like(answer))
    answer.sum().backward()
    assert load.force.grad.isfinite().all()


@pytest.mark.parametrize("name", ["own", "gnn"])
def test_gradients_with_respect_to_the_force_are_those_of_differences(name, scene, batch):
    surrogate = build(name, scene).double()
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
    surrogate = build("fcnn", scene)
    group = symmetries(scene.problem)
    samples = surrogate.encode(batch, group)
    assert isinstance(samples, LinearSamples)
    assert len(samples) == len(group) * len(batch.force)
    linear, sample = samples.__getitems__(list(range(len(samples))))
    expected = surrogate.predictor.base.solutions(sample.load)
    assert relative(linear.double(), expected).max() < 1e-5
    assert {linear.dtype, sample.displacement.dtype} == {torch.float32}  # as MSE wants
    direct = surrogate.training_step(sample, 0)
    monkeypatch.setattr(LinearResponse, "solutions", None)
    assert torch.isclose(surrogate.training_step((linear, sample), 0).double(), direct, rtol=1e-5)


@pytest.mark.parametrize("name", ["fcnn", "gnn"])
def test_training_reduces_the_error_of_small_and_large_loads(name, scene, batch):
    surrogate = build(name, scene)
    small = solve(scene.solver, Load(0.1 * batch.force[:4], batch.young[:4])).displacement
    force = torch.cat([batch.force[:4], 0.1 * batch.force[:4]])
    both = batch._replace(
        force=force,
        displacement=torch.cat([batch.displacement[:4], small]),
        young=batch.young[:8],
        parameters=batch.parameters[:8],
    )
    optimizer = torch.optim.Adam(surrogate.parameters(), lr=3e-3)
    linear = LinearResponse(scene).solutions(both.load)
    before = relative(linear, both.displacement).view(2, 4).mean(dim=1)
    for _ in range(60):
        optimizer.zero_grad()
        surrogate.training_step(both, 0).backward()
        optimizer.step()
    with torch.no_grad():
        after = relative(surrogate.predict(both.load), both.displacement).view(2, 4).mean(dim=1)
    assert (after < 0.9 * before).all()


@pytest.mark.parametrize(
    ("name", "base"), [("fcnn", "linear"), ("cnn", None), ("gnn", "linear"), ("fcnn", None)]
)
def test_half_precision_products_change_a_prediction_by_their_rounding(name, base, scene, batch):
    """As with `trainer.precision=bf16-mixed`; a bfloat16 number has 8 digits, in base 2."""
    surrogate = build(name, scene, base)
    linear = LinearResponse(scene).solutions(batch.load) if base == "linear" else 0.0
    with torch.no_grad():
        exact = surrogate.predict(batch.load) - linear
        with torch.autocast("cpu", torch.bfloat16):
            rounded = surrogate.predict(batch.load) - linear
    assert rounded.dtype == torch.float64
    assert 0 < relative(rounded, exact).max() < 0.1


def test_a_checkpoint_has_scales_and_weights_only(scene, batch):
    one, other = build("fcnn", scene), build("fcnn", scene, seed=1)
    scales = {"predictor.force_scale", "predictor.displacement_scale"}
    weights = {f"predictor.net.{name}" for name, _ in one.net.named_parameters()}
    assert set(one.state_dict()) == scales | weights
    other.load_state_dict(one.state_dict())
    with torch.no_grad():
        assert torch.equal(one.predict(batch.load), other.predict(batch.load))


def test_what_excludes_a_base_is_refused(scene):
    with pytest.raises(ValueError, match="base = quadratic must be linear or null"):
        Inputs.from_scene(scene, "quadratic")
    with pytest.raises(ValueError, match="young = true requires base = null"):
        Inputs.from_scene(scene, "linear", young=True)


def test_a_network_for_other_inputs_raises_an_error(scene, batch):
    for kind, options in NETS.values():
        for base, other in ((None, "linear"), ("linear", None)):
            net = kind(scene, Inputs.from_scene(scene, base), **options)
            with pytest.raises((RuntimeError, ValueError)):
                Surrogate(net, MSE(), scene, base=other).predict(batch.load)


def test_without_a_base_nothing_is_solved(scene, batch, monkeypatch):
    monkeypatch.setattr(LinearResponse, "solutions", None)
    surrogate = build("gnn", scene, None)
    assert isinstance(surrogate.predictor, Scaled)
    assert not isinstance(surrogate.encode(batch), LinearSamples)
    assert surrogate.predict(batch.load).isfinite().all()


# ------------------------------------------------------------------ whitening


SIZES = torch.tensor([1.0, 1e-1, 1e-2, 1e-3]).double()


@pytest.fixture(scope="module")
def shaped():
    """Fields (S, N, D) of four orthogonal shapes of falling size, free mask (N, D), whitening."""
    generator = torch.Generator().manual_seed(0)
    free = torch.ones(10, 3, dtype=torch.bool)
    free[:2] = False
    shapes = torch.linalg.qr(torch.randn(24, 4, generator=generator).double())[0]
    columns = (SIZES * torch.randn(64, 4, generator=generator).double()) @ shapes.T
    fields = torch.zeros(64, 10, 3).double()
    fields[:, free] = columns
    return fields, free, shapes, FieldWhitening(fields, free)


def test_rare_shapes_are_amplified_and_the_mean_square_is_one(shaped):
    fields, free, shapes, whiten = shaped
    whitened = whiten(fields)
    sizes = (whitened[:, free] @ shapes).square().mean(dim=0).sqrt()
    expected = SIZES / partial_whitening(SIZES)
    assert torch.allclose(sizes / sizes[0], expected / expected[0], rtol=0.2)
    assert torch.isclose(whitened[:, free].square().mean(), torch.tensor(1.0).double(), rtol=1e-4)


def test_a_shape_outside_the_modes_is_kept(shaped):
    fields, free, shapes, whiten = shaped
    other = torch.randn(24, generator=torch.Generator().manual_seed(1)).double()
    other -= shapes @ (shapes.T @ other)
    field = torch.zeros(1, 10, 3).double()
    field[0, free] = other
    factor = whiten(field)[0, free] @ other / other.square().sum()
    assert torch.allclose(whiten(field), factor * field, atol=1e-3 * float(factor))
    rarest = (whiten(fields)[:, free] @ shapes[:, -1]).norm()
    assert torch.isclose(factor, rarest / (fields[:, free] @ shapes[:, -1]).norm(), rtol=0.05)


def test_whitening_is_linear_and_leaves_fixed_values_their_own(shaped):
    """Lower precision of products does not reach it."""
    fields, free, _, whiten = shaped
    one, other = fields[:1], fields[1:2].clone()
    other[:, ~free] = 2.0
    assert torch.allclose(whiten(one + 3 * other), whiten(one) + 3 * whiten(other))
    moved = torch.where(free, 0.0, other)
    assert torch.equal(whiten(moved)[:, free], moved[:, free])
    with torch.autocast("cpu", torch.bfloat16):
        inside = whiten(fields.float())
    assert torch.equal(inside, whiten(fields.float()))


def test_a_network_with_a_base_reads_whitened_linear_solutions(scene, batch):
    class Spy(torch.nn.Module):
        def forward(self, field, scalars):
            self.seen = field
            return field

    surrogate = Surrogate(Spy(), MSE(), scene, base="linear")
    surrogate.predict(batch.load)
    predictor = surrogate.predictor
    field, _ = predictor.normalise(predictor.base.solutions(batch.load))
    random, _ = predictor.normalise(sampled_solutions(scene)[1])
    own = FieldWhitening(random, scene.problem.free)
    assert torch.allclose(surrogate.net.seen, own(field.float()), atol=1e-4)
