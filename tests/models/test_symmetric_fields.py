"""Fields from their images at the representatives of orbits."""

import pytest
import torch

from dpl.fem import box, symmetries
from dpl.models.symmetric_fields import Orbits, coordinates_of_images, sum_over_images


@pytest.fixture(scope="module", params=["even", "odd", "skew"])
def body(request, make_scene):
    """Beams with and without nodes on their mirror planes, and one without symmetries."""
    if request.param == "skew":
        return make_scene(mesh=box([100.0, 30.0, 25.0], [4, 3, 2], "tetra"))
    return make_scene(nodes=(4, 4, 4) if request.param == "even" else (4, 5, 5))


@pytest.fixture(scope="module")
def group(body):
    return symmetries(body.problem)


@pytest.fixture(scope="module")
def orbits(body, group):
    return Orbits(group, body.problem.free)


def noise(body, count=3):
    random = torch.Generator().manual_seed(0)
    field = torch.randn(count, *body.problem.shape, generator=random, dtype=torch.float64)
    return torch.where(body.problem.free, field, 0.0)


def test_images_at_representatives_determine_the_field(body, orbits):
    field = noise(body)
    assert torch.allclose(orbits.field(orbits.images(field), field), field, rtol=0, atol=1e-14)


def test_images_at_representatives_are_those_of_the_symmetries(body, group, orbits):
    field = noise(body)
    for k, symmetry in enumerate(group):
        expected = orbits.at_representatives(symmetry.image(field))
        assert torch.allclose(orbits.images(field)[:, k], expected, rtol=0, atol=1e-14)


def test_weights_reproduce_the_scalar_product(body, orbits):
    one, other = noise(body), noise(body).roll(1, dims=0)
    found = (orbits.images(one) * orbits.weights * orbits.images(other)).sum(dim=(1, 2))
    assert torch.allclose(found, (one * other).sum(dim=(1, 2)), rtol=1e-12)


def test_each_orbit_has_one_representative(body, group, orbits):
    free = body.problem.free.any(dim=1)
    sources = torch.stack([symmetry.source for symmetry in group])[:, free]
    count = len({tuple(sorted(set(column.tolist()))) for column in sources.T})
    assert len(orbits.weights) == 3 * count
    assert len(orbits.weights) <= 3 * int(free.sum()) / (len(group) / 2)


def test_without_a_group_every_node_is_a_representative(body):
    orbits, field = Orbits([], body.problem.free), noise(body)
    free = body.problem.free.any(dim=1)
    assert torch.equal(orbits.at_representatives(field), field[:, free].flatten(1))
    assert torch.equal(orbits.images(field)[:, 0], orbits.at_representatives(field))
    assert torch.equal(orbits.field(orbits.images(field), field), field)
    assert (orbits.weights == 1).all()


def test_coordinates_of_images_sum_to_the_order_of_the_group_times_the_coordinates():
    """The group is that of quarter turns of the plane."""
    quarter = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    motions = torch.stack([torch.linalg.matrix_power(quarter, k) for k in range(4)])
    one = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))
    every = coordinates_of_images(one, motions.mT)
    for k in range(4):
        assert torch.allclose(every[:, k], one @ motions[k], atol=1e-6)
    assert torch.allclose(sum_over_images(every, motions.mT), 4 * one, atol=1e-5)
