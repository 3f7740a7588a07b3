"""Data sets that tests may damage."""

import shutil

import pytest

from dpl.data import Store


@pytest.fixture
def copy(data, tmp_path):
    """A copy of the tiny data set that may be damaged."""
    folder = tmp_path / "copy"
    shutil.copytree(data.store.folder, folder)
    return Store(folder, data.scene, data.store.seed)
