"""Conjugate gradients for all parameters of a range from the inverse of K(0) for one of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpl.fem import (
    ConstantFibres,
    FibreReinforced,
    Guccione,
    NeoHookeanIsoK2,
    NeoHookeanLn,
    Plane,
    Problem,
    RobinBC,
    Sphere,
    symmetries,
)
from dpl.fem.linear.condensation import condense, condensed_iteration
from dpl.fem.linear.interface import full_matrix
from dpl.fem.rom.stiffness_iteration import (
    MAX_ERROR,
    StiffnessIteration,
    TermMatrices,
    check_terms,
    conjugate_gradients,
    count_steps,
)
from dpl.fem.solvers.parity_factor import OrbitForm
from dpl.fem.solvers.stiffness_terms import StiffnessTerms

REGION = {"core": Sphere([0.0, 0.0, 0.0], 0.7)}
SPRINGS = [RobinBC(Plane(2, 0.0), 0.3)]
FIBRES = FibreReinforced(
    NeoHookeanIsoK2([0.3, 0.45], [0.5, 2.0]),
    Guccione([0.1, 1.0], 8.0, 2.0, 4.0),
    ConstantFibres([1, 1, 0]),
)
LAWS = {  # and the number of terms
    "a core and Poisson's ratio": (
        {"core": NeoHookeanLn(0.3, young=[1, 50]), "other": NeoHookeanLn([0.2, 0.4])},
        3,
    ),
    "two Poisson's ratios": (
        {"core": NeoHookeanLn([0.1, 0.3], [1, 9]), "other": NeoHookeanLn([0.2, 0.4])},
        4,
    ),
    "fibres in an isotropic matrix": (FIBRES, 3),
}
PAIRS = [(name, springs) for name in LAWS for springs in (False, True)]


@pytest.fixture(params=PAIRS, ids=lambda pair: f"{pair[0]}{', springs' if pair[1] else ''}")
def terms(request, grid):
    law, count = LAWS[request.param[0]]
    regions = REGION if isinstance(law, dict) else None
    supports = SPRINGS if request.param[1] else []
    mesh = grid("hexahedron", 3, 0.2, inside=True)
    body = Problem.build(mesh, law, regions=regions, fixed=Plane(0, "min"), supports=supports)
    found = StiffnessTerms.of(body)
    assert len(found) == count
    return found


def dense(body):
    return full_matrix(body.pattern, body.stiffness_at_rest().numpy()).toarray()


def random_parameters(problem, count):
    ranges = problem.parameter_ranges.values()
    random = torch.Generator().manual_seed(5)
    values = torch.rand(count, len(ranges), generator=random, dtype=torch.float64)
    return torch.stack([r.at(t) for r, t in zip(ranges, values.T, strict=True)], dim=1)


def node_body(terms, iteration):
    law = terms.body(torch.tensor(iteration.node, dtype=torch.float64)).material
    return replace(terms.problem.reference, material=law)


def test_condition_numbers_are_at_most_their_bounds(terms):
    iteration = StiffnessIteration.of_terms(terms)
    root = np.linalg.cholesky(dense(node_body(terms, iteration)))
    node = torch.tensor(iteration.node, dtype=torch.float64)
    for own in random_parameters(terms.problem, 4):
        body = terms.problem.with_parameters(own[None])
        half = np.linalg.solve(root, dense(body))
        values = np.linalg.eigvalsh(np.linalg.solve(root, half.T))
        bound = float(terms.condition_numbers(terms.factors(body.material), node))
        assert 1 < values[-1] / values[0] <= bound * (1 + 1e-9)
        assert bound <= iteration.condition * (1 + 1e-9)


def test_matrices_of_the_terms_sum_up_to_the_stiffness_of_each_parity(terms):
    (own,) = random_parameters(terms.problem, 1)
    body = terms.problem.with_parameters(own[None])
    form = OrbitForm.of(body, symmetries(body))
    matrices = TermMatrices.of(terms, form)
    factors = np.append(terms.factors(body.material)[0].numpy(), 1.0)
    columns, entries = matrices.padded()
    padded = torch.einsum("k,kmjw->mjw", torch.from_numpy(factors), entries)
    force = torch.randn(int(body.free.sum()), generator=torch.Generator().manual_seed(0))
    parts = form.parts(force.double())
    every = zip(form.matrices(body), matrices.at(factors), padded, parts, strict=True)
    for exact, own, rows, part in every:
        structure = own, matrices.columns, matrices.first_entry
        product = type(exact)(structure, shape=exact.shape) @ part.numpy()
        expected = exact @ part.numpy()
        size = np.abs(expected).max(initial=1e-300)
        assert np.abs(product - expected).max() < 1e-12 * size
        of_rows = (rows * part[columns]).sum(dim=1).numpy()
        assert np.abs(of_rows - product).max() < 1e-12 * size


def system(size=40, seed=0):
    """Return a random positive definite matrix, one near it, and a force."""
    random = np.random.default_rng(seed)
    factor = random.standard_normal((size, size))
    near = factor @ factor.T + size * np.eye(size)
    return near + np.diag(random.uniform(0, 5 * size, size)), near, random.standard_normal(size)


def csr(matrix):
    size = len(matrix)
    rows, columns = np.arange(size + 1) * size, np.tile(np.arange(size), size)
    return rows.astype(np.int32), columns.astype(np.int32), matrix.ravel().copy()


def blocks_of(matrix):
    from scipy.sparse import csr_array

    points = np.random.default_rng(1).uniform(size=(len(matrix), 3))
    return condense([csr_array(matrix)], points)


def iterated(matrix, near, force, steps):
    blocks, found = blocks_of(near), np.empty_like(force)
    arguments = *blocks.fronts[:2], blocks.values[0], csr(matrix), force, steps, found
    return condensed_iteration(*arguments), found


def test_the_iteration_converges_to_the_solution():
    matrix, near, force = system()
    exact = np.linalg.solve(matrix, force)
    _, found = iterated(matrix, near, force, 40)
    assert np.linalg.norm(found - exact) < 1e-5 * np.linalg.norm(exact)


def test_energies_of_the_steps_sum_up_to_the_error_before_them():
    matrix, near, force = system()
    exact = np.linalg.solve(matrix, force)
    energies, _ = iterated(matrix, near, force, 40)
    for steps in (1, 3, 6):
        error = iterated(matrix, near, force, steps)[1] - exact
        left = energies[steps:].sum() * np.abs(force).max() ** 2
        assert left == pytest.approx(error @ matrix @ error, rel=1e-3)


@pytest.mark.parametrize("steps", [1, 4, 30])
def test_tensor_operations_do_the_same_steps(steps):
    matrix, near, force = system()
    inverse = torch.from_numpy(np.linalg.inv(near))
    product = torch.from_numpy(matrix)
    pair = torch.from_numpy(np.stack([force, np.zeros_like(force)]))
    found = conjugate_gradients(lambda x: x @ product, lambda x: x @ inverse, pair, steps)
    expected = iterated(matrix, near, force, steps)[1]
    assert np.abs(found[0].numpy() - expected).max() < 1e-9 * np.abs(expected).max()
    assert not found[1].any()


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_the_size_of_a_force_does_not_matter(scale):
    matrix, near, force = system()
    one, other = (iterated(matrix, near, size * force, 5)[1] for size in (1.0, scale))
    assert np.abs(other / scale - one).max() < 1e-12 * np.abs(one).max()
    inverse, product = torch.from_numpy(np.linalg.inv(near)), torch.from_numpy(matrix)
    right = torch.from_numpy(scale * force)
    found = conjugate_gradients(lambda x: x @ product, lambda x: x @ inverse, right, 5)
    assert np.abs(found.numpy() / scale - one).max() < 1e-9 * np.abs(one).max()


def test_the_measured_number_of_steps_is_enough_and_no_more_than_the_bound(terms):
    iteration = StiffnessIteration.of_terms(terms)
    form = OrbitForm.of(terms.problem.reference, [])
    node = node_body(terms, iteration)
    blocks, matrices = condense(form.matrices(node), form.points), TermMatrices.of(terms, form)
    steps = count_steps(iteration, terms, form, blocks, matrices)
    assert 1 < steps <= iteration.bound
    random = np.random.default_rng(3)
    for own in random_parameters(terms.problem, 4):
        body = terms.problem.with_parameters(own[None])
        entries = matrices.at(np.append(terms.factors(body.material)[0].numpy(), 1.0))[0]
        matrix, force = form.matrices(body)[0].toarray(), random.standard_normal(len(form.points))
        part = form.parts(torch.from_numpy(force)).numpy()[0]
        found = np.empty_like(part)
        structure = matrices.first_entry, matrices.columns, entries
        condensed_iteration(*blocks.fronts[:2], blocks.values[0], structure, part, steps, found)
        exact = np.linalg.solve(matrix, part)
        error = found - exact
        assert error @ matrix @ error < (2 * MAX_ERROR) ** 2 * (exact @ matrix @ exact)


def test_parameters_that_change_the_stiffness_too_much_are_refused(grid):
    laws = {"core": NeoHookeanLn(0.3, young=[1.0, 1e9]), "other": NeoHookeanLn([0.2, 0.4])}
    body = Problem.build(grid("hexahedron"), laws, regions=REGION, fixed=Plane(0, "min"))
    with pytest.raises(ValueError, match=r"core.young.* takes more than 200 steps.*base=none"):
        check_terms(StiffnessTerms.of(body))


def test_two_terms_are_interpolated_and_never_refused(grid):
    laws = {"core": NeoHookeanLn(0.3, young=[1.0, 1e9]), "other": NeoHookeanLn(0.2)}
    body = Problem.build(grid("hexahedron"), laws, regions=REGION, fixed=Plane(0, "min"))
    terms = StiffnessTerms.of(body)
    assert len(terms) == 2
    check_terms(terms)
