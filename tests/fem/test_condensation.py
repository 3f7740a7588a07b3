"""Nested dissection and condensation solve like a dense factorisation, for all kinds of graphs."""

import numpy as np
import pytest
import torch
from scipy.linalg import norm
from scipy.sparse import block_diag, csr_array, diags_array, eye_array, kron

from dpl.fem.linear.condensation import (
    condense,
    condensed_layers,
    condensed_solutions,
    rounded,
    run_length,
    solve_layers,
)
from dpl.fem.linear.interface import SingularMatrix


def laplacian(shape):
    """Return the matrix of a grid, (n, n), and the positions of its unknowns, (n, D)."""
    total = csr_array((1, 1))
    for count in shape:
        chain = diags_array([-np.ones(count - 1)] * 2, offsets=[-1, 1])
        one = chain + 2.1 * eye_array(count)
        total = kron(total, eye_array(count)) + kron(eye_array(total.shape[0]), one)
    axes = np.meshgrid(*map(np.arange, shape), indexing="ij")
    return csr_array(total), np.stack([axis.ravel() for axis in axes], axis=1).astype(float)


def ring(count):
    """Return the matrix and positions of a closed chain."""
    matrix = diags_array([-np.ones(count - 1)] * 2, offsets=[-1, 1]).tolil()
    matrix[0, count - 1] = matrix[count - 1, 0] = -1
    angle = 2 * np.pi * np.arange(count) / count
    return csr_array(matrix + 2.1 * eye_array(count)), np.stack([np.cos(angle), np.sin(angle)], 1)


def two_parts():
    """Return two grids without a coupling at the same place."""
    matrix, points = laplacian((9, 10))
    return csr_array(block_diag([matrix, matrix])), np.concatenate([points, points])


def full():
    """Return a full matrix, which has no separator."""
    random = np.random.default_rng(0).standard_normal((90, 90))
    return csr_array(random @ random.T + 90 * np.eye(90)), random[:, :2]


def three_at_each_node():
    """Return a grid with three coupled unknowns at each node."""
    matrix, points = laplacian((5, 6, 7))
    coupling = np.array([[2, 1, 0], [1, 3, 1], [0, 1, 4]])
    return csr_array(kron(matrix, coupling)), np.repeat(points, 3, axis=0)


GRAPHS = {
    "line": laplacian((200,)),
    "plane": laplacian((15, 16)),
    "solid": laplacian((7, 8, 9)),
    "one leaf": laplacian((3, 3)),
    "ring": ring(300),
    "two parts": two_parts(),
    "full": full(),
    "three unknowns at each node": three_at_each_node(),
}


@pytest.fixture(params=GRAPHS, scope="module")
def graph(request):
    return GRAPHS[request.param]


def test_all_solutions_equal_those_of_a_dense_factorisation(graph):
    matrix, points = graph
    size = matrix.shape[0]
    blocks = condense([matrix, 2 * matrix], points)
    random = np.random.default_rng(1).standard_normal((size, 3))
    random[:, 2] = np.arange(size) == size // 2  # one entry: fronts without forces are left out
    exact = np.linalg.solve(matrix.toarray(), random)
    right = torch.from_numpy(random).expand(2, -1, -1)
    found = solve_layers(condensed_layers(blocks, "cpu"), right).numpy()
    for k in range(2):
        assert norm((1 + k) * found[k] - exact) < 1e-11 * norm(exact)
    for stored, most in ((blocks, 1e-11), (rounded(blocks), 2e-4)):
        for right, expected in zip([*random.T, np.zeros(size)], [*exact.T, 0.0], strict=True):
            solutions = condensed_solutions(stored, np.stack([right, right]))
            for k, solution in enumerate(solutions):
                assert norm((1 + k) * solution - expected) <= most * norm(expected)


def test_the_blocks_of_a_solid_are_smaller_than_its_inverse():
    matrix, points = GRAPHS["solid"]
    blocks = condense([matrix], points)
    assert blocks.values.size < 0.5 * matrix.shape[0] ** 2
    for layer in condensed_layers(blocks, "cpu").layers:
        assert torch.equal(layer.inverse, layer.inverse.mT)


def test_unknowns_of_a_node_stay_together():
    matrix, points = GRAPHS["three unknowns at each node"]
    blocks = condense([matrix], points)
    table, unknowns = blocks.table, blocks.order[blocks.unknowns].astype(np.int64)
    assert run_length(unknowns, table[:, 1], table[:, 2]) == 3
    assert run_length(unknowns, table[:, 1] - 1) == 1
    assert run_length(unknowns + 1) == 1


def test_an_indefinite_matrix_is_refused():
    matrix, points = GRAPHS["plane"]
    with pytest.raises(SingularMatrix, match="not positive definite"):
        condense([matrix, matrix - eye_array(matrix.shape[0])], points)
