"""Files for ParaView, read back with meshio."""

import xml.etree.ElementTree as ElementTree

import meshio
import numpy as np
import pytest
import torch
from meshio._vtk_common import vtk_to_meshio_type

from dpl.evaluation import tables
from dpl.export import write_results
from dpl.export.paraview import ResultRow
from dpl.fem import box, fields, read_mesh, rectangle, write_mesh, write_series
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

BODIES = {
    "hexahedron": (1, "hexahedron", 8),
    "hexahedron, quadratic": (2, "hexahedron27", 27),
    "tetra": (1, "tetra", 4),
    "tetra, quadratic": (2, "tetra10", 10),
    "quad": (1, "quad", 4),
    "quad, quadratic": (2, "quad9", 9),
    "triangle": (1, "triangle", 3),
    "triangle, quadratic": (2, "triangle6", 6),
}


@pytest.fixture
def make_scene_of(make_scene):
    """Function that returns a small scene with cells of a kind."""

    def make_scene_of(name):
        cell, degree = name.split(",")[0], BODIES[name][0]
        solid = cell in ("hexahedron", "tetra")
        size, nodes = [100.0, 25.0, 25.0], [3, 2, 2]
        grid = box(size, nodes, cell) if solid else rectangle(size[:2], [4, 2], cell)
        return make_scene(mesh=grid, degree=degree, n_modes=2)

    return make_scene_of


@pytest.mark.parametrize("name", BODIES)
def test_series_contain_the_fields_of_the_predictions_in_si_units(make_scene_of, tmp_path, name):
    scene = make_scene_of(name)
    _, kind, corners = BODIES[name]
    torch.manual_seed(0)
    surrogate = Surrogate(FCNN(scene, width=8), MSE(), scene).eval()
    loads = scene.loads.sample((0, 12), range(2))
    rows, files = write_results(surrogate, loads, tmp_path / "new" / "series")
    assert [path.name for path in files[:2]] == ["series.pvd", "series.xdmf"]
    collection = ElementTree.parse(files[0]).getroot()
    named = [one.get("file") for one in collection.iter("DataSet")]
    assert [one.get("timestep") for one in collection.iter("DataSet")] == ["0", "1"]
    newton = "N" if scene.problem.shape[1] == 3 else "N/m"
    nodes, dim = scene.problem.shape
    with torch.no_grad():
        answer = torch.cat([surrogate.predict(single) for single in loads.unbatch()])
    inside = fields(scene.problem, answer)
    for k, file in enumerate(named):
        found = meshio.read(tmp_path / "new" / file)
        assert [(block.type, block.data.shape[1]) for block in found.cells] == [(kind, corners)]
        points = (scene.length * scene.problem.points).numpy()
        assert np.allclose(found.points[:, :dim], points, rtol=1e-14)
        data = found.point_data
        unit = 4500.0 * scene.force_unit
        assert np.allclose(data[f"force [{newton}]"][:, :dim], unit * loads.force[k].numpy())
        assert np.allclose(data["displacement [m]"][:, :dim], scene.length * answer[k].numpy())
        assert not data["displacement [m]"][:, dim:].any()
        stress = data["Cauchy stress [Pa]"].reshape(nodes, 3, 3)
        assert np.allclose(stress, 4500.0 * inside.stress[k].numpy())
        assert np.allclose(data["von Mises stress [Pa]"], 4500.0 * inside.von_mises[k].numpy())
        assert np.allclose(data["pressure [Pa]"], 4500.0 * inside.pressure[k].numpy())
        assert np.allclose(data["det F"], inside.volume_ratio[k].numpy())
        exact = data["reference displacement [m]"][:, :dim] / scene.length
        known = fields(scene.problem, torch.from_numpy(exact)[None])
        reference = data["reference Cauchy stress [Pa]"].reshape(nodes, 3, 3)
        assert np.allclose(reference, 4500.0 * known.stress[0].numpy(), rtol=1e-6)
        balance = scene.problem.relative_residual(
            torch.from_numpy(exact)[None], loads.force[k : k + 1]
        )
        assert float(balance) < 1e-7
        error = np.linalg.norm(exact - answer[k].numpy(), axis=1)
        assert np.allclose(data["error [m]"], scene.length * error)
        assert rows[k].error == pytest.approx(np.linalg.norm(error) / np.linalg.norm(exact))
    with meshio.xdmf.TimeSeriesReader(files[1]) as series:
        points, cells = series.read_points_cells()
        assert [block.type for block in cells] == [kind]
        for k, file in enumerate(named):
            time, data, _ = series.read_data(k)
            assert time == k
            single = meshio.read(tmp_path / "new" / file)
            assert np.array_equal(points, single.points)
            assert set(data) == set(single.point_data)
            for key, column in data.items():
                assert np.allclose(
                    column.reshape(single.point_data[key].shape), single.point_data[key]
                )


