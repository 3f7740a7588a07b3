"""Difficult and unsolvable bodies and loads, and what the package reports of them.

Further cases are in tests/config/test_run_folder.py and test_mesh.py.
The names T1 to T23 are those of the cases in `benchmarks.stress`, which check all states too.
"""

import math
import warnings
from functools import cache
from itertools import cycle

import pytest

from benchmarks.stress.fixtures import (
    UNDERCONSTRAINED,
    as_load,
    column,
    folded_mesh,
    nearest_node,
    plate,
    sliver_mesh,
    underconstrained_bar,
)
from benchmarks.stress.invalid_input import EMPTY_REGIONS, REGION_USES
from dpl import fem
from dpl.fem.mesh import check_mesh

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
DIRECT = [name for name in fem.installed_backends() if name != "cg"]


@pytest.fixture(params=[False, True], ids=["plain", "mixed"])
def mixed(request) -> bool:
    """Both kinds of Newton: without and with mixed integration points."""
    return request.param


# law, q [Pa], min u_z / L of any node, min J
ANSWERED = {
    "T1": (SVK, 80.0, None, 0.720),
    "T3": (NH, 80.0, -0.7239, 0.804),
    "T4, q = 160": (NH, 160.0, -0.9179, 0.723),
    "T4, q = 400": (NH, 400.0, -1.1102, 0.590),
    "T4, q = 1000": (NH, 1000.0, -1.3502, 0.443),
}


@pytest.mark.parametrize("case", ANSWERED)
def test_large_load_that_has_an_answer_gets_it(beam, pull, mixed, case):
    """Stress cases T1, T3, T4: whole, uninverted on the way, stable; hex8 16 x 4 x 4."""
    law, q, deepest, volume = ANSWERED[case]
    problem = beam(law, 16, 4)
    for state in fem.Newton(problem, mixed_integration=mixed).iterate(as_load(pull(problem, q)[0])):
        assert state.volume_ratio.item() > 0
        assert 0 <= state.load_factor.item() <= 1
    assert state.status.item() == fem.Status.CONVERGED
    assert state.negative_pivots.item() == 0
    assert state.load_factor.item() == 1
    assert state.volume_ratio.item() == pytest.approx(volume, abs=5.1e-4)
    if deepest is not None:
        assert state.displacement[..., 2].min().item() == pytest.approx(deepest, abs=5.1e-5)


def test_slender_beam_takes_steps_where_one_does_not_do(mixed):
    """Stress case T5: NH-ln 20 x 1 x 1, nu = 0, P L^2 / EI = 1: w / L = .302130893."""
    law = fem.NeoHookeanLn(0.0)
    mesh = fem.box([20.0, 1.0, 1.0], [21, 2, 2])
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), degree=2)
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1 / 12 / 400]).on(problem)
    states = list(fem.Newton(problem, mixed_integration=mixed).iterate(as_load(force)))
    assert states[-1].status.item() == fem.Status.CONVERGED
    mean = force[:, 2] @ states[-1].displacement[0, :, 2] / force[:, 2].sum()
    assert -mean.item() == pytest.approx(0.302130893, abs=5.1e-10)
    stepped = any(0 < state.load_factor.item() < 1 for state in states)
    assert stepped != mixed  # mixed points spare the steps


# Stress case T2: q [Pa] of SVK on hex8 16 x 4 x 4; plain Newton inverts elements there
@pytest.mark.parametrize(
    "q", [pytest.param(q, marks=pytest.mark.slow) for q in (160.0, 400.0)] + [1000.0]
)
def test_load_beyond_all_answers_is_refused_with_the_part_that_has_one(beam, pull, mixed, q):
    """Stress case T2: no inverted state passes, and none is stored as an answer."""
    problem = beam(SVK, 16, 4)
    force = pull(problem, q)[0]
    solver = fem.Newton(problem, mixed_integration=mixed)
    for state in solver.iterate(as_load(force)):
        assert state.volume_ratio.item() > 0
        assert state.residual.isfinite().all()
        assert not state.converged.any()
    assert state.status.item() == fem.Status.NO_VALID_EQUILIBRIUM
    assert not state.stable.any()
    assert str(fem.Status(state.status.item())) == "no valid equilibrium"
    residual = problem.relative_residual(state.displacement, force[None])
    assert state.residual.item() == residual.item() > solver.tol
    assert 130 < q * state.load_factor.item() < q
    part = fem.evaluate_solution(
        problem, state.displacement, as_load(state.load_factor * force), solver.intermediate_tol
    )
    assert part.converged.all()


@pytest.mark.parametrize("q", [1e-2, 1e-12])
def test_tiny_load_of_isotropic_laws_ends_at_the_linear_answer(
    beam, pull, corner, isotropic_law, q
):
    """Stress case T6: u / q within 1e-6 of the linear one; no law stalls above 1e-8."""
    problem = beam(isotropic_law)
    load = as_load(pull(problem, q)[0])
    answer, linear = (fem.solve(kind(problem), load) for kind in (fem.Newton, fem.LinearSolver))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.iterations.item() <= 3
    assert answer.residual.item() < 1e-8
    ratio = corner(problem, answer.displacement)[2] / corner(problem, linear.displacement)[2]
    assert ratio.item() == pytest.approx(1.0, abs=max(1e-2 * q, 1e-11))


