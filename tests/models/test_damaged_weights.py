"""Damaged weights are refused in one line, or give finite answers with honest estimated errors."""

from functools import partial

import pytest
import torch
from safetensors.torch import load, save

from benchmarks.samples import solved
from dpl.config import ConfigError
from dpl.config.plain import error_in
from dpl.config.run_folder import DAMAGED
from dpl.inference import Simulator
from dpl.models import CNN, FCNN, GNN, PODNet, Unrolled
from dpl.training import MSE, Surrogate

MODELS = {
    "unrolled": lambda scene, _: Unrolled(scene, rank=20, cells=8, stages=2),
    "pod": partial(PODNet, rank=10, coordinates=6, width=8, blocks=1),
    "fcnn": partial(FCNN, width=8, layers=2),
    "linear base": partial(FCNN, width=8, layers=2),
    "cnn": partial(CNN, channels=2),
    "gnn": partial(GNN, width=2),
}
E = 4500.0  # Young's modulus of the scene [Pa]


@pytest.fixture(scope="module")
def sets(scene):
    """Training, held-out and test samples of the tiny scene."""
    loads = (scene.loads.sample(k, range(count)) for k, count in enumerate((24, 8, 2)))
    return [solved(scene, load) for load in loads]


@pytest.fixture(scope="module", params=MODELS)
def surrogate(request, scene, sets):
    """An untrained network, or a fitted model."""
    torch.manual_seed(0)
    base = "linear" if request.param == "linear base" else None
    surrogate = Surrogate.from_network(MODELS[request.param], MSE(), scene, base=base)
    if request.param == "unrolled":
        surrogate.net.fit(*sets[:2])
    elif request.param == "pod":
        surrogate.predictor.fit_bases(sets[0])
    return surrogate.eval()


def replacements(tensor):
    """Yield tensors that a damaged file may have in the place of one."""
    yield torch.zeros(0, dtype=tensor.dtype)
    yield tensor[None]
    for axis, size in enumerate(tensor.shape):
        yield tensor.narrow(axis, 0, max(0, size - 1))
        yield torch.cat([tensor, tensor.narrow(axis, 0, min(1, size))], axis)
    yield from (tensor.to(kind) for kind in (torch.float16, torch.float64, torch.int64, torch.bool))
    if tensor.is_floating_point():
        yield 1000 * tensor
    values = [-1, 0, 3, 10**6, -(2**62)]
    if tensor.is_floating_point():
        values = [torch.nan, torch.inf, 1e30, -1.0, 0.0, 1e-12]
    for value in values:
        yield torch.full_like(tensor, value)
        one = tensor.flatten().clone()
        one[len(one) // 2 : len(one) // 2 + 1] = value
        yield one.view(tensor.shape)


def damaged_states(surrogate):
    """Yield damaged weights, each buffer in its turn, and the first and last parameters."""
    good = {name: tensor.clone() for name, tensor in surrogate.state_dict().items()}
    weights = [name for name, _ in surrogate.named_parameters()]
    for name in good.keys() - set(weights[2:-2]):
        for tensor in replacements(good[name]):
            yield name, load(save({**good, name: tensor.contiguous()}))


def test_damaged_weights_are_refused_or_give_honest_answers(surrogate, scene, sets):
    force = E * scene.force_unit * sets[2].force
    exact = scene.length * sets[2].displacement.flatten(1)
    refusals, answers = [], 0
    for name, state in damaged_states(surrogate):
        try:
            with error_in("weights", *DAMAGED):
                surrogate.load_state_dict(state)
                surrogate.check_predictions()
        except ConfigError as refusal:
            refusals.append(str(refusal))
            continue
        answer = Simulator(surrogate)(force)
        error = (answer.displacement.flatten(1) - exact).norm(dim=1) / exact.norm(dim=1)
        assert answer.displacement.isfinite().all(), name
        # of predictions that are far off, the corotational estimate is a quarter of the error
        assert (answer.error > error.clamp(max=0.1) / 4).all(), (name, answer.error, error)
        answers += 1
    assert len(refusals) > 10
    assert answers > 10
    assert not any("\n" in line for line in refusals)
