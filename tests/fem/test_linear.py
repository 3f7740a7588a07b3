"""Laws of the sparse solves, for every backend."""

import importlib.util
import pickle
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from dpl.fem import NeoHookeanLn, Plane, Problem, RobinBC, SingularMatrix, box, installed_backends
from dpl.fem.linear import (
    BACKENDS,
    Backend,
    Pattern,
    SymmetricProduct,
    backends,
    conjugate_gradients,
    full_matrix,
    make_backend,
    multigrid_installed,
    select_backend,
)
from dpl.fem.linear.banded import BandedFactor, MixedPrecisionFactor
from dpl.fem.linear.ordering import band_storage
from dpl.system.threads import slow_blas

DIRECT = ["band", "band32", "pardiso", "superlu"]  # those that solve indefinite matrices too
System = tuple[Pattern, np.ndarray]


class Structure(NamedTuple):
    """Pattern of a matrix."""

    size: int
    indptr: np.ndarray
    indices: np.ndarray


@pytest.fixture(params=installed_backends())
def name(request) -> str:
    """Each installed backend."""
    return request.param


@pytest.fixture(params=[name for name in DIRECT if name in installed_backends()])
def direct(request) -> str:
    """Each installed backend that solves indefinite matrices."""
    return request.param


@pytest.fixture
def hide(monkeypatch) -> Callable[..., None]:
    """Function that makes packages look as if they were not installed."""
    find = importlib.util.find_spec

    def hide(*packages: str) -> None:
        monkeypatch.setattr(
            importlib.util, "find_spec", lambda name, *_: None if name in packages else find(name)
        )

    return hide


def system(problem: Problem) -> System:
    """Return the tangent of a body at rest."""
    rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
    return problem.pattern, problem.tangent(rest)[0].numpy()


@pytest.fixture(scope="module")
def body(beam) -> Problem:
    """A beam of 162 degrees of freedom."""
    return beam(NeoHookeanLn(0.3), 6, 2)


@pytest.fixture(scope="module")
def stiffness(body) -> System:
    """The tangent of the beam at rest: positive definite."""
    return system(body)


@pytest.fixture(scope="module")
def shuffled() -> Problem:
    """A beam whose nodes are numbered at random."""
    mesh = box([100.0, 25.0, 25.0], [21, 5, 5])
    order = np.random.default_rng(0).permutation(mesh.p.shape[1])
    mesh = type(mesh)(mesh.p[:, order], np.argsort(order)[mesh.t])
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"))


def dense(matrix: np.ndarray) -> System:
    """Return a full symmetric matrix as a pattern and its entries."""
    n = len(matrix)
    rows, columns = np.triu_indices(n)
    indptr = np.searchsorted(rows, np.arange(n + 1)).astype(np.int32)
    return Structure(n, indptr, columns.astype(np.int32)), matrix[rows, columns]


def of_eigenvalues(values: np.ndarray) -> System:
    """Return a full matrix with these eigenvalues."""
    basis = np.linalg.qr(np.random.default_rng(5).normal(size=(len(values),) * 2))[0]
    return dense(basis * values @ basis.T)


def of_band(size: int, half: int) -> Structure:
    """Return the pattern of a full band."""
    columns = np.arange(size)[:, None] + np.arange(half + 1)
    indptr = np.cumsum([0, *(columns < size).sum(axis=1)]).astype(np.int32)
    return Structure(size, indptr, columns[columns < size].astype(np.int32))


def shifted(pattern: Pattern, values: np.ndarray, shift: float) -> np.ndarray:
    """Return the entries of K - shift I."""
    moved = values.copy()
    moved[pattern.indptr[:-1]] -= shift
    return moved


def error(solver: Backend, pattern: Pattern, values: np.ndarray) -> float:
    """Return the relative error of a solve with a known solution."""
    answer = np.random.default_rng(0).normal(size=pattern.size)
    found = solver.factorise(values).solve(full_matrix(pattern, values) @ answer)
    return float(np.linalg.norm(found - answer) / np.linalg.norm(answer))


