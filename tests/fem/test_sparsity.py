"""Sparsity pattern of the tangent for all kinds of cells and constraints."""

import numpy as np
import pytest

from dpl.fem import NeoHookeanLn, Problem
from dpl.fem.assembly.sparsity import Pattern

LINKS = np.array([[0, 7], [7, 1], [3, 3]])  # pairs of nodes; all bodies have eight


@pytest.fixture
def cells(kind, grid) -> np.ndarray:
    """Cells (E, A) of a small body of each kind of element."""
    return Problem.build(grid(kind[0]), NeoHookeanLn(0.3), degree=kind[1]).cells.numpy()


@pytest.fixture
def free(cells, kind) -> np.ndarray:
    """Degrees of freedom (N, D) that may move, drawn at random, more of some elements."""
    cell, degree = kind
    kept = {"triangle": 1.0, "quad": 0.8, "tetra": 0.1, "hexahedron": 0.8}[cell]
    shape = cells.max() + 1, 3 if cell in ("tetra", "hexahedron") else 2
    return np.random.default_rng(1).random(shape) < (kept if degree == 1 else 1.1 - kept)


@pytest.fixture
def pattern(cells, free) -> Pattern:
    """The pattern of both."""
    return Pattern.build(cells, LINKS, free)


def linked(cells: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return which free degrees of freedom share a cell or link, (n, n), one after the other."""
    nodes, dim = free.shape
    whole = np.zeros((nodes * dim,) * 2, dtype=bool)
    for cell in (*cells, *LINKS):
        own = (cell[:, None] * dim + np.arange(dim)).ravel()
        whole[np.ix_(own, own)] = True
    kept = free.ravel()
    return whole[np.ix_(kept, kept)]


def test_pattern_is_the_sorted_upper_triangle_of_nodes_that_share_a_cell_or_link(
    pattern, cells, free
):
    expected = np.triu(linked(cells, free))
    assert pattern.size == free.sum() == len(pattern.indptr) - 1
    assert pattern.indptr[0] == 0
    for row in range(pattern.size):
        columns = pattern.indices[pattern.indptr[row] : pattern.indptr[row + 1]]
        assert columns.tolist() == np.flatnonzero(expected[row]).tolist()
    assert pattern.indptr[-1] == len(pattern.indices) == expected.sum()


def test_free_degrees_of_freedom_are_numbered_in_order(pattern, free):
    assert pattern.number[free].tolist() == list(range(free.sum()))
    assert (pattern.number[~free] == -1).all()


def test_body_without_free_degrees_of_freedom_has_an_empty_pattern(cells, kind):
    dim = 3 if kind[0] in ("tetra", "hexahedron") else 2
    pattern = Pattern.build(cells, LINKS, np.zeros((cells.max() + 1, dim), dtype=bool))
    assert pattern.size == len(pattern.indices) == 0
    assert not pattern.places.any()


def test_order_of_the_cells_does_not_change_the_structure(cells, free, pattern):
    order = np.random.default_rng(3).permutation(len(cells))
    other = Pattern.build(cells[order], LINKS, free)
    assert np.array_equal(other.indptr, pattern.indptr)
    assert np.array_equal(other.indices, pattern.indices)
    assert np.array_equal(other.places, pattern.places[order])
