"""Symmetries of a body: all of them are found, they form a group, and map solutions exactly."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import skfem
import torch
from torch.testing import assert_close

from dpl.fem import (
    Box,
    DirichletBC,
    LinearElastic,
    LinearSolver,
    Load,
    Material,
    ModalLoads,
    NeoHookeanLn,
    Newton,
    Plane,
    Problem,
    RobinBC,
    Tag,
    Traction,
    box,
    propeller,
    rectangle,
    solve,
    symmetries,
)
from dpl.fem.symmetry import products

NH = NeoHookeanLn(0.3)
LEFT, RIGHT = Plane(0, "min"), Plane(0, "max")
CUBE = box([1.0, 1.0, 1.0], [4, 4, 4])
BEAM = box([100.0, 25.0, 25.0], [9, 4, 4])
BODIES = {  # mesh, what is held, order of the group
    "beam of square section": (BEAM, LEFT, 8),
    "beam of rectangular section": (box([100.0, 25.0, 10.0], [9, 4, 3]), LEFT, 4),
    "beam of square section, unequal cells": (box([100.0, 25.0, 25.0], [9, 4, 3]), LEFT, 4),
    "cantilever": (rectangle([100.0, 25.0], [17, 5]), LEFT, 2),
    "cantilever of triangles": (rectangle([100.0, 25.0], [17, 5], "triangle"), LEFT, 1),
    "free cube": (CUBE, None, 48),
    "free square": (rectangle([1.0, 1.0], [4, 4]), None, 8),
    "free square of triangles": (rectangle([1.0, 1.0], [4, 4], "triangle"), None, 4),
    "free cube of tetrahedra": (box([1.0, 1.0, 1.0], [4, 4, 4], "tetra"), None, 12),
    "beam of tetrahedra": (box([100.0, 25.0, 25.0], [9, 4, 4], "tetra"), LEFT, 2),
    "free cube of five tetrahedra": (skfem.MeshTet(), None, 24),
    "corner of a cube": (skfem.MeshTet.init_refdom(), None, 6),
}


def ring(corners: int) -> skfem.Mesh:
    """Return a flat ring of hexahedra with so many corners, askew in space."""
    angle = 2 * math.pi / corners * np.arange(corners)
    a, r, z = np.meshgrid(angle, [1.0, 1.3, 1.5], [0.0, 0.2, 0.4], indexing="ij")
    points = np.stack([r * np.cos(a), r * np.sin(a), z]).reshape(3, -1)
    nodes = np.arange(corners * 9).reshape(corners, 3, 3)
    nodes = np.concatenate([nodes, nodes[:1]])
    places = skfem.MeshHex.elem.refdom.p.T.astype(int)
    cells = [nodes[i : corners + i, j : 2 + j, k : 2 + k].ravel() for i, j, k in places]
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    return skfem.MeshHex(turn @ points + 2.0, np.stack(cells))


@pytest.fixture(params=BODIES)
def body(request) -> tuple[Problem, int]:
    """Each of the bodies, and the order of its group."""
    mesh, fixed, order = BODIES[request.param]
    return Problem.build(mesh, NH, fixed=fixed), order


@pytest.fixture(scope="module")
def solver() -> Newton:
    """The beam with eight symmetries."""
    return Newton(Problem.build(BEAM, NH, fixed=LEFT), linear="superlu")


def check_group(group):
    """The product of two members is a member, on nodes and vectors; so is each inverse."""
    member = {symmetry.source.numpy().tobytes(): symmetry.rotation for symmetry in group}
    assert len(member) == len(group)
    one = torch.eye(len(group[0].rotation), dtype=torch.float64)
    for first, second in itertools.product(group, group):
        product = first.source[second.source].numpy().tobytes()  # first, then second
        assert_close(member[product], second.rotation @ first.rotation, rtol=0, atol=1e-13)
    for symmetry in group:
        inverse = torch.argsort(symmetry.source).numpy().tobytes()
        assert_close(member[inverse], symmetry.rotation.mT, rtol=0, atol=1e-13)
        assert_close(symmetry.rotation @ symmetry.rotation.mT, one, rtol=0, atol=1e-14)


def test_every_symmetry_of_a_body_is_found(body):
    problem, order = body
    assert len(symmetries(problem)) == order


def test_symmetries_are_a_group_that_starts_with_the_identity(body, bend):
    problem, _ = body
    group = symmetries(problem)
    check_group(group)
    assert torch.equal(group[0].rotation, torch.eye(problem.shape[1], dtype=torch.float64))
    assert group[0].source.tolist() == list(range(problem.shape[0]))
    field = bend(problem.points, 2)
    assert torch.equal(group[0].image(field), field)


def test_symmetries_map_nodes_by_the_matrix_that_rotates_vectors(body):
    problem, _ = body
    points = problem.points - problem.points.mean(dim=0)
    for symmetry in symmetries(problem):
        assert_close(symmetry.image(points), points, rtol=0, atol=1e-14)


def test_energy_force_and_volume_ratio_are_those_of_the_image(body, bend):
    problem, _ = body
    u = bend(problem.points, 2, seed=5)
    internal, volume = problem.evaluate(u)
    for symmetry in symmetries(problem):
        image = problem.evaluate(symmetry.image(u))
        assert_close(problem.energy(symmetry.image(u)), problem.energy(u), rtol=1e-12, atol=0)
        assert_close(image.internal, symmetry.image(internal), rtol=0, atol=1e-13)
        assert_close(image.volume_ratio, volume, rtol=1e-12, atol=0)


def test_all_signed_permutations_that_keep_the_cells_are_found():
    """Counted another way: on the nodes' whole numbers, and without any mechanics."""
    mesh = box([3.0, 3.0, 3.0], [4, 4, 4], "tetra")
    grid = {tuple(point): node for node, point in enumerate(mesh.p.T.round().astype(int))}
    cells = {frozenset(cell) for cell in mesh.t.T.tolist()}
    kept = set()
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            Q = np.eye(3)[list(order)] * signs
            moved = ((mesh.p.T - 1.5) @ Q.T + 1.5).round().astype(int)
            node = [grid[tuple(point)] for point in moved]
            if {frozenset(node[i] for i in cell) for cell in cells} == cells:
                kept.add(tuple(Q.ravel()))
    found = symmetries(Problem.build(mesh, NH))
    assert {tuple(symmetry.rotation.flatten().tolist()) for symmetry in found} == kept


