"""Irreducible representations, isotypic components, and the POD that uses them."""

import itertools
import math

import pytest
import torch

from dpl.fem.symmetry import Symmetry
from dpl.models.invariant_basis import InvariantPOD, image_columns
from dpl.models.irreps import irreducible_representations, products


def rotations_of(order):
    """Return the rotations of the plane by multiples of 2 pi / order."""
    angles = [2 * math.pi * k / order for k in range(order)]
    rows = [[[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]] for t in angles]
    return torch.tensor(rows, dtype=torch.float64)


def dihedral(order):
    turns = rotations_of(order)
    return torch.cat([turns, turns @ torch.diag(torch.tensor([1.0, -1.0])).double()])


def cube():
    """Return the 48 symmetries of the cube."""
    signs = torch.tensor(list(itertools.product([1.0, -1.0], repeat=3))).double()
    eye = torch.eye(3).double()
    orders = itertools.permutations(range(3))
    return torch.stack([s[:, None] * eye[list(order)] for order in orders for s in signs])


GROUPS = {
    "identity": rotations_of(1),
    "rotations of a triangle": rotations_of(3),
    "rotations of a square": rotations_of(4),
    "square": dihedral(4),
    "pentagon": dihedral(5),
    "cube": cube(),
}
ALL = pytest.mark.parametrize("rotations", GROUPS.values(), ids=GROUPS.keys())


def group_of(rotations):
    """Return a group of symmetries of a cloud of points: general ones and one on a mirror."""
    dim = rotations.shape[1]
    random = torch.randn(2, dim, generator=torch.Generator().manual_seed(0)).double()
    mirror = torch.eye(dim)[:1].double()
    points = torch.cat([torch.cat([random, mirror]) @ Q.T for Q in rotations])
    far = torch.cdist(points, points) > 1e-9
    points = points[[i for i in range(len(points)) if far[i, :i].all()]]
    sources = [torch.cdist(points @ Q, points).argmin(dim=1) for Q in rotations]
    return [Symmetry(Q, source) for Q, source in zip(rotations, sources, strict=True)]


@ALL
def test_representations_are_unitary_homomorphisms(rotations):
    table = products(group_of(rotations))
    for D in irreducible_representations(table):
        product = torch.einsum("jab,ibc->ijac", D, D)
        assert (product - D[table]).abs().max() < 1e-12
        assert (D.mH @ D - torch.eye(D.shape[1])).abs().max() < 1e-12


@ALL
def test_squares_of_dimensions_add_up_to_the_order(rotations):
    found = irreducible_representations(products(group_of(rotations)))
    squares = [D.shape[1] ** 2 * (2 if D.is_complex() else 1) for D in found]
    assert sum(squares) == len(rotations)


@ALL
@pytest.mark.parametrize("count", [3, 400])
def test_modes_are_those_of_all_images(rotations, count):
    """They capture nearly as much as the best modes, which may split a family; all are whole."""
    group = group_of(rotations)
    nodes, dim = len(group[0].source), rotations.shape[1]
    dofs = torch.ones(nodes, dim, dtype=torch.bool)
    random = torch.Generator().manual_seed(1)
    sizes = 0.7 ** torch.arange(nodes * dim)
    noise = torch.randn(count, nodes * dim, generator=random).double()
    snapshots = (noise * sizes) @ torch.linalg.qr(noise.T @ noise + torch.eye(nodes * dim))[0]
    basis = InvariantPOD(dofs, group, count)
    for part in snapshots.split(150):
        basis.add(part)
    modes = basis.modes(10)
    rank = modes.shape[1]
    assert 0 < rank <= 10
    assert (modes.T @ modes - torch.eye(rank)).abs().max() < 1e-5
    images = torch.cat([image_columns(snapshots, dofs, group, k) for k in range(len(group))])
    moved = torch.cat([image_columns(modes.T, dofs, group, k) for k in range(len(group))])
    assert (moved - moved @ modes @ modes.T).abs().max() < 1e-5
    values = torch.linalg.svdvals(images).square()
    assert (images @ modes).square().sum() > 0.97 * values[:rank].sum()
