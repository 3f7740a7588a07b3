"""Laws of figures: closed surfaces of bodies and colours that show errors."""

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from dpl.fem import NeoHookeanLn, Plane, Problem, box, rectangle, surface
from dpl.fem.postprocess import coarse, triangles
from dpl.visualization import draw_body, plot_deformed, plot_errors
from dpl.visualization.shapes import error_scale, project


def panels(figure):
    """Return the axes of a figure without those of colour bars."""
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def faces(ax):
    """Return the colours of the polygons of a panel, without those of its lines."""
    (shape,) = [one for one in ax.collections if isinstance(one, PolyCollection)]
    areas = [len(path.vertices) > 3 for path in shape.get_paths()]
    return np.asarray(shape.get_facecolor())[areas]


@pytest.mark.parametrize("cell", ["tetra", "quad"])
def test_a_figure_has_columns_of_reference_and_predictions_and_one_row_per_load(make_scene, cell):
    plane = {"mesh": rectangle([8.0, 2.0], [5, 3], cell)} if cell == "quad" else {}
    scene = make_scene(**(plane or {"cell": cell}), n_modes=2)
    truth = 0.01 * torch.randn(2, *scene.problem.shape, dtype=torch.float64)
    shown = [("network", truth * 0.9), ("linear", truth * 1.1), ("exact", truth)]
    figure = plot_deformed(scene.problem, truth, shown, names=["first", "second"])
    figure.draw_without_rendering()
    axes = panels(figure)
    assert len(axes) == 8
    assert [ax.get_title(loc="left") for ax in axes[:3]] == ["first", "second", ""]
    assert [ax.get_xlabel() for ax in axes[1::2]] == ["finite elements", *(n for n, _ in shown)]
    assert [bar.get_xlabel() for bar in figure.axes[8:]] == 3 * ["nodal error / L [-]"]


def test_texts_of_a_figure_neither_overlap_nor_leave_it(scene, batch):
    truth = batch.displacement[:3]
    names = ["load 1, max displacement 0.4 L\nrelative L2 1.33 %: largest"] * 3
    shown = [("network", 0.9 * truth), ("linear", 1.1 * truth)]
    figure = plot_deformed(scene.problem, truth, shown, names=names)
    figure.draw_without_rendering()
    texts = [text for ax in figure.axes for text in (*ax.texts, ax.xaxis.label, ax.yaxis.label)]
    texts += [ax._left_title for ax in panels(figure)]
    places = {text: text.get_window_extent() for text in texts if text.get_text()}
    rows = [ax.get_position() for ax in panels(figure)]
    assert rows[0].y0 > rows[1].y0 > rows[2].y0, "one row per load"
    assert rows[0].x0 < rows[3].x0 < rows[6].x0, "finite elements, then the predictions"
    assert len(places) == 3 + 3 + 2
    width, height = figure.canvas.get_width_height()
    for text, place in places.items():
        assert 0 <= place.x0 < place.x1 <= width, text
        assert 0 <= place.y0 < place.y1 <= height, text
        assert sum(place.overlaps(other) for other in places.values()) == 1, text