def test_the_beam_of_the_paper_has_eight_symmetries():
    """Of its square section: four turns, four mirrors."""
    mesh = box([100.0, 25.0, 25.0], [40, 10, 10])
    group = symmetries(Problem.build(mesh, NH, fixed=LEFT))
    assert len(group) == 8
    assert sum(torch.det(symmetry.rotation) < 0 for symmetry in group) == 4
    assert all((symmetry.rotation == symmetry.rotation.round()).all() for symmetry in group)


@pytest.mark.parametrize("blades", [2, 3, 5])
def test_a_propeller_has_two_rotations_per_blade_and_no_reflection(blades):
    """About the shaft, and by half a turn about each blade, whose sections look the same."""
    group = symmetries(Problem.build(propeller(blades=blades), NH, fixed=Tag("bore")))
    assert len(group) == 2 * blades
    assert all(torch.det(symmetry.rotation) > 0 for symmetry in group)
    about_the_shaft = [s for s in group if s.rotation[0, 0] > 0]
    assert len(about_the_shaft) == blades
    check_group(group)


@pytest.mark.parametrize("corners", [4, 5, 7, 12])
def test_rotations_and_reflections_of_rings_are_found_in_every_orientation(corners):
    group = symmetries(Problem.build(ring(corners), NH))
    assert len(group) == 4 * corners
    check_group(group)


@pytest.mark.parametrize("mesh", [CUBE, propeller()], ids=["cube", "propeller"])
def test_products_are_the_members_that_compose_two_images(mesh):
    problem = Problem.build(mesh, NH, fixed=None if mesh is CUBE else Tag("bore"))
    group = symmetries(problem)
    table, every = products(group), torch.arange(len(group))
    field = torch.randn(problem.shape, generator=torch.Generator().manual_seed(0)).double()
    for i, j in [(0, 1), (1, 0), (1, 2), (2, 1), (3, 5), (5, 3), (4, 4)]:
        both = group[j].image(group[i].image(field))
        assert_close(both, group[int(table[i, j])].image(field), rtol=0, atol=1e-9)
    assert torch.equal(table[0], every), "the identity first"
    for row in (*table, *table.T):
        assert torch.equal(row.sort().values, every)
    assert not torch.equal(table, table.T), "order matters"


def test_without_a_group_the_only_product_is_the_identity():
    assert products([]).tolist() == [[0]]


def test_neither_size_nor_place_nor_numbering_matters():
    shuffled = np.random.default_rng(0).permutation(BEAM.nvertices)
    for mesh in (
        BEAM.scaled(1e-3),
        BEAM.translated((500.0, -300.0, 200.0)),
        type(BEAM)(BEAM.p[:, np.argsort(shuffled)], shuffled[BEAM.t]),
    ):
        assert len(symmetries(Problem.build(mesh, NH, fixed=LEFT))) == 8


@pytest.mark.parametrize("shaken", [1e-8, 1e-3, 0.1])
def test_distorted_meshes_have_the_identity_only(grid, kind, shaken):
    """Shaken by 1e-8 the nodes look symmetric, but images of answers would not be exact."""
    problem = Problem.build(grid(kind[0], 2, shaken), NH, fixed=None, degree=kind[1])
    assert len(symmetries(problem)) == 1


