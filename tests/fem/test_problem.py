"""Laws of the discrete body: element matrices, consistency, invariance, supports."""

import math
import re
import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import skfem
import torch
from solving import Uncompiled, assert_derivatives, load_of, rest
from torch import Tensor
from torch.testing import assert_close

from benchmarks.verification.beams import balance
from dpl import fem
from dpl.fem.linear import full_matrix

SVK, NH = fem.SaintVenantKirchhoff(0.3), fem.NeoHookeanLn(0.3)
CORNER = skfem.MeshTet(
    np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), np.arange(4)[:, None]
)
CUBE = fem.box([1.0, 1.0, 1.0], [2, 2, 2])


def stiffness(problem: fem.Problem) -> np.ndarray:
    """Return K(0) over the free degrees of freedom."""
    values = problem.tangent(rest(problem))[0]
    return full_matrix(problem.pattern, values.numpy()).toarray()


# By another code: mesh, degree, eigenvalues from below, number of them in all, largest, trace
ELEMENTS = {
    "hex8": (
        *(CUBE, 1),
        [0.064102564] * 2 + [0.117521368] * 3 + [0.192307692] * 3 + [0.256410256],
        *(24, 1.25, 5.641025641),
    ),
    "tet4": (CORNER, 1, [0.128205128] * 2 + [0.212521895], 12, 1.005426823, 2.115384615),
    "tet10": (
        *(CORNER, 2),
        [0.01232388] * 2 + [0.018478595] + [0.029921395] * 2,
        *(30, 2.547414087, 9.730769231),
    ),
    "hex27": (
        *(CUBE, 2),
        [0.033427874] * 2 + [0.036130435] * 3 + [0.037893416],
        *(81, 4.029073639, 40.615384615),
    ),
}


@pytest.mark.parametrize("element", ELEMENTS)
def test_element_matrix_has_the_tabulated_eigenvalues(element):
    mesh, degree, smallest, count, largest, trace = ELEMENTS[element]
    K = stiffness(fem.Problem.build(mesh, NH, degree=degree, length=1.0))
    values = np.linalg.eigvalsh(K)
    assert len(values) == count
    assert np.abs(values[:6]).max() < 1e-14
    assert values[6 : 6 + len(smallest)] == pytest.approx(smallest, abs=6e-10)
    assert values[-1] == pytest.approx(largest, abs=6e-10)
    assert np.trace(K) == pytest.approx(trace, abs=6e-10)


@pytest.fixture(scope="module")
def bent(beam, pull) -> tuple[fem.Problem, Tensor, Tensor]:
    """The paper's beam (hex8 8 x 2 x 2, NH-ln, q = 20), its load and its solution."""
    problem = beam(NH)
    force = pull(problem, 20.0)
    answer = fem.solve(fem.Newton(problem, tol=1e-12, linear="superlu"), load_of(force))
    assert answer.converged.all()
    return problem, force, answer.displacement


def test_the_paper_s_beam_satisfies_all_balance_identities(tmp_path):
    """Taylor remainders, reactions and moments, objectivity, work and energy."""
    for row in balance(tmp_path).rows:
        assert row.holds, row


SVK_ON = [("quad", 1), ("tetra", 2), ("hexahedron", 1)]  # the elements with the other law


@pytest.fixture
def body(kind, grid) -> fem.Problem:
    """A body of each kind of element with unequal cells, held where x is small."""
    (cell, degree), law = kind, SVK if kind in SVK_ON else NH
    return fem.Problem.build(
        grid(cell, 2, 0.15), law, fixed=lambda points: points[:, 0] < 0.2, degree=degree, length=1.0
    )


def test_force_and_tangent_are_slopes_of_energy_and_force(body, bend):
    assert not body.discretisation.equal_cells
    u, v = bend(body.points, 3), bend(body.points, 3, seed=1)
    assert (body.volume_ratio(u) > 0.3).all()
    assert_derivatives(body, u, v)


def test_mixed_points_in_agreement_give_force_and_tangent(body, bend):
    u = bend(body.points, 3)
    force, tangent, _ = body.tensors.linearise(u, torch.zeros_like(body.stress(u)))
    assert_close(force, body.internal_force(u), rtol=1e-11, atol=1e-14)
    assert_close(tangent, body.tangent(u), rtol=1e-10, atol=1e-13)


