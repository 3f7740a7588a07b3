"""Bodies with fibres and of several laws, on coarse meshes, against known solutions."""

import math

import numpy as np
import pytest
import skfem

from benchmarks.verification.artery import ARTERIES, exact_radius, radius
from benchmarks.verification.cardiac import ENDO, EPI, TIP, apex_of, beam_tip, contracted, inflated
from benchmarks.verification.composites import RATIOS, REMOTE, ball_strain, bent, eshelby
from benchmarks.verification.ventricle import (
    BASE,
    LONG,
    SHORT,
    WALL,
    depth_of,
    endocardium,
    fibres,
    ventricle,
)


def capped_volume(short: float, long: float) -> float:
    """Return the volume [mm^3] of an ellipsoid with the half axes short, short and long below z."""
    return math.pi * short**2 * (BASE + long - (BASE**3 + long**3) / (3 * long**2))


@pytest.mark.parametrize(("quarter", "share"), [(True, 0.25), (False, 1.0)])
def test_the_ventricle_has_its_volume_and_no_degenerate_cell(quarter, share):
    mesh = ventricle(2, 6, 2, quarter=quarter)
    dx = skfem.Basis(mesh, skfem.ElementHex2()).dx
    wall = capped_volume(SHORT + WALL, LONG + WALL) - capped_volume(SHORT, LONG)
    assert dx.sum() == pytest.approx(share * wall, rel=1e-4)
    jacobian = mesh.mapping().detDF(np.full((3, 1), 0.5))
    corners = mesh.mapping().detDF(np.array([[0.0, 1.0]] * 3))
    assert (corners.min(axis=1) > 0.2 * jacobian[:, 0]).all()


def test_fibres_of_the_ventricle_lie_in_the_wall():
    """They are unit vectors across the normal of the ellipsoid; in the middle they are hoops."""
    points = ventricle(2, 6, 2).doflocs.T
    points = points[np.hypot(points[:, 0], points[:, 1]) > 0.1]  # not on the axis
    depth = depth_of(points)
    assert depth.min() == pytest.approx(0.0, abs=1e-9)
    assert depth.max() == pytest.approx(1.0, abs=1e-9)
    found = fibres(points)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0)
    axes = np.stack([SHORT + WALL * depth] * 2 + [LONG + WALL * depth], axis=1)
    assert (found * points / axes**2).sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    middle = np.abs(depth - 0.5) < 1e-9
    assert middle.any()
    assert found[middle, 2] == pytest.approx(0.0, abs=1e-8)
    assert endocardium(points).sum() == (depth < 1e-9).sum()


def test_the_beam_of_muscle_bends_as_in_the_benchmark():
    """Land et al. (2015), problem 1, on a coarse mesh; the iterations do not depend on kappa."""
    found = [beam_tip((10, 2, 2), bulk) for bulk in (1e3, 1e5)]
    assert [z for z, _ in found] == pytest.approx([float(TIP)] * 2, rel=3e-3)
    assert max(count for _, count in found) <= 12


def test_the_ventricle_expands_as_in_the_benchmark():
    """Land et al. (2015), problem 2, on a coarse mesh."""
    inner, outer, _ = apex_of(inflated((2, 6, 1), 1e5))
    assert inner == pytest.approx(float(ENDO), rel=2e-3)
    assert outer == pytest.approx(float(EPI), rel=2e-3)


def test_the_ventricle_contracts_against_its_pressure():
    """Land et al. (2015), problem 3; so coarse a mesh has an error of half a millimetre."""
    inner, outer, _ = apex_of(contracted(2, 6, 1))
    assert inner == pytest.approx(-12.347, abs=0.6)
    assert outer == pytest.approx(-15.452, abs=0.6)


@pytest.mark.parametrize("name", ARTERIES)
def test_an_artery_of_two_layers_expands_as_its_integral(name):
    layers, pressure = ARTERIES[name]
    found = radius(layers, pressure, (4, 24), 1e5)
    assert found == pytest.approx(exact_radius(layers, pressure), rel=1e-4)


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_beam_of_two_layers_bends_as_its_transformed_section(ratio):
    curvature, error = bent(ratio, cells=3)
    assert curvature == pytest.approx(1.0, rel=1e-8)
    assert error < 1e-8


def test_a_stiff_ball_in_a_large_matrix_has_the_strain_of_eshelby():
    """Eshelby (1957); the error falls with the size of the cells and of the matrix."""
    exact = eshelby(REMOTE)
    errors = {}
    for cells, size in ((1, 4.0), (1, 16.0), (2, 16.0)):
        strain, deviation = ball_strain(cells, size, REMOTE)
        errors[cells, size] = np.linalg.norm(strain - exact) / np.linalg.norm(exact)
    assert deviation < 5e-3
    assert errors[2, 16.0] < errors[1, 16.0] < errors[1, 4.0]
    assert errors[2, 16.0] < 5e-3
