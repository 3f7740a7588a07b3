"""Invalid meshes and the words of the error that each must raise."""

from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

CORNERS = np.array(  # of a hexahedron, in the order of files (VTK, Gmsh)
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)
TETS = np.array([[0, 1, 3, 4], [1, 2, 3, 6], [1, 3, 4, 6], [1, 4, 5, 6], [3, 4, 6, 7]])  # of a cube
TWO_CUBES = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], float)
TWO_HEXES = np.array([[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]])
PATCH = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])  # four triangles
FAN = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def write(path: Path, points: Any, **cells: Any) -> Path:
    """Write a mesh with meshio; `cells` maps cell types to connectivity."""
    kind = {"file_format": "gmsh"} if path.suffix == ".msh" else {}
    meshio.write(path, meshio.Mesh(points, list(cells.items())), **kind)
    return path


def with_node(points: Array, index: int, place: Any) -> Array:
    """Return the points with one of them moved to `place`."""
    moved = np.array(points, dtype=float)
    moved[index] = place
    return moved


FAR = TWO_CUBES + np.array([5, 0, 0])
NEXT = TWO_CUBES + np.array([2, 0, 0])
# name -> words of the error, points, cells
BROKEN_MESHES: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "not a number": ("not finite", with_node(TWO_CUBES, 3, np.nan), {"hexahedron": TWO_HEXES}),
    "infinite": ("not finite", with_node(TWO_CUBES, 3, np.inf), {"hexahedron": TWO_HEXES}),
    "index from one": ("does the numbering start at 1?", TWO_CUBES, {"hexahedron": TWO_HEXES + 1}),
    "index too large": (
        "to 99",
        TWO_CUBES,
        {"hexahedron": np.where(TWO_HEXES > 10, 99, TWO_HEXES)},
    ),
    "index below zero": ("= -1 to", TWO_CUBES, {"hexahedron": TWO_HEXES - 1}),
    "node listed twice": (
        "1 cells list a node twice: 0",
        TWO_CUBES,
        {"hexahedron": np.where(TWO_HEXES == 9, 10, TWO_HEXES)},
    ),
    "cell listed twice": (
        "1 cells are listed twice: 1 and 5",
        CORNERS,
        {"tetra": np.concatenate([TETS, TETS[1:2, [1, 2, 3, 0]]])},
    ),
    "side of three": (
        "a side is shared by three or more cells: 0, 1, 2",
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1], [0, 0, 1], [0.3, 0.3, -1]]),
        {"tetra": np.array([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])},
    ),
    "inverted hexahedron": (
        "inverted",
        with_node(TWO_CUBES, 8, [0.2, -0.2, 0.8]),
        {"hexahedron": TWO_HEXES},
    ),
    "inverted tetrahedron": ("inverted", with_node(CORNERS, 0, [2, 2, 2]), {"tetra": TETS}),
    "folded tetrahedra": (
        "2 cells are inverted, folded over their neighbours: 0, 1",
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1], [0.2, 0.2, 1]]),
        {"tetra": np.array([[0, 1, 2, 3], [0, 1, 2, 4]])},
    ),
    "inverted triangle": ("inverted", with_node(PATCH, 4, [1.5, 0.5, 0]), {"triangle": FAN}),
    "flat hexahedra": ("no volume", TWO_CUBES * [1, 1, 0], {"hexahedron": TWO_HEXES}),
    "one flat hexahedron": (
        "1 cells are of no volume: 1",
        np.minimum(TWO_CUBES, 1),
        {"hexahedron": TWO_HEXES},
    ),
    "flat tetrahedron": ("no volume", CORNERS, {"tetra": np.concatenate([TETS, [[0, 1, 2, 3]]])}),
    "flat triangle": ("no volume", with_node(PATCH, 4, [0.5, 0, 0]), {"triangle": FAN}),
    "crack": (
        "4 nodes coincide with others: 2 and 12, 5 and 15, 8 and 18, 11 and 21; merge them",
        np.concatenate([TWO_CUBES, NEXT]),
        {"hexahedron": np.concatenate([TWO_HEXES, TWO_HEXES + 12])},
    ),
    "two pieces": (
        "2 parts (of 2, 2 cells); join",
        np.concatenate([TWO_CUBES, FAR]),
        {"hexahedron": np.concatenate([TWO_HEXES, TWO_HEXES + 12])},
    ),
    "parts that touch in an edge": (
        "2 parts (of 1, 1 cells) that touch only in nodes or edges: 2, 6",
        np.concatenate([CORNERS, (CORNERS + np.array([1, 1, 0]))[[1, 2, 3, 5, 6, 7]]]),
        {"hexahedron": np.array([[*range(8)], [2, 8, 9, 10, 6, 11, 12, 13]])},
    ),
    "parts that touch in a node": (
        "2 parts (of 2, 1 cells) that touch only in nodes or edges: 2",
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 1, 0], [1, 2, 0]]),
        {"triangle": np.array([[0, 1, 2], [0, 2, 3], [2, 4, 5]])},
    ),
    "hanging nodes": (
        "1 nodes lie inside a side of a cell that does not have them as vertices "
        "(hanging nodes): 4",
        np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 2, 0], [0, 3, 0], [2, 3, 0]]),
        {"triangle": np.array([[0, 1, 2], [0, 2, 3], [3, 4, 5], [4, 6, 5], [4, 2, 6]])},
    ),
    "two kinds": (
        "holds hexahedron and tetra",
        np.concatenate([TWO_CUBES, CORNERS + np.array([2, 0, 0])]),
        {"hexahedron": TWO_HEXES, "tetra": TETS + 12},
    ),
    "lines only": ("holds line cells", TWO_CUBES, {"line": TWO_HEXES[:, :2]}),
    "wedges": ("holds wedge cells", TWO_CUBES, {"wedge": np.array([[0, 1, 3, 6, 7, 9]])}),
    "surface in space": (
        "surface mesh embedded in 3D",
        with_node(PATCH, 4, [0.5, 0.5, 0.3]),
        {"triangle": FAN},
    ),
    "surface of a box": (
        "surface mesh embedded in 3D",
        TWO_CUBES,
        {"quad": TWO_HEXES[:, :4] + [0, 0, 6, 6]},
    ),
}