def residual(pattern: Pattern, values: np.ndarray, x: np.ndarray, right: np.ndarray) -> float:
    """Return ||right - K x|| / ||right||."""
    rest = right - full_matrix(pattern, values) @ x
    return float(np.linalg.norm(rest) / np.linalg.norm(right))


def test_many_right_hand_sides_are_solved_like_one(name, stiffness):
    pattern, values = stiffness
    factor = make_backend(pattern, name).factorise(values)
    right = np.random.default_rng(0).standard_normal((5, pattern.size))
    right[1] = 0
    right[2] *= 1e-200
    for row, one in zip(factor.solve_many(right), right, strict=True):
        assert np.abs(row - factor.solve(one)).max() <= 1e-10 * np.abs(row).max()


@pytest.mark.parametrize("half", [0, 1, 40, 100])
def test_blocks_of_a_banded_factor_solve_in_single_precision(half):
    random = np.random.default_rng(0)
    lower = random.uniform(-1, 1, (150, half + 1)).astype(np.float32)
    lower[:, 0] = half + 2
    for k in range(half + 1):
        lower[150 - k :, k] = 0
    factor = BandedFactor(lower, np.arange(150))
    right = random.standard_normal((3, 150))
    for row, one in zip(factor.solve_many(right), right, strict=True):
        assert np.abs(row - factor.solve(one)).max() <= 1e-5 * np.abs(row).max()


def test_conjugate_gradients_detect_indefinite_matrices(body):
    """By a solve with a random right-hand side, which has a component along every eigenvector."""
    pattern, values = system(body)
    eigenvalues = np.linalg.eigvalsh(full_matrix(pattern, values).toarray())
    for near_null in (None, body.near_null):
        solver = make_backend(pattern, "cg", near_null)
        assert solver.factorise(values).stability == 0
        for count in (1, 3):
            moved = shifted(pattern, values, eigenvalues[count - 1] * 1.01)
            assert solver.factorise(moved).stability == 1
        with pytest.raises(SingularMatrix, match="not positive definite"):
            solver.factorise(moved).solve(np.ones(pattern.size))


def test_indefinite_matrix_is_solved_and_its_negative_eigenvalues_are_counted(direct, stiffness):
    """Sylvester's law of inertia, against the eigenvalues."""
    pattern, values = stiffness
    eigenvalues = np.linalg.eigvalsh(full_matrix(pattern, values).toarray())
    solver = make_backend(pattern, direct)
    for count in (1, 2, 5, 20):
        shift = eigenvalues[count - 1 : count + 1].mean()
        if eigenvalues[count] - eigenvalues[count - 1] < 1e-6 * shift:
            continue  # a pair: no matrix with this many
        moved = shifted(pattern, values, shift)
        assert solver.factorise(moved).negative_pivots == count
        assert error(solver, pattern, moved) < 1e-10
    assert eigenvalues[2] - eigenvalues[1] > 1e-3 * eigenvalues[2]  # count = 2 has run


def test_positive_definite_matrices_are_solved_to_rounding(name, stiffness):
    """One after another: only the symbolic work is shared."""
    pattern, values = stiffness
    solver = make_backend(pattern, name)
    for scale in (1.0, 1e-6, 1e6):
        assert error(solver, pattern, scale * values) < 1e-10
        factor = solver.factorise(scale * values)
        assert factor.negative_pivots == (None if name == "cg" else 0)


def test_factor_stays_valid_after_the_next_factorisation(name, stiffness):
    pattern, values = stiffness
    solver, right = make_backend(pattern, name), np.ones(pattern.size)
    entries = values.copy()
    first = solver.factorise(entries)
    expected = first.solve(right)
    second = solver.factorise(2 * values)
    entries[:] = np.nan
    assert np.array_equal(first.solve(right), expected)
    assert second.solve(right) == pytest.approx(expected / 2, rel=1e-9)
    assert np.array_equal(first.solve(right), expected)


