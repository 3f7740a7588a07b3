"""The graph network: range of information, conservation, invariance."""

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from dpl.fem import NeoHookeanLn, Problem, box, rectangle
from dpl.models import GNN, gnn
from dpl.models.gnn import NeighbourSum
from dpl.models.graph import COARSEST, coarser, mesh_graph

BODIES = {
    "hexahedra": {"nodes": (9, 4, 4)},
    "quadratic tetrahedra": {"nodes": (4, 2, 2), "cell": "tetra", "degree": 2},
    "triangles": {"mesh": rectangle((4.0, 1.0), (13, 4), "triangle")},
    "few nodes": {"nodes": (4, 2, 2)},
}


@pytest.fixture(scope="module", params=BODIES)
def body(request, make_scene):
    return make_scene(**BODIES[request.param])


@pytest.fixture(scope="module")
def bar(make_scene):
    return make_scene(nodes=(17, 4, 4))


def answer_of(net, force):
    """Return the answer of a network without scalars."""
    return net(force, force.new_zeros(len(force), 0))


def build(scene, seed=0, **options):
    torch.manual_seed(seed)
    return GNN(scene, **{"width": 8, **options})


def forces(scene, count=3):
    return torch.randn(count, *scene.problem.shape, generator=torch.Generator().manual_seed(1))


# ------------------------------------------------------------------ answers


@pytest.mark.parametrize(
    ("body", "options"),
    [
        ("hexahedra", {}),
        ("quadratic tetrahedra", {"levels": 4}),
        ("triangles", {"levels": 1}),
        ("few nodes", {"passes": 2}),
    ],
    indirect=["body"],
)
def test_the_network_accepts_every_kind_of_mesh(body, options):
    net, force = build(body, **options), forces(body)
    answer = answer_of(net, force)
    assert answer.shape == force.shape
    assert answer.dtype == torch.float32
    assert answer.isfinite().all()
    assert answer.any()
    answer.square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad.any(), name


def test_information_crosses_the_body_in_one_pass(body):
    """The force on any node changes the displacement of every node."""
    net, force = build(body), forces(body, 1).requires_grad_()
    far = body.problem.points[:, 0].argmax()
    (slope,) = torch.autograd.grad(answer_of(net, force)[0, far].sum(), force)
    assert slope.any(dim=2).all()
    assert net.sizes[0] == len(body.problem.points)
    assert net.sizes == sorted(net.sizes, reverse=True)
    assert net.levels[-1].complete
    assert net.sizes[-1] <= COARSEST


def test_without_clusters_information_does_not_cross_the_body(bar):
    net, force = build(bar, levels=1), forces(bar, 1).requires_grad_()
    x = bar.problem.points[:, 0]
    (slope,) = torch.autograd.grad(answer_of(net, force)[0, x.argmax()].sum(), force)
    assert not slope[0, x.argmin()].any()


def test_predictions_are_invariant_under_translations(make_scene):
    here, there = box((4.0, 1.0, 1.0), (9, 4, 4)), box((4.0, 1.0, 1.0), (9, 4, 4))
    there = there.translated((1000.3, -77.7, 0.1))
    one, other = make_scene(mesh=here), make_scene(mesh=there)
    assert not torch.allclose(one.problem.points, other.problem.points)
    force = forces(one)
    with torch.no_grad():
        answers = [answer_of(build(scene), force) for scene in (one, other)]
    assert torch.allclose(*answers, rtol=1e-4, atol=1e-5)


# ------------------------------------------------------------------ levels


def test_total_force_and_moment_are_the_same_on_every_level(body):
    """Sums over clusters preserve the total force and its moment about the origin."""
    net, force = build(body).double(), forces(body).double()
    places = body.problem.points
    graph, total = mesh_graph(body.problem), force.sum(1)
    moment = torch.einsum("nd,bne->bde", places, force)
    levels = net.resultants(force)
    assert [len(level[0]) for level in levels] == net.sizes
    for k, (on_cluster, about_centre) in enumerate(levels):
        assert torch.allclose(on_cluster.sum(0), total)
        arms = torch.einsum("kd,kbe->bde", torch.from_numpy(graph.points), on_cluster)
        own = about_centre.sum(0).reshape(moment.shape)
        assert torch.allclose(arms + own, moment, atol=1e-6)  # arms are kept in float32
        if k + 1 < len(levels):
            graph, _ = coarser(graph, net.sizes[k + 1])