@pytest.mark.parametrize("name", ["holzapfel_gasser_ogden", "holzapfel_ogden"])
@pytest.mark.parametrize("q", [1e-2, 1e-12])
def test_tiny_load_of_fibres_without_compression_converges(beam, pull, laws, name, q):
    """Fibres that are shortened do not resist, so that the solution is not the linear one."""
    problem = beam(laws[name])
    answer = fem.solve(fem.Newton(problem), as_load(pull(problem, q)[0]))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.iterations.item() <= 6
    assert answer.residual.item() < 1e-8


# Stress case T8: nu -> compliance over that of hex27 16 x 4 x 4
LOCKING = {
    0.3: (0.960, 0.795, 0.991, 0.996),
    0.45: (0.901, 0.615, 0.973, 0.981),
    0.49: (0.753, 0.323, 0.957, 0.963),
    0.499: (0.467, 0.103, 0.947, 0.954),
    0.4999: (0.209, 0.067, 0.945, 0.952),
}
ELEMENTS = {  # cell, degree, cells along and across
    "hex8": ("hexahedron", 1, (16, 4)),
    "tet4": ("tetra", 1, (16, 4)),
    "tet10": ("tetra", 2, (8, 2)),
    "hex27": ("hexahedron", 2, (8, 2)),
}


@pytest.fixture(scope="module")
def compliance(beam, pull):
    """Work of the linear solution to a load on the end of the beam, each computed once."""

    @cache
    def compliance(nu: float, cell: str, degree: int, cells: tuple[int, int], mean: bool = False):
        options = {"cell": cell, "degree": degree, "mean_dilatation": mean}
        problem = beam(fem.NeoHookeanLn(nu), *cells, **options)
        force = pull(problem, 1e-3)
        return (
            (force * fem.solve(fem.LinearSolver(problem), as_load(force[0])).displacement)
            .sum()
            .item()
        )

    return compliance


@pytest.mark.filterwarnings("ignore:linear .* lock")
@pytest.mark.parametrize("nu", LOCKING)
@pytest.mark.parametrize("element", ELEMENTS)
def test_element_locks_as_tabulated(compliance, element, nu):
    """Stress case T8."""
    reference = compliance(nu, "hexahedron", 2, (16, 4))
    ratio = compliance(nu, *ELEMENTS[element]) / reference
    printed = LOCKING[nu][list(ELEMENTS).index(element)]
    assert ratio == pytest.approx(printed, abs=6e-4)


@pytest.mark.parametrize("nu", LOCKING)
def test_mean_dilatation_does_not_lock(compliance, nu):
    """Stress case T8: .94 or more of the compliance; not softer than the exact body either."""
    reference = compliance(nu, "hexahedron", 2, (16, 4))
    ratio = compliance(nu, "hexahedron", 1, (16, 4), True) / reference
    assert 0.94 <= ratio <= 1.02


# Stress case T10: cells along a side, through the thickness, degree -> w at a/h = 100 and 10
PLATES = {
    (16, 1, 1): (0.087, 0.904),
    (16, 2, 1): (0.088, 0.990),
    (8, 1, 2): (0.937, 1.119),
    (16, 1, 2): (0.982, 1.132),
}


def deflection(sides: int, layers: int, degree: int, slenderness: int) -> float:
    """Return the deflection of a clamped square plate over Kirchhoff's, under an even load."""
    problem, force, known = plate(sides, layers, degree, slenderness)
    answer = fem.solve(fem.LinearSolver(problem), as_load(force))
    below = nearest_node(problem, [0.5, 0.5, 0.0])
    return -answer.displacement[0, below, 2].item() / known


@pytest.mark.filterwarnings("ignore:linear .* lock")
@pytest.mark.parametrize("cells", PLATES)
@pytest.mark.parametrize("case", [0, 1], ids=["thin", "thick"])
def test_plate_bends_as_tabulated(cells, case):
    """Stress case T10: linear elements lock in a thin plate, quadratic ones hardly."""
    assert deflection(*cells, (100, 10)[case]) == pytest.approx(PLATES[cells][case], abs=6e-4)


SLIVERS = {1e-2: -0.2388289, 1e-4: -0.2386176, 1e-6: -0.2386155, 1e-8: -0.2386155}


