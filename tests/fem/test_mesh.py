"""Meshes: structured grids, the propeller, validation, reading and writing of files."""

import math
import os
import re
import subprocess
import sys
import warnings

import meshio
import numpy as np
import pytest
import skfem

from benchmarks.stress import broken_meshes
from benchmarks.stress.broken_meshes import CORNERS, FAN, PATCH, TETS, TWO_CUBES, TWO_HEXES, write
from dpl import fem
from dpl.fem.mesh import check_mesh, nodes_in
from dpl.fem.mesh.generators import aspect_ratio, longest_side
from dpl.system.memory import at_most

# what the process of a reader adds is in test_mesh_sandbox
pytestmark = pytest.mark.usefixtures("in_process")


def volumes(mesh: skfem.Mesh) -> np.ndarray:
    """Return the volumes of the cells."""
    return skfem.Basis(mesh, mesh.elem(), intorder=6).dx.sum(axis=1)


GRIDS = [
    (fem.box, [4.0, 1.0, 2.0], [5, 2, 3], "hexahedron", 8),
    (fem.box, [4.0, 1.0, 2.0], [5, 2, 3], "tetra", 48),
    (fem.rectangle, [4.0, 1.0], [5, 3], "quad", 8),
    (fem.rectangle, [4.0, 1.0], [5, 3], "triangle", 16),
]


@pytest.mark.parametrize(("grid", "size", "nodes", "cell", "cells"), GRIDS)
def test_grid_fills_its_box_with_equal_cells_and_has_a_small_bandwidth(
    grid, size, nodes, cell, cells
):
    mesh = grid(size, nodes, cell)
    assert mesh.p.shape == (len(size), math.prod(nodes))
    assert mesh.t.shape[1] == cells
    assert volumes(mesh) == pytest.approx(math.prod(size) / cells, rel=1e-12)
    assert mesh.p.min(axis=1) == pytest.approx(0.0)
    assert mesh.p.max(axis=1) == pytest.approx(size)
    assert check_mesh(mesh) is mesh
    # the half bandwidth is one layer across the side with the most nodes, a row and a node
    few = sorted(nodes)[:-1]
    row = few[0] if len(few) == 2 else 0
    assert np.ptp(mesh.t, axis=0).max() <= math.prod(few) + row + 1


def test_more_nodes_than_fit_are_refused_before_they_are_made(monkeypatch):
    def forbidden(*_, **__):
        raise AssertionError("allocated")

    monkeypatch.setattr(np, "linspace", forbidden)
    for make in (
        lambda: fem.box([1, 1, 1], [10**9, 3, 3]),
        lambda: fem.rectangle([1, 1], [10**6, 10**6]),
        lambda: fem.propeller(cells=[1, 1, 1, 2, 10**12]),
    ):
        with pytest.raises(MemoryError, match=r"nodes need .* GB, there are .* GB; take fewer"):
            make()


def rotated(points: np.ndarray, angle: float) -> np.ndarray:
    """Return 3D points rotated about the axis (1, 2, 3)."""
    x, y, z = np.array([1, 2, 3]) / math.sqrt(14)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return points @ (np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K).T


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.0, 2.5])
def test_longest_side_of_a_beam_does_not_depend_on_its_orientation(angle):
    beam = fem.box([4.0, 1.0, 0.5], [9, 3, 2]).p.T + np.array([10, -3, 2])
    assert longest_side(rotated(beam, angle)) == pytest.approx(4.0, rel=1e-9)


@pytest.mark.parametrize("nodes", [2, 3, 6])
def test_longest_side_of_a_cube_is_its_side(nodes):
    assert longest_side(fem.box([2.0] * 3, [nodes] * 3).p.T) == pytest.approx(2.0, rel=1e-12)
    assert longest_side(fem.rectangle([2.0] * 2, [nodes] * 2).p.T) == pytest.approx(2.0, rel=1e-12)


