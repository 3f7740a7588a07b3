"""Data sets that tests may damage, counted solves, and loads without a solution."""

import shutil

import pytest
import torch

from dpl.data import Store
from dpl.data.solving.solve import solve_load
from dpl.fem import SaintVenantKirchhoff


@pytest.fixture(autouse=True)
def threads():
    """Restore the number of threads, which streams and growth change."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def copy(data, tmp_path):
    """A copy of the tiny data set that may be damaged."""
    folder = tmp_path / "copy"
    shutil.copytree(data.store.folder, folder)
    return Store(folder, data.scene, data.store.seed)


@pytest.fixture
def solves(monkeypatch):
    """Return a function that lets another one change each solved load of this process."""

    def solves(change):
        def changed(scene, job):
            return change(solve_load(scene, job))

        monkeypatch.setattr("dpl.data.solving.worker_pool.solve_load", changed)

    return solves


@pytest.fixture
def solved(solves):
    """The list of solved loads, extended by each solve: stream and number."""
    found = []

    def counted(one):
        found.append((one.job.seed[1], one.job.number))
        return one

    solves(counted)
    return found


@pytest.fixture(scope="session")
def hard(make_scene):
    """Loads of ten times L on a law that does not bear them all."""
    return make_scene(law=SaintVenantKirchhoff, deflection=10.0, patch_radius=(2.0, 2.0))