def test_a_sheared_beam_has_no_symmetry():
    shear = np.array([[1.0, 0.3, 0.2], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    mesh = type(BEAM)(shear @ BEAM.p, BEAM.t)
    assert len(symmetries(Problem.build(mesh, NH, fixed=BEAM.p[0] == 0))) == 1
    assert len(symmetries(Problem.build(mesh, NH))) == 2  # the point reflection


@pytest.mark.parametrize("degree", [1, 2])
def test_degree_does_not_matter(degree):
    for cell, order in (("hexahedron", 8), ("tetra", 2)):
        mesh = box([100.0, 25.0, 25.0], [5, 3, 3], cell)
        problem = Problem.build(mesh, NH, fixed=LEFT, degree=degree)
        assert len(symmetries(problem)) == order
    mesh = rectangle([100.0, 25.0], [9, 3])
    assert len(symmetries(Problem.build(mesh, NH, fixed=LEFT, degree=degree))) == 2


@pytest.mark.parametrize("mean", [False, True])
def test_isotropic_laws_do_not_matter(isotropic_law, mean):
    mesh = box([4.0, 1.0, 1.0], [5, 3, 3])
    problem = Problem.build(mesh, isotropic_law, fixed=LEFT, mean_dilatation=mean)
    assert len(symmetries(problem)) == 8


def test_no_law_fails_on_motions_that_are_no_symmetries(isotropic_law):
    """Nodes that are symmetric and cells that are not: images of displacements fold the cells."""
    mesh = box([4.0, 1.0, 1.0], [5, 3, 3], "tetra")
    assert len(symmetries(Problem.build(mesh, isotropic_law, fixed=LEFT))) == 2


@dataclass(frozen=True)
class Fibred(Material):
    """Neo-Hookean solid with fibres along the direction (0, 1, 0)."""

    def energy(self, H):
        """Return the energy density, see `Material.energy`."""
        stretched = ((H[..., 1] + torch.eye(3, dtype=H.dtype)[1]).square().sum(-1) - 1) / 2
        return NH.energy(H) + stretched.square()


def test_fibres_across_the_beam_leave_half_of_its_symmetries():
    group = symmetries(Problem.build(box([4.0, 1.0, 1.0], [5, 3, 3]), Fibred(), fixed=LEFT))
    assert len(group) == 4
    assert all(symmetry.rotation[1, 1].abs() == 1 for symmetry in group)


@pytest.mark.parametrize(
    ("supports", "order"),
    [
        ([DirichletBC(LEFT)], 8),
        ([DirichletBC(LEFT), DirichletBC(RIGHT)], 16),
        ([DirichletBC(Box([0, 0, 0], [0, 0, 1]))], 4),  # an edge: its two mirrors
        ([DirichletBC(Box([0, 0, 0], [0, 0, 0]))], 6),  # a corner: turns about the diagonal
        ([DirichletBC(LEFT, [0.0, None, None])], 8),
        ([DirichletBC(LEFT, [None, 0.0, None])], 4),
        (
            [
                DirichletBC(Plane(axis, "min"), np.where(np.eye(3)[axis], 0, None))
                for axis in (0, 1)
            ],
            4,
        ),
        ([DirichletBC(LEFT), DirichletBC(RIGHT, [0.1, None, None])], 8),
        ([DirichletBC(LEFT), DirichletBC(RIGHT, [-0.1, 0.0, 0.0])], 8),
        ([DirichletBC(LEFT), DirichletBC(RIGHT, [0.1, 0.0, 1e-6])], 2),
        ([DirichletBC(LEFT, [-0.1, 0, 0]), DirichletBC(RIGHT, [0.1, 0, 0])], 16),
        ([DirichletBC(LEFT), RobinBC(RIGHT, 0.1)], 8),
        ([DirichletBC(LEFT), RobinBC(RIGHT, [0.1, 0.2, 0.2])], 8),
        ([DirichletBC(LEFT), RobinBC(RIGHT, [0.1, 0.2, 0.3])], 4),
        ([DirichletBC(LEFT), RobinBC(Plane(1, "max"), 1e-13)], 2),
        ([DirichletBC(LEFT), RobinBC(Plane(1, "max"), 1e13)], 2),
    ],
)
def test_boundary_conditions_reduce_the_group_to_their_symmetries(supports, order):
    """A cube, whose nodes and cells have 48 symmetries."""
    group = symmetries(Problem.build(CUBE, NH, supports=supports))
    assert len(group) == order
    check_group(group)


def test_very_stiff_springs_do_not_hide_the_cells():
    mesh = box([1.0, 1.0, 1.0], [4, 4, 4], "tetra")
    springs = [RobinBC(Plane(axis, side), 1e13) for axis in range(3) for side in ("min", "max")]
    assert len(symmetries(Problem.build(mesh, NH, supports=springs))) == 12


def test_constant_forces_reduce_the_group_to_their_symmetries(solver):
    problem = solver.problem
    stretch, sag, twist = (
        Traction(RIGHT, value).on(problem)
        for value in ([0.1, 0.0, 0.0], [0.0, 0.0, -0.1], [0.1, 0.2, 0.3])
    )
    none = torch.zeros(problem.shape, dtype=torch.float64)
    for also, order in (
        ([none], 8),
        ([stretch], 8),
        ([sag], 2),
        ([stretch, sag], 2),
        ([twist], 1),
        ([stretch + 1e-6 * sag], 2),
    ):
        group = symmetries(problem, also=also)
        assert len(group) == order
        for symmetry, force in itertools.product(group, also):
            assert_close(symmetry.image(force), force, rtol=0, atol=1e-13)


def test_images_of_solutions_are_solutions_of_the_images_of_their_loads(solver):
    problem = solver.problem
    load = ModalLoads(solver.linear_solver, n_modes=5).sample(0, range(4))
    load = Load(load.force * torch.tensor([1.0, 1.0, 1e-3, 1e-6])[:, None, None], load.young)
    answer = solve(solver, load)
    assert answer.converged.all()
    for symmetry in symmetries(problem):
        image, force = symmetry.image(answer.displacement), symmetry.image(load.force)
        ratio = problem.relative_residual(image, force)
        assert (ratio < 1e-8).all()
        assert_close(ratio, answer.residual, rtol=1e-2, atol=1e-11)
        assert_close(problem.evaluate(image).volume_ratio, answer.volume_ratio)
        assert not image[:, ~problem.free].any()


@pytest.mark.parametrize("mean", [False, True])
def test_images_of_solutions_with_moved_supports_and_springs_are_solutions(law, mean):
    supports = [
        DirichletBC(LEFT),
        DirichletBC(RIGHT, [0.1, None, None]),
        RobinBC(Plane(2, "min"), 0.3),
    ]
    problem = Problem.build(CUBE, law, supports=supports, mean_dilatation=mean)
    force = Traction(Plane(1, "max"), [0.01, -0.03, 0.02]).on(problem)
    answer = solve(Newton(problem, linear="superlu"), Load(force[None], torch.ones(1)))
    assert answer.converged.all()
    group = symmetries(problem)
    assert len(group) == 2
    for symmetry in group:
        image = symmetry.image(answer.displacement)
        assert problem.relative_residual(image, symmetry.image(force)[None]) < 1e-8
        assert_close(image[0][~problem.free], problem.prescribed[~problem.free], rtol=0, atol=1e-15)


def test_linear_solutions_are_mapped_with_their_loads(solver, bend):
    problem = solver.problem
    linear = LinearSolver(problem, linear="superlu")
    force = torch.where(problem.free, bend(problem.points)[0], 0.0)
    answer = linear.solve(force)
    for symmetry in symmetries(problem):
        expected = symmetry.image(answer)
        found = linear.solve(symmetry.image(force))
        assert (found - expected).abs().max() < 1e-10 * expected.abs().max()


def test_images_keep_norms_shape_and_type(solver):
    problem = solver.problem
    field = torch.rand(3, 2, *problem.shape, dtype=torch.float64, generator=torch.Generator())
    for symmetry in symmetries(problem):
        image = symmetry.image(field)
        assert image.shape == field.shape
        assert_close(image.norm(dim=(-2, -1)), field.norm(dim=(-2, -1)), rtol=1e-14, atol=0)
        assert torch.equal(image[1, 0], symmetry.image(field[1, 0]))
        single = symmetry.image(field.float())
        assert single.dtype == torch.float32
        assert torch.equal(single, image.float())  # turns by right angles are exact


def test_the_order_is_always_the_same():
    problem = Problem.build(ring(5), LinearElastic(0.3))
    first, again = symmetries(problem), symmetries(problem)
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.rotation, other.rotation)
        assert torch.equal(one.source, other.source)


def test_a_body_with_coincident_nodes_has_the_identity_only():
    """Two cubes that touch without nodes in common: which of the two is the image is not known."""
    shifted = CUBE.translated((1.0, 0.0, 0.0))
    cells = np.concatenate([CUBE.t, shifted.t + CUBE.nvertices], axis=1)
    mesh = skfem.MeshHex(np.concatenate([CUBE.p, shifted.p], axis=1), cells)
    (one,) = symmetries(Problem.build(mesh, NH))
    assert one.source.tolist() == list(range(mesh.nvertices))