def test_edges_of_the_mesh_graph_are_edges_of_cells(make_scene):
    grid = mesh_graph(make_scene(nodes=(9, 4, 4)).problem)
    assert len(grid.sender) == 2 * (8 * 16 + 2 * 9 * 3 * 4)
    plane = mesh_graph(make_scene(mesh=rectangle((4.0, 1.0), (13, 4), "triangle")).problem)
    assert len(plane.sender) == 2 * (12 * 4 + 13 * 3 + 12 * 3)
    fine = mesh_graph(make_scene(nodes=(4, 2, 2), degree=2).problem)
    assert len(fine.sender) == 2 * (6 * 9 + 2 * 7 * 2 * 3)  # the edges of 7 x 3 x 3 nodes


def test_the_graph_is_symmetric(body):
    graph = mesh_graph(body.problem)
    for count in (30, 10):
        pairs = set(zip(graph.receiver.tolist(), graph.sender.tolist(), strict=True))
        assert {(j, i) for i, j in pairs} == pairs
        assert (np.diff(graph.receiver) >= 0).all()
        graph, cluster = coarser(graph, count)
        assert sorted(set(cluster.tolist())) == list(range(len(graph.points)))


def test_clusters_are_connected(bar):
    graph = mesh_graph(bar.problem)
    _, cluster = coarser(graph, 40)
    inside = cluster[graph.sender] == cluster[graph.receiver]
    nodes = len(cluster), len(cluster)
    pairs = csr_array((inside.astype(int), (graph.sender, graph.receiver)), nodes)
    pairs.eliminate_zeros()
    assert connected_components(pairs)[0] == 40


def test_each_part_of_a_body_has_a_cluster():
    cube = box((1.0, 1.0, 1.0), (4, 4, 4))
    two = Problem.build(cube + cube.translated((9.0, 0.0, 0.0)), NeoHookeanLn(0.3))
    coarse, cluster = coarser(mesh_graph(two), 1)
    assert np.bincount(cluster).tolist() == [64, 64]
    assert coarse.complete


def test_gradients_of_neighbour_sums_do_not_depend_on_the_size_of_blocks(bar, monkeypatch):
    graph = mesh_graph(bar.problem)
    pairs = torch.from_numpy(graph.receiver), torch.from_numpy(graph.sender)
    state = torch.randn(len(graph.points), 2, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(len(graph.sender), 3, dtype=torch.float64, requires_grad=True)
    probe = torch.randn_like(state)
    plain = torch.zeros_like(state).index_add(0, pairs[0], state[pairs[1]] * weight[:, None])
    expected = torch.autograd.grad((plain * probe).sum(), (state, weight))
    for cache in (1, 1000, gnn.CACHE):
        monkeypatch.setattr(gnn, "CACHE", cache)
        heard = NeighbourSum.apply(state, weight, *pairs)
        assert torch.allclose(heard, plain)
        for slope, right in zip(
            torch.autograd.grad((heard * probe).sum(), (state, weight)), expected, strict=True
        ):
            assert torch.allclose(slope, right)


# ------------------------------------------------------------------ what it says


def test_skipped_work_describes_the_network(make_scene, bar):
    assert build(bar, levels=4).sizes[3] == COARSEST
    assert build(bar).skipped_work()[1].startswith("multigrid hierarchy: 272 nodes, ")
    assert (
        build(bar, levels=1).skipped_work()[1]
        == "no clusters: 272 nodes with messages to neighbours only"
    )
    few = make_scene(**BODIES["few nodes"])
    assert build(few).skipped_work()[1] == "no clusters: complete graph of 16 nodes"
