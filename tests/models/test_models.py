"""Properties of every trained network in conf/model, and the parameter counts of the paper."""

from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dpl.config.validation import PREDICTOR
from dpl.fem import Load
from dpl.models import FCNN, GNN, PODNet, Unrolled
from dpl.models.cnn import Residual
from dpl.models.fcnn import count_parameters
from dpl.system.memory import refuse_weights
from dpl.training import MSE, Surrogate

FILES = sorted((Path(__file__).parents[2] / "conf" / "model").glob("*.yaml"))
OTHERS = "unrolled", "fcnn_paper"  # not trained, see test_unrolled.py; other options of fcnn
MODELS = [path for path in FILES if path.stem not in OTHERS]


def with_bases(surrogate, samples):
    if surrogate.predictor.lacks_bases:
        surrogate.predictor.fit_bases(samples)
    return surrogate


def answer_of(net, force):
    """Return the answer of a network without scalars."""
    return net(force, force.new_zeros(len(force), 0))


@pytest.fixture(params=MODELS, ids=lambda path: path.stem)
def build(request, scene, batch):
    """Returns a network with the defaults of its file for a seed; bases are fitted to a batch."""
    node = OmegaConf.load(request.param)
    node = node.get("model", node)  # beside batch size and epochs that suit it
    own = {key: node[key] for key in node if key not in PREDICTOR}

    def build(seed=0):
        torch.manual_seed(seed)
        net = instantiate(own, _convert_="all")(scene=scene)
        with_bases(Surrogate(net, MSE(), scene), batch)
        return net

    return build


def test_a_network_maps_fields_to_fields_by_its_weights_alone(build, scene, batch):
    """In single precision; the weights are a function of the seed and define the network."""
    net, same, other = build(0).eval(), build(0), build(1).eval()
    force = batch.force[:4].float()
    with torch.no_grad():
        whole = answer_of(net, force)
        assert (whole.shape, whole.dtype) == (force.shape, torch.float32)
        parts = torch.cat([answer_of(net, one[None]) for one in force])
        assert torch.allclose(whole, parts, rtol=1e-4, atol=1e-5), "a load does not know its batch"
        assert not torch.equal(whole, answer_of(other, force))
        other.load_state_dict(net.state_dict())
        assert torch.equal(whole, answer_of(other, force))
        surrogate = Surrogate(net, MSE(), scene).eval()
        answer = surrogate.predict(Load(batch.force + 1.0, batch.young))
    pairs = zip(net.parameters(), same.parameters(), strict=True)
    assert all(torch.equal(*pair) and pair[0].dtype == torch.float32 for pair in pairs)
    held = ~scene.problem.free
    assert torch.equal(answer[:, held], torch.zeros_like(answer[:, held]))
    assert answer.abs().max() > 0


@pytest.mark.parametrize("kind", ["all the same", "one degree of freedom moves"])
def test_identical_samples_give_finite_outputs(build, scene, batch, kind):
    """Nothing is divided by a variance of zero."""
    force, displacement = (column[:1].expand(6, -1, -1) for column in batch[:2])
    if kind.startswith("one"):
        force, displacement = 0 * force, 0 * displacement
        displacement[:, *scene.problem.free.nonzero()[0]] = 1e-3
    even = batch._replace(force=force, displacement=displacement, young=batch.young[:6])
    surrogate = Surrogate(build(), MSE(), scene)
    if hasattr(surrogate.net, "fit_bases"):
        surrogate.predictor.fit_bases(even)
    optimizer = torch.optim.Adam(surrogate.parameters(), lr=1e-3)
    for _ in range(3):
        loss = surrogate.loss(surrogate.predict(even.load), even, surrogate.physics)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert surrogate.eval().predict(even.load).isfinite().all()
    assert all(tensor.isfinite().all() for tensor in surrogate.state_dict().values())


def test_a_network_overfits_one_batch(build, scene, batch):
    """The error on four samples decreases 100-fold within 300 steps."""
    surrogate = Surrogate(build(), MSE(), scene)
    four = type(batch)(*(column[:4] for column in batch))
    optimizer = torch.optim.Adam(surrogate.parameters(), lr=3e-3)
    losses = []
    for _ in range(300):
        loss = surrogate.loss(surrogate.predict(four.load), four, surrogate.physics)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if losses[-1] < losses[0] / 100:
            return
    pytest.fail(f"the loss fell {losses[0] / min(losses):.0f} times only")