def test_stress_of_mixed_points_is_moved_to_the_strain_by_the_moduli_there(body, bend):
    """To first order in the gap the force does not see it."""
    u, gap = bend(body.points), body.tensors.strain(bend(body.points, seed=1))
    plain = body.internal_force(u)
    errors = [
        (body.tensors.linearise(u, h * gap)[0] - plain).norm().item() for h in (4e-3, 2e-3, 1e-3)
    ]
    if isinstance(body.material, fem.SaintVenantKirchhoff):
        assert max(errors) < 1e-14
    else:
        assert [math.log2(a / b) for a, b in pairwise(errors)] == pytest.approx([2.0] * 2, abs=0.05)


def test_gap_is_what_the_linear_change_of_strain_falls_short_of(kind, grid, bend):
    """Points close the part of the gap that the step takes and follow the slope of the strain."""
    body = Uncompiled.build(grid(kind[0], 2, 0.15), NH, degree=kind[1], length=1.0)
    u, v = bend(body.points), bend(body.points, seed=1)
    gap = body.tensors.strain(bend(body.points, seed=2))
    slope = torch.func.jvp(body.tensors.strain, (u,), (v,))[1]
    for before, found in (
        (torch.zeros_like(gap), body.update_strain_gap(None, 0.25, v)),
        (gap, body.update_strain_gap(gap, 0.25, v)),
    ):
        mixed = body.tensors.strain(u) - before
        moved = mixed + 0.25 * (slope + before)
        assert_close(found, body.tensors.strain(u + 0.25 * v) - moved, rtol=1e-11, atol=1e-14)


def test_equal_cells_answer_like_unequal_ones(kind, chain, grid, bend):
    (cell, degree), law = kind, SVK if kind in SVK_ON else NH
    assert not fem.Problem.build(grid(cell, 3, 1e-4), NH).discretisation.equal_cells
    short = fem.Problem.build(chain(cell, 3), law, fixed=fem.Plane(0, "min"), degree=degree)
    assert short.discretisation.equal_cells
    count = len(short.cells)
    dN, dV = short.dN.expand(count, -1, -1, -1), short.dV.expand(count, -1)
    long = replace(short, dN=dN.contiguous(), dV=dV.contiguous())
    assert not long.discretisation.equal_cells
    u, v = bend(short.points, 2), bend(short.points, 2, seed=1)
    for method in ("energy", "internal_force", "tangent", "volume_ratio", "stress"):
        assert_close(getattr(short, method)(u), getattr(long, method)(u), rtol=1e-11, atol=1e-13)
    assert_close(short.tangent_product(u, v), long.tangent_product(u, v), rtol=1e-11, atol=1e-13)


def test_homogeneous_deformation_has_one_stress_and_one_volume_ratio(body):
    dim = body.shape[1]
    random = torch.Generator().manual_seed(2)
    H = torch.zeros(3, 3, dtype=torch.float64)
    H[:dim, :dim] = torch.rand(dim, dim, generator=random, dtype=torch.float64) * 0.4 - 0.2
    u = (body.points @ H[:dim, :dim].T)[None]
    assert_close(
        body.stress(u), body.material.stress(H).expand_as(body.stress(u)), rtol=1e-10, atol=1e-12
    )
    J = torch.linalg.det(H + torch.eye(3, dtype=torch.float64))
    assert_close(body.volume_ratio(u), J[None], rtol=1e-12, atol=0.0)
    volume = body.dV.expand(len(body.cells), -1).sum()
    assert_close(body.energy(u), volume * body.material.energy(H)[None], rtol=1e-11, atol=0.0)


@pytest.mark.parametrize("degree", [1, 2])
def test_plane_strain_is_a_slice_of_the_solid(law, degree):
    flat = fem.Problem.build(fem.rectangle([2.0, 1.0], [5, 3]), law, degree=degree, length=1.0)
    solid = fem.Problem.build(fem.box([2.0, 1.0, 0.7], [5, 3, 2]), law, degree=degree, length=1.0)

    def shape(points):
        x, y = points[:, 0], points[:, 1]
        return torch.stack([0.1 * x * y + 0.05 * x, 0.1 * x**2 - 0.1 * y], dim=1)[None]

    in_space = torch.nn.functional.pad(shape(solid.points), (0, 1))
    assert_close(
        solid.energy(in_space), 0.7 * flat.energy(shape(flat.points)), rtol=1e-12, atol=0.0
    )


@pytest.fixture
def held(grid) -> fem.Problem:
    """A body of unequal cells, held where x is small."""
    mesh = grid("hexahedron", 2, 0.15)
    return fem.Problem.build(mesh, NH, fixed=lambda points: points[:, 0] < 0.2, length=1.0)