def test_a_solve_changes_no_argument_and_takes_strides(name, stiffness):
    pattern, values = stiffness
    many = np.random.default_rng(0).standard_normal((pattern.size, 3))
    kept, factor = values.copy(), make_backend(pattern, name).factorise(values)
    for right in (np.ones(pattern.size), many[:, 1], many[::-1, 0]):
        given = right.copy()
        first, second = factor.solve(right), factor.solve(right)
        assert np.array_equal(right, given)
        assert np.array_equal(first, second)
        assert factor.solve(given) == pytest.approx(first, rel=1e-9)
    assert np.array_equal(values, kept)


def test_matrix_that_is_not_finite_is_an_error(name, stiffness):
    pattern, values = stiffness
    solver = make_backend(pattern, name)
    for place, entry in ((7, np.nan), (7, np.inf), (0, np.nan), (0, np.inf)):
        broken = values.copy()
        broken[place] = entry
        with pytest.raises(SingularMatrix, match="finite"):
            solver.factorise(broken)
    assert error(solver, pattern, values) < 1e-10, "it solves the next one"


MATRIX = np.random.default_rng(1).normal(size=(6, 6))
SINGULAR = {
    "zero": np.zeros((6, 6)),
    "a zero row and column": (MATRIX + MATRIX.T) * np.outer(np.arange(6) != 2, np.arange(6) != 2),
    "rank one": np.outer(MATRIX[0], MATRIX[0]),
}


@pytest.mark.parametrize("kind", SINGULAR)
def test_singular_matrix_is_an_error(name, kind):
    """Conjugate gradients find it when they solve."""
    pattern, values = dense(SINGULAR[kind])

    def attempt() -> None:
        factor = make_backend(pattern, name).factorise(values)
        if name == "cg":
            factor.solve(np.ones(6))

    with pytest.raises(SingularMatrix):
        attempt()


def test_backend_survives_pickling_before_and_after_its_use(name, stiffness):
    pattern, values = stiffness
    solver = make_backend(pattern, name)
    for _ in range(2):
        solver = pickle.loads(pickle.dumps(solver))
        assert error(solver, pattern, values) < 1e-10


def needs_multigrid(name: str) -> None:
    """Skip where conjugate gradients have the diagonal preconditioner, a poor inverse."""
    if name == "cg" and not multigrid_installed():
        pytest.skip("pyamg is not installed")


NEAR = {"band32": 1e-2, "cg": 0.99}  # how far an applied factor may be from K^-1; others: rounding


@pytest.mark.parametrize("scale", [1.0, 1e-6, 1e6])
def test_applied_factor_is_symmetric_positive_definite_and_near_the_inverse(
    name, body, stiffness, scale
):
    needs_multigrid(name)
    pattern, values = stiffness
    factor = make_backend(pattern, name, body.near_null).factorise(scale * values)
    applied = np.stack([factor.apply(column) for column in np.eye(pattern.size)], axis=1)
    symmetric = (applied + applied.T) / 2
    rounding = 1e-5 if name == "band32" else 1e-12
    assert np.abs(applied - applied.T).max() < rounding * np.abs(applied).max()
    assert np.linalg.eigvalsh(symmetric)[0] > 0
    root = np.linalg.cholesky(full_matrix(pattern, scale * values).toarray())
    spread = np.linalg.eigvalsh(root.T @ symmetric @ root)  # the eigenvalues of M K
    assert np.abs(spread - 1).max() < NEAR.get(name, 1e-8)


def test_the_preconditioner_without_multigrid_is_the_diagonal(stiffness):
    pattern, values = stiffness
    applied = make_backend(pattern, "cg").factorise(values).apply(np.ones(pattern.size))
    assert np.allclose(applied, 1 / values[pattern.indptr[:-1]], rtol=1e-14, atol=0)