def test_finger_has_a_closed_chamber_within_its_walls():
    mesh = fem.finger([8.0, 4.0, 6.0], [8, 4, 6])
    assert len(mesh.t.T) == 8 * 4 * 6 - 6 * 2 * 2
    with at_most(mesh.p.shape[1], "a run has no more nodes"):
        fem.finger([8.0, 4.0, 6.0], [8, 4, 6])
    facets = mesh.boundaries["chamber"]
    assert len(facets) == 2 * (6 * 2 + 6 * 2 + 2 * 2)
    corners = mesh.p[:, np.unique(mesh.facets[:, facets])]
    np.testing.assert_allclose(corners.min(axis=1), [1, 1, 3])
    np.testing.assert_allclose(corners.max(axis=1), [7, 3, 5])
    chamber = fem.FollowerPressure(fem.Tag("chamber"), 1.0)
    problem = fem.Problem.build(
        mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"), follower_loads=[chamber]
    )
    assert float(problem.force_at_rest.sum(dim=0).abs().max()) < 1e-12, "it is closed"


def test_propeller_has_the_size_of_the_papers():
    """4,025 nodes, 12,075 degrees of freedom; a metre long; fixed at 525 of them.

    Reverse Cuthill-McKee orders them by rings of all blades, not by whole blades.
    """
    mesh = fem.propeller()
    assert np.ptp(mesh.t, axis=0).max() < 250
    assert mesh.p.shape == (3, 4025)
    assert mesh.t.shape == (8, 2550)
    assert longest_side(mesh.p.T) == pytest.approx(1.0, rel=0.03)
    radius = np.hypot(mesh.p[1], mesh.p[2])
    assert radius.max() == pytest.approx(0.5, rel=1e-12)
    assert radius.min() == pytest.approx(0.05, rel=1e-12)
    bore = nodes_in(fem.Tag("bore"), skfem.Basis(mesh, skfem.ElementHex1()))
    assert bore.sum() == 175
    assert np.array_equal(bore, fem.Cylinder(0, 0.05)(mesh.p.T))
    assert {name: len(cells) for name, cells in mesh.subdomains.items()} == {
        "hub": 300,
        "blades": 2250,
    }


@pytest.mark.parametrize("options", [{}, {"blades": 3, "cells": [2, 4, 1, 4, 9]}])
def test_propeller_counts_by_its_formula_and_its_cells_are_sound(options):
    mesh = fem.propeller(**options)
    blades, (t, g, w, c, s) = options.get("blades", 5), options.get("cells", (3, 2, 2, 6, 25))
    nodes = blades * (t + g) * (w + 1) * (c + 1) + blades * (t + 1) * (c + 1) * s
    assert mesh.p.shape == (3, nodes)
    X = skfem.quadrature.get_quadrature(mesh.elem.refdom, 5)[0]
    assert (mesh.mapping().detDF(X) > 0).all()
    assert check_mesh(mesh) is mesh
    assert aspect_ratio(mesh).max() < 20


def test_blades_of_a_propeller_twist_and_taper():
    """Measured on the first blade: direction and length of its sections' chords."""
    mesh = fem.propeller(blades=5)
    radius, angle = np.hypot(mesh.p[1], mesh.p[2]), np.arctan2(mesh.p[2], mesh.p[1])
    pitch, chord = [], []
    for r in np.linspace(0.116, 0.5, 25):
        on = np.isclose(radius, r) & (np.abs(angle) < math.pi / 5)
        assert on.sum() == 28
        section = np.stack([mesh.p[0, on], r * angle[on]], axis=1)
        along = np.linalg.svd(section - section.mean(axis=0))[2][0]
        pitch.append(math.degrees(math.atan2(abs(along[0]), abs(along[1]))))
        chord.append(np.ptp(section @ along))
    assert np.all(np.diff(pitch) < 0)
    assert pitch[-1] == pytest.approx(25.0, abs=0.1)
    assert chord[-1] == pytest.approx(0.1, rel=0.01)
    assert max(chord) > 2 * chord[-1]


