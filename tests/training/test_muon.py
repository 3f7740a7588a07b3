"""Muon with Adam acts as one optimiser for schedules, checkpoints and trainers."""

import io

import pytest
import torch
from torch import nn

from dpl.training import Muon, warmup_cosine
from dpl.training.muon import orthogonal


def network(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Unflatten(1, (1, 6)), nn.Conv1d(1, 2, 3), nn.Flatten(), nn.Linear(8, 5), nn.PReLU(5),
        nn.Linear(5, 3),
    )  # fmt: skip


def loss_of(net, k=0):
    random = torch.Generator().manual_seed(k)
    x, y = torch.randn(16, 6, generator=random), torch.randn(16, 3, generator=random)
    return (net(x) - y).square().mean()


def step(net, *optimizers, k=0, scheduler=None):
    net.zero_grad()
    loss_of(net, k).backward()
    for optimizer in optimizers:
        optimizer.step()
    if scheduler is not None:
        scheduler.step()


def same(one, other):
    return all(map(torch.equal, one.parameters(), other.parameters()))


def test_muon_updates_matrices_and_adam_vectors():
    """Equal to torch's Adam, and to torch's Muon up to the precision of bfloat16."""
    one, two = network(), network()
    whole = Muon(one.parameters(), lr=1e-2, momentum=0.9, betas=(0.8, 0.95), weight_decay=0.1)
    for net in (one, two):  # torch's Muon refuses convolutions
        net[1].weight.requires_grad_(False)
    matrices = [p for p in two.parameters() if p.ndim == 2]
    others = [p for p in two.parameters() if p.ndim == 1]
    assert len(matrices) == 2
    parts = (
        torch.optim.Muon(
            matrices, lr=1e-2, momentum=0.9, weight_decay=0.1, adjust_lr_fn="match_rms_adamw"
        ),
        torch.optim.AdamW(others, lr=1e-2, betas=(0.8, 0.95), weight_decay=0.1),
    )
    for k in range(4):
        step(one, whole, k=k)
        step(two, *parts, k=k)
    start = network()
    for mine, theirs, before in zip(*(n.parameters() for n in (one, two, start)), strict=True):
        if mine.ndim == 3:
            continue
        off, way = (mine - theirs).norm(), (theirs - before).norm()
        assert off < (0.03 if mine.ndim == 2 else 1e-3) * way


def test_the_weights_of_a_convolution_are_the_matrix_of_its_filters():
    torch.manual_seed(0)
    filters = nn.Parameter(torch.randn(4, 3, 2, 2))
    matrix = nn.Parameter(filters.detach().flatten(1).clone())
    optimizer = Muon([filters, matrix], lr=1e-2, weight_decay=0.1)
    for _ in range(3):
        filters.grad = torch.randn(4, 3, 2, 2)
        matrix.grad = filters.grad.flatten(1).clone()
        before = filters.detach().clone()
        optimizer.step()
        assert not torch.equal(filters, before)
        assert torch.allclose(filters.flatten(1), matrix, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("shape", [(32, 60), (32, 640), (640, 32), (60, 32), (40, 40)])
def test_matrices_are_made_orthogonal_in_their_own_precision(shape):
    torch.manual_seed(0)
    u, _, v = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    sizes = torch.linspace(0.1, 1, min(shape))
    answer = orthogonal(u @ sizes.diag() @ v)
    assert answer.dtype == torch.float32
    along = torch.einsum("ik,ij,kj->k", u, answer, v)
    assert ((along > 0.6) & (along < 1.3)).all()
    rest = answer - u @ along.diag() @ v
    assert rest.norm() < 1e-4 * answer.norm()


@pytest.mark.parametrize("shape", [(4, 3), (4,)], ids=["matrices", "vectors"])
def test_parameters_of_one_kind_move_decay_and_need_a_gradient(shape):
    moving, still, fixed = (nn.Parameter(torch.ones(shape)) for _ in range(3))
    optimizer = Muon([moving, still, fixed], lr=0.1, weight_decay=0.5)
    moving.grad, still.grad = torch.ones(shape), torch.zeros(shape)
    optimizer.step()
    assert torch.allclose(still, torch.full(shape, 0.95)), "it decays"
    assert (moving < still).all()
    assert (fixed == 1).all()
    optimizer.load_state_dict(optimizer.state_dict())


def test_a_closure_is_evaluated_once_with_gradients_and_its_loss_returned():
    one, two = network(), network()
    optimizer, calls = Muon(one.parameters()), []

    def closure():
        calls.append(torch.is_grad_enabled())
        optimizer.zero_grad()
        loss = loss_of(one)
        loss.backward()
        return loss

    with torch.no_grad():
        found = optimizer.step(closure)
    assert calls == [True]
    assert float(found) == float(loss_of(two))
    step(two, Muon(two.parameters()))
    assert same(one, two)
    assert optimizer.step() is None


def saved(value):
    file = io.BytesIO()
    torch.save(value, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_a_saved_state_continues_bit_for_bit():
    def fresh(net):
        optimizer = Muon(net.parameters(), lr=0.1, weight_decay=0.01)
        return optimizer, warmup_cosine(optimizer, total_steps=10)

    straight = network()
    optimizer, scheduler = fresh(straight)
    seen = []
    for k in range(8):
        seen.append(optimizer.param_groups[0]["lr"])
        if k == 4:
            parts = (straight, optimizer, scheduler)
            states = saved([part.state_dict() for part in parts])
        step(straight, optimizer, k=k, scheduler=scheduler)
    resumed = network(1)
    parts = (resumed, *fresh(resumed))
    for part, state in zip(parts, states, strict=True):
        part.load_state_dict(state)
    assert not same(straight, resumed)
    for k in range(4, 8):
        step(resumed, parts[1], k=k, scheduler=parts[2])
    assert same(straight, resumed)
    assert optimizer.param_groups[0]["lr"] == parts[1].param_groups[0]["lr"]
    assert seen[0] < seen[1] > seen[7] > 0, "the schedule reaches both parts"
    assert loss_of(straight) < loss_of(network())
    assert not any(map(torch.equal, straight.parameters(), network().parameters()))


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        ({"params": []}, "empty"),
        ({"momentum": 1.0}, "momentum = 1.0"),
        ({"momentum": -0.1}, "momentum = -0.1"),
        ({"betas": (0.9, -0.5)}, "(?i)beta.*-0.5"),
    ],
)
def test_invalid_options_raise_an_error_with_their_name(options, reported):
    """Vectors alone suffice; commands validate an optimiser in this way."""
    with pytest.raises(ValueError, match=reported):
        Muon(**{"params": [nn.Parameter(torch.zeros(1))], **options})