def test_applied_factor_is_a_fixed_linear_map(name, body, stiffness):
    """It depends on no solve or factorisation between, and does not change its argument."""
    pattern, values = stiffness
    solver = make_backend(pattern, name, body.near_null)
    factor = solver.factorise(values)
    one, other = np.random.default_rng(0).normal(size=(2, pattern.size))
    kept, first = one.copy(), factor.apply(one)
    size = np.abs(first).max()
    solver.factorise(2 * values).solve(other)
    factor.solve(other)
    assert np.array_equal(one, kept)
    assert np.array_equal(factor.apply(one), first)
    both = factor.apply(2 * one - 3 * other)
    rounding = 1e-4 if name == "band32" else 1e-12
    assert np.abs(both - 2 * first + 3 * factor.apply(other)).max() < rounding * size
    assert not factor.apply(np.zeros(pattern.size)).any()
    for scale in (1e-300, 1e100):
        assert np.abs(factor.apply(scale * one) / scale - first).max() < 1e-5 * size


def test_factor_of_a_near_tangent_is_a_preconditioner(name, body, stiffness, bend):
    """Conjugate gradients with the factor of another tangent take few steps."""
    needs_multigrid(name)
    pattern, values = stiffness
    solver = make_backend(pattern, name, body.near_null)
    moved = 0.1 * bend(body.points) * body.points[:, :1]  # held where the body is
    other = body.tangent(moved)[0].numpy()
    assert np.abs(other - values).max() > 1e-3 * np.abs(values).max()
    near, product = solver.factorise(values), SymmetricProduct(pattern, other)
    right = np.random.default_rng(0).normal(size=pattern.size)
    x = conjugate_gradients(product, near.apply, right, 1e-3, 25 if name == "cg" else 8)
    assert residual(pattern, other, x, right) < 1.01e-3


def of_contrast(contrast: float) -> Problem:
    """Return a beam with springs under its end that are stiffer than it is, or softer."""
    mesh = box([100.0, 25.0, 25.0], [9, 3, 3])
    spring = RobinBC(Plane(0, "max"), stiffness=contrast / 100.0)
    return Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min"), supports=[spring])


@pytest.mark.parametrize("contrast", [1e-6, 1e9])
def test_stiffnesses_far_apart_are_solved_to_rounding(direct, contrast):
    """Without iterative refinement."""
    pattern, values = system(of_contrast(contrast))
    right = np.random.default_rng(0).normal(size=pattern.size)
    x = make_backend(pattern, direct).factorise(values).solve(right)
    assert residual(pattern, values, x, right) < 1e-10
    expected = np.linalg.solve(full_matrix(pattern, values).toarray(), right)
    assert np.linalg.norm(x - expected) < 1e-9 * np.linalg.norm(expected)


# ---- bands


def test_bandwidth_of_a_shuffled_mesh_is_reduced(shuffled):
    pattern, values = system(shuffled)
    layout = band_storage(pattern)
    own = (pattern.indices - np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))).max()
    assert sorted(layout.order) == list(range(pattern.size))
    assert layout.half < own / 4
    assert layout.half <= 3 * 2 * 25  # two layers of nodes
    for name in ("band", "band32"):
        assert error(make_backend(pattern, name), pattern, values) < 1e-10


def test_narrow_numbering_is_kept(stiffness):
    pattern, _ = stiffness
    layout = band_storage(pattern)
    assert np.array_equal(layout.order, np.arange(pattern.size))
    assert layout.half == 3 * (9 + 3 + 1) + 2  # a node's farthest neighbour, its last component


def test_float32_covers_stiff_and_soft_unknowns(stiffness):
    """Demmel (1989): diagonal scaling changes nothing in the rounding of Cholesky."""
    pattern, values = stiffness
    scale = 10 ** np.random.default_rng(4).uniform(-12, 12, pattern.size)
    rows = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    scaled = values * scale[rows] * scale[pattern.indices]
    factor = make_backend(pattern, "band32").factorise(scaled)
    right = scale * np.random.default_rng(0).normal(size=pattern.size)
    assert residual(pattern, scaled, factor.solve(right), right) < 1e-11
    assert isinstance(factor, MixedPrecisionFactor)
    assert factor.exact is None


