"""Selection of the backend that solves K x = r with sparse symmetric tangents.

A backend object does the symbolic work (ordering, structure) once; each call does the numerical
work.
"""

import importlib.util
from collections.abc import Callable

from dpl.fem.linear.banded import BandedCholesky, MixedPrecisionBandedCholesky
from dpl.fem.linear.interface import Array, Backend, Pattern
from dpl.fem.linear.krylov import CG, multigrid_installed
from dpl.fem.linear.ordering import band_storage
from dpl.fem.linear.pardiso import Pardiso
from dpl.fem.linear.superlu import SuperLU
from dpl.version import install

BackendFactory = Callable[[Pattern, Array | None], Backend]  # of a pattern and near-null fields


def installed_backends() -> list[str]:
    """Return the names of the installed backends."""
    missing = set() if importlib.util.find_spec("pypardiso") else {"pardiso"}
    return [name for name in BACKENDS if name not in missing]


def make_backend(
    pattern: Pattern,
    name: str | BackendFactory = "auto",
    near_null: Array | None = None,
    *,
    many_rhs: bool = False,
) -> Backend:
    """Return a backend for matrices of a pattern.

    Args:
        pattern: Structure of the matrices.
        name: "band", "band32", "pardiso", "superlu", "cg", "auto", see `select_backend`, or a
            function of `pattern` and `near_null` that returns a backend.
        near_null: Rigid body modes, (n, k), see `Problem.near_null`; "cg" needs them for
            multigrid.
        many_rhs: Whether one factor solves for many right-hand sides: the factorisation may then
            cost more if each solve costs less.

    Raises:
        ValueError: The backend is unknown or not installed.
    """
    chosen = select_backend(name, pattern, near_null, many_rhs=many_rhs)
    make = BACKENDS[chosen] if isinstance(chosen, str) else chosen
    return make(pattern, near_null)


def select_backend(
    name: str | BackendFactory,
    pattern: Pattern | None = None,
    near_null: Array | None = None,
    *,
    many_rhs: bool = False,
) -> str | BackendFactory:
    """Return the name of the backend, with "auto" replaced by the backend it selects.

    "auto" selects by the pattern and the installed packages, not by timings, so that results are
    reproducible. Without a pattern it stays "auto". A function is returned as it is. Arguments and
    errors are those of `make_backend`.
    """
    if callable(name):
        return name
    if name not in (*BACKENDS, "auto"):
        raise ValueError(f"linear = {name!r} must be one of auto, {', '.join(BACKENDS)}")
    if name != "auto" and name not in installed_backends():
        raise ValueError(f"linear = {name!r} is not installed: {install(name)}")
    if name != "auto" or pattern is None:
        return name
    best = sparse = _sparse_backend()
    if near_null is not None and multigrid_installed():
        large = MULTIGRID[sparse] * (MANY_RHS_FACTOR if many_rhs else 1)
        best = "cg" if pattern.size > large else sparse
    half = band_storage(pattern).half
    if half**2 >= BAND_COST_RATIO[best] * pattern.size:
        return best
    # float32 makes the factorisation faster, but not a solve to full accuracy
    return "band32" if half >= FLOAT32_BANDWIDTH and not many_rhs else "band"


# A banded factorisation takes n b^2 operations, a sparse one of a solid about n^2 slower ones, so
# b^2 / n decides. Thresholds from beams, cubes, stars and plates of 1,000 to 100,000 unknowns.
BAND_COST_RATIO = {"pardiso": 22, "superlu": 100, "cg": 10}  # b^2 / n below which a band is faster
MULTIGRID = {"pardiso": 100_000, "superlu": 30_000}  # n above which multigrid is faster
MANY_RHS_FACTOR = 3.0  # multiplies MULTIGRID if one factor solves for many right-hand sides
FLOAT32_BANDWIDTH = 250  # b from which float32 saves more than its iterations cost


def _sparse_backend() -> str:
    """Return the name of the best sparse direct solver, which takes indefinite matrices too."""
    return "pardiso" if "pardiso" in installed_backends() else "superlu"


def factorisation_work(pattern: Pattern) -> float:
    """Return the multiply-adds of a banded factorisation that takes as long as that of "auto"."""
    half, size = float(band_storage(pattern).half), pattern.size
    return size * min(half**2, BAND_COST_RATIO[_sparse_backend()] * size)


def _indefinite(pattern: Pattern) -> Backend:
    return BACKENDS[_sparse_backend()](pattern, None)


BACKENDS: dict[str, BackendFactory] = {
    "band": lambda pattern, near_null: BandedCholesky(pattern, _indefinite),
    "band32": lambda pattern, near_null: MixedPrecisionBandedCholesky(pattern, _indefinite),
    "pardiso": lambda pattern, near_null: Pardiso(pattern),
    "superlu": lambda pattern, near_null: SuperLU(pattern),
    "cg": CG,
}
