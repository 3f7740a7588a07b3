"""Whitening of the inputs of networks."""

import pytest
import torch

from dpl.models.linear_base import sampled_solutions
from dpl.models.whitening import FieldWhitening, partial_whitening
from dpl.training import MSE, Surrogate

SIZES = torch.tensor([1.0, 1e-1, 1e-2, 1e-3]).double()


@pytest.fixture(scope="module")
def fields():
    """Fields (S, N, D) of four orthogonal shapes of falling size, and the free mask (N, D)."""
    generator = torch.Generator().manual_seed(0)
    free = torch.ones(10, 3, dtype=torch.bool)
    free[:2] = False
    shapes = torch.linalg.qr(torch.randn(24, 4, generator=generator).double())[0]
    columns = (SIZES * torch.randn(64, 4, generator=generator).double()) @ shapes.T
    fields = torch.zeros(64, 10, 3).double()
    fields[:, free] = columns
    return fields, free, shapes


def test_rare_shapes_are_amplified_and_the_mean_square_is_one(fields):
    fields, free, shapes = fields
    whitened = FieldWhitening(fields, free)(fields)
    sizes = (whitened[:, free] @ shapes).square().mean(dim=0).sqrt()
    expected = SIZES / partial_whitening(SIZES)
    assert torch.allclose(sizes / sizes[0], expected / expected[0], rtol=0.2)
    assert torch.isclose(whitened[:, free].square().mean(), torch.tensor(1.0).double(), rtol=1e-4)


def test_a_shape_outside_the_modes_is_kept(fields):
    fields, free, shapes = fields
    whiten = FieldWhitening(fields, free)
    other = torch.randn(24, generator=torch.Generator().manual_seed(1)).double()
    other -= shapes @ (shapes.T @ other)
    field = torch.zeros(1, 10, 3).double()
    field[0, free] = other
    factor = whiten(field)[0, free] @ other / other.square().sum()
    assert torch.allclose(whiten(field), factor * field, atol=1e-3 * float(factor))
    rarest = (whiten(fields)[:, free] @ shapes[:, -1]).norm()
    assert torch.isclose(factor, rarest / (fields[:, free] @ shapes[:, -1]).norm(), rtol=0.05)


def test_the_map_is_linear_and_leaves_fixed_values_their_own(fields):
    fields, free, _ = fields
    whiten = FieldWhitening(fields, free)
    one, other = fields[:1], fields[1:2].clone()
    other[:, ~free] = 2.0
    assert torch.allclose(whiten(one + 3 * other), whiten(one) + 3 * whiten(other))
    moved = torch.where(free, 0.0, other)
    assert torch.equal(whiten(moved)[:, free], moved[:, free])


def test_lower_precision_of_products_does_not_reach_the_whitening(fields):
    fields, free, _ = fields
    whiten = FieldWhitening(fields, free)
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
    field, _ = predictor.normalise(predictor.base.solve(batch.load))
    random, _ = predictor.normalise(sampled_solutions(scene)[1])
    own = FieldWhitening(random, scene.problem.free)
    assert torch.allclose(surrogate.net.seen, own(field.float()), atol=1e-4)
