"""Regions: selection of points, nodes and facets, and tags of mesh files."""

from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest
import skfem
from skfem.io.meshio import to_meshio

from dpl import fem
from dpl.fem.assembly.elements import basis_of
from dpl.fem.mesh import facets_in, group_names, nodes_in

pytestmark = pytest.mark.usefixtures("in_process")

BAR = ([4.0, 1.0, 2.0], [5, 2, 3])
CELLS = ["hexahedron", "tetra", "quad", "triangle"]
SCALES = [1.0, 1e-3, 40.0]
PAIRWISE = [(*pair, 1 + k % 2) for k, pair in enumerate(product(CELLS, SCALES))]


@pytest.mark.parametrize(
    ("region", "count"),
    [
        (fem.Plane(0, "min"), 6),
        (fem.Plane(0, "max"), 6),
        (fem.Plane(0, 2.0), 6),
        (fem.Plane(1, 0.0), 15),
        (fem.Plane(2, "max"), 10),
        (fem.Plane(0, 2.5), 0),
        (fem.Box([1, 0, 0], [3, 1, 2]), 18),
        (fem.Box([0, 0, 0], [0, 0, 0]), 1),
        (fem.Box([0, 0, 1], [4, 1, 1]), 10),
        (fem.Box([5, 0, 0], [6, 1, 1]), 0),
        (fem.Sphere([0, 0, 0], 1.0), 4),
        (fem.Sphere([2, 0.5, 1], 0.5), 2),
        (fem.Sphere([2, 0.5, 1], 0.4), 0),
        (fem.Sphere([2, 0.5, 1], 100.0), 30),
        (fem.Cylinder(0, 1.0), 15),
        (fem.Cylinder(0, 0.5, [9, 0.5, 1]), 10),
        (fem.Cylinder(1, 1.0, [1, 7, 1]), 10),
        (fem.Cylinder(2, 1.0, [4, 1, 0]), 9),
        (fem.Cylinder(2, 0.5, [2, 0.5, 0]), 6),
        (fem.Cylinder(2, 0.4, [2, 0.5, 0]), 0),
    ],
)
def test_region_selects_its_nodes(region, count):
    points = fem.box(*BAR).p.T
    inside = region(points)
    assert inside.shape == (30,)
    assert inside.sum() == count


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_regions_tolerate_rounding_at_every_scale(scale):
    points = scale * fem.box([0.3, 0.1, 0.1], [4, 2, 2]).p.T
    side = 0.1 * scale
    assert fem.Plane(0, side)(points).sum() == 4
    assert fem.Box([0, 0, 0], [2 * side, side, side])(points).sum() == 12
    assert fem.Sphere([0, 0, 0], 3 * side)(points).sum() == 13
    assert fem.Cylinder(0, side)(points).sum() == 12


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: fem.Plane(3, "min"), "axis = 3"),
        (lambda: fem.Plane(0, "middle"), "at = 'middle'"),
        (lambda: fem.Plane(2, "min")(np.zeros((4, 2))), "axis = 2 must be less than 2"),
        (lambda: fem.Box([0, 0, 1], [1, 1, 0]), "lower"),
        (lambda: fem.Box([0, 0], [1, 1, 1]), "lower"),
        (lambda: fem.Box([0, 0, float("nan")], [1, 1, 1]), "lower"),
        (lambda: fem.Box([0, 0], [1, 1])(np.zeros((4, 3))), "lower = .* must be 3 finite numbers"),
        (lambda: fem.Sphere([0, 0, 0], 0.0), "radius = 0.0"),
        (lambda: fem.Sphere([0, 0], 1.0)(np.zeros((4, 3))), "centre = .* 3 finite"),
        (lambda: fem.Sphere([0, np.inf, 0], 1.0)(np.zeros((4, 3))), "centre = .* 3 finite"),
        (lambda: fem.Cylinder(3, 1.0), "axis = 3"),
        (lambda: fem.Cylinder(0, float("nan")), "radius = nan"),
        (lambda: fem.Cylinder(0, -1.0), "radius = -1.0"),
        (lambda: fem.Cylinder(0, 1.0, [0, 0])(np.zeros((4, 3))), "centre = .* 3 finite"),
        (lambda: fem.Tag(7), "in quotes"),
        (lambda: fem.Tag(""), "must be a string"),
    ],
)
def test_invalid_region_is_an_error(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def tagged(cell: str) -> skfem.Mesh:
    """Return a bar or strip of length 4 with tags: facets "end", cells "half" (x < 2)."""
    grid, dim = (fem.box, 3) if cell in ("hexahedron", "tetra") else (fem.rectangle, 2)
    mesh = grid([4.0, 1.0, 2.0][:dim], [5, 2, 3][:dim], cell)
    half = mesh.p[0, mesh.t].max(axis=0) <= 2.0
    return mesh.with_boundaries({"end": lambda x: x[0] == 4.0}).with_subdomains(
        {"half": np.flatnonzero(half)}
    )


@pytest.mark.parametrize(("cell", "scale", "degree"), PAIRWISE)
def test_a_tag_contains_the_nodes_of_its_facets_or_cells_for_every_degree(cell, scale, degree):
    """A dimensionless mesh: its points times `scale` are metres."""
    mesh = tagged(cell).scaled(1 / scale)
    basis = basis_of(mesh, degree)
    for tag, region in (("end", fem.Plane(0, "max")), ("half", lambda x: x[:, 0] <= 2 + 1e-9)):
        inside = nodes_in(fem.Tag(tag), basis, scale)
        assert inside.shape == (basis.N,)
        assert np.array_equal(inside, nodes_in(region, basis, scale))
    assert (
        nodes_in(fem.Plane(0, 4.0), basis, scale).sum()
        == nodes_in(fem.Tag("end"), basis, scale).sum()
    )


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("scale", SCALES)
def test_facets_are_in_a_region_with_all_their_vertices(cell, scale):
    mesh = tagged(cell).scaled(1 / scale)
    dim = mesh.dim()
    end = facets_in(fem.Plane(0, 4.0), mesh, scale)
    assert np.array_equal(end, np.sort(mesh.boundaries["end"]))
    assert np.array_equal(facets_in(fem.Tag("end"), mesh, scale), end)
    half = facets_in(fem.Tag("half"), mesh, scale)
    lower = fem.Box([0.0] * dim, [2.0, 1.0, 2.0][:dim])
    assert np.array_equal(half, facets_in(lower, mesh, scale))
    assert np.isin(half, mesh.boundary_facets()).all()
    everything = facets_in(lambda x: np.ones(len(x), dtype=bool), mesh, scale)
    assert np.array_equal(everything, mesh.boundary_facets())


def test_a_region_that_selects_nothing_is_an_error_that_names_it():
    mesh = tagged("hexahedron").with_boundaries(
        {"none": np.array([], int), "inner": np.flatnonzero(fem.box(*BAR).f2t[1] >= 0)}
    )
    basis = skfem.Basis(mesh, skfem.ElementHex1())
    for region, name in (
        (fem.Plane(0, 0.3), r"Plane\(axis=0, at=0.3\)"),
        (fem.Tag("none"), "'none'"),
        ("none", "'none'"),
        (lambda x: np.zeros(len(x), dtype=bool), "lambda"),
    ):
        with pytest.raises(ValueError, match=f"{name}.* holds no node of the mesh"):
            nodes_in(region, basis)
        with pytest.raises(ValueError, match=f"{name}.* holds no facet of the boundary"):
            facets_in(region, mesh)
    assert nodes_in(fem.Tag("inner"), basis).any()
    with pytest.raises(ValueError, match=r"'inner'.* holds no facet of the boundary"):
        facets_in(fem.Tag("inner"), mesh)
    with pytest.raises(ValueError, match="holds no facet of the boundary"):
        facets_in(fem.Box([0, 0, 0], [4, 0, 0]), mesh)  # an edge: nodes, but no facet


def test_the_error_for_an_unknown_tag_lists_the_tags():
    mesh = tagged("quad")
    with pytest.raises(ValueError, match=r"^'ends' must be a group of the mesh: 'end', 'half'$"):
        nodes_in(fem.Tag("ends"), skfem.Basis(mesh, skfem.ElementQuad1()))
    with pytest.raises(ValueError, match="'ends' must be a group of the mesh, which has none"):
        facets_in(fem.Tag("ends"), fem.rectangle([1, 1], [2, 2]))


@pytest.mark.parametrize(
    "answer", [lambda x: x[:, 0], lambda x: x > 0, lambda x: np.array([True]), lambda x: None]
)
def test_a_region_must_return_a_mask(answer):
    mesh = fem.rectangle([1, 1], [3, 3])
    with pytest.raises(ValueError, match="must return bool of shape"):
        nodes_in(answer, skfem.Basis(mesh, skfem.ElementQuad1()))
    with pytest.raises(ValueError, match="must return bool of shape"):
        facets_in(answer, mesh)


NODES = [20, *range(5, 17)]  # their numbers; the first one has no cell
PLACES = ["9 9 9", *(f"{x} {y} {z}" for z in range(2) for y in range(2) for x in range(3))]
GMSH_41 = "\n".join(
    [
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat",
        '$PhysicalNames\n3\n2 1 "held end"\n3 1 "body"\n3 2 "far cell"\n$EndPhysicalNames',
        "$Entities\n0 0 2 2\n1 0 0 0 0 1 1 1 1 0\n2 1 0 0 1 1 1 1 7 0",
        "1 0 0 0 1 1 1 1 1 0\n2 1 0 0 2 1 1 2 1 2 0\n$EndEntities",
        *("$Nodes\n1 13 5 20\n3 1 0 13", *map(str, NODES), *PLACES, "$EndNodes"),
        "$Elements\n4 4 1 4\n2 1 3 1\n1 5 11 14 8\n2 2 3 1\n2 6 9 15 12",
        "3 1 5 1\n3 5 6 9 8 11 12 15 14\n3 2 5 1\n4 6 7 10 9 12 13 16 15\n$EndElements\n",
    ]
)


def test_physical_groups_of_gmsh_are_tags_by_name_or_by_number(tmp_path):
    """MSH 4.1 as Gmsh writes it, with a node without a cell: two cubes, x from 0 to 2."""
    (tmp_path / "bar.msh").write_text(GMSH_41)
    mesh = fem.read_mesh(tmp_path / "bar.msh")
    assert mesh.p.shape == (3, 12)
    assert mesh.p[0, mesh.facets[:, facets_in(fem.Tag("held end"), mesh)]].tolist() == [[0]] * 4
    (between,) = mesh.boundaries["7"]
    assert mesh.p[0, mesh.facets[:, between]].tolist() == [1] * 4
    assert {name: list(cells) for name, cells in mesh.subdomains.items() if "=" not in name} == {
        "body": [0, 1],
        "far cell": [1],
    }


def test_groups_that_gmsh_numbers_are_hidden_unless_there_are_no_others(tmp_path):
    (tmp_path / "bar.msh").write_text(GMSH_41)
    mesh = fem.read_mesh(tmp_path / "bar.msh")
    assert "gmsh:geometrical=1" in mesh.subdomains
    assert facets_in("held end", mesh).size == 1
    assert group_names(mesh) == ["7", "body", "far cell", "held end"]
    with pytest.raises(ValueError, match=r"'lid' must be .*: '7', 'body', 'far cell', 'held end'$"):
        facets_in("lid", mesh)
    fem.write_mesh(tmp_path / "bar.vtu", mesh, {})
    assert set(meshio.read(tmp_path / "bar.vtu").cell_data) == {
        *("skfem:s:body", "skfem:s:far cell", "skfem:b:held end", "skfem:b:7")
    }
    bare = fem.box(*BAR).with_boundaries({"gmsh:geometrical=4": np.array([0])})
    assert group_names(bare) == ["gmsh:geometrical=4"]


def side_blocks(mesh: skfem.Mesh, facets) -> tuple[str, np.ndarray]:
    """Return the facets as cells of a file, listed in turn."""
    kind = {(3, 4): "quad", (3, 3): "triangle", (2, 2): "line"}[mesh.dim(), len(mesh.facets)]
    t = mesh.facets[:, facets]
    return kind, (t[[0, 1, 3, 2]] if kind == "quad" else t).T


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("cell", CELLS)
def test_physical_groups_of_msh_2_are_tags_too(tmp_path, cell, named):
    """The third coordinate, the order of blocks and nodes without cells do not confuse them."""
    mesh = tagged(cell)
    flat = to_meshio(mesh)
    kind = flat.cells[0].type
    half = np.isin(np.arange(mesh.nelements), mesh.subdomains["half"])
    body = flat.cells[0].data + 1
    side, ends = side_blocks(mesh, mesh.boundaries["end"])
    blocks = [(kind, body[half]), (side, ends + 1), (kind, body[~half])]
    numbers = [np.full(len(data), n) for (_, data), n in zip(blocks, (5, 5, 6), strict=True)]
    points = np.pad(mesh.p.T, ((1, 0), (0, 3 - mesh.dim())))
    dim = mesh.dim()
    names = {"half": [5, dim], "end": [5, dim - 1]} if named else {}
    data = {"gmsh:physical": numbers, "gmsh:geometrical": numbers}
    groups = {name: np.array(key) for name, key in names.items()}
    file = meshio.Mesh(points, blocks, cell_data=data, field_data=groups)
    meshio.write(tmp_path / "bar.msh", file, file_format="gmsh22")
    again = fem.read_mesh(tmp_path / "bar.msh")
    assert again.p.shape == mesh.p.shape
    end = again.boundaries["end" if named else "5"]
    assert len(end) == len(ends)
    assert (again.p[0, again.facets[:, end]] == 4.0).all()
    first = again.subdomains["half" if named else "5"]
    assert len(first) == half.sum()
    assert again.p[0, again.t[:, first]].max() == 2.0
    assert np.isin(np.arange(mesh.nelements), again.subdomains["6"]).sum() == (~half).sum()


def test_sets_of_cells_and_nodes_are_tags(tmp_path):
    """Abaqus: ELSET and NSET; a set of nodes stands for the facets that it fills."""
    mesh = tagged("hexahedron")
    flat = to_meshio(mesh)
    x, cells = mesh.p[0], {"half": [mesh.subdomains["half"]]}
    sets = {"end": np.flatnonzero(x == 4.0), "corner": [0], "low": np.flatnonzero(x <= 1.0)}
    file = meshio.Mesh(flat.points, flat.cells, point_sets=sets, cell_sets=cells)
    meshio.write(tmp_path / "bar.inp", file)
    again = fem.read_mesh(tmp_path / "bar.inp")
    basis = skfem.Basis(again, skfem.ElementHex1())
    assert np.array_equal(again.subdomains["half"], mesh.subdomains["half"])
    assert np.array_equal(nodes_in(fem.Tag("end"), basis), nodes_in(fem.Plane(0, "max"), basis))
    assert np.array_equal(facets_in(fem.Tag("end"), again), facets_in(fem.Plane(0, "max"), again))
    assert nodes_in(fem.Tag("low"), basis).sum() == 12
    with pytest.raises(ValueError, match=r"'corner'.* holds no node"):
        nodes_in(fem.Tag("corner"), basis)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
@pytest.mark.parametrize("cell", CELLS)
def test_integer_fields_are_tags(tmp_path, cell, suffix):
    mesh = tagged(cell)
    flat = to_meshio(mesh)
    half = np.isin(np.arange(mesh.nelements), mesh.subdomains["half"]).astype(np.int64)
    x = np.pad(mesh.p.T, ((0, 0), (0, 3 - mesh.dim())))
    file = meshio.Mesh(
        x,
        [(flat.cells[0].type, flat.cells[0].data)],
        cell_data={
            "half": [half],
            "material": [np.where(half == 1, 3, 8)],
            "density": [half.astype(float)],
        },
        point_data={
            "plane": mesh.p[0].astype(np.int64),
            "end": (mesh.p[0] == 4.0).astype(np.int64),
            "heat": mesh.p[0],
            "normal": x.astype(np.int64),
        },
    )
    meshio.write(tmp_path / f"bar{suffix}", file)
    again = fem.read_mesh(tmp_path / f"bar{suffix}")
    assert set(again.subdomains) == {"half", "half=0", "half=1", "material=3", "material=8"}
    assert set(again.boundaries) == {"end", "end=0", "end=1", *(f"plane={k}" for k in range(5))}
    for name in ("half", "half=1", "material=3"):
        assert np.array_equal(again.subdomains[name], mesh.subdomains["half"])
    end = np.sort(mesh.boundaries["end"])
    for name in ("end", "end=1", "plane=4"):
        assert np.array_equal(facets_in(fem.Tag(name), again), end)
    assert len(again.boundaries["plane=2"]) == len(end)  # inner facets
    with pytest.raises(ValueError, match="holds no facet of the boundary"):
        facets_in(fem.Tag("plane=2"), again)


def test_numbers_of_cells_and_nodes_are_no_tags(tmp_path):
    mesh = fem.box([1.0, 1.0, 1.0], [12, 11, 11])
    flat = to_meshio(mesh)
    cells, nodes = {"id": [np.arange(mesh.nelements)]}, {"id": np.arange(mesh.nvertices)}
    file = meshio.Mesh(flat.points, flat.cells, cell_data=cells, point_data=nodes)
    meshio.write(tmp_path / "cube.vtu", file)
    again = fem.read_mesh(tmp_path / "cube.vtu")
    assert not again.boundaries
    assert not again.subdomains


@pytest.mark.parametrize(
    ("cell", "suffix", "quadratic"),
    [
        (cell, suffix, (k + n) % 2 == 0)
        for k, cell in enumerate(CELLS)
        for n, suffix in enumerate([".vtu", ".vtk"])
    ],
)
def test_tags_survive_save_and_load(tmp_path, cell, suffix, quadratic):
    mesh = tagged(cell).with_boundaries({"a:b=1": np.array([0, 3]), "none": np.array([], int)})
    if quadratic:
        kinds = {"hexahedron": skfem.MeshHex2, "tetra": skfem.MeshTet2}
        kind = {**kinds, "quad": skfem.MeshQuad2, "triangle": skfem.MeshTri2}[cell]
        mesh = (
            kind.from_mesh(mesh).with_boundaries(mesh.boundaries).with_subdomains(mesh.subdomains)
        )
    path = Path(tmp_path / f"bar{suffix}")
    fem.write_mesh(path, mesh, {"x": mesh.p[0]})
    again = fem.read_mesh(path)
    for old, new in ((mesh.boundaries, again.boundaries), (mesh.subdomains, again.subdomains)):
        np.testing.assert_equal(new, {name: np.sort(members) for name, members in old.items()})