def test_residual_ratio_is_relative_to_the_load(held, bend):
    u, f = bend(held.points, 2), bend(held.points, 2, seed=1)
    norm = held.residual(u, f).flatten(1).norm(dim=1)
    assert not held.moved_supports
    acting = f[:, held.free].norm(dim=1)
    assert_close(held.relative_residual(u, f), norm / acting, rtol=1e-13, atol=0)
    zero = torch.zeros_like(u)
    assert_close(held.relative_residual(u, zero), held.residual(u, zero).flatten(1).norm(dim=1))
    assert not held.relative_residual(zero, zero).any()
    ones = torch.where(held.free, 1.0, 0.0).expand_as(f).to(f)
    assert_close(held.relative_residual(zero, ones), torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("power", [-290, -158, 158, 290])
def test_a_ratio_does_not_depend_on_the_size_of_the_forces(bent, power):
    """Squares of these numbers are 0 or infinite in float64."""
    problem, force, u = bent
    internal, size = problem.internal_force(u) - 0.3 * force, 10.0**power
    force = force / problem.acting(force).abs().max()
    ratio = problem.relative_residual_of(internal, force)
    assert ratio > 1e-3
    assert_close(
        problem.relative_residual_of(size * internal, size * force), ratio, rtol=1e-12, atol=0
    )
    for tol, met in ((1.01 * float(ratio), True), (0.99 * float(ratio), False)):
        found = problem.is_equilibrium(size * u, size * internal, size * force, tol)
        assert found.item() is met


def test_reactions_count_as_load_where_supports_move(grid, bend):
    mesh = grid("hexahedron", 2, 0.1)
    ends = (mesh.p[0] < 0.2) | (mesh.p[0] > 0.8)
    given = np.where(mesh.p.T > 0.8, 0.1, 0.0)
    problem = fem.Problem.build(mesh, NH, fixed=ends, prescribed=given, length=1.0)
    assert problem.moved_supports
    assert not problem.prescribed[problem.free].any()
    u = bend(problem.points)
    internal, none = problem.internal_force(u), torch.zeros_like(u)
    moved = problem.prescribed != 0
    reaction, off = internal[:, moved].norm(), problem.residual(u, none).norm()
    assert reaction < 0.99 * internal[:, ~problem.free].norm()
    assert_close(problem.relative_residual(u, none), (off / reaction)[None])
    held = torch.where(problem.free, 0.0, 1e10).to(u)[None]
    assert_close(problem.relative_residual(u, held), (off / reaction)[None])
    for size in (0.1, 10.0):  # the larger of the two counts
        force = problem.acting(torch.ones_like(u))
        force *= size * reaction / force.norm()
        ratio = problem.residual(u, force).norm() / max(reaction, force.norm())
        assert_close(problem.relative_residual(u, force), ratio[None])


def test_reactions_of_supports_that_are_not_moved_never_count(grid, bend):
    """One node that is moved by next to nothing must not change how a load is judged."""
    mesh = grid("hexahedron", 2, 0.1)
    problem = fem.Problem.build(mesh, NH, fixed=mesh.p[0] < 0.2, length=1.0)
    u = bend(problem.points)
    f = problem.acting(1e-3 * bend(problem.points, seed=1))
    node = int((~problem.free).any(dim=1).nonzero()[0, 0])
    prescribed = torch.zeros_like(problem.prescribed)
    prescribed[node, 1] = 1e-9
    moved = replace(problem, prescribed=prescribed)
    internal = problem.internal_force(u)
    norm = torch.maximum(f.norm(), internal[0, node, 1].abs())
    assert norm < 0.5 * internal[:, ~problem.free].norm()
    off = problem.residual(u, f).norm()
    assert_close(moved.relative_residual_of(internal, f), (off / norm)[None])


def test_nodes_lie_where_the_shape_functions_say(kind, grid):
    """A field linear in `points` has a constant gradient only where nodes and cells agree."""
    cell, degree = kind
    problem = fem.Problem.build(grid(cell, 3, 0.1, inside=True), NH, degree=degree, length=1.0)
    x, count = problem.points, (3 * degree + 1) ** problem.shape[1]
    assert problem.shape[0] == count
    identity = torch.einsum("eai,eqaj->eqij", problem.points[problem.cells], problem.dN)
    eye = torch.eye(problem.shape[1], dtype=torch.float64)
    assert_close(identity, eye.expand_as(identity), rtol=0, atol=1e-12)
    assert torch.equal(problem.boundary, ((x < 1e-12) | (x > 1 - 1e-12)).any(dim=1))


def test_lengths_are_over_the_longest_side():
    problem = fem.Problem.build(fem.box([2.0, 8.0, 4.0], [2, 5, 3]), NH, fixed=fem.Plane(1, 8.0))
    assert problem.length == pytest.approx(8.0)
    assert problem.points.max(dim=0).values.tolist() == pytest.approx([0.25, 1.0, 0.5])
    assert problem.dV.sum() * len(problem.cells) == pytest.approx(64.0 / 8.0**3)
    held = ~problem.free.any(dim=1)
    assert held.sum() == 6
    assert (problem.points[held, 1] == 1).all()


def test_support_may_be_a_region_or_nodes_or_components(grid):
    mesh = grid("hexahedron")
    by_region = fem.Problem.build(mesh, NH, fixed=fem.Plane(0, "min"))
    by_nodes = fem.Problem.build(mesh, NH, fixed=mesh.p[0] == 0)
    by_component = np.zeros((27, 3), dtype=bool)
    by_component[mesh.p[0] == 0, 1] = True
    sliding = fem.Problem.build(mesh, NH, fixed=by_component)
    assert torch.equal(by_region.free, by_nodes.free)
    assert (~by_region.free).sum() == 27
    assert (~sliding.free).sum(dim=0).tolist() == [0, 9, 0]
    assert fem.Problem.build(mesh, NH).free.all()


def test_curved_cells_fill_the_curved_body():
    """Isoparametric quadratic triangles: the error of a disc's area falls with the fourth power."""
    errors = []
    for refinements in (1, 2):
        disc = skfem.MeshTri2.init_circle(refinements)
        problem = fem.Problem.build(disc, NH, length=1.0)
        errors.append(abs(problem.dV.sum().item() - math.pi))
    assert math.log2(errors[0] / errors[1]) > 3.5


ALONG = [f"translation along {axis}" for axis in "xyz"]
ABOUT = [f"rotation about {axis}" for axis in "xyz"]


@pytest.mark.parametrize(
    ("cell", "fixed", "names"),
    [
        ("hexahedron", None, ALONG + ABOUT),
        ("hexahedron", fem.Plane(0, "min"), []),
        ("hexahedron", fem.Box([0, 0, 0], [0, 0, 0]), ABOUT),
        ("hexahedron", fem.Box([0, 0, 0], [0, 1, 0]), ABOUT[1:2]),
        ("hexahedron", (1, [False, True, True]), ALONG[:1]),
        ("hexahedron", (2, [False, False, True]), [*ALONG[:2], ABOUT[2]]),
        ("quad", None, [*ALONG[:2], ABOUT[2]]),
        ("quad", fem.Plane(0, "min"), []),
        ("quad", fem.Box([0, 0], [0, 0]), ABOUT[2:]),
    ],
)
def test_motions_that_no_support_holds_are_named(grid, cell, fixed, names):
    mesh = grid(cell, 3)
    if isinstance(fixed, tuple):  # components on the plane where a coordinate is zero
        axis, components = fixed
        fixed = (mesh.p[axis] == 0)[:, None] & np.array(components)
    assert fem.Problem.build(mesh, NH, fixed=fixed).unconstrained_rigid_body_modes() == names


def test_strain_of_no_deformation_is_not_valid(kind, grid):
    """Det C of the strain of u less the gap must be above zero: here it is 0.2 - 1 < 0."""
    for owner in (fem.Problem, Uncompiled):
        body = owner.build(grid(kind[0]), NH, degree=kind[1], length=1.0)
        squeezed = -0.6 * body.points[None] * torch.eye(body.shape[1], dtype=torch.float64)[0]
        for length, valid in ((1.0, True), (2.0, False)):
            gap = body.update_strain_gap(None, length, squeezed)  # 0.36/2 and 1.44/2 along x
            found = body.linearise(torch.zeros_like(squeezed), gap).valid
            assert found.tolist() == [valid]


def test_residual_below_the_tolerance_or_at_the_level_of_rounding_is_balance(bent):
    problem, force, u = bent
    internal, room, tol = problem.internal_force(u), problem.roundoff_bound(u), 1e-8
    assert room.shape == (1,)
    assert room < 0.1 * tol * force.norm()  # no excuse on an ordinary body
    spot, free = torch.zeros_like(u), torch.where(problem.free, force, 0.0)
    spot[0, problem.free.any(dim=1).nonzero()[0, 0], 0] = 1.0
    target = torch.where(problem.free, force, internal)
    for off, own_tol in ((room * spot, 1e-30), (tol * force.norm() / free.norm() * free, tol)):
        for part, balanced in ((0.99, True), (1.01, False)):
            found = problem.is_equilibrium(u, target + part * off, force, own_tol)
            assert found.item() is balanced


def test_rounding_excuses_no_imbalance_that_matters(grid):
    """However large the bound, a ratio of 1e-4 is no rounding."""
    problem = fem.Problem.build(grid("hexahedron"), NH, fixed=fem.Plane(0, "min"))
    u = 1e12 * problem.points[None]
    force = torch.where(problem.free, 1e-3, 0.0).to(u)[None]
    assert problem.roundoff_bound(u) > 1e-3 * force.norm()
    for ratio, balanced in ((0.99e-4, True), (1.01e-4, False)):
        assert problem.is_equilibrium(u, (1 + ratio) * force, force, 1e-8).item() is balanced


def test_rounding_bounds_what_rounding_does(body, bend):
    """The residual of an answer as exact as can be, in another order of summation."""
    problem = fem.Problem.build(body.mesh, body.material, fixed=lambda x: x[:, 0] < 0.2, length=1.0)
    u = 1e-3 * bend(problem.points, 5)
    order = torch.randperm(len(problem.cells), generator=torch.Generator().manual_seed(0))
    parts = {name: getattr(problem, name)[order] for name in ("cells", "dN", "dV")}
    shuffled = replace(problem, **parts)
    noise = torch.where(problem.free, shuffled.internal_force(u) - problem.internal_force(u), 0.0)
    room = problem.roundoff_bound(u)
    assert noise.any()
    assert (noise.flatten(1).norm(dim=1) < room).all()


@pytest.mark.parametrize(
    ("mesh", "options", "message"),
    [
        (CUBE, {"degree": 3}, "degree"),
        (CUBE, {"degree": 0}, "degree"),
        (CUBE, {"fixed": fem.Plane(0, 0.3)}, "no node"),
        (skfem.MeshWedge1(), {}, r"cells of degree . must be one of"),
    ],
)
def test_problem_that_cannot_be_built_is_an_error(mesh, options, message):
    with pytest.raises(ValueError, match=message):
        fem.Problem.build(mesh, NH, **options)


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((1, 11, 3), torch.float64, "must have"),  # the loops would read past its end
        ((1, 12, 3), torch.float32, "must be in torch"),
    ],
)
def test_a_displacement_that_does_not_fit_is_refused(beam, shape, dtype, message):
    problem = beam(NH, 2, 1)
    for method in (problem.evaluate, problem.linearise):
        with pytest.raises(ValueError, match=message):
            method(torch.zeros(shape, dtype=dtype))


