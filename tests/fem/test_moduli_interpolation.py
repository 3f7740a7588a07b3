"""Solutions for all Poisson's ratios of a range from those for a few of them."""

import numpy as np
import pytest
import torch

from dpl.fem.rom.moduli_interpolation import LARGEST_EIGENVALUE, ModuliInterpolation


def diagonal(poisson, b, c=0.0):
    mu, lam = 1 / (2 * (1 + poisson)), poisson / ((1 + poisson) * (1 - 2 * poisson))
    return 1 / (mu + lam * b + c)


def weights_at(interpolation, poisson):
    mu = 1 / (2 * (1 + poisson))
    lam = poisson / ((1 + poisson) * (1 - 2 * poisson))
    return interpolation.weights(*(torch.tensor([one]).double() for one in (mu, lam)))[0].numpy()


@pytest.mark.parametrize("ends", [(0.2, 0.4), (0.0, 0.45), (0.0, 0.49), (-0.4, 0.1)])
@pytest.mark.parametrize("springs", [False, True])
def test_every_component_of_a_solution_is_interpolated_to_the_bound(ends, springs):
    found = ModuliInterpolation.of(*ends, springs=springs)
    nodes = np.array(found.nodes)
    random = np.random.default_rng(0)
    for poisson in random.uniform(*ends, 20):
        weights = weights_at(found, poisson)
        for b in random.uniform(0, LARGEST_EIGENVALUE, 10):
            for c in (0.0, *(10.0 ** random.uniform(-4, 4, 5) if springs else ())):
                value = weights @ diagonal(nodes, b, c)
                assert value == pytest.approx(diagonal(poisson, b, c), rel=2e-4)


def test_the_weights_of_a_node_are_those_of_its_solution():
    found = ModuliInterpolation.of(0.2, 0.4)
    for k, poisson in enumerate(found.nodes):
        assert weights_at(found, poisson) == pytest.approx(np.eye(len(found.nodes))[k], abs=1e-5)


def test_one_ratio_needs_one_solution():
    found = ModuliInterpolation.of(0.3, 0.3)
    assert found.nodes == (0.3,)
    assert weights_at(found, 0.3) == pytest.approx([1.0])


def test_wider_ranges_need_more_solutions():
    counts = [len(ModuliInterpolation.of(0.0, high).nodes) for high in (0.1, 0.3, 0.45, 0.49)]
    assert counts == sorted(set(counts))
    assert counts[-1] < 12
