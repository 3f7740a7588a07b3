"""Sparsity pattern of the tangent for all kinds of cells and constraints."""

import numpy as np
import pytest
import torch

from dpl.fem import NeoHookeanLn, Problem
from dpl.fem.assembly import Pattern


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
    return Pattern.build(cells, free)


def linked(cells: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return which free degrees of freedom share a cell, (n, n), one cell after the other."""
    nodes, dim = free.shape
    whole = np.zeros((nodes * dim,) * 2, dtype=bool)
    for cell in cells:
        own = (cell[:, None] * dim + np.arange(dim)).ravel()
        whole[np.ix_(own, own)] = True
    kept = free.ravel()
    return whole[np.ix_(kept, kept)]


def test_pattern_is_the_sorted_upper_triangle_of_nodes_that_share_a_cell(pattern, cells, free):
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


def test_every_entry_of_a_cell_goes_where_its_row_and_column_say(pattern, cells, free):
    """Pairs of nodes a <= b, b slowest; an entry below the diagonal is its mirror image."""
    count, dim = cells.shape[1], free.shape[1]
    pairs = [(a, b) for b in range(count) for a in range(b + 1)]
    assert pattern.places.shape == (len(cells), len(pairs), dim, dim)
    rows = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    where = {pair: k for k, pair in enumerate(zip(rows, pattern.indices, strict=True))}
    for cell, places in zip(cells, pattern.places, strict=True):
        for (a, b), block in zip(pairs, places, strict=True):
            for i, k in np.ndindex(dim, dim):
                p, q = pattern.number[cell[a], i], pattern.number[cell[b], k]
                held = p < 0 or q < 0
                again = a == b and i > k  # the pair (k, i) of the same node stands for it
                expected = None if held or again else where[min(p, q), max(p, q)]
                assert block[i, k] == (len(pattern.indices) if expected is None else expected)


def test_cell_matrices_add_up_to_the_matrix_of_the_body(pattern, cells, free):
    """`source` and `target`, for matrices laid out (E, A, i, k, A)."""
    count, dim = cells.shape[1], free.shape[1]
    random = np.random.default_rng(2)
    matrices = random.normal(size=(len(cells), count, dim, count, dim))
    matrices += matrices.transpose(0, 3, 4, 1, 2)
    whole = np.zeros((free.size, free.size))
    for cell, matrix in zip(cells, matrices, strict=True):
        own = (cell[:, None] * dim + np.arange(dim)).ravel()
        whole[np.ix_(own, own)] += matrix.reshape(count * dim, -1)
    whole = whole[np.ix_(free.ravel(), free.ravel())]
    laid_out = torch.from_numpy(matrices.transpose(0, 1, 2, 4, 3).copy()).flatten()
    values = torch.zeros(len(pattern.indices), dtype=torch.float64)
    values = values.index_add(0, pattern.target, laid_out[pattern.source]).numpy()
    rows = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    assert values == pytest.approx(whole[rows, pattern.indices], rel=1e-12, abs=1e-13)


def test_places_between_linked_nodes_are_those_of_equal_components(pattern, cells, free):
    """Where a spring's stiffness goes; nnz for what is held or below the diagonal."""
    a, b = np.divmod(np.arange(cells.shape[1] ** 2), cells.shape[1])
    rows, columns = cells[:, a].ravel(), cells[:, b].ravel()
    found = pattern.between(rows, columns)
    owner = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    for p, q, places in zip(rows, columns, found, strict=True):
        for i, place in enumerate(places):
            row, column = pattern.number[p, i], pattern.number[q, i]
            if row < 0 or column < row:
                assert place == len(pattern.indices)
            else:
                assert (owner[place], pattern.indices[place]) == (row, column)


def test_body_without_free_degrees_of_freedom_has_an_empty_pattern(cells, kind):
    dim = 3 if kind[0] in ("tetra", "hexahedron") else 2
    pattern = Pattern.build(cells, np.zeros((cells.max() + 1, dim), dtype=bool))
    assert pattern.size == len(pattern.indices) == 0
    assert not pattern.places.any()
    assert len(pattern.source) == len(pattern.target) == 0


def test_order_of_the_cells_does_not_change_the_structure(cells, free, pattern):
    order = np.random.default_rng(3).permutation(len(cells))
    other = Pattern.build(cells[order], free)
    assert np.array_equal(other.indptr, pattern.indptr)
    assert np.array_equal(other.indices, pattern.indices)
    assert np.array_equal(other.places, pattern.places[order])