REMEDY = "set degree=2 with the same mesh file, or write it with order 2"


@pytest.mark.parametrize(
    ("cell", "material", "options", "words"),
    [
        ("triangle", fem.NeoHookeanLn(0.45), {}, f"ratio 0.45: {REMEDY}"),
        ("tetra", fem.NeoHookeanLn(0.45), {}, f"ratio 0.45: {REMEDY}"),
        ("quad", fem.NeoHookeanLn(0.45), {}, r"ratio 0.45: .*or set mean_dilatation=true$"),
        ("hexahedron", fem.NeoHookeanLn(0.45), {}, r"ratio 0.45: .*or set mean_dilatation=true$"),
        ("hexahedron", fem.MooneyRivlinK2(0.15, 0.05, 20.0), {}, "ratio 0.4901"),  # of its moduli
        ("hexahedron", fem.NeoHookeanLn(0.449), {}, None),
        ("tetra", fem.NeoHookeanLn(0.49), {"degree": 2}, "ratio 0.49: set mean_dilatation=true$"),
        ("triangle", fem.NeoHookeanLn(0.49), {"degree": 2, "mean_dilatation": True}, None),
        ("tetra", fem.NeoHookeanLn(0.48), {"degree": 2}, None),
        ("hexahedron", fem.NeoHookeanLn(0.49), {"degree": 2}, None),
        ("quad", fem.NeoHookeanLn(0.49), {"mean_dilatation": True}, None),
        ("hexahedron", fem.NeoHookeanLn(0.49), {"mean_dilatation": True}, None),
        (0.999, NH, {}, f"aspect ratio 20 lock in bending: {REMEDY}"),
        (0.999, NH, {"degree": 2}, None),
        (1.001, NH, {}, None),
    ],
)
def test_elements_that_will_lock_are_warned_of(grid, cell, material, options, words):
    """From a Poisson's ratio of 0.45 or an aspect ratio of 20."""
    thin = isinstance(cell, float)
    mesh = fem.rectangle([4.0, 4 * cell / 20], [5, 5]) if thin else grid(cell)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        fem.Problem.build(mesh, material, **options)
    lines = [str(one.message) for one in caught if one.category is UserWarning]
    assert len(lines) == (words is not None)
    assert all(re.search(words, line) for line in lines)
