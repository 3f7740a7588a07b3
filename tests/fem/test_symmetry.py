"""Symmetries of a body: all of them are found, they form a group, and map solutions exactly."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import skfem
import torch
from laws import ISOTROPIC, LAWS
from solving import sliding
from torch.testing import assert_close

from dpl import fem
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.rom.pod import scatter_fields

NH = fem.NeoHookeanLn(0.3)
LEFT, RIGHT = fem.Plane(0, "min"), fem.Plane(0, "max")
CUBE = fem.box([1.0, 1.0, 1.0], [4, 4, 4])
BEAM = fem.box([100.0, 25.0, 25.0], [9, 4, 4])
PLATE = fem.rectangle([100.0, 25.0], [9, 4])
COARSE = [1, 1, 1, 2, 3]  # cells of a propeller
BODIES = {  # mesh, what is held, order of the group
    "beam of square section": (BEAM, LEFT, 8),
    "beam of rectangular section": (fem.box([100.0, 25.0, 10.0], [9, 4, 3]), LEFT, 4),
    "beam of square section, unequal cells": (fem.box([100.0, 25.0, 25.0], [9, 4, 3]), LEFT, 4),
    "cantilever": (fem.rectangle([100.0, 25.0], [17, 5]), LEFT, 2),
    "cantilever of triangles": (fem.rectangle([100.0, 25.0], [17, 5], "triangle"), LEFT, 1),
    "free cube": (CUBE, None, 48),
    "free square": (fem.rectangle([1.0, 1.0], [4, 4]), None, 8),
    "free square of triangles": (fem.rectangle([1.0, 1.0], [4, 4], "triangle"), None, 4),
    "free cube of tetrahedra": (fem.box([1.0, 1.0, 1.0], [4, 4, 4], "tetra"), None, 12),
    "beam of tetrahedra": (fem.box([100.0, 25.0, 25.0], [9, 4, 4], "tetra"), LEFT, 2),
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
def body(request) -> tuple[fem.Problem, int]:
    """Each of the bodies, and the order of its group."""
    mesh, fixed, order = BODIES[request.param]
    return fem.Problem.build(mesh, NH, fixed=fixed), order


@pytest.fixture(scope="module")
def solver() -> fem.Newton:
    """The beam with eight symmetries."""
    return fem.Newton(fem.Problem.build(BEAM, NH, fixed=LEFT), linear="superlu")


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


def test_all_symmetries_are_found_and_are_a_group_that_starts_with_the_identity(body, bend):
    """The matrix that maps the nodes is the one that rotates vectors."""
    problem, order = body
    group = fem.symmetries(problem)
    assert len(group) == order
    check_group(group)
    assert torch.equal(group[0].rotation, torch.eye(problem.shape[1], dtype=torch.float64))
    assert group[0].source.tolist() == list(range(problem.shape[0]))
    field = bend(problem.points, 2)
    assert torch.equal(group[0].image(field), field)
    points = problem.points - problem.points.mean(dim=0)
    for symmetry in group:
        assert_close(symmetry.image(points), points, rtol=0, atol=1e-14)


def test_energy_force_and_volume_ratio_are_those_of_the_image(body, bend):
    problem, _ = body
    u = bend(problem.points, 2, seed=5)
    internal, volume = problem.evaluate(u)
    for symmetry in fem.symmetries(problem):
        image = problem.evaluate(symmetry.image(u))
        assert_close(problem.energy(symmetry.image(u)), problem.energy(u), rtol=1e-12, atol=0)
        assert_close(image.internal, symmetry.image(internal), rtol=0, atol=1e-13)
        assert_close(image.volume_ratio, volume, rtol=1e-12, atol=0)


@pytest.mark.parametrize("blades", [2, 3, 5])
def test_a_propeller_has_two_rotations_per_blade_and_no_reflection(blades):
    """About the shaft, and by half a turn about each blade, whose sections look the same."""
    group = fem.symmetries(
        fem.Problem.build(fem.propeller(blades=blades), NH, fixed=fem.Tag("bore"))
    )
    assert len(group) == 2 * blades
    assert all(torch.det(symmetry.rotation) > 0 for symmetry in group)
    about_the_shaft = [s for s in group if s.rotation[0, 0] > 0]
    assert len(about_the_shaft) == blades
    check_group(group)


@pytest.mark.parametrize("corners", [4, 5, 7, 12])
def test_rotations_and_reflections_of_rings_are_found_in_every_orientation(corners):
    group = fem.symmetries(fem.Problem.build(ring(corners), NH))
    assert len(group) == 4 * corners
    check_group(group)


PROPELLER = fem.propeller(cells=COARSE)
FEW = pytest.mark.parametrize(
    ("mesh", "fixed", "count"),
    [(BEAM, LEFT, 4), (PROPELLER, fem.Tag("bore"), 2), (CUBE, None, 8), (PLATE, LEFT, 2)],
    ids=["beam", "propeller", "cube", "plate"],
)


@FEW
def test_reflections_and_one_member_of_each_coset_compose_all_members(mesh, fixed, count):
    problem = fem.Problem.build(mesh, NH, fixed=fixed)
    group = fem.symmetries(problem)
    field = torch.randn(problem.shape, generator=torch.Generator().manual_seed(0)).double()
    diagonal, others = group.diagonal.tolist(), group.coset_representatives()
    assert len(diagonal) == count
    assert len(diagonal) * len(others) == len(group)
    assert_close(others[0].image(field), field, rtol=0, atol=0)
    products = torch.stack([group[h].image(g.image(field)) for h in diagonal for g in others])
    for symmetry in group:
        assert (products - symmetry.image(field)).abs().amax(dim=(1, 2)).min() < 1e-9


@FEW
def test_cells_are_mapped_like_their_centres(mesh, fixed, count):
    problem = fem.Problem.build(mesh, NH, fixed=fixed)
    group = fem.symmetries(problem)
    centres = (problem.points - problem.points.mean(dim=0))[problem.cells].mean(dim=1)
    for symmetry, image in zip(group, group.cell_images(problem), strict=True):
        assert_close(centres[image], centres @ symmetry.rotation.T, rtol=0, atol=1e-9)


@FEW
def test_fields_are_the_sums_of_their_parts_of_definite_parity(mesh, fixed, count):
    """The parts are orthogonal; reflections multiply them by exactly 1 or -1."""
    problem = fem.Problem.build(mesh, NH, fixed=fixed)
    group, free, dim = fem.symmetries(problem), problem.free, problem.shape[1]
    parities, size = Parities.of(group, dim), int(free.sum())
    assert_close(parities.characters.T @ parities.characters, count * torch.eye(count).double())
    orbits = SignedOrbits.of_field(parities, group, free)
    values = torch.randn(2, size, generator=torch.Generator().manual_seed(0)).double()
    total, squares = torch.zeros(2, size).double(), torch.zeros(2).double()
    for characters in parities.characters:
        coordinates = orbits.coordinates(values, characters)
        part = orbits.fields(coordinates, characters, size)
        total, squares = total + part, squares + coordinates.square().sum(dim=1)
        field = scatter_fields(part, free)
        for number, factor in zip(parities.members.tolist(), characters, strict=True):
            assert torch.equal(group[number].image(field), factor * field)
    assert_close(total, values, rtol=0, atol=1e-13)
    assert_close(squares, values.square().sum(dim=1))


def test_the_inverse_maps_images_back(solver, bend):
    field = bend(solver.problem.points)
    for symmetry in fem.symmetries(solver.problem):
        assert_close(symmetry.inverse.image(symmetry.image(field)), field, rtol=0, atol=1e-14)


def test_a_batch_has_an_image_under_a_member_for_each_field(solver):
    group = fem.symmetries(solver.problem)
    fields = torch.randn(3, *solver.problem.shape, generator=torch.Generator()).double()
    which = torch.tensor([5, 0, 2])
    expected = [group[k].image(field) for k, field in zip(which.tolist(), fields, strict=True)]
    assert torch.equal(group.images(fields, which), torch.stack(expected))


def test_neither_size_nor_place_nor_numbering_matters():
    shuffled = np.random.default_rng(0).permutation(BEAM.nvertices)
    for mesh in (
        BEAM.scaled(1e-3),
        BEAM.translated((500.0, -300.0, 200.0)),
        type(BEAM)(BEAM.p[:, np.argsort(shuffled)], shuffled[BEAM.t]),
    ):
        assert len(fem.symmetries(fem.Problem.build(mesh, NH, fixed=LEFT))) == 8


@pytest.mark.parametrize("shaken", [1e-8, 0.1])
def test_distorted_meshes_have_the_identity_only(grid, kind, shaken):
    """Shaken by 1e-8 the nodes look symmetric, but images of answers would not be exact."""
    problem = fem.Problem.build(grid(kind[0], 2, shaken), NH, fixed=None, degree=kind[1])
    assert len(fem.symmetries(problem)) == 1


def test_a_sheared_beam_has_no_symmetry():
    shear = np.array([[1.0, 0.3, 0.2], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]])
    mesh = type(BEAM)(shear @ BEAM.p, BEAM.t)
    assert len(fem.symmetries(fem.Problem.build(mesh, NH, fixed=BEAM.p[0] == 0))) == 1
    assert len(fem.symmetries(fem.Problem.build(mesh, NH))) == 2  # the point reflection


@pytest.mark.parametrize(
    "options",
    [
        *({"degree": 2, "mean_dilatation": mean} for mean in (False, True)),
        *({"material": LAWS[name]} for name in ISOTROPIC),
    ],
    ids=str,
)
def test_neither_degree_nor_dilatation_nor_an_isotropic_law_matters(options):
    """Of tetrahedra nodes are symmetric and cells are not: images of displacements fold cells."""
    for cell, order in (("hexahedron", 8), ("tetra", 2)):
        mesh = fem.box([4.0, 1.0, 1.0], [5, 3, 3], cell)
        problem = fem.Problem.build(mesh, fixed=LEFT, **{"material": NH} | options)
        assert len(fem.symmetries(problem)) == order


@dataclass(frozen=True)
class Fibred(fem.Material):
    """Neo-Hookean solid with fibres along the direction (0, 1, 0)."""

    def energy(self, H):
        """Return the energy density, see `Material.energy`."""
        stretched = ((H[..., 1] + torch.eye(3, dtype=H.dtype)[1]).square().sum(-1) - 1) / 2
        return NH.energy(H) + stretched.square()


def test_fibres_across_the_beam_leave_half_of_its_symmetries():
    group = fem.symmetries(
        fem.Problem.build(fem.box([4.0, 1.0, 1.0], [5, 3, 3]), Fibred(), fixed=LEFT)
    )
    assert len(group) == 4
    assert all(symmetry.rotation[1, 1].abs() == 1 for symmetry in group)


@pytest.mark.parametrize(
    ("supports", "order"),
    [
        ([fem.DirichletBC(LEFT)], 8),
        ([fem.DirichletBC(LEFT), fem.DirichletBC(RIGHT)], 16),
        ([fem.DirichletBC(fem.Box([0, 0, 0], [0, 0, 1]))], 4),  # an edge: its two mirrors
        ([fem.DirichletBC(fem.Box([0, 0, 0], [0, 0, 0]))], 6),  # a corner: turns about the diagonal
        ([fem.DirichletBC(LEFT, [0.0, None, None])], 8),
        ([fem.DirichletBC(LEFT, [None, 0.0, None])], 4),
        (sliding(3)[:2], 4),
        ([fem.DirichletBC(LEFT), fem.DirichletBC(RIGHT, [0.1, None, None])], 8),
        ([fem.DirichletBC(LEFT), fem.DirichletBC(RIGHT, [-0.1, 0.0, 0.0])], 8),
        ([fem.DirichletBC(LEFT), fem.DirichletBC(RIGHT, [0.1, 0.0, 1e-6])], 2),
        ([fem.DirichletBC(LEFT, [-0.1, 0, 0]), fem.DirichletBC(RIGHT, [0.1, 0, 0])], 16),
        ([fem.DirichletBC(LEFT), fem.RobinBC(RIGHT, 0.1)], 8),
        ([fem.DirichletBC(LEFT), fem.RobinBC(RIGHT, [0.1, 0.2, 0.2])], 8),
        ([fem.DirichletBC(LEFT), fem.RobinBC(RIGHT, [0.1, 0.2, 0.3])], 4),
        ([fem.DirichletBC(LEFT), fem.RobinBC(fem.Plane(1, "max"), 1e-13)], 2),
        ([fem.DirichletBC(LEFT), fem.RobinBC(fem.Plane(1, "max"), 1e13)], 2),
    ],
)
def test_boundary_conditions_reduce_the_group_to_their_symmetries(supports, order):
    """A cube, whose nodes and cells have 48 symmetries."""
    group = fem.symmetries(fem.Problem.build(CUBE, NH, supports=supports))
    assert len(group) == order
    check_group(group)


def test_very_stiff_springs_do_not_hide_the_cells():
    mesh = fem.box([1.0, 1.0, 1.0], [4, 4, 4], "tetra")
    springs = [
        fem.RobinBC(fem.Plane(axis, side), 1e13) for axis in range(3) for side in ("min", "max")
    ]
    assert len(fem.symmetries(fem.Problem.build(mesh, NH, supports=springs))) == 12


def test_constant_forces_reduce_the_group_to_their_symmetries(solver):
    problem = solver.problem
    stretch, sag, twist = (
        fem.Traction(RIGHT, value).on(problem)
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
        group = fem.symmetries(problem, also=also)
        assert len(group) == order
        for symmetry, force in itertools.product(group, also):
            assert_close(symmetry.image(force), force, rtol=0, atol=1e-13)


def test_a_body_with_coincident_nodes_has_the_identity_only():
    """Two cubes that touch without nodes in common: which of the two is the image is not known."""
    shifted = CUBE.translated((1.0, 0.0, 0.0))
    cells = np.concatenate([CUBE.t, shifted.t + CUBE.nvertices], axis=1)
    mesh = skfem.MeshHex(np.concatenate([CUBE.p, shifted.p], axis=1), cells)
    (one,) = fem.symmetries(fem.Problem.build(mesh, NH))
    assert one.source.tolist() == list(range(mesh.nvertices))
