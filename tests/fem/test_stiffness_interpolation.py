"""Solutions for all parameters of a range from those for a few of them."""

import numpy as np
import pytest
import torch

from dpl.fem import (
    ConstantFibres,
    FibreReinforced,
    Guccione,
    NeoHookeanLn,
    Plane,
    Problem,
    Sphere,
    VolumetricK2,
    YeohK2,
)
from dpl.fem.rom.stiffness_interpolation import StiffnessInterpolation
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

ISOTROPIC = (0.0, 1.5)  # ratios of the energies of lambda and mu


def moduli(poisson):
    nu = np.atleast_1d(poisson)
    return np.stack([1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))], axis=1)


def diagonal(factors, b, c=0.0):
    return 1 / (factors[:, 0] + factors[:, 1] * b + c)


def of_range(low, high, **options):
    return StiffnessInterpolation.of(moduli(np.linspace(low, high, 101)), ISOTROPIC, **options)


def weights_at(interpolation, factors):
    return interpolation.weights(torch.from_numpy(factors))[0].numpy()


@pytest.mark.parametrize("ends", [(0.2, 0.4), (0.0, 0.45), (0.0, 0.49), (-0.4, 0.1)])
@pytest.mark.parametrize("springs", [False, True])
def test_every_component_of_a_solution_is_interpolated_to_the_bound(ends, springs):
    found = of_range(*ends, springs=springs)
    nodes = np.array(found.nodes)
    random = np.random.default_rng(0)
    for poisson in random.uniform(*ends, 20):
        weights = weights_at(found, moduli(poisson))
        for b in random.uniform(*ISOTROPIC, 10):
            for c in (0.0, *(10.0 ** random.uniform(-4, 4, 5) if springs else ())):
                value = weights @ diagonal(nodes, b, c)
                assert value == pytest.approx(diagonal(moduli(poisson), b, c)[0], rel=2e-4)


def test_the_weights_of_a_node_are_those_of_its_solution():
    found = of_range(0.2, 0.4)
    for k, node in enumerate(found.nodes):
        weights = weights_at(found, np.array([node]))
        assert weights == pytest.approx(np.eye(len(found.nodes))[k], abs=1e-5)


def test_one_ratio_needs_one_solution():
    found = of_range(0.3, 0.3)
    assert np.array(found.nodes) == pytest.approx(moduli(0.3))
    assert weights_at(found, moduli(0.3)) == pytest.approx([1.0])


def test_wider_ranges_need_more_solutions():
    counts = [len(of_range(0.0, high).nodes) for high in (0.1, 0.3, 0.45, 0.49)]
    assert counts == sorted(set(counts))
    assert counts[-1] < 12


def inclusion(grid, young):
    laws = {"core": NeoHookeanLn(0.3, young), "other": NeoHookeanLn(0.4)}
    region = {"core": Sphere([0.0, 0.0, 0.0], 0.7)}
    return Problem.build(grid("hexahedron"), laws, regions=region, fixed=Plane(0, "min"))


def test_energies_of_a_stiff_inclusion_are_between_those_of_its_parts(grid):
    """One stiffness with a range: two terms, whose energies differ by at most that range."""
    terms = StiffnessTerms.of(inclusion(grid, young=[1.0, 100.0]))
    assert len(terms) == 2
    assert max(terms.eigenvalues) / min(terms.eigenvalues) == pytest.approx(100.0)


@pytest.mark.parametrize("young", [1.0, 3.7, 41.0, 100.0])
def test_solutions_of_a_stiff_inclusion_are_interpolated(grid, young):
    problem = inclusion(grid, young=[1.0, 100.0])
    terms = StiffnessTerms.of(problem)
    found = StiffnessInterpolation.of_terms(terms)
    body = problem.with_parameters(torch.tensor([[young]]).double())
    weights = found.weights(terms.factors(body.material))[0].numpy()
    matrices = [terms.body(torch.tensor(node).double()) for node in found.nodes]
    exact = full(body)
    right = np.random.default_rng(0).standard_normal(len(exact))
    each = [np.linalg.solve(full(matrix), right) for matrix in matrices]
    answer = np.linalg.solve(exact, right)
    assert np.linalg.norm(weights @ each - answer) < 2e-4 * np.linalg.norm(answer)


def full(body):
    one = torch.eye(int(body.free.sum())).double()
    fields = torch.zeros(len(one), *body.shape).double()
    fields[:, body.free] = one
    return body.tangent_product(torch.zeros_like(fields), fields)[:, body.free].numpy()


def test_three_terms_have_no_weights_that_are_the_same_for_every_load(grid):
    laws = {"core": NeoHookeanLn(0.3, young=[1.0, 9.0]), "other": NeoHookeanLn([0.2, 0.4])}
    region = {"core": Sphere([0.0, 0.0, 0.0], 0.7)}
    problem = Problem.build(grid("hexahedron"), laws, regions=region, fixed=Plane(0, "min"))
    terms = StiffnessTerms.of(problem)
    assert len(terms) == 3
    with pytest.raises(ValueError, match="there are 3 terms"):
        StiffnessInterpolation.of_terms(terms)


FIBRES = FibreReinforced(
    VolumetricK2([1.0, 3.0]), Guccione([0.1, 1.0], 8.0, 2.0, 4.0), ConstantFibres([1, 1, 0])
)
BODIES = {  # laws of the core and of the rest, and the number of terms
    "one law": (NeoHookeanLn(0.3), NeoHookeanLn(0.3), 1),
    "two stiffnesses": (NeoHookeanLn(0.3, [1, 9]), NeoHookeanLn(0.2, [1, 9]), 2),
    "moduli of Yeoh's law": (YeohK2([0.1, 0.4], 0.0, 0.0, 3.0), NeoHookeanLn(0.3), 2),
    "fibres": (FIBRES, NeoHookeanLn(0.3), 3),
}


@pytest.mark.parametrize("name", BODIES)
def test_stiffness_is_the_sum_of_its_terms(grid, name):
    core, other, count = BODIES[name]
    region = {"core": Sphere([0.0, 0.0, 0.0], 0.7)}
    laws = {"core": core, "other": other}
    problem = Problem.build(grid("hexahedron"), laws, regions=region, fixed=Plane(0, "min"))
    terms = StiffnessTerms.of(problem)
    assert len(terms) == count
    values = [
        ends.at(t)
        for ends, t in zip(
            problem.parameter_ranges.values(), (0.3, 0.8, 0.1, 0.6, 0.45), strict=False
        )
    ]
    body = problem.with_parameters(torch.tensor([values]).double())
    parts = [one.stiffness_at_rest() for one in terms.bodies]
    found = (terms.factors(body.material)[0, :, None] * torch.stack(parts)).sum(dim=0)
    expected = body.stiffness_at_rest()
    assert (found - expected).abs().max() < 1e-12 * expected.abs().max()
