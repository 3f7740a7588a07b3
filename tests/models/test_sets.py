"""Laws of layers on sets."""

import pytest
import torch

from dpl.models.sets import Block, SetLinear

KINDS = pytest.mark.parametrize("kind", [SetLinear, Block])


def members(count=8, channels=3):
    return torch.randn(5, count, channels, generator=torch.Generator().manual_seed(0))


@KINDS
def test_a_layer_commutes_with_permutations(kind):
    torch.manual_seed(0)
    layer, order = kind(3), torch.randperm(8, generator=torch.Generator().manual_seed(1))
    answer, moved = layer(members()), layer(members()[:, order])
    assert not torch.allclose(moved, answer, rtol=1e-2)
    assert torch.allclose(moved, answer[:, order], rtol=1e-5, atol=1e-6)


@KINDS
def test_every_member_hears_of_every_other(kind):
    torch.manual_seed(0)
    layer, at = kind(1), torch.zeros(1, 8, 1, requires_grad=True)
    (slope,) = torch.autograd.grad(layer(at)[0, 2, 0], at)
    assert (slope != 0).all()
    others = slope.flatten()[[0, 1, 3, 4, 5, 6, 7]]
    assert torch.allclose(others, others[0].expand(7))


def test_alone_it_is_a_linear_layer():
    torch.manual_seed(0)
    layer = SetLinear(3, alone=True)
    assert layer.mix.weight.shape == (3, 3)
    assert torch.equal(layer(members(1)), layer.mix(members(1)))


def test_a_block_begins_close_to_the_identity():
    torch.manual_seed(0)
    change = Block(3)(members()).detach() - members()
    assert 0 < float(change.norm() / members().norm()) < 0.2
