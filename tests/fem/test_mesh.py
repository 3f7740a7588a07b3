"""Laws of meshes: grids, regions, what a file may hold, and what it gives back."""

import math
from pathlib import Path

import meshio
import numpy as np
import pytest
import skfem

from dpl.fem.mesh import Box, Plane, box, check, load, longest_side, rectangle, save

CORNERS = np.array(  # of a hexahedron, in the order of files (VTK, Gmsh)
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)
TETS = np.array([[0, 1, 3, 4], [1, 2, 3, 6], [1, 3, 4, 6], [1, 4, 5, 6], [3, 4, 6, 7]])  # of a cube
TWO_CUBES = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], float)
TWO_HEXES = np.array([[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]])
PATCH = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])  # four triangles
FAN = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def write(path: Path, points, **cells) -> Path:
    """Write a mesh by meshio alone; cells are its kinds and their nodes."""
    kind = {"file_format": "gmsh"} if path.suffix == ".msh" else {}
    meshio.write(path, meshio.Mesh(points, list(cells.items())), **kind)
    return path


def volumes(mesh: skfem.Mesh) -> np.ndarray:
    """Return the volumes of the cells."""
    return skfem.Basis(mesh, mesh.elem(), intorder=6).dx.sum(axis=1)


GRIDS = [
    (box, [4.0, 1.0, 2.0], [5, 2, 3], "hexahedron", 8),
    (box, [4.0, 1.0, 2.0], [5, 2, 3], "tetra", 48),
    (rectangle, [4.0, 1.0], [5, 3], "quad", 8),
    (rectangle, [4.0, 1.0], [5, 3], "triangle", 16),
]


@pytest.mark.parametrize(("grid", "size", "nodes", "cell", "cells"), GRIDS)
def test_grid_fills_its_box_with_equal_cells(grid, size, nodes, cell, cells):
    mesh = grid(size, nodes, cell)
    assert mesh.p.shape == (len(size), math.prod(nodes))
    assert mesh.t.shape[1] == cells
    assert volumes(mesh) == pytest.approx(math.prod(size) / cells, rel=1e-12)
    assert mesh.p.min(axis=1) == pytest.approx(0.0)
    assert mesh.p.max(axis=1) == pytest.approx(size)
    assert check(mesh) is mesh


@pytest.mark.parametrize(("grid", "size", "nodes", "cell", "_"), GRIDS)
def test_cells_of_a_grid_know_only_near_numbers(grid, size, nodes, cell, _):
    """The half bandwidth is one layer across the side with the most nodes, a row and a node."""
    mesh = grid(size, nodes, cell)
    few = sorted(nodes)[:-1]
    layer = math.prod(few)
    row = few[0] if len(few) == 2 else 0
    assert np.ptp(mesh.t, axis=0).max() <= layer + row + 1


@pytest.mark.parametrize("order", [(9, 3, 2), (2, 9, 3), (3, 2, 9)])
def test_numbering_of_a_box_does_not_depend_on_where_its_long_side_points(order):
    assert np.ptp(box([1.0, 1.0, 1.0], order).t, axis=0).max() == 2 * 3 + 2 + 1


@pytest.mark.parametrize(
    ("size", "nodes", "cell", "message"),
    [
        ([1, 1], [2, 2, 2], "hexahedron", "size"),
        ([1, 1, 0], [2, 2, 2], "hexahedron", "size"),
        ([1, 1, -1], [2, 2, 2], "tetra", "size"),
        ([1, 1, math.nan], [2, 2, 2], "hexahedron", "size"),
        ([1, 1, math.inf], [2, 2, 2], "hexahedron", "size"),
        ([1, 1, 1], [2, 2], "hexahedron", "nodes"),
        ([1, 1, 1], [2, 2, 1], "hexahedron", "nodes"),
        ([1, 1, 1], [2, 2, 2.5], "hexahedron", "nodes"),
        ([1, 1, 1], [2, 2, 2], "quad", "cell"),
    ],
)
def test_box_out_of_range_is_an_error(size, nodes, cell, message):
    with pytest.raises(ValueError, match=message):
        box(size, nodes, cell)