@pytest.mark.parametrize("smallest", [1e-6, 1e-9, -1e-9, 1e-12])
def test_nearly_singular_matrix_is_solved_in_float64(smallest):
    pattern, values = of_eigenvalues(np.array([smallest, *np.linspace(1, 2, 40)]))
    right = np.random.default_rng(0).normal(size=pattern.size)
    factor = make_backend(pattern, "band32").factorise(values)
    x = factor.solve(right)
    exact = np.linalg.solve(full_matrix(pattern, values).toarray(), right)
    assert np.linalg.norm(x - exact) < 1e-15 / abs(smallest) * 100 * np.linalg.norm(exact)
    assert factor.negative_pivots == (smallest < 0)


# ---- iterations


@pytest.mark.parametrize("name", ["band32", "cg"])
def test_iteration_stops_at_the_tolerance(name, shuffled, monkeypatch):
    pattern, values = system(shuffled)
    factor = make_backend(pattern, name, shuffled.near_null).factorise(values)
    products, multiply = [], SymmetricProduct.__call__

    def counted(self, x):
        products.append(1)
        return multiply(self, x)

    monkeypatch.setattr(SymmetricProduct, "__call__", counted)
    right, costs = np.random.default_rng(0).normal(size=pattern.size), []
    for rtol in (1e-1, 1e-5, 1e-11):
        products.clear()
        x = factor.solve(right, rtol=rtol)
        costs.append(len(products))
        assert residual(pattern, values, x, right) <= 1.01 * rtol
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]


def test_iteration_that_does_not_converge_is_an_error(stiffness):
    product = SymmetricProduct(*stiffness)
    right = np.ones(len(product.diagonal))
    with pytest.raises(SingularMatrix, match="no convergence to 1e-12 in 3"):
        conjugate_gradients(product, lambda r: r, right, 1e-12, 3)


def test_rigid_body_modes_have_no_energy(body):
    """On a body without supports."""
    free = Problem.build(box([100.0, 25.0, 25.0], [5, 3, 3]), NeoHookeanLn(0.3))
    pattern, values = system(free)
    fields = free.near_null
    assert np.linalg.matrix_rank(fields) == fields.shape[1] == 6
    forces = full_matrix(pattern, values) @ fields
    assert np.abs(forces).max() < 1e-12 * np.abs(values).max()
    assert body.near_null.shape == (body.pattern.size, 6)


def test_multigrid_takes_few_iterations_on_a_large_body(beam):
    """Smoothed aggregation, Vanek, Mandel, Brezina (1996)."""
    pytest.importorskip("pyamg")
    problem = beam(NeoHookeanLn(0.3), 32, 8)
    pattern, values = system(problem)
    factor = make_backend(pattern, "cg", problem.near_null).factorise(values)
    right = np.random.default_rng(0).normal(size=pattern.size)
    x = conjugate_gradients(factor.product, factor.precondition, right, 1e-8, 29)
    assert residual(pattern, values, x, right) < 1e-7


def test_multigrid_works_with_sliding_supports():
    """Nodes then have different numbers of unknowns."""
    pytest.importorskip("pyamg")
    mesh = box([1.0, 1.0, 1.0], [6, 6, 6])
    held = mesh.p.T == 0  # each side slides on its plane
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=held)
    pattern, values = system(problem)
    assert error(make_backend(pattern, "cg", problem.near_null), pattern, values) < 1e-10


def test_multigrid_draws_no_random_numbers(body):
    """Its result is therefore reproducible."""
    pytest.importorskip("pyamg")
    pattern, values = system(body)
    np.random.seed(3)  # noqa: NPY002  the global state is what must stay
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    right = np.ones(pattern.size)
    first, second = (
        make_backend(pattern, "cg", body.near_null).factorise(values).solve(right) for _ in range(2)
    )
    assert np.random.random() == expected  # noqa: NPY002
    assert np.array_equal(first, second)


# ---- the choice