def test_every_parameter_learns(build, scene, batch):
    surrogate = Surrogate(build(), MSE(), scene)
    for part in surrogate.modules():
        if isinstance(part, Residual):
            torch.nn.init.normal_(part.second.weight)  # zero at first
    surrogate.loss(surrogate.predict(batch.load), batch, surrogate.physics).backward()
    for name, parameter in surrogate.net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


class OwnNet(torch.nn.Module):
    """A network with bases that inherits from no class of the package."""

    def __init__(self):
        super().__init__()
        self.register_buffer("factor", torch.zeros(()))

    @property
    def is_fitted(self):
        return bool(self.factor > 0)

    def forward(self, field, scalars):
        return self.factor * field

    def fit_bases(self, field, output):
        self.factor.copy_((field * output).sum() / field.square().sum())


def test_bases_of_a_network_of_another_package_are_fitted_once(scene, batch):
    module = Surrogate(OwnNet(), MSE(), scene)
    assert module.predictor.lacks_bases
    module.predictor.fit_bases(batch)
    assert not module.predictor.lacks_bases
    field, output = module.predictor.examples(batch)
    error = output - float(module.net.factor) * field
    assert abs(float((error * field).sum())) < 1e-5 * float(output.norm() * field.norm())


# ------------------------------------------------------------------ the paper's network


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_papers_network_has_4_n2_plus_7_n_parameters(make_scene):
    scene = make_scene(nodes=(9, 3, 3))  # 243 degrees of freedom
    net = FCNN(scene, all_dofs=True)
    assert count(net) == 4 * 243**2 + 7 * 243 == 237_897
    assert net.parameters_needed == 237_897
    assert net.skipped_work() == []
    small = FCNN(scene, width=20)
    for one in (small, FCNN(scene, layers=2), FCNN(scene, layers=6, width=7)):
        assert one.parameters_needed == count(one)
    (line,) = small.skipped_work()
    assert line.startswith(f"{237_897 - count(small):,} of 237,897 parameters")
    slopes = [stage for stage in small.stages if isinstance(stage, torch.nn.PReLU)]
    assert [slope.num_parameters for slope in slopes] == [20, 20, 20], "one for each unit"


def test_the_papers_beam_has_576_million_parameters_and_needs_nine_gigabytes():
    assert count_parameters([12_000] * 5) == 4 * 12_000**2 + 7 * 12_000 == 576_084_000
    refuse_weights(576_084_000, 9.3, "take less")
    with pytest.raises(
        MemoryError, match=r"576,084,000 parameters .* need 9\.2 GB, there are 8\.0"
    ):
        refuse_weights(576_084_000, 8.0, "take less")


def test_inputs_are_loadable_and_outputs_free_degrees_of_freedom(scene, batch):
    torch.manual_seed(0)
    net = FCNN(scene)
    inputs, outputs = int(scene.loads.loadable_dofs.sum()), int(scene.problem.free.sum())
    assert net.stages[0].in_features == inputs < scene.problem.free.numel()
    assert net.stages[-1].out_features == outputs
    force = batch.force.float()
    with torch.no_grad():
        answer = answer_of(net, force)
        blind = answer_of(net, force + torch.where(scene.loads.loadable_dofs, 0.0, 1.0))
    assert torch.equal(answer, blind)
    assert not answer[:, ~scene.problem.free].any()


def test_a_network_beyond_memory_raises_an_error_before_it_is_built(scene, monkeypatch):
    def forbidden(*_, **__):
        raise AssertionError("allocated")

    needed = FCNN(scene).parameters_needed
    monkeypatch.setattr(torch.nn, "Linear", forbidden)
    with pytest.raises(MemoryError) as refusal:
        FCNN(scene, memory_limit=needed * 16 / 1e9 * 0.99)
    assert f"{needed:,} parameters" in str(refusal.value)
    assert f"{needed * 16 / 1e9:.1f} GB" in str(refusal.value)
    with pytest.raises(AssertionError, match="allocated"):
        FCNN(scene, memory_limit=needed * 16 / 1e9 * 1.01)


POD_SIZES = "rank", "coordinates", "width"
BEYOND = r"parameters .* need .* GB, there are .* GB; take"


