"""K(0) as a sum of terms, and conjugate gradients from the inverse of K(0) for one parameter."""

import numpy as np
import pytest
import torch

from dpl import fem
from dpl.fem import NeoHookeanLn
from dpl.fem.linear.interface import full_matrix
from dpl.fem.linear.krylov import conjugate_gradients, conjugate_gradients_of_tensors
from dpl.fem.solvers.parity_factor import OrbitForm, TermMatrices
from dpl.fem.solvers.stiffness_terms import MAX_ERROR, StiffnessTerms

FIXED, RANGED_LAW = NeoHookeanLn(0.3), NeoHookeanLn([0.2, 0.4])
REGION = {"core": fem.Sphere([0.0, 0.0, 0.0], 0.7)}
SPRINGS = [fem.RobinBC(fem.Plane(2, 0.0), 0.3)]
FIBRES = fem.FibreReinforced(
    fem.VolumetricK2([1.0, 3.0]),
    fem.Guccione([0.1, 1.0], 8.0, 2.0, 4.0),
    fem.ConstantFibres([1, 1, 0]),
)


def regions(core, other):
    return {"core": core, "other": other}


LAWS = {  # and the number of terms
    "Poisson's ratio": (NeoHookeanLn([0.1, 0.45]), 2),
    "a stiff core": (regions(NeoHookeanLn(0.3, [1, 100]), NeoHookeanLn(0.4)), 2),
    "moduli of Yeoh's law": (regions(fem.YeohK2([0.1, 0.4], 0.0, 0.0, 3.0), FIXED), 2),
    "a core and Poisson's ratio": (regions(NeoHookeanLn(0.3, [1, 50]), RANGED_LAW), 3),
    "two Poisson's ratios": (regions(NeoHookeanLn([0.1, 0.3], [1, 9]), RANGED_LAW), 4),
    "fibres in an isotropic matrix": (regions(FIBRES, FIXED), 3),
    "no range": (regions(FIXED, FIXED), 1),
    "one ratio of stiffnesses": (
        regions(NeoHookeanLn(0.3, [1, 9]), NeoHookeanLn(0.2, [1, 9])),
        2,
    ),
}
RANGED = list(LAWS)[:6]
PAIRS = [(name, number % 2 == 1) for number, name in enumerate(RANGED)]
PAIRS += [("Poisson's ratio", True)]


def terms_of(grid, name, supports=(), count=2, **shape):
    """Return the terms of K(0) of a cube."""
    law, number = LAWS[name]
    mesh, where = grid("hexahedron", count, **shape), REGION if isinstance(law, dict) else {}
    held = fem.Plane(0, "min")
    body = fem.Problem.build(mesh, law, regions=where, fixed=held, supports=supports)
    found = StiffnessTerms.of(body)
    assert len(found) == number
    return found


@pytest.fixture(params=PAIRS, ids=lambda pair: f"{pair[0]}{', springs' if pair[1] else ''}")
def terms(request, grid):
    name, has_springs = request.param
    supports = SPRINGS if has_springs else ()
    return terms_of(grid, name, supports, 3, shaken=0.2, inside=True)


def dense(body):
    return full_matrix(body.pattern, body.stiffness_at_rest().numpy()).toarray()


def random_parameters(problem, count):
    ranges = problem.parameter_ranges.values()
    random = torch.Generator().manual_seed(5)
    values = torch.rand(count, len(ranges), generator=random, dtype=torch.float64)
    return torch.stack([r.at(t) for r, t in zip(ranges, values.T, strict=True)], dim=1)


def test_condition_numbers_are_at_most_their_bounds(terms):
    root = np.linalg.cholesky(dense(terms.node_body))
    for own in random_parameters(terms.problem, 4):
        body = terms.problem.with_parameters(own[None])
        half = np.linalg.solve(root, dense(body))
        values = np.linalg.eigvalsh(np.linalg.solve(root, half.T))
        bound = float(terms.condition_numbers(terms.factors(body.material), terms.node))
        assert 1 < values[-1] / values[0] <= bound * (1 + 1e-9)
        assert bound <= terms.condition * (1 + 1e-9)


def test_matrices_of_the_terms_sum_up_to_the_stiffness_of_each_parity(terms):
    body, random = terms.problem.reference, np.random.default_rng(0)
    form = OrbitForm.of(body, fem.symmetries(body))
    matrices = TermMatrices.of(terms, form)
    factors = np.append(terms.factors(body.material)[0].numpy(), 1.0)
    parts = form.parts(torch.from_numpy(random.standard_normal(int(body.free.sum())))).numpy()
    pairs = zip(form.matrices(body), parts, strict=True)
    expected = np.concatenate([matrix @ part for matrix, part in pairs])
    columns, entries = matrices.padded()
    rows = torch.einsum("k,knw->nw", torch.from_numpy(factors), entries)
    padded = (rows * torch.from_numpy(parts.ravel())[columns]).sum(dim=1).numpy()
    for product in (matrices.at(factors) @ parts.ravel(), padded):
        assert np.abs(product - expected).max() < 1e-12 * np.abs(expected).max()


