"""Fibre directions: orthonormal frames, coordinates of the user, the rule of Laplace's equation."""

import math

import meshio
import numpy as np
import pytest
import skfem
import torch
from torch import Tensor
from torch.testing import assert_close

from dpl import fem
from dpl.fem.assembly.elements import basis_of

INNER, OUTER = 1.0, 2.0  # radii of the cylinder [m]
INNER_ANGLE, OUTER_ANGLE = 1.0, -0.8  # [rad]


def frames_on(spec, mesh: skfem.Mesh, degree: int = 1) -> Tensor:
    """Return the frames (n, 3, 3) of the body that `Problem.build` makes of a mesh [m]."""
    body = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), degree=degree)
    frames = spec.on(body.basis, body.length, body.origin)
    assert frames.dtype == torch.float64
    eye = torch.eye(3, dtype=torch.float64)
    assert_close(frames.mT @ frames, eye.expand_as(frames), rtol=0, atol=1e-14)
    one = torch.ones(frames.shape[:-2], dtype=torch.float64)
    assert_close(torch.linalg.det(frames), one, rtol=0, atol=1e-14)
    return frames.flatten(0, -3)


def points_of(mesh: skfem.Mesh, degree: int = 1) -> np.ndarray:
    """Return the quadrature points of a body, (n, D) [m]."""
    return basis_of(mesh, degree).global_coordinates().value.reshape(mesh.dim(), -1).T


def quarter_cylinder(
    count: int, cell: str = "hexahedron", scale: float = 1.0, *, curved: bool = False
) -> skfem.Mesh:
    """Return a quarter of a thick cylinder along z, with `count` cells through the wall."""
    flat = cell in ("quad", "triangle")
    make, nodes = (fem.rectangle, []) if flat else (fem.box, [3])
    mesh = make([1.0] * (3 - flat), [count + 1, 3 * count + 1, *nodes], cell)
    if curved:
        mesh = {"tetra": skfem.MeshTet2, "hexahedron": skfem.MeshHex2}[cell].from_mesh(mesh)
    radius = INNER + (OUTER - INNER) * mesh.doflocs[0]
    angle = mesh.doflocs[1] * math.pi / 2
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), *mesh.doflocs[2:]])
    mesh = type(mesh)(points, mesh.t)
    surfaces = {
        name: lambda x, r=r: np.abs(np.hypot(*x[:2]) - r) < 0.3 * (OUTER - INNER) / count
        for name, r in (("inner", INNER), ("outer", OUTER))
    }
    return mesh.with_boundaries(surfaces, boundaries_only=True).scaled(scale)


