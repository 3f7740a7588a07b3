"""Sets and surfaces of Abaqus input files, which are regions of a body."""

import numpy as np
import pytest

import dpl.fem as fem
from dpl.fem.mesh.abaqus import FACES
from dpl.fem.mesh.regions import cells_in, facets_in

NODES = [(x, y, z) for x in (0, 1, 2) for y in (0, 1) for z in (0, 1)]
HEXES = [[4 * k + one for one in (1, 2, 4, 3, 5, 6, 8, 7)] for k in (0, 1)]
SETS = """*Nset, nset=Left, generate
1, 3, 2
2, 4, 2
*Nset, nset=End, instance=Part-1-1
 9, 10,
*nset, NSET="End"
11, 12
*Nset, nset=Both
Left, End
*Elset, elset=All, internal
First, 7
*Elset, elset=_Load_S2, internal, generate
7, 7, 1
*Surface, type=ELEMENT, name=Load
_Load_S2, S2
*Surface, type=NODE, name=Nodes
End, 1.
*Solid Section, elset=All, material=Rubber
,
"""


def written(path, more="", *, before="", elements=("First", "")):
    """Writes two hexahedra along x with the labels 3 and 7, in two blocks, and further lines."""
    lines = ["*Heading", "** a comment", before, "*Node, nset=Every"]
    lines += [f"{k}, {', '.join(map(str, node))}" for k, node in enumerate(NODES, 1)]
    for label, name, cell in zip((3, 7), elements, HEXES, strict=True):
        lines.append("*Element, type=C3D8R" + f", elset={name}" * bool(name))
        lines.append(f"{label}, {', '.join(map(str, cell[:4]))},\n {', '.join(map(str, cell[4:]))}")
    path.write_text("\n".join(filter(None, [*lines, more])))
    return path


def nodes_of(mesh, name):
    """X coordinates of the nodes of the facets of a region."""
    return sorted(mesh.p[0, np.unique(mesh.facets[:, facets_in(name, mesh)])])


@pytest.mark.parametrize("elements", [("First", ""), ("", "First")])
def test_sets_and_surfaces_of_abaqus_are_regions(tmp_path, elements):
    mesh = fem.read_mesh(written(tmp_path / "a.inp", SETS, elements=elements))
    assert nodes_of(mesh, "Left") == 4 * [0]
    for name in ("End", "Nodes"):
        assert nodes_of(mesh, name) == 4 * [2]
    assert nodes_of(mesh, "Both") == 4 * [0] + 4 * [2]
    assert len(facets_in("Every", mesh)) == 10
    centre = 0.5 if elements[0] else 1.5
    (cell,) = cells_in("First", mesh)
    assert mesh.p[0, mesh.t[:, cell]].mean() == centre
    assert len(cells_in("All", mesh)) == (2 if elements[0] else 1)
    (facet,) = facets_in("Load", mesh)  # S2 has the last four nodes of C3D8, here x = 2
    assert (mesh.p[0, mesh.facets[:, facet]] == 2).all()


@pytest.mark.parametrize("kind", ["tetra", "hexahedron", "quad", "triangle"])
def test_the_faces_of_abaqus_cells_make_up_their_surface(kind):
    plane = kind in ("quad", "triangle")
    mesh = (fem.rectangle if plane else fem.box)((3 - plane) * [1], (3 - plane) * [2], kind)
    order = [0, 1, 4, 2, 3, 5, 7, 6] if kind == "hexahedron" else range(len(mesh.t))
    own = mesh.t[list(order), 0]
    faces = {frozenset(own[list(map(int, face))]) for face in FACES[kind][1]}
    assert faces == {frozenset(mesh.facets[:, facet]) for facet in mesh.t2f[:, 0]}


LOST = {
    "an unknown label": "*Nset, nset=Lost\n1, Part-2-1.7",
    "an unknown node": "*Nset, nset=Lost\n1, 99",
    "a set of it": "*Nset, nset=More\n99\n*Nset, nset=Lost\nMore, 1",
    "an unknown element": "*Elset, elset=Lost\n3, 8",
    "a free surface": "*Surface, type=ELEMENT, name=Lost\nFirst",
    "a face of shells": "*Surface, type=ELEMENT, name=Lost\nFirst, SPOS",
}


@pytest.mark.parametrize("how", LOST)
def test_a_set_that_cannot_be_read_is_named_and_is_no_region(tmp_path, how):
    path = written(tmp_path / "a.inp", LOST[how])
    with pytest.warns(UserWarning, match=r"cannot be read: .*'Lost'"):
        mesh = fem.read_mesh(path)
    with pytest.raises(ValueError, match="'Lost' holds no"):
        facets_in("Lost", mesh)


@pytest.mark.parametrize(
    ("before", "match"),
    [
        ("*Instance, name=A, part=P\n*End Instance\n*Instance, name=B, part=P", "flat input file"),
        ("*Instance, name=A, part=P\n1., 0., 0.", "flat input file"),
        ("*Ngen\n1, 9, 2", r"\*NGEN; write them all out"),
        ("*Elgen\n3, 9, 2", r"\*ELGEN; write them all out"),
    ],
)
def test_files_that_make_or_move_nodes_are_refused(tmp_path, before, match):
    with pytest.raises(ValueError, match=match):
        fem.read_mesh(written(tmp_path / "a.inp", before=before))