INVALID = [  # generator, its options, words of the message
    *(
        (fem.box, {"size": size, "nodes": nodes, "cell": cell}, message)
        for size, nodes, cell, message in (
            ([1, 1], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, 0], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, -1], [2, 2, 2], "tetra", "size"),
            ([1, 1, math.nan], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, math.inf], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, 1], [2, 2], "hexahedron", "nodes"),
            ([1, 1, 1], [2, 2, 1], "hexahedron", "nodes"),
            ([1, 1, 1], [2, 2, 2.5], "hexahedron", "nodes"),
            ([1, 1, 1], [2, 2, 2], "quad", "cell"),
            ([1, 1, 5e-324], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, 1e300], [2, 2, 2], "hexahedron", "size"),
            ([1, 1, 2e6], [2, 2, 2], "hexahedron", "must have a ratio of at most 1e.06"),
        )
    ),
    (fem.rectangle, {"size": [1, 1, 1], "nodes": [2, 2]}, "size"),
    (fem.rectangle, {"size": [1, 1], "nodes": [2, 2], "cell": "hexahedron"}, "cell"),
    *(
        (fem.finger, {"cells": cells}, r"cells = .* must be at least \[3, 3, 4\]")
        for cells in ([2, 4, 4], [8, 2, 4], [8, 4, 5], [8, 4], [8, 4, 2])
    ),
    *(
        (fem.propeller, options, message)
        for options, message in (
            ({"diameter": -1.0}, "diameter = -1.0"),
            ({"diameter": math.nan}, "diameter = nan"),
            ({"hub_diameter": [0.1, 1.0]}, "hub_diameter = .* ascending lengths below 1.0"),
            ({"hub_diameter": [0.2, 0.2]}, "hub_diameter = .* must ascend"),
            ({"hub_diameter": [0.0, 0.2]}, "hub_diameter = .* must be 2"),
            ({"hub_length": math.inf}, "hub_length = inf"),
            ({"blades": 1}, "blades = 1"),
            ({"blades": 2.5}, "blades = 2.5"),
            ({"pitch_angle": [60.0]}, "pitch_angle"),
            ({"pitch_angle": [60.0, 90.0]}, "pitch_angle"),
            ({"pitch_angle": [math.nan, 20.0]}, "pitch_angle"),
            ({"chord": [0.2, 0.0]}, "chord"),
            ({"chord": [0.02, 0.02]}, "chord or thickness fold the blades"),
            ({"thickness": [0.05]}, "thickness"),
            ({"thickness": [0.2, 0.01]}, "no room between 5 blades"),
            ({"blades": 20}, "no room between 20 blades"),
            ({"cells": [3, 2, 2, 6]}, "cells"),
            ({"cells": [3, 2, 2, 6, 0]}, "cells"),
            ({"cells": [3, 2, 2, 6, 2.5]}, "cells"),
        )
    ),
]


@pytest.mark.parametrize(("generator", "options", "message"), INVALID)
def test_generator_out_of_range_is_an_error_of_one_line(generator, options, message):
    with pytest.raises(ValueError, match=message) as error:
        generator(**options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("mesh", "ratio"),
    [
        (fem.box([2.0, 2.0, 2.0], [2, 2, 2]), 1.0),
        (fem.box([5.0, 1.0, 2.0], [2, 2, 2]), 5.0),
        (fem.box([1.0, 1.0, 0.01], [5, 5, 2]), 25.0),
        (fem.rectangle([3.0, 1.0], [2, 2]), 3.0),
        (fem.rectangle([1.0, 1.0], [2, 2], "triangle"), math.sqrt(3)),
        (fem.box([1.0, 1.0, 1.0], [3, 3, 3], "tetra"), 1 + math.sqrt(2)),
        (skfem.MeshHex2.from_mesh(fem.box([5.0, 1.0, 2.0], [2, 2, 2])), 5.0),
        (skfem.MeshTri(np.array([[0, 1, 0.5], [0, 0, 0.75**0.5]]), np.array([[0], [1], [2]])), 1.0),
    ],
)
def test_aspect_ratio_is_longest_over_shortest(mesh, ratio):
    assert aspect_ratio(mesh) == pytest.approx(np.full(mesh.nelements, ratio), rel=1e-9)