def polar(mesh: skfem.Mesh, degree: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return radius (n,), radial and circumferential directions (n, 3) at the points."""
    x = points_of(mesh, degree).T
    radius = np.hypot(x[0], x[1])
    zero = np.zeros_like(radius)
    radial = np.stack([x[0] / radius, x[1] / radius, zero], axis=1)
    return radius, radial, np.cross([0.0, 0.0, 1.0], radial)


def wall(**other) -> fem.LaplaceFibres:
    options = {"longitudinal": [0.0, 0.0, 2.0]}
    options |= {"inner": fem.Tag("inner"), "inner_angle": INNER_ANGLE}
    options |= {"outer": fem.Tag("outer"), "outer_angle": OUTER_ANGLE}
    return fem.LaplaceFibres(**(options | other))


def errors(mesh: skfem.Mesh, degree: int = 1) -> tuple[float, float]:
    """Return the largest error of the fibre angle [rad] and of the sheet direction [-]."""
    frames = frames_on(wall(), mesh, degree).numpy()
    radius, radial, around = polar(mesh, degree)
    depth = np.log(radius / INNER) / math.log(OUTER / INNER)
    wanted = INNER_ANGLE + (OUTER_ANGLE - INNER_ANGLE) * depth
    angle = np.arctan2(frames[:, 2, 0], (frames[:, :, 0] * around).sum(1))
    return np.abs(angle - wanted).max(), np.abs(frames[:, :, 1] - radial).max()


# ------------------------------------------------------------------ constant, function, data


@pytest.mark.parametrize(
    ("spec", "wanted"),
    [
        (fem.ConstantFibres([2.0, 0.0, 0.0]), [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        (fem.ConstantFibres([0.0, 3.0, 0.0]), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        (fem.ConstantFibres([0.0, 0.0, 1e-200]), [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        (fem.ConstantFibres([1, 0, 0], [1, 0, 1e-3]), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        (fem.ConstantFibres([3.0, 4.0]), [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]),
    ],
)
def test_constant_fibres_are_orthonormalised(spec, wanted):
    """Columns f, s, n; the default sheet is z x f, or x where f lies along z."""
    frame = spec.constant()
    assert_close(frame[0].mT, torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=1e-12)
    mesh = (
        fem.rectangle([1.0, 1.0], [3, 3]) if len(spec.fibre) == 2 else fem.box([1.0] * 3, [2, 2, 2])
    )
    assert_close(frames_on(spec, mesh), frame, rtol=0, atol=0)


@pytest.mark.parametrize("cell", ["hexahedron", "tetra"])
@pytest.mark.parametrize("degree", [1, 2])
def test_functions_take_the_coordinates_of_the_user(cell, degree):
    """In metres, far from the origin."""
    mesh = fem.box([2.0, 1.0, 1.0], [3, 3, 3], cell).scaled(5.0).translated([1e4, -20.0, 0.0])
    points = []

    def directions(x):
        points.append(x)
        return np.stack([x[:, 0] - 1e4, x[:, 1], 0 * x[:, 0]], axis=1)

    frames = frames_on(fem.FibreFunction(directions), mesh, degree)
    places = points_of(mesh, degree)
    np.testing.assert_allclose(points[0], places, rtol=0, atol=1e-9)
    wanted = directions(places)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    np.testing.assert_allclose(frames[:, :, 0], wanted, rtol=0, atol=1e-10)
    assert not frames[:, 2, :2].any()  # the default sheet lies in the plane of x and y


def test_function_may_return_sheets_too():
    spec = fem.FibreFunction(lambda x: (np.ones_like(x), x * [1.0, -1.0, 0.0]))
    mesh = fem.box([1.0] * 3, [3, 3, 3])
    frames = frames_on(spec, mesh)
    assert_close(frames[:, :, 0], torch.full((8 * 8, 3), 3**-0.5).double())
    sheet = points_of(mesh) * [1.0, -1.0, 0.0]
    normal = np.cross(np.ones(3), sheet)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(frames[:, :, 2], normal, atol=1e-14)


def test_data_are_arrays_with_a_row_for_each_cell():
    mesh = fem.rectangle([1.0, 1.0], [4, 3])
    rows = np.random.default_rng(0).normal(size=(6, 2))
    frames = frames_on(fem.FibreData(rows), mesh)
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    np.testing.assert_allclose(frames[:, :2, 0], unit, atol=1e-14)
    assert_close(frames, frames_on(fem.FibreData(rows.tolist()), mesh))
    for wrong in (rows[:5], rows[0], np.zeros((6, 4))):
        with pytest.raises(ValueError, match=r"fibre of shape .* must have \(6, 2\)"):
            frames_on(fem.FibreData(wrong), mesh)


@pytest.mark.usefixtures("in_process")
@pytest.mark.filterwarnings("ignore:.*inside out")
def test_data_may_be_named_fields_of_a_mesh_file(tmp_path):
    """The rows are those of the cells that are kept, in their order."""
    made = fem.box([1.0, 1.0, 1.0], [3, 3, 2], "tetra")
    rows = np.random.default_rng(0).normal(size=(2, made.t.shape[1], 3))
    file = str(tmp_path / "body.vtu")
    halves = made.t.T[:7], made.facets.T[:2], made.t.T[7:]
    meshio.Mesh(
        made.p.T,
        list(zip(("tetra", "triangle", "tetra"), halves, strict=True)),
        cell_data={
            name: [data[:7], np.full((2, 3), np.nan), data[7:]]
            for name, data in zip(("fibres", "sheets"), rows, strict=True)
        },
    ).write(file)
    mesh = fem.read_mesh(file)
    np.testing.assert_allclose(mesh.p[:, mesh.t].mean(1), made.p[:, made.t].mean(1))
    found = frames_on(fem.FibreData("fibres", "sheets", file), mesh)
    assert_close(found, frames_on(fem.FibreData(*rows), mesh), rtol=0, atol=0)
    np.testing.assert_array_equal(fem.read_cell_data(file, ["sheets"])[0], rows[1])
    with pytest.raises(ValueError, match=r"body.vtu: has no cell data 'nothing'; .*'fibres'"):
        frames_on(fem.FibreData("nothing", file=file), mesh)
    with pytest.raises(FileNotFoundError):
        frames_on(fem.FibreData("fibres", file=str(tmp_path / "none.vtu")), mesh)


def test_law_takes_the_frames_of_its_directions():
    law = fem.FibreReinforced(fem.VolumetricK2(2.0), fem.Guccione(0.2, 8, 2, 4), wall())
    mesh = quarter_cylinder(2)
    body = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3))
    known = law.on(body.basis, body.length, body.origin)
    assert_close(known.frames.flatten(0, 1), frames_on(wall(), mesh), rtol=0, atol=0)
    assert known.on(body.basis, body.length, body.origin) is known


# ------------------------------------------------------------------ Laplace's equation


@pytest.mark.parametrize("cell", ["quad", "triangle"])
def test_angle_through_a_cylinder_follows_the_logarithm_of_the_radius(cell):
    """Laplace's equation between two radii has the solution ln(r/a) / ln(b/a)."""
    coarse, fine = (errors(quarter_cylinder(count, cell)) for count in (4, 8))
    assert fine[0] < 0.01
    assert fine[0] < 0.6 * coarse[0]
    assert fine[1] < 0.05


def test_a_wall_of_one_cell_has_directions_too():
    """All nodes lie on its surfaces: the equation has no unknowns."""
    frames = frames_on(wall(inner_angle=0.0, outer_angle=0.0), quarter_cylinder(1))
    _, radial, around = polar(quarter_cylinder(1))
    assert (frames[:, :, 0].numpy() * around).sum(1).min() > 0.95
    assert (frames[:, :, 1].numpy() * radial).sum(1).min() > 0.95


@pytest.mark.parametrize("cell", ["hexahedron", "tetra"])
def test_directions_are_of_first_order_on_linear_meshes_and_of_second_on_curved_ones(cell):
    coarse, fine = (np.array(errors(quarter_cylinder(count, cell))) for count in (2, 4))
    assert (fine > 0.3 * coarse).all()
    assert fine[0] < 0.6 * coarse[0]
    meshes = (quarter_cylinder(count, cell, curved=True) for count in (2, 4))
    coarse, fine = (np.array(errors(mesh, 2)) for mesh in meshes)
    assert (fine < 0.3 * coarse).all()
    assert (fine < np.radians(0.3)).all()


def test_directions_depend_neither_on_size_nor_on_place_and_surfaces_may_be_regions():
    frames = frames_on(wall(), quarter_cylinder(3))
    moved = quarter_cylinder(3, scale=1e-3).translated([4.0, 0.0, 0.0])
    assert_close(frames_on(wall(), moved), frames, rtol=0, atol=1e-8)
    regions = {
        "inner": lambda x: np.hypot(x[:, 0], x[:, 1]) < 10.001,  # [m]
        "outer": lambda x: np.hypot(x[:, 0], x[:, 1]) > 19.999,
    }
    large = quarter_cylinder(3, scale=10.0)
    assert_close(frames_on(wall(**regions), large), frames_on(wall(), large), rtol=0, atol=1e-12)


# ------------------------------------------------------------------ errors


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: fem.ConstantFibres([0.0, 0.0, 0.0]), "fibre must be finite and not zero"),
        (lambda: fem.ConstantFibres([math.inf, 0.0, 0.0]), "fibre must be finite and not zero"),
        (lambda: fem.ConstantFibres([1.0]), "fibre = .* must have 2 or 3 components"),
        (lambda: fem.ConstantFibres([1.0, 0, 0], [0, 0, 0]), "sheet must be finite and not zero"),
        (lambda: fem.ConstantFibres([1.0, 1, 0], [2, 2, 0]), "sheet must not be parallel to fibre"),
        (lambda: wall(longitudinal=[0, 0, 0]), "longitudinal must be finite and not zero"),
        (lambda: wall(inner_angle=math.nan), "inner_angle = nan must be a number"),
        (lambda: fem.FibreData("fibres"), "fibre must be the name of cell data if there is a file"),
        (lambda: fem.FibreData("f", [[1.0, 0]], "a.vtu"), "sheet must be the name of cell data"),
    ],
)
def test_invalid_directions_are_an_error(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (fem.ConstantFibres([1.0, 0.0]), "must have 3 components"),
        (fem.FibreFunction(lambda x: x[:2]), r"fibre of shape \(2, 3\)"),
        (fem.FibreFunction(lambda x: (x, x)), r"sheet must not be parallel to fibre \(cells 0, 1"),
        (fem.FibreFunction(lambda x: 0 * x), r"fibre must be finite and not zero \(cells 0, 1"),
        (wall(outer=fem.Tag("inner")), "inner and outer must not touch"),
        (wall(outer=fem.Tag("nothing")), "a group of the mesh: 'inner', 'outer'"),
    ],
)
def test_directions_that_do_not_fit_the_body_are_an_error(spec, message):
    with pytest.raises(ValueError, match=message):
        frames_on(spec, quarter_cylinder(2))


def test_long_axis_across_the_wall_is_an_error():
    mesh = fem.box([1.0, 1.0, 1.0], [3, 2, 2])
    spec = wall(
        inner=lambda x: x[:, 0] < 1e-6, outer=lambda x: x[:, 0] > 1 - 1e-6, longitudinal=[1, 0, 0]
    )
    with pytest.raises(ValueError, match="longitudinal must not be parallel to the transmural"):
        frames_on(spec, mesh)
