"""Laws of the sparse solves: every backend answers, counts and refuses alike."""

import importlib.util
import pickle

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from dpl.fem.linear import Backend, SingularMatrix, backend, full_matrix, installed
from dpl.fem.materials import NeoHookean
from dpl.fem.problem import Pattern

KNOWN = ["pardiso", "superlu"]


@pytest.fixture(params=KNOWN)
def name(request) -> str:
    """Each backend that is installed here."""
    if request.param not in installed():
        pytest.skip(f"{request.param} is not installed")
    return request.param


@pytest.fixture(scope="module")
def stiffness(beam) -> tuple[Pattern, np.ndarray]:
    """The tangent of the beam at rest: positive definite."""
    problem = beam(NeoHookean(0.3), 6, 2)
    rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
    return problem.pattern, problem.tangent(rest)[0].numpy()


def dense(matrix: np.ndarray) -> tuple[Pattern, np.ndarray]:
    """Return a full symmetric matrix as a pattern and its entries."""
    n = len(matrix)
    rows, columns = np.triu_indices(n)
    indptr = np.searchsorted(rows, np.arange(n + 1)).astype(np.int32)
    none = torch.zeros(0, dtype=torch.int64)
    return Pattern(n, indptr, columns.astype(np.int32), none, none), matrix[rows, columns]


def shifted(pattern: Pattern, values: np.ndarray, shift: float) -> np.ndarray:
    """Return the entries of K - shift I."""
    moved = values.copy()
    moved[pattern.indptr[:-1]] -= shift
    return moved


def error(solver: Backend, pattern: Pattern, values: np.ndarray) -> float:
    """Return the relative error of a solve whose answer is known."""
    answer = np.random.default_rng(0).normal(size=pattern.size)
    found = solver.factorise(values).solve(full_matrix(pattern, values) @ answer)
    return float(np.linalg.norm(found - answer) / np.linalg.norm(answer))


def test_positive_definite_matrix_is_solved_to_rounding(name, stiffness):
    pattern, values = stiffness
    solver = backend(pattern, name)
    assert error(solver, pattern, values) < 1e-10
    assert solver.factorise(values).negative_pivots == 0


def test_indefinite_matrix_is_solved_and_its_negative_eigenvalues_are_counted(name, stiffness):
    """Sylvester's law of inertia, against the eigenvalues."""
    pattern, values = stiffness
    eigenvalues = np.linalg.eigvalsh(full_matrix(pattern, values).toarray())
    solver = backend(pattern, name)
    for count in (1, 2, 5, 20):
        shift = eigenvalues[count - 1 : count + 1].mean()
        if eigenvalues[count] - eigenvalues[count - 1] < 1e-6 * shift:
            continue  # a pair: no matrix with this many
        moved = shifted(pattern, values, shift)
        assert solver.factorise(moved).negative_pivots == count
        assert error(solver, pattern, moved) < 1e-10
    assert eigenvalues[2] - eigenvalues[1] > 1e-3 * eigenvalues[2]  # count = 2 has run


def test_backend_serves_matrix_after_matrix(name, stiffness):
    """The symbolic work is shared; the numbers must not be."""
    pattern, values = stiffness
    solver = backend(pattern, name)
    for scale in (1.0, 1e-6, 1e6):
        assert error(solver, pattern, scale * values) < 1e-10


def test_right_hand_side_stays_as_it_is(name, stiffness):
    pattern, values = stiffness
    right = np.ones(pattern.size)
    kept = values.copy()
    factor = backend(pattern, name).factorise(values)
    first, second = factor.solve(right), factor.solve(right)
    assert (right == 1).all()
    assert np.array_equal(values, kept)
    assert np.array_equal(first, second)


@pytest.mark.parametrize("entry", [np.nan, np.inf])
def test_matrix_that_is_not_finite_is_an_error(name, stiffness, entry):
    pattern, values = stiffness
    broken = values.copy()
    broken[7] = entry
    with pytest.raises(SingularMatrix, match="finite"):
        backend(pattern, name).factorise(broken)


MATRIX = np.random.default_rng(1).normal(size=(6, 6))
SINGULAR = {
    "zero": np.zeros((6, 6)),
    "a zero row and column": (MATRIX + MATRIX.T) * np.outer(np.arange(6) != 2, np.arange(6) != 2),
    "rank one": np.outer(MATRIX[0], MATRIX[0]),
}


@pytest.mark.parametrize("kind", SINGULAR)
def test_singular_matrix_is_an_error(name, kind):
    pattern, values = dense(SINGULAR[kind])
    with pytest.raises(SingularMatrix):
        backend(pattern, name).factorise(values)


def test_backend_recovers_from_a_matrix_it_refused(name, stiffness):
    pattern, values = stiffness
    solver = backend(pattern, name)
    with pytest.raises(SingularMatrix):
        solver.factorise(np.full_like(values, np.nan))
    assert error(solver, pattern, values) < 1e-10


@pytest.mark.parametrize("used", [False, True])
def test_backend_survives_pickling(name, stiffness, used):
    pattern, values = stiffness
    solver = backend(pattern, name)
    if used and name == "superlu":
        solver._plan  # noqa: B018  the analysis
    elif used:
        solver.factorise(values)
    assert error(pickle.loads(pickle.dumps(solver)), pattern, values) < 1e-10


def test_backends_agree(stiffness):
    if len(installed()) < 2:
        pytest.skip("one backend alone")
    pattern, values = stiffness
    right = np.random.default_rng(2).normal(size=pattern.size)
    first, second = (backend(pattern, name).factorise(values).solve(right) for name in KNOWN)
    assert first == pytest.approx(second, rel=1e-9, abs=1e-12 * np.abs(first).max())


def hide_pardiso(monkeypatch) -> None:
    """Make pypardiso look like a package that is not installed."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *_: None if name == "pypardiso" else find(name)
    )


def test_superlu_stands_in_where_pardiso_is_not_installed(monkeypatch, stiffness):
    pattern, values = stiffness
    hide_pardiso(monkeypatch)
    assert installed() == ["superlu"]
    solver = backend(pattern)
    assert type(solver).__name__ == "SuperLU"
    assert error(solver, pattern, values) < 1e-10


def test_backend_that_is_not_installed_is_an_error_that_says_how_to_get_it(monkeypatch, stiffness):
    hide_pardiso(monkeypatch)
    with pytest.raises(ValueError, match=r"not installed: pip install 'deepphysics\[pardiso\]'"):
        backend(stiffness[0], "pardiso")


def test_unknown_backend_is_an_error_that_names_the_known(stiffness):
    with pytest.raises(ValueError, match=r"linear = 'umfpack' must be auto, superlu or pardiso"):
        backend(stiffness[0], "umfpack")


def test_fastest_backend_comes_first():
    found = [name for name in KNOWN if name == "superlu" or importlib.util.find_spec("pypardiso")]
    assert installed() == found


def test_full_matrix_mirrors_the_upper_triangle(stiffness):
    pattern, values = stiffness
    matrix = full_matrix(pattern, values)
    assert abs(matrix - matrix.T).max() == 0
    upper = csr_array((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    assert np.array_equal(np.triu(matrix.toarray()), upper.toarray())
    random = np.random.default_rng(3).normal(size=(5, 5))
    symmetric = random + random.T
    assert np.array_equal(full_matrix(*dense(symmetric)).toarray(), symmetric)