SLENDER, LONG, WIDE = of_band(2000, 20), of_band(3200, 255), of_band(800, 400)
FIELDS, PARDISO = np.ones((800, 6)), "pardiso" in installed_backends()
NARROW = of_band(800, 40)
NONE = ("pypardiso", "pyamg")
PYAMG = multigrid_installed()
CHOICES = [  # pattern, rigid-body modes, many right-hand sides, packages that are hidden, backend
    (SLENDER, None, False, (), "band"),
    (LONG, None, False, (), "band32"),
    (LONG, None, False, NONE, "band32"),
    (LONG, None, True, (), "band"),
    (LONG, None, True, NONE, "band"),
    (WIDE, None, False, (), "pardiso" if PARDISO else "superlu"),
    (WIDE, None, False, ("pypardiso",), "superlu"),
    (NARROW, FIELDS, False, (), "band"),
    (WIDE, FIELDS, False, ("pyamg",), "pardiso" if PARDISO else "superlu"),
    (WIDE, FIELDS, False, (), "cg" if PYAMG else "pardiso" if PARDISO else "superlu"),
    (WIDE, FIELDS, True, (), "pardiso" if PARDISO else "superlu"),  # up to three times the size
    (None, None, False, (), "auto"),
]


@pytest.mark.parametrize(("pattern", "fields", "many", "hidden", "expected"), CHOICES)
def test_a_backend_suits_the_body(hide, pattern, fields, many, hidden, expected, monkeypatch):
    """Bands of slender bodies, factors of compact ones, in float64 for many right-hand sides."""
    monkeypatch.setattr(backends, "MULTIGRID", {"pardiso": 799, "superlu": 799})
    hide(*hidden)
    assert select_backend("auto", pattern, fields, many_rhs=many) == expected
    assert [select_backend(name) for name in installed_backends()] == installed_backends()


def test_superlu_replaces_pardiso_where_that_is_not_installed(hide, stiffness):
    pattern, values = stiffness
    hide("pypardiso")
    assert installed_backends() == [name for name in BACKENDS if name != "pardiso"]
    moved = shifted(pattern, values, 2 * np.abs(values).max())
    factor = make_backend(pattern, "band").factorise(moved)
    assert type(factor).__name__ == "SuperLUFactor"
    assert factor.negative_pivots > 0


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pardiso", r"not installed: pip install .*\[pardiso\]"),
        ("umfpack", r"linear = 'umfpack' must be one of auto, band, band32, pardiso"),
    ],
)
def test_a_backend_that_cannot_be_had_is_refused_by_name(hide, stiffness, name, message):
    hide("pypardiso")
    with pytest.raises(ValueError, match=message):
        make_backend(stiffness[0], name)


def test_full_matrix_and_product_mirror_the_upper_triangle(stiffness):
    pattern, values = stiffness
    matrix, x = full_matrix(pattern, values), np.random.default_rng(0).normal(size=pattern.size)
    assert abs(matrix - matrix.T).max() == 0
    upper = csr_array((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    assert np.array_equal(np.triu(matrix.toarray()), upper.toarray())
    assert SymmetricProduct(pattern, values)(x) == pytest.approx(matrix @ x, rel=1e-12)


# ---- the library below


@pytest.mark.parametrize(
    ("flags", "kernels", "advice"),
    [
        ("sse avx avx2", "Prescott", "OPENBLAS_CORETYPE=Haswell"),
        ("sse avx avx2 avx512dq", "Nehalem", "OPENBLAS_CORETYPE=SkylakeX"),
        ("sse avx avx2", "Haswell", None),
        ("sse", "Prescott", None),
    ],
)
def test_slow_kernels_on_a_fast_cpu_are_reported(monkeypatch, tmp_path, flags, kernels, advice):
    (tmp_path / "cpuinfo").write_text(f"processor : 0\nflags : {flags}\n")
    library = {"internal_api": "openblas", "architecture": kernels}
    monkeypatch.delenv("OPENBLAS_CORETYPE", raising=False)
    monkeypatch.setattr("dpl.system.threads.CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(
        "dpl.system.threads.threadpool_info", lambda: [{"internal_api": "mkl"}, library]
    )
    said = slow_blas()
    assert said is None if advice is None else advice in said
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Prescott")  # what the user has set is meant
    assert slow_blas() is None