WRITTEN = {  # type, nodes, cells and their volumes in ascending order
    "hexahedron": (skfem.MeshHex, TWO_CUBES, TWO_HEXES, [1.0, 1.0]),
    "tetra": (skfem.MeshTet, CORNERS, TETS, [1 / 6] * 4 + [1 / 3]),
    "triangle": (skfem.MeshTri, PATCH, FAN, [0.25] * 4),
    "quad": (skfem.MeshQuad, PATCH[:4], np.array([[0, 1, 2, 3]]), [1.0]),
}


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
@pytest.mark.parametrize("cell", WRITTEN)
def test_cells_of_a_file_are_those_that_were_written_planar_ones_in_2d(tmp_path, cell, suffix):
    kind, points, cells, sizes = WRITTEN[cell]
    mesh = fem.read_mesh(write(tmp_path / f"body{suffix}", points, **{cell: cells}))
    assert isinstance(mesh, kind)
    assert np.array_equal(mesh.p.T, points[:, : mesh.dim()])
    assert np.sort(volumes(mesh)) == pytest.approx(sizes, rel=1e-14)


@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
def test_quadratic_tetrahedra_keep_their_curved_edges(tmp_path, suffix):
    edges = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]  # order of VTK
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    points = np.concatenate([corners, [(corners[a] + corners[b]) / 2 for a, b in edges]])
    points[5] += 0.05  # the middle of edge 1-2 bulges
    mesh = fem.read_mesh(write(tmp_path / f"curved{suffix}", points, tetra10=np.arange(10)[None]))
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
    mesh = fem.read_mesh(write(tmp_path / "brick.vtu", points, hexahedron27=np.arange(27)[None]))
    assert isinstance(mesh, skfem.MeshHex2)
    assert volumes(mesh) == pytest.approx(6.0, rel=1e-13)


INSIDE_OUT = {  # file with cells the other way round, and the words of the warning
    "hexahedron": (TWO_CUBES, TWO_HEXES[:, [4, 5, 6, 7, 0, 1, 2, 3]], "2 of 2 .* inverted"),
    "one hexahedron": (
        *(TWO_CUBES, np.stack([TWO_HEXES[0], TWO_HEXES[1, [4, 5, 6, 7, 0, 1, 2, 3]]])),
        "1 of 2 cells are inverted; their nodes are reordered$",
    ),
    "tetra": (CORNERS, TETS[:, [1, 0, 2, 3]], "5 of 5 cells .* inverted"),
    "one tetra": (
        *(CORNERS, np.concatenate([TETS[:4], TETS[4:, [1, 0, 2, 3]]])),
        "1 of 5 cells .* inverted",
    ),
    "triangle": (
        *(PATCH, np.concatenate([FAN[:3], FAN[3:, ::-1]])),
        "1 of 4 cells list their nodes clockwise, unlike the others; their nodes are reordered",
    ),
    "quad": (
        np.concatenate([PATCH[:4], PATCH[:4][[3, 2]] + np.array([0, 1, 0])]),
        np.array([[0, 1, 2, 3], [3, 4, 5, 2]]),
        "1 of 2 cells .* clockwise",
    ),
}


@pytest.mark.parametrize("name", INSIDE_OUT)
def test_cells_that_are_listed_inside_out_are_read_and_counted_in_a_warning(tmp_path, name):
    """Files differ in it, and so do the tetrahedra of one box."""
    points, cells, reported = INSIDE_OUT[name]
    path = write(tmp_path / "part.vtu", points, **{name.removeprefix("one "): cells})
    with pytest.warns(UserWarning, match=rf"part\.vtu: {reported}") as warned:
        mesh = fem.read_mesh(path)
    assert len(warned) == 1
    size = np.ptp(points, axis=0)
    assert volumes(mesh).sum() == pytest.approx(np.prod(size[: mesh.dim()]), rel=1e-14)