@pytest.mark.parametrize("name", BODIES)
def test_a_vtkhdf_file_contains_the_series_with_one_mesh(make_scene_of, tmp_path, name):
    h5py = pytest.importorskip("h5py")
    problem, rng = make_scene_of(name).problem, np.random.default_rng(0)
    nodes, dim = problem.shape
    mesh = problem.mesh.with_boundaries({"left": lambda x: x[0] == 0})
    step = {"force [N/m]": (nodes, dim), "det F": nodes, "Cauchy stress [Pa]": (nodes, 3, 3)}
    steps = [{key: rng.random(shape) for key, shape in step.items()} for _ in range(3)]
    *_, path = write_series(tmp_path / "series", mesh, steps)
    with h5py.File(path) as file:
        root = file["VTKHDF"]
        assert (root.attrs["Type"], root["Steps"].attrs["NSteps"]) == (b"UnstructuredGrid", 3)
        points, cells = root["Points"][:], root["Connectivity"][:].reshape(len(root["Types"]), -1)
        sizes = [root[f"NumberOf{key}"][0] for key in ("Points", "Cells", "ConnectivityIds")]
        assert sizes == [nodes, len(cells), cells.size]
        assert (np.diff(root["Offsets"]) == cells.shape[1]).all()
        for k, time in enumerate(root["Steps/Values"]):
            single = meshio.read(tmp_path / f"series_{k:03d}.vtu")
            assert time == k
            assert {vtk_to_meshio_type[one] for one in root["Types"]} == {single.cells[0].type}
            assert np.array_equal(cells, single.cells[0].data)
            assert np.array_equal(points, single.points)
            assert np.array_equal(
                root["CellData/skfem:b:left"], single.cell_data["skfem:b:left"][0]
            )
            for key, column in single.point_data.items():
                key = key.replace("/", " per ")
                start = root["Steps/PointDataOffsets"][key][k]
                assert np.array_equal(root["PointData"][key][start : start + nodes], column)


def test_without_a_reference_solution_the_error_is_nan(make_scene_of, tmp_path):
    scene = make_scene_of("quad")
    surrogate = Surrogate(FCNN(scene, width=8), MSE(), scene).eval()
    loads = scene.loads.sample((0, 12), range(1))
    rows, _ = write_results(surrogate, loads, tmp_path / "series", solve_reference=False)
    assert np.isnan(rows[0].error)
    assert "error [m]" not in meshio.read(tmp_path / "series_000.vtu").point_data


def test_the_table_of_results_has_units_and_per_cent(capsys):
    tables.show([ResultRow(0, 4500.0, 1.5, 99.0, 0.98, 0.0031)], "results")
    out = capsys.readouterr().out
    assert (out.count("[Pa]"), out.count("[m]"), out.count("0.31 %")) == (2, 1, 1)


@pytest.mark.parametrize("name", ["tetra", "tetra, quadratic"])
def test_tetrahedra_are_written_right_handed(make_scene_of, tmp_path, name):
    """Half of Kuhn's tetrahedra are left-handed before they are written."""
    problem = make_scene_of(name).problem
    write_mesh(tmp_path / "body.vtu", problem.mesh, {"x": problem.points.numpy()[:, 0]})
    found = meshio.read(tmp_path / "body.vtu")
    nodes = found.points[found.cells[0].data]
    volume = np.linalg.det(nodes[:, 1:4] - nodes[:, :1]) / 6
    assert (volume > 0).all()
    assert volume.sum() == pytest.approx(float(problem.dV.expand(len(problem.cells), -1).sum()))
    pairs = {"tetra10": [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]}
    for k, (i, j) in enumerate(pairs.get(found.cells[0].type, [])):
        middle = (nodes[:, i] + nodes[:, j]) / 2
        assert np.allclose(nodes[:, 4 + k], middle), "midpoints are in VTK order"
    assert len(read_mesh(tmp_path / "body.vtu").p.T) == len(problem.points)


def test_fields_of_another_size_raise_an_error(tmp_path):
    mesh = box([1.0, 1.0, 1.0], [2, 2, 2])
    with pytest.raises(ValueError, match="arrays of 9 nodes must have those of the mesh"):
        write_mesh(tmp_path / "body.vtu", mesh, {"x": np.zeros(9)})
    with pytest.raises(ValueError, match="8, 27"):
        write_mesh(tmp_path / "body.vtu", mesh, {"x": np.zeros(8), "y": np.zeros(27)})


def test_paths_with_xml_characters_are_escaped(tmp_path):
    mesh = box([1.0, 1.0, 1.0], [2, 2, 2])
    files = write_series(tmp_path / 'a&"b', mesh, [{"x": np.zeros(8)}])
    (one,) = ElementTree.parse(files[0]).getroot().iter("DataSet")
    assert (tmp_path / one.get("file")).is_file()