@pytest.mark.parametrize(
    ("network", "options", "error", "words"),
    [
        (PODNet, {"width": 10**12}, MemoryError, BEYOND),
        (GNN, {"width": 10**6}, MemoryError, BEYOND),
        (GNN, {"width": 10**12, "passes": 3}, MemoryError, BEYOND),
        (FCNN, {"width": 10**18}, MemoryError, BEYOND),
        (PODNet, {"blocks": 10**9, "width": 1}, ValueError, "blocks = .* between 0 and 1,000"),
        (GNN, {"passes": 10**9, "width": 1}, ValueError, "passes = .* between 1 and 1,000"),
        (FCNN, {"layers": 10**9, "width": 1}, ValueError, "layers = .* between 2 and 1,000"),
        *((Unrolled, {name: 0}, ValueError, f"{name} = 0") for name in ("rank", "cells")),
        (Unrolled, {"stages": -1}, ValueError, "stages = -1"),
        (FCNN, {"layers": 1}, ValueError, "layers = 1"),
        (FCNN, {"layers": 0}, ValueError, "layers = 0"),
        (FCNN, {"width": 0}, ValueError, "width = 0"),
        *((PODNet, {name: 0}, ValueError, f"{name} = 0") for name in POD_SIZES),
        (PODNet, {"blocks": -1}, ValueError, "blocks = -1"),
        *((GNN, {name: 0}, ValueError, f"{name} = 0") for name in ("width", "levels", "passes")),
    ],
)
def test_invalid_options_are_refused_before_the_network_is_built(
    scene, monkeypatch, network, options, error, words
):
    def forbidden(*_, **__):
        raise AssertionError("allocated")

    monkeypatch.setattr(torch.nn, "Linear", forbidden)
    with pytest.raises(error, match=words):
        network(scene, **options)


def over_modulus(scene):
    """Return a surrogate with E as an input."""
    torch.manual_seed(0)
    return Surrogate.from_network(FCNN, MSE(), scene, base=None, young=True)


def test_youngs_modulus_matters_where_it_is_an_input_and_only_there(make_scene):
    """Over the widest range of the paper."""
    scene = make_scene(young=[1e6, 2.03e11])
    surrogate, load = over_modulus(scene), scene.loads.sample((0, 0), range(4))
    plain = Surrogate(FCNN(surrogate.scene), MSE(), surrogate.scene)
    soft, stiff = (load._replace(young=torch.full_like(load.young, e)) for e in (1e6, 2.03e11))
    with torch.no_grad():
        apart = (surrogate.predict(soft) - surrogate.predict(stiff)).flatten(1).norm(dim=1)
        size = surrogate.predict(stiff).flatten(1).norm(dim=1)
        assert (apart > 0.01 * size).all()
        assert torch.equal(plain.predict(soft), plain.predict(stiff))


@pytest.mark.parametrize(
    ("young", "moduli", "expected"),
    [
        ([1e6, 2.03e11], [1e6, 1e9, 1.015005e11, 2.03e11], [-1.0, -0.99015, 0.0, 1.0]),
        ({"low": 1e6, "high": 1e10, "distribution": "log"}, [1e6, 1e8, 1e10], [-1.0, 0.0, 1.0]),
    ],
    ids=["uniform", "log"],
)
def test_moduli_are_normalised_and_forces_are_relative_to_the_largest_one(
    make_scene, young, moduli, expected
):
    scene = make_scene(young=young)
    surrogate, entered = over_modulus(scene), []
    surrogate.net.stages[0].register_forward_hook(lambda _, given, __: entered.append(given[0]))
    moduli = torch.tensor(moduli, dtype=torch.float64)
    force = scene.loads.sample((0, 0), range(1)).force.expand(len(moduli), -1, -1)
    surrogate.predict(Load(force, moduli))
    (inputs,) = entered
    assert inputs[:, -1].tolist() == pytest.approx(expected, abs=1e-4)
    newtons = inputs[:, :-1].norm(dim=1) / moduli
    assert torch.allclose(newtons, newtons[:1].expand(len(moduli)), rtol=1e-5)
    scaled = (force[-1] / surrogate.predictor.force_scale).float()[scene.loads.loadable_dofs]
    assert torch.allclose(inputs[-1, :-1], scaled), "the stiffest body's are those over E L^2"


def test_a_single_modulus_as_an_input_is_normalised_by_itself(scene, batch):
    """The tiny scene has E = 4500 Pa; an increase of 1 % changes the prediction little."""
    surrogate = over_modulus(scene)
    with torch.no_grad():
        here, near = (
            surrogate.predict(batch.load._replace(young=k * batch.young)) for k in (1, 1.01)
        )
    apart, size = (near - here).flatten(1).norm(dim=1), here.flatten(1).norm(dim=1)
    assert ((apart > 0) & (apart < 0.1 * size)).all()
