"""Laws of discretisation errors: meshes tend to a limit, quadratic ones faster."""

import itertools
from dataclasses import replace

import pytest

from benchmarks import discretisation
from dpl.fem import NeoHookeanLn, SaintVenantKirchhoff


def test_values_on_meshes_twice_as_fine_tend_to_the_limit():
    values = [3.0 + 0.5 * 4.0**-k for k in range(3)]
    assert discretisation.limit(*values) == pytest.approx(3.0, rel=1e-12)


def test_finer_meshes_are_nearer_to_the_limit_and_quadratic_ones_nearer_still():
    """The deflections are those of an independent code: Saint Venant-Kirchhoff, q = 20 Pa."""
    family = replace(discretisation.FAMILIES["beam"], linear=((4, 1, 1), (8, 2, 2), (16, 4, 4)))
    rows = discretisation.discretisations(family, SaintVenantKirchhoff(0.3), repeats=1)
    tips = [mesh.value for mesh in rows]
    known = [-18.7537, -24.79226, -27.28787, -27.72827, -28.2134, -28.3413]
    assert tips == pytest.approx(known, abs=5e-5)
    linear, quadratic = rows[:3], rows[3:]
    for each in (linear, quadratic):
        assert all(a.error > b.error for a, b in itertools.pairwise(each))
    assert all(a.dofs == b.dofs for a, b in zip(linear[1:], quadratic, strict=False))
    assert all(a.error > b.error for a, b in zip(linear[1:], quadratic, strict=False))
    assert quadratic[-1].error == pytest.approx(1 - 28.3413 / 28.387, rel=0.02)


def test_where_there_is_no_limit_the_finest_quadratic_mesh_stands_for_it():
    few = ((1, 1, 1, 2, 4), (1, 1, 1, 3, 8))
    family = replace(discretisation.FAMILIES["propeller"], linear=few, quadratic=few)
    rows = discretisation.discretisations(family, NeoHookeanLn(0.3), repeats=1)
    assert [(mesh.cells, mesh.degree) for mesh in rows] == [(few[0], 1), (few[1], 1), (few[0], 2)]
    assert rows[0].error > rows[1].error > rows[2].error > 0
    assert rows[2].value == pytest.approx(5.1e-3, rel=0.1)  # the blades bend, tips by 0.05 L