def test_near_points_are_nearer_to_the_viewer():
    flat, depth = project(np.array([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert depth[1] > depth[0], "the view is from the side of negative y"
    assert flat[2, 1] > flat[0, 1], "z points upwards"
    assert np.linalg.norm(np.column_stack([flat, depth]), axis=1) == pytest.approx([0, 1, 1])


def test_a_prediction_lies_within_its_panel_in_the_colours_of_its_error(scene, batch):
    truth = batch.displacement[:1]
    shown = [("network", 1.2 * truth), ("exact", truth), ("shifted", truth + 0.1)]
    figure = plot_deformed(scene.problem, truth, shown)
    points = scene.problem.points.numpy()
    (low, high), (left, right) = (figure.axes[1].get_ylim(), figure.axes[1].get_xlim())
    for factor in (0.0, 1.0, 1.2):
        flat, _ = project(points + factor * truth[0].numpy())
        assert left <= flat[:, 0].min() < flat[:, 0].max() <= right
        assert low <= flat[:, 1].min() < flat[:, 1].max() <= high
    assert not np.ptp(faces(figure.axes[2]), axis=0).any(), "all polygons have the same colour"
    assert figure.axes[-1].get_xscale() == "linear", "errors of similar size"


def test_a_prediction_that_is_not_finite_is_left_out(scene, batch):
    truth = batch.displacement[:1]
    broken = torch.full_like(truth, torch.nan)
    figure = plot_deformed(scene.problem, truth, [("network", broken), ("linear", truth)])
    figure.draw_without_rendering()
    kinds = [[type(one) for one in ax.collections] for ax in panels(figure)]
    assert kinds[1:] == [[LineCollection], [PolyCollection, LineCollection]]


@pytest.mark.parametrize("background", [0.0, 1e-3])
def test_nodes_with_larger_errors_are_brighter(make_scene, background):
    """Brightness increases with the nodal error, on a linear and on a logarithmic scale."""
    scene = make_scene(mesh=rectangle([8.0, 2.0], [5, 3]), n_modes=2)
    truth = torch.zeros(1, *scene.problem.shape, dtype=torch.float64)
    end = scene.problem.points[:, 0] == scene.problem.points[:, 0].max()
    wrong = truth + background + 0.1 * end[:, None]
    figure = plot_deformed(scene.problem, truth, [("network", wrong)])
    assert figure.axes[-1].get_xscale() == ("log" if background else "linear")
    touched = end.numpy()[surface(scene.problem.mesh)].any(axis=1)
    light = faces(figure.axes[1])[:, :3] @ [0.3, 0.6, 0.1]
    assert touched.sum() == 2
    assert light[touched].min() > light[~touched].max() + 0.3


@pytest.mark.parametrize(("cell", "most"), [("hexahedron", 1000), ("tetra", 300), ("tetra", 100)])
def test_a_coarse_body_has_at_most_the_requested_polygons_and_keeps_its_extent(cell, most):
    mesh = box([4.0, 2.0, 1.0], [17, 9, 5], cell)
    points, polygons = mesh.p.T, surface(mesh)
    found = coarse(points, polygons, most)
    assert 10 < len(found) <= most
    assert set(found.ravel()) <= set(polygons.ravel())
    assert np.ptp(points[np.unique(found)], axis=0) == pytest.approx([4, 2, 1], abs=0.6)
    if len(polygons) <= most:
        assert np.array_equal(found, polygons)
    faces = triangles(found)
    assert all(len(set(face)) == 3 for face in faces.tolist())


def test_colours_become_brighter_over_three_decades():
    error = np.array([0.0, 1e-6, 1e-3, 1e-2, 1e-1, 1.0])
    light = error_scale(error).to_rgba(error, bytes=True)[:, :3] @ [0.3, 0.6, 0.1]
    assert light[0] == light[1] == light[2]
    assert (np.diff(light[2:]) > 20).all()
    assert not np.ptp(error_scale(np.zeros(3)).to_rgba(np.zeros(3)), axis=0).any()


def test_errors_are_plotted_against_displacement_and_as_a_distribution():
    relative = torch.tensor([0.5, 0.01, torch.nan, 0.1, torch.inf])
    size = torch.tensor([0.001, 0.2, 0.1, 0.05, 0.3])
    figure = plot_errors(relative, size, [0, 2])
    upper, lower = figure.axes
    assert "5 validation loads, 2 without" in figure.get_suptitle()
    shown = np.asarray(upper.collections[0].get_offsets())
    assert shown == pytest.approx(np.array([[0.001, 0.5], [0.2, 0.01], [0.05, 0.1]]))
    assert [text.get_text().strip() for text in upper.texts] == ["0"]
    parts, errors = lower.lines[0].get_data()
    assert list(parts) == pytest.approx([0.2, 0.4, 0.6])
    assert list(errors) == pytest.approx([0.01, 0.1, 0.5])
    figure.canvas.draw()


@pytest.mark.parametrize("value", [0.0, torch.nan])
def test_errors_that_are_all_zero_or_not_finite_can_be_plotted(value):
    figure = plot_errors(torch.full((3,), value), torch.zeros(3), [0])
    figure.canvas.draw()
    missing = 3 if np.isnan(value) else 0
    assert ("3 without a finite error" in figure.get_suptitle()) == bool(missing)
    (points,) = figure.axes[0].collections
    assert len(points.get_offsets()) == 3 - missing


@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_is_drawn_at_its_deformed_nodes_in_the_colours_of_its_values(dim):
    shape = {2: rectangle([2.0, 1.0], [3, 2]), 3: box([2.0, 1.0, 1.0], [3, 2, 2])}[dim]
    problem = Problem.build(shape, NeoHookeanLn(0.3), fixed=Plane(0, "min"))
    moved = torch.zeros(problem.shape, dtype=torch.float64)
    moved[:, 0] = 0.3 * problem.points[:, 0]
    ax = Figure().add_subplot(projection="3d" if dim == 3 else None)
    scale = draw_body(ax, problem, moved, values=problem.points[:, 0], fit=[-moved])
    (drawn,) = ax.collections
    faces = drawn.get_facecolor()
    if dim == 2:
        assert max(path.vertices[:, 0].max() for path in drawn.get_paths()) == pytest.approx(1.3)
        assert np.allclose(faces, scale.to_rgba([0.25, 0.75]))  # means of their corners
    assert ax.get_xlim() == (pytest.approx(0.0), pytest.approx(1.3))
    assert scale.get_clim() == (0.0, 1.0)
    assert len(np.unique(faces, axis=0)) > 1
    ax = Figure().add_subplot(projection="3d" if dim == 3 else None)
    draw_body(ax, problem)
    (drawn,) = ax.collections
    assert len(np.unique(drawn.get_facecolor()[:, :3])) == 1 or dim == 3, "grey"
    assert ax.get_xlim()[1] - ax.get_xlim()[0] == pytest.approx(1.0), "undeformed"