@pytest.mark.parametrize(
    ("part", "name", "mixed"),
    [
        (part, name, (row + column) % 2 == 0)
        for row, part in enumerate(SLIVERS)
        for column, name in enumerate(DIRECT)
    ],
)
def test_slivers_are_warned_of_and_change_nothing(pull, part, name, mixed):
    """Stress case T11: the plane x = 50 of the beam moved to 37.5 + 12.5 eps."""
    with pytest.warns(UserWarning, match="aspect ratio .* lock in bending"):
        problem = fem.Problem.build(sliver_mesh(part), SVK, fixed=fem.Plane(0, "min"))
    solver = fem.Newton(problem, linear=name, mixed_integration=mixed)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = fem.solve(solver, as_load(pull(problem, 20.0)[0]))
    assert answer.status.item() == fem.Status.CONVERGED
    assert answer.load_factor.item() == 1
    assert answer.iterations.item() <= 6
    end = answer.displacement[0, problem.points.sum(dim=1).argmax(), 2].item()
    assert end == pytest.approx(SLIVERS[part], abs=1.1e-7)
    # rounding leaves more than the tolerance for the thinnest, and that is said
    said = any("rounding allows no less" in str(one.message) for one in caught)
    assert said == (1e-8 < answer.residual.item() < 1e-5) == (part == 1e-8)


def test_body_folded_at_rest_is_refused_by_the_numbers_of_its_cells():
    """Stress case T12."""
    with pytest.raises(ValueError, match="4 cells are inverted: 2, 3, 6, 7"):
        check_mesh(folded_mesh())


@pytest.mark.parametrize("support", UNDERCONSTRAINED)
def test_loose_body_is_refused_by_its_motions(support):
    """Stress case T13: before any factorisation."""
    linear = fem.LinearSolver(underconstrained_bar(support))
    with pytest.raises(ValueError, match=UNDERCONSTRAINED[support][1]):
        fem.eigenmodes(linear, 3)
    assert "factor" not in linear.__dict__


@pytest.mark.parametrize(
    ("support", "name"),
    [(support, "superlu") for support in UNDERCONSTRAINED]
    + list(zip(cycle(UNDERCONSTRAINED), fem.installed_backends())),
)
def test_loose_body_never_moves_far(support, name):
    """Stress case T13: Newton does not take the rounding of a zero pivot for an answer."""
    problem = underconstrained_bar(support)
    force = fem.Traction(fem.Plane(0, "max"), [0.0, 0.0, -1e-3]).on(problem)
    answer = fem.solve(fem.Newton(problem, linear=name), as_load(force))
    assert answer.status.item() >= fem.Status.NO_VALID_EQUILIBRIUM
    assert answer.load_factor.item() == 0
    assert not answer.displacement.any()


@pytest.mark.parametrize("where", EMPTY_REGIONS)
@pytest.mark.parametrize("use", REGION_USES)
def test_region_without_a_node_is_an_error_and_not_an_absent_load(grid, use, where):
    """Stress case T16."""
    region = EMPTY_REGIONS[where]
    words = rf"({type(region).__name__}\(.* holds no|'end' must be a group of the mesh)"
    with pytest.raises(ValueError, match=words):
        REGION_USES[use](grid("hexahedron"), region)


@pytest.mark.parametrize(("name", "mixed"), list(zip(DIRECT, cycle([False, True]))))
def test_column_beyond_buckling_is_in_balance_and_flagged(name, mixed):
    """Stress cases T17 and T22: two negative pivots, whichever backend meets them; not stored."""
    problem, force = column(fem.SaintVenantKirchhoff(0.0), (10, 1, 1))
    answer = fem.solve(
        fem.Newton(problem, mixed_integration=mixed, linear=name), as_load(2.5 * force)
    )
    assert answer.status.item() == fem.Status.UNSTABLE
    assert answer.negative_pivots.item() == 2
    assert answer.converged.all()
    assert not answer.stable.any()
    assert answer.load_factor.item() == 1
    assert 10 * answer.displacement[..., 0].min().item() == pytest.approx(-0.02509, abs=5e-6)
    assert answer.displacement[..., 1:].abs().max() < 1e-12


@pytest.mark.parametrize(
    ("name", "P"),
    [("superlu", P) for P in (2.0397, 2.0398, 2.5)]
    + [(name, 2.039763) for name in fem.installed_backends()],
)
def test_singular_tangent_ends_in_words_and_not_in_nan(name, P):
    """Stress case T22: at the critical load 2.039763 and about it, with any backend."""
    problem, force = column(fem.SaintVenantKirchhoff(0.0), (10, 1, 1))
    for state in fem.Newton(problem, linear=name).iterate(as_load(P * force)):
        assert check_sane(state)
    if P > 2.04:
        assert not state.stable.any()
    if name in DIRECT:
        assert state.converged.all()
        assert state.displacement[..., 1:].abs().max() < 1e-6
    else:  # conjugate gradients want a positive definite tangent
        assert state.converged.all() or state.status.item() == fem.Status.NO_VALID_EQUILIBRIUM


def check_sane(state: fem.Solution) -> bool:
    """Return whether all that is said of a state is finite and in range."""
    finite = all(value.isfinite().all() for value in state)
    factor, volume = state.load_factor.item(), state.volume_ratio.item()
    return finite and 0 <= factor <= 1 and volume > 0 and 0 <= state.residual.item() < math.inf