def test_the_error_of_every_force_and_parameter_is_small_after_at_most_the_steps(terms):
    """The steps stop by the norm of the preconditioner, the error is in the energy norm."""
    random = np.random.default_rng(3)
    near = np.linalg.inv(dense(terms.node_body))
    for own in random_parameters(terms.problem, 4):
        matrix = dense(terms.problem.with_parameters(own[None]))
        point = np.zeros(len(matrix))
        point[random.integers(len(point))] = 1.0
        for force in (point, random.standard_normal(len(matrix))):
            exact = np.linalg.solve(matrix, force)
            ends = terms.rtol, 2 * terms.bound
            found = conjugate_gradients(matrix.dot, near.dot, force, *ends, natural=True)
            error = found - exact
            assert error @ matrix @ error < MAX_ERROR**2 * (exact @ matrix @ exact)


@pytest.mark.parametrize(
    ("law", "kept"),
    [
        (NeoHookeanLn([0.3, 0.3001]), 2),
        (NeoHookeanLn([0.29, 0.31]), 4),
        (RANGED_LAW, 9),
        (NeoHookeanLn([0.2, 0.44]), 8),
        (regions(NeoHookeanLn(0.3, [1, 3]), NeoHookeanLn(0.2, [1, 2])), 8),
    ],
    ids=str,
)
def test_the_error_of_interpolated_inverses_is_small_for_every_force_and_parameter(grid, law, kept):
    where = REGION if isinstance(law, dict) else {}
    mesh = grid("hexahedron", 3, shaken=0.2, inside=True)
    terms = StiffnessTerms.of(
        fem.Problem.build(mesh, law, regions=where, fixed=fem.Plane(0, "min"))
    )
    inverses = np.stack([np.linalg.inv(dense(body)) for body in terms.kept_bodies])
    assert len(inverses) == kept
    ends = torch.tensor(list(terms.problem.parameter_ranges.values())).double().T
    for own in torch.cat([random_parameters(terms.problem, 8), ends]):
        body = terms.problem.with_parameters(own[None])
        weights = terms.weights(terms.factors(body.material))[0].numpy()
        assert np.count_nonzero(weights) <= 4
        root = np.linalg.cholesky(dense(body))
        found = root.T @ np.tensordot(weights, inverses, 1) @ root
        assert np.abs(np.linalg.eigvalsh(found) - 1).max() <= MAX_ERROR


def test_wide_ranges_three_terms_and_foundations_need_conjugate_gradients(grid):
    kinds = [("a stiff core", ()), ("a core and Poisson's ratio", ()), ("Poisson's ratio", SPRINGS)]
    for name, supports in kinds:
        terms = terms_of(grid, name, supports)
        assert terms.has_steps
        assert terms.kept_bodies == [terms.node_body]


def system(size=40, seed=0):
    """Return a random positive definite matrix, the inverse of one near it, and a force."""
    random = np.random.default_rng(seed)
    factor = random.standard_normal((size, size))
    near = factor @ factor.T + size * np.eye(size)
    matrix = near + np.diag(random.uniform(0, 5 * size, size))
    return matrix, np.linalg.inv(near), random.standard_normal(size)


def by_tensors(matrix, inverse, right, rtol, steps=60):
    matrix, inverse, right = map(torch.from_numpy, (matrix, inverse, right))
    maps = (lambda x: x @ matrix), (lambda x: x @ inverse)
    return conjugate_gradients_of_tensors(*maps, right, rtol, steps).numpy()


@pytest.mark.parametrize(("rtol", "scale"), [(1e-2, 1e200), (1e-5, 1.0), (1e-10, 1e-200)])
def test_tensor_operations_do_the_steps_of_arrays_for_forces_of_any_size(rtol, scale):
    matrix, inverse, force = system()
    exact = scale * np.linalg.solve(matrix, force)
    pair = scale * np.stack([force, np.zeros_like(force)])
    found = by_tensors(matrix, inverse, pair, rtol)
    same = conjugate_gradients(matrix.dot, inverse.dot, pair[0], rtol, 60, natural=True)
    assert np.abs(found[0] - same).max() < 1e-9 * np.abs(exact).max()
    assert np.abs(found[0] - exact).max() < 10 * rtol * np.abs(exact).max()
    assert not found[1].any()


def test_fewer_steps_than_the_tolerance_needs_are_all_that_are_taken():
    matrix, inverse, force = system()
    errors = [
        np.abs(by_tensors(matrix, inverse, force, 0.0, k) - np.linalg.solve(matrix, force)).max()
        for k in (0, 1, 4, 8, 16)
    ]
    assert errors == sorted(errors, reverse=True)


def test_a_law_without_ranges_needs_no_iteration(grid):
    found = terms_of(grid, "no range")
    assert not found.varies
    assert (found.condition, found.bound) == (1.0, 1)


@pytest.mark.parametrize("name", LAWS)
def test_stiffness_is_the_sum_of_its_terms(grid, name):
    terms = terms_of(grid, name)
    body = terms.problem.reference
    parts = [one.stiffness_at_rest() for one in terms.bodies]
    found = (terms.factors(body.material)[0, :, None] * torch.stack(parts)).sum(dim=0)
    expected = body.stiffness_at_rest()
    assert (found - expected).abs().max() < 1e-12 * expected.abs().max()