def test_rectangle_out_of_range_is_an_error():
    with pytest.raises(ValueError, match="size"):
        rectangle([1, 1, 1], [2, 2])
    with pytest.raises(ValueError, match="cell"):
        rectangle([1, 1], [2, 2], "hexahedron")


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Return 3D points turned about the axis (1, 2, 3)."""
    x, y, z = np.array([1, 2, 3]) / math.sqrt(14)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return points @ (np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K).T


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.0, 2.5])
def test_longest_side_of_a_beam_does_not_depend_on_how_it_lies(angle):
    beam = box([4.0, 1.0, 0.5], [9, 3, 2]).p.T + np.array([10, -3, 2])
    assert longest_side(turned(beam, angle)) == pytest.approx(4.0, rel=1e-9)


@pytest.mark.parametrize("nodes", [2, 3, 6])
def test_longest_side_of_a_cube_is_its_side(nodes):
    assert longest_side(box([2.0] * 3, [nodes] * 3).p.T) == pytest.approx(2.0, rel=1e-12)
    assert longest_side(rectangle([2.0] * 2, [nodes] * 2).p.T) == pytest.approx(2.0, rel=1e-12)


@pytest.mark.parametrize(
    ("region", "count"),
    [
        (Plane(0, "min"), 6),
        (Plane(0, "max"), 6),
        (Plane(0, 2.0), 6),
        (Plane(1, 0.0), 15),
        (Plane(2, "max"), 10),
        (Plane(0, 2.5), 0),
        (Box([1, 0, 0], [3, 1, 2]), 18),
        (Box([0, 0, 0], [0, 0, 0]), 1),
        (Box([0, 0, 1], [4, 1, 1]), 10),
        (Box([5, 0, 0], [6, 1, 1]), 0),
    ],
)
def test_region_selects_its_nodes(region, count):
    points = box([4.0, 1.0, 2.0], [5, 2, 3]).p.T
    inside = region(points)
    assert inside.shape == (30,)
    assert inside.sum() == count


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_regions_forgive_rounding_at_every_scale(scale):
    points = scale * box([0.3, 0.1, 0.1], [4, 2, 2]).p.T
    assert Plane(0, 0.1 * scale)(points).sum() == 4
    assert Box([0, 0, 0], [0.2 * scale, 0.1 * scale, 0.1 * scale])(points).sum() == 12


def test_region_that_cannot_be_is_an_error():
    with pytest.raises(ValueError, match="axis"):
        Plane(3, "min")
    with pytest.raises(ValueError, match="at"):
        Plane(0, "middle")
    with pytest.raises(ValueError, match="2D"):
        Plane(2, "min")(np.zeros((4, 2)))


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_hexahedra_come_out_of_a_file_as_they_went_in(tmp_path, suffix):
    mesh = load(write(tmp_path / f"bar{suffix}", TWO_CUBES, hexahedron=TWO_HEXES))
    assert isinstance(mesh, skfem.MeshHex)
    assert np.array_equal(mesh.p.T, TWO_CUBES)
    assert volumes(mesh) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_tetrahedra_come_out_of_a_file_as_they_went_in(tmp_path, suffix):
    mesh = load(write(tmp_path / f"cube{suffix}", CORNERS, tetra=TETS))
    assert isinstance(mesh, skfem.MeshTet)
    assert np.array_equal(mesh.p.T, CORNERS)
    assert np.sort(volumes(mesh)) == pytest.approx([1 / 6] * 4 + [1 / 3], rel=1e-14)


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_planar_triangles_become_a_2d_mesh(tmp_path, suffix):
    mesh = load(write(tmp_path / f"patch{suffix}", PATCH, triangle=FAN))
    assert isinstance(mesh, skfem.MeshTri)
    assert np.array_equal(mesh.p.T, PATCH[:, :2])
    assert volumes(mesh) == pytest.approx(0.25, rel=1e-14)


def test_planar_quads_become_a_2d_mesh(tmp_path):
    mesh = load(write(tmp_path / "square.vtu", PATCH[:4], quad=np.array([[0, 1, 2, 3]])))
    assert isinstance(mesh, skfem.MeshQuad)
    assert volumes(mesh) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_quadratic_tetrahedra_keep_their_curved_edges(tmp_path, suffix):
    edges = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]  # order of VTK
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    points = np.concatenate([corners, [(corners[a] + corners[b]) / 2 for a, b in edges]])
    points[5] += 0.05  # the middle of edge 1-2 bulges
    mesh = load(write(tmp_path / f"curved{suffix}", points, tetra10=np.arange(10)[None]))
    assert isinstance(mesh, skfem.MeshTet2)
    assert {tuple(x) for x in mesh.p.T} == {tuple(x) for x in points}
    assert volumes(mesh)[0] > 1 / 6 + 1e-3


def test_quadratic_hexahedra_keep_their_volume(tmp_path):
    """A wrong order of the 27 nodes would change it."""
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6)]
    edges += [(6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    faces = [(0, 4, 7, 3), (1, 5, 6, 2), (0, 1, 5, 4), (3, 2, 6, 7), (0, 3, 2, 1), (4, 5, 6, 7)]
    groups = [(k,) for k in range(8)] + edges + faces + [tuple(range(8))]  # order of VTK
    points = np.array([CORNERS[list(group)].mean(axis=0) for group in groups]) * [3, 2, 1]
    mesh = load(write(tmp_path / "brick.vtu", points, hexahedron27=np.arange(27)[None]))
    assert isinstance(mesh, skfem.MeshHex2)
    assert volumes(mesh) == pytest.approx(6.0, rel=1e-13)


def test_listing_the_nodes_of_a_cell_the_other_way_round_changes_nothing(tmp_path):
    """Files differ in it, and so do the tetrahedra of one box."""
    tets = TETS.copy()
    tets[1::2, :2] = tets[1::2, 1::-1]
    mesh = load(write(tmp_path / "cube.vtu", CORNERS, tetra=tets))
    assert volumes(mesh).sum() == pytest.approx(1.0, rel=1e-14)
    mesh = load(write(tmp_path / "fan.vtu", PATCH, triangle=FAN[:, ::-1]))
    assert volumes(mesh).sum() == pytest.approx(1.0, rel=1e-14)


def test_load_keeps_the_cells_of_the_highest_dimension_and_the_nodes_they_use(tmp_path):
    points = np.concatenate([[[9, 9, 9]], TWO_CUBES, [[8, 8, 8]]])
    path = write(
        tmp_path / "all.vtu",
        points,
        vertex=np.array([[0]]),
        line=np.array([[0, 1]]),
        quad=TWO_HEXES[:, :4] + 1,
        hexahedron=TWO_HEXES + 1,
    )
    mesh = load(path)
    assert np.array_equal(mesh.p.T, TWO_CUBES)
    assert mesh.t.shape == (8, 2)


def test_several_blocks_of_one_kind_are_one_body(tmp_path):
    blocks = [("hexahedron", TWO_HEXES[:1]), ("line", [[0, 1]]), ("hexahedron", TWO_HEXES[1:])]
    meshio.write(tmp_path / "bar.vtu", meshio.Mesh(TWO_CUBES, blocks))
    assert len(meshio.read(tmp_path / "bar.vtu").cells) == 3
    assert load(tmp_path / "bar.vtu").t.shape == (8, 2)


def test_missing_file_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.vtu"):
        load(tmp_path / "none.vtu")
    with pytest.raises(FileNotFoundError):
        load(tmp_path)


@pytest.mark.parametrize("name", ["junk.vtu", "junk.msh", "junk.vtk", "junk.inp", "junk.what"])
@pytest.mark.parametrize("text", ["", "no mesh at all\n"])
def test_unreadable_file_is_an_error_that_names_it(tmp_path, name, text):
    """On some of these meshio calls sys.exit (VERIFICATION 0.8)."""
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=name):
        load(tmp_path / name)


def test_half_a_file_is_an_error(tmp_path):
    path = write(tmp_path / "bar.vtu", TWO_CUBES, hexahedron=TWO_HEXES)
    text = path.read_bytes()
    path.write_bytes(text[: len(text) // 2])
    with pytest.raises(ValueError, match="cannot be read"):
        load(path)


def with_node(points: np.ndarray, index: int, place) -> np.ndarray:
    """Return the points with one of them elsewhere."""
    moved = np.array(points, dtype=float)
    moved[index] = place
    return moved


FAR = TWO_CUBES + np.array([5, 0, 0])
NEXT = TWO_CUBES + np.array([2, 0, 0])
BAD = {
    "not a number": ("not finite", with_node(TWO_CUBES, 3, np.nan), {"hexahedron": TWO_HEXES}),
    "infinite": ("not finite", with_node(TWO_CUBES, 3, np.inf), {"hexahedron": TWO_HEXES}),
    "index from one": ("nodes 1 to 12", TWO_CUBES, {"hexahedron": TWO_HEXES + 1}),
    "index too large": (
        "to 99",
        TWO_CUBES,
        {"hexahedron": np.where(TWO_HEXES > 10, 99, TWO_HEXES)},
    ),
    "index below zero": ("nodes -1", TWO_CUBES, {"hexahedron": TWO_HEXES - 1}),
    "inverted hexahedron": (
        "inverted",
        with_node(TWO_CUBES, 8, [0.2, -0.2, 0.8]),
        {"hexahedron": TWO_HEXES},
    ),
    "inverted tetrahedron": ("inverted", with_node(CORNERS, 0, [2, 2, 2]), {"tetra": TETS}),
    "inverted triangle": ("inverted", with_node(PATCH, 4, [1.5, 0.5, 0]), {"triangle": FAN}),
    "flat hexahedra": ("no volume", TWO_CUBES * [1, 1, 0], {"hexahedron": TWO_HEXES}),
    "one flat hexahedron": (
        "1 cells are of no volume: 1",
        np.minimum(TWO_CUBES, 1),
        {"hexahedron": TWO_HEXES},
    ),
    "flat tetrahedron": (
        "no volume",
        CORNERS,
        {"tetra": np.concatenate([TETS, [[0, 1, 2, 3]]])},
    ),
    "flat triangle": ("no volume", with_node(PATCH, 4, [0.5, 0, 0]), {"triangle": FAN}),
    "crack": (
        "4 nodes coincide",
        np.concatenate([TWO_CUBES, NEXT]),
        {"hexahedron": np.concatenate([TWO_HEXES, TWO_HEXES + 12])},
    ),
    "two pieces": (
        "2 pieces (of 12, 12 nodes)",
        np.concatenate([TWO_CUBES, FAR]),
        {"hexahedron": np.concatenate([TWO_HEXES, TWO_HEXES + 12])},
    ),
    "two kinds": (
        "mixes hexahedron and tetra",
        np.concatenate([TWO_CUBES, CORNERS + np.array([2, 0, 0])]),
        {"hexahedron": TWO_HEXES, "tetra": TETS + 12},
    ),
    "lines only": ("no cells that can be solved", TWO_CUBES, {"line": TWO_HEXES[:, :2]}),
    "wedges": ("no cells that can be solved", TWO_CUBES, {"wedge": np.array([[0, 1, 3, 6, 7, 9]])}),
    "surface in space": (
        "surface in space",
        with_node(PATCH, 4, [0.5, 0.5, 0.3]),
        {"triangle": FAN},
    ),
    "surface of a box": ("surface in space", TWO_CUBES, {"quad": TWO_HEXES[:, :4] + [0, 0, 6, 6]}),
}


@pytest.mark.parametrize("flaw", BAD)
def test_mesh_that_cannot_be_solved_is_an_error_that_says_why(tmp_path, flaw):
    message, points, cells = BAD[flaw]
    path = write(tmp_path / "bad.vtu", points, **cells)
    with pytest.raises(ValueError, match=r"bad\.vtu") as error:
        load(path)
    assert message in str(error.value)


@pytest.mark.parametrize(
    "mesh",
    [
        box([2.0, 1.0, 1.0], [3, 2, 2]),
        box([2.0, 1.0, 1.0], [3, 2, 2], "tetra"),
        rectangle([2.0, 1.0], [3, 2]),
        rectangle([2.0, 1.0], [3, 2], "triangle"),
        skfem.MeshTet2.from_mesh(box([2.0, 1.0, 1.0], [3, 2, 2], "tetra")),
        skfem.MeshHex2.from_mesh(box([2.0, 1.0, 1.0], [3, 2, 2])),
    ],
    ids=lambda mesh: type(mesh).__name__,
)
@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
def test_save_and_load_give_the_mesh_and_its_fields_back(tmp_path, mesh, suffix):
    path = tmp_path / "new" / f"body{suffix}"
    nodes, dim = mesh.p.shape[1], mesh.dim()
    vector, scalar = np.arange(nodes * dim).reshape(nodes, dim) / 7, np.arange(nodes) / 3
    save(path, mesh, {"displacement": vector, "energy": scalar})
    again = load(path)
    assert type(again) is type(mesh)
    assert np.array_equal(again.p, mesh.p)
    assert volumes(again) == pytest.approx(volumes(mesh), rel=1e-13)
    data = meshio.read(path).point_data
    vertices = mesh.nvertices
    assert np.array_equal(data["displacement"][:vertices, :dim], vector[:vertices])
    assert not data["displacement"][:, dim:].any()
    assert np.array_equal(data["energy"][:vertices], scalar[:vertices])