def test_a_valid_file_is_read_without_a_warning(tmp_path):
    for kind, points, cells in (
        ("hexahedron", TWO_CUBES, TWO_HEXES),
        ("tetra", CORNERS, TETS),
        ("triangle", PATCH, FAN),
        ("triangle", PATCH, FAN[:, ::-1]),  # a plane body, seen from the other side
    ):
        path = write(tmp_path / f"{kind}.vtu", points, **{kind: cells})
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert fem.read_mesh(path).nelements == len(cells)


NUMBERS = {  # format: file, a node of it, the same with the number of another
    "gmsh22": ("cube.msh", "\n4 0.0", "\n3 0.0"),
    "gmsh": ("cube.msh", "\n4\n5\n", "\n3\n5\n"),
    "abaqus": ("cube.inp", "\n4, 0.0", "\n3, 0.0"),
    "permas": ("cube.dato", "\n4 0.0", "\n3 0.0"),
    "avsucd": ("cube.avs", "\n4 0.0", "\n3 0.0"),
    "nastran": ("cube.bdf", "BEGIN BULK\n", "BEGIN BULK\nGRID,3,,9.0,9.0,9.0\n"),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_a_node_number_that_is_listed_twice_is_an_error_that_names_it(tmp_path, kind):
    """Meshio would use the last node of that number, wherever it is."""
    name, own, other = NUMBERS[kind]
    path = tmp_path / name
    binary = {"binary": False} if kind.startswith("gmsh") else {}
    meshio.write(path, meshio.Mesh(CORNERS, [("tetra", TETS)]), file_format=kind, **binary)
    assert fem.read_mesh(path).nvertices == 8
    text = path.read_text()
    assert text.count(own) == 1
    path.write_text(text.replace(own, other))
    with pytest.raises(ValueError, match=r"1 node numbers .* more than once: 3") as error:
        fem.read_mesh(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("cell", ["hexahedron", "tetra", "quad", "triangle"])
def test_a_body_that_touches_itself_in_a_node_is_one_body(cell):
    """A ring of cells that is pinched: joined by sides all around."""
    grid, dim = (fem.rectangle, 2) if cell in ("quad", "triangle") else (fem.box, 3)
    mesh = grid([4.0, 4.0, 1.0][:dim], [5, 5, 2][:dim], cell)
    x, y = mesh.p[:2, mesh.t].mean(axis=1)
    hole = ((x > 1) & (x < 2) & (y > 1) & (y < 2)) | ((x > 2) & (x < 3) & (y > 2) & (y < 3))
    kept = mesh.restrict(np.flatnonzero(~hole))
    assert check_mesh(kept).nelements == (~hole).sum()


def test_cells_of_the_highest_dimension_and_their_nodes_are_kept(tmp_path):
    points = np.concatenate([[[9, 9, 9]], TWO_CUBES, [[8, 8, 8]]])
    path = write(
        tmp_path / "all.vtu",
        points,
        vertex=np.array([[0]]),
        line=np.array([[0, 1]]),
        quad=TWO_HEXES[:, :4] + 1,
        hexahedron=TWO_HEXES + 1,
    )
    with pytest.warns(UserWarning, match="2 nodes belong to no cell; they are dropped$"):
        mesh = fem.read_mesh(path)
    assert np.array_equal(mesh.p.T, TWO_CUBES)
    assert mesh.t.shape == (8, 2)


def test_several_blocks_of_one_kind_are_one_body(tmp_path):
    blocks = [("hexahedron", TWO_HEXES[:1]), ("line", [[0, 1]]), ("hexahedron", TWO_HEXES[1:])]
    meshio.write(tmp_path / "bar.vtu", meshio.Mesh(TWO_CUBES, blocks))
    assert len(meshio.read(tmp_path / "bar.vtu").cells) == 3
    assert fem.read_mesh(tmp_path / "bar.vtu").t.shape == (8, 2)


@pytest.mark.parametrize("name", ["junk.vtu", "junk.msh", "junk.vtk", "junk.inp", "junk.what"])
def test_unreadable_file_is_an_error_that_names_it(tmp_path, name):
    """On some of these files meshio calls sys.exit."""
    (tmp_path / name).write_text("no mesh at all\n")
    with pytest.raises(ValueError, match=name):
        fem.read_mesh(tmp_path / name)


@pytest.mark.parametrize("flaw", broken_meshes.BROKEN_MESHES)
def test_invalid_mesh_is_an_error_that_states_the_cause(tmp_path, flaw):
    message, points, cells = broken_meshes.BROKEN_MESHES[flaw]
    path = write(tmp_path / "bad.vtu", np.asarray(points, float), **cells)
    with pytest.raises(ValueError, match=r"bad\.vtu") as error:
        fem.read_mesh(path)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("flaw", ["crack", "hanging nodes", "not a number", "surface in space"])
def test_errors_number_nodes_as_the_file_does(tmp_path, flaw):
    """Nodes that no cell uses are dropped: here every second one."""
    _, points, cells = broken_meshes.BROKEN_MESHES[flaw]
    loose = np.repeat(points, 2, axis=0).astype(float)
    loose[::2] += np.nan  # not even that counts
    errors = []
    for name, nodes, factor in (("tight", points, 1), ("loose", loose, 2)):
        shifted = {kind: factor * np.asarray(t) + factor - 1 for kind, t in cells.items()}
        with pytest.raises(ValueError, match=name) as error:
            fem.read_mesh(write(tmp_path / f"{name}.vtu", np.asarray(nodes, float), **shifted))
        text = str(error.value).split(name)[1]
        named = ":".join(text.split(":")[2:])
        errors.append([int(n) for n in re.findall(r"\d+", named)])
    assert errors[0]
    assert errors[1] == [2 * n + 1 for n in errors[0]]


def joined(first: skfem.Mesh, second: skfem.Mesh) -> skfem.Mesh:
    """Return two meshes as one, nodes in one place merged."""
    p = np.concatenate([first.p, second.p], axis=1)
    _, one, all_of_them = np.unique(
        np.round(p, 9) + 0.0, axis=1, return_index=True, return_inverse=True
    )
    t = np.concatenate([first.t, second.t + first.p.shape[1]], axis=1)
    return type(first)(p[:, one], all_of_them.ravel()[t])


def warped(mesh: skfem.Mesh, size: float) -> skfem.Mesh:
    """Return the mesh with twisted planes, or inclined lines."""
    p = mesh.p.copy()
    p[0] += size * p[1] * (p[2] if len(p) == 3 else 1)
    return type(mesh)(p, mesh.t)


@pytest.mark.parametrize(("coarse", "fine", "warp"), [(2, 3, 0.0), (1, 4, 0.2)])
@pytest.mark.parametrize("cell", ["hexahedron", "tetra", "quad", "triangle"])
def test_fine_cells_on_coarse_ones_are_an_error(cell, coarse, fine, warp):
    """All nodes that the other side lacks hang; on a warped plane tetrahedra have edges there."""
    grid, dim = (fem.rectangle, 2) if cell in ("quad", "triangle") else (fem.box, 3)
    second = grid([1.0] * dim, [fine + 1] * dim, cell)
    first = grid([1.0] * dim, [coarse + 1] * dim, cell)
    mesh = joined(first, type(second)(second.p + np.eye(dim)[:, :1], second.t))
    shared = (coarse * math.gcd(coarse, fine) // coarse + 1) ** (dim - 1)
    lacking = (fine + 1) ** (dim - 1) + (coarse + 1) ** (dim - 1) - 2 * shared
    with pytest.raises(ValueError, match="hanging nodes") as error:
        check_mesh(warped(mesh, warp))
    hanging = int(str(error.value).split()[0])
    assert hanging == lacking or (cell == "tetra" and warp and 0 < hanging < lacking)


def test_sides_cut_along_the_other_diagonal_are_an_error():
    first = fem.box([1.0, 1.0, 1.0], [2, 2, 2], "tetra")
    fits = type(first)(np.stack([2 - first.p[0], first.p[1], first.p[2]]), first.t)
    check_mesh(joined(first, fits))
    crossed = type(first)(np.stack([2 - first.p[0], 1 - first.p[1], first.p[2]]), first.t)
    with pytest.raises(ValueError, match="overlap without being the same"):
        check_mesh(joined(first, crossed))


@pytest.mark.parametrize("cell", ["hexahedron", "tetra"])
@pytest.mark.parametrize(("layer", "place"), [(50.0, 37.5 + 1.25e-7), (87.5, 100 - 1.25e-7)])
def test_a_layer_of_slivers_is_valid(cell, layer, place):
    """Inside of the beam and at its end."""
    mesh = fem.box([100.0, 25.0, 25.0], [9, 3, 3], cell)
    p = mesh.p.copy()
    p[0, p[0] == layer] = place
    thinned = type(mesh)(p, mesh.t)
    assert check_mesh(thinned) is thinned


@pytest.mark.parametrize("cell", ["hexahedron", "tetra", "quad", "triangle"])
def test_distorted_thin_and_distant_meshes_are_valid(cell, grid):
    mesh = grid(cell, 4, shaken=0.15)
    flat = np.where(np.arange(mesh.dim()) == mesh.dim() - 1, 1e-3, 1.0)[:, None]
    for p in (mesh.p, mesh.p + 1e4, mesh.p * 1e-6, mesh.p * 1e6, mesh.p * flat, -mesh.p):
        moved = type(mesh)(p, mesh.t)
        assert check_mesh(moved) is moved


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cell", ["tetra", "triangle"])
def test_folded_simplices_are_an_error(cell, seed, grid):
    """The volume that the boundary encloses is the flux of x / D through it."""
    mesh = grid(cell, 4)
    random = np.random.default_rng(seed)
    p = mesh.p + 0.25 * random.uniform(-1, 1, mesh.p.shape) * (random.random(mesh.nvertices) < 0.1)
    mesh = type(mesh)(p, mesh.t)
    boundary = skfem.FacetBasis(mesh, mesh.elem(), intorder=4)
    flux = (boundary.normals * boundary.global_coordinates()).sum(axis=0) * boundary.dx
    if abs(flux.sum() / mesh.dim() / volumes(mesh).sum() - 1) > 1e-9:
        with pytest.raises(ValueError, match="inverted, folded over"):
            check_mesh(mesh)
    else:
        check_mesh(mesh)


def test_a_mesh_built_by_hand_may_not_have_nodes_without_a_cell():
    mesh = fem.box([1.0, 1.0, 1.0], [2, 2, 2])
    with pytest.raises(ValueError, match="1 nodes belong to no cell: 0"):
        check_mesh(skfem.MeshHex(np.concatenate([[[9], [9], [9]], mesh.p], axis=1), mesh.t + 1))


def test_thirty_thousand_nodes_can_be_checked():
    """A comparison of all pairs would not fit in memory."""
    mesh = fem.box([1.0, 1.0, 1.0], [31, 31, 31])
    assert check_mesh(mesh) is mesh


def test_vtu_of_several_pieces_is_an_error(tmp_path):
    """Meshio would keep the cells of the last one (its issue 1444)."""
    path = write(tmp_path / "bar.vtu", TWO_CUBES, hexahedron=TWO_HEXES)
    text = path.read_text()
    start, end = text.index("<Piece"), text.index("</Piece>") + len("</Piece>")
    path.write_text(text[:end] + text[start:end] + text[end:])
    with pytest.raises(ValueError, match="several pieces"):
        fem.read_mesh(path)


LINEAR = [
    fem.box([2.0, 1.0, 1.0], [3, 2, 3]),
    fem.box([2.0, 1.0, 1.0], [3, 2, 3], "tetra"),
    fem.rectangle([2.0, 1.0], [3, 2]),
    fem.rectangle([2.0, 1.0], [3, 2], "triangle"),
]
KINDS = skfem.MeshHex2, skfem.MeshTet2, skfem.MeshQuad2, skfem.MeshTri2
QUADRATIC = [kind.from_mesh(mesh) for kind, mesh in zip(KINDS, LINEAR, strict=True)]


@pytest.mark.parametrize("mesh", [*LINEAR, *QUADRATIC[:2]], ids=lambda mesh: type(mesh).__name__)
@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
def test_save_and_load_give_the_mesh_and_its_fields_back(tmp_path, mesh, suffix):
    path = tmp_path / "new" / f"body{suffix}"
    nodes, dim = mesh.p.shape[1], mesh.dim()
    vector, scalar = np.arange(nodes * dim).reshape(nodes, dim) / 7, np.arange(nodes) / 3
    fem.write_mesh(path, mesh, {"displacement": vector, "energy": scalar})
    again = fem.read_mesh(path)
    assert type(again) is type(mesh)
    assert np.array_equal(again.p, mesh.p)
    assert volumes(again) == pytest.approx(volumes(mesh), rel=1e-13)
    data = meshio.read(path).point_data
    vertices = mesh.nvertices
    assert np.array_equal(data["displacement"][:vertices, :dim], vector[:vertices])
    assert not data["displacement"][:, dim:].any()
    assert np.array_equal(data["energy"][:vertices], scalar[:vertices])


@pytest.mark.parametrize("mesh", [*LINEAR, *QUADRATIC], ids=lambda mesh: type(mesh).__name__)
@pytest.mark.filterwarnings("ignore:.* list their nodes")
def test_a_mesh_that_is_saved_exactly_is_loaded_to_the_last_bit(tmp_path, mesh):
    """Left-handed cells stay so: the identity of a scene knows how cells list their nodes."""
    shift = np.random.default_rng(0).uniform(-0.02, 0.02, mesh.doflocs.shape)
    mesh = type(mesh)(mesh.doflocs + shift, mesh.t)
    names = {'a<b&"c"\n =1': np.array([0, 3]), "größe": np.arange(2)}
    mesh = mesh.with_boundaries(names).with_subdomains({"half": np.arange(2), "none": []})
    fem.write_mesh_exactly(tmp_path / "mesh.vtu", mesh)
    again = fem.read_mesh(tmp_path / "mesh.vtu")
    assert type(again) is type(mesh)
    assert np.array_equal(again.t, mesh.t)
    assert np.array_equal(again.doflocs, mesh.doflocs)
    np.testing.assert_equal(again.boundaries, mesh.boundaries)
    np.testing.assert_equal(again.subdomains, {"half": [0, 1], "none": []})


def test_the_propeller_s_nodes_have_one_order_on_all_processors():
    """NumPy sorts ties in one way with AVX-512 or AVX2, in another without both."""
    program = (
        "import numpy as np; from dpl.fem import propeller; m = propeller();"
        "print(m.t.ravel()[:99].tolist(), np.round(m.p[:, :9], 9).tolist())"
    )
    mesh = fem.propeller()
    own = mesh.t.ravel()[:99].tolist(), np.round(mesh.p[:, :9], 9).tolist()
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        capture_output=True, text=True, check=True,
        env=os.environ | {"NPY_DISABLE_CPU_FEATURES": "X86_V3"},
    )  # fmt: skip
    assert done.stdout == "{} {}\n".format(*own)
