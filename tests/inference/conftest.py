"""Loads that several files of this folder share."""

import pytest

E = 4500.0  # Young's modulus of the scene [Pa]


@pytest.fixture(scope="module")
def loads(scene):
    """Four loads that need several iterations."""
    return scene.loads.sample((0, 9), range(4))


@pytest.fixture(scope="module")
def forces(scene, loads):
    """The same, (B, N, D) [N]."""
    return loads.force * scene.force_unit * E
