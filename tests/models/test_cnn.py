"""The convolutional network and its grid."""

import math

import numpy as np
import pytest
import torch

from dpl.fem import rectangle
from dpl.models import CNN, cnn
from dpl.models.grid import Immersion, filling, own_grid


def shaken(mesh, size=0.1):
    """Return the mesh with its inner nodes moved by a fraction of the shortest edge."""
    moved = mesh.p.copy()
    inner = mesh.interior_nodes()
    noise = torch.rand(mesh.dim(), len(inner), generator=torch.Generator().manual_seed(0))
    moved[:, inner] += size * mesh.param() * (noise.numpy() - 0.5)
    return type(mesh)(moved, mesh.t)


@pytest.fixture(scope="module")
def unstructured(make_scene, scene):
    """The tiny beam of tetrahedra with perturbed inner nodes."""
    mesh = make_scene(nodes=(7, 4, 4), cell="tetra").problem.mesh
    return make_scene(mesh=shaken(mesh.scaled(100.0)))


@pytest.fixture(scope="module")
def ring(make_scene):
    """A square with a square hole in plane strain, whose nodes form no grid."""
    mesh = rectangle([1.0, 1.0], [10, 10])
    x, y = mesh.p[:, mesh.t].mean(axis=1) - 0.5
    return make_scene(mesh=mesh.remove_elements(np.flatnonzero((abs(x) < 0.3) & (abs(y) < 0.3))))


@pytest.fixture(params=["scene", "unstructured", "ring"])
def body(request):
    return request.getfixturevalue(request.param)


def answer_of(net, force):
    """Return the answer of a network without scalars."""
    return net(force, force.new_zeros(len(force), 0))


def network(scene, seed=0, **options):
    torch.manual_seed(seed)
    return CNN(scene, **{"channels": 4, **options})


def field(scene, batch=3, seed=0):
    return torch.randn(batch, *scene.problem.shape, generator=torch.Generator().manual_seed(seed))


def is_exact(net):
    """Return True if nodes are grid points, between which nothing is interpolated."""
    return net.immersion.corners.shape[1] == 1


# ------------------------------------------------------------------ the grid


def test_nodes_of_a_box_form_a_grid_in_any_order(scene, make_scene):
    for body, shape in ((scene, (5, 3, 3)), (make_scene(cell="tetra"), (5, 3, 3))):
        net = network(body)
        assert own_grid(body.problem.points) == shape
        assert is_exact(net)
        values = field(body)
        assert torch.equal(net.immersion.read(net.immersion.spread(values)), values)
    shuffled = scene.problem.points[torch.randperm(45, generator=torch.Generator().manual_seed(0))]
    immersion = Immersion(shuffled, (5, 3, 3))
    x, y, z = immersion.spread(shuffled[None])[0]
    assert (x.diff(dim=0) > 0).all()
    assert (y.diff(dim=1) > 0).all()
    assert (z.diff(dim=2) > 0).all()


def test_irregular_nodes_form_no_grid(unstructured, ring, scene, make_scene):
    points = scene.problem.points
    assert own_grid(make_scene(nodes=(3, 2, 2), degree=2).problem.points) == (5, 3, 3)
    assert own_grid(unstructured.problem.points) is None
    assert own_grid(ring.problem.points) is None
    assert own_grid(points.square()) is None  # graded
    assert own_grid(torch.cat([points[:-1], points[:1]])) is None  # one twice, one never
    assert own_grid(points.float().double() @ torch.eye(3).double().roll(1, 0)) == (3, 3, 5)


def coordinates(points, shape):
    low, high = points.amin(0), points.amax(0)
    sides = [torch.linspace(a, b, n).double() for a, b, n in zip(low, high, shape, strict=True)]
    return torch.stack(torch.meshgrid(*sides, indexing="ij"))


def test_interpolation_reproduces_linear_fields(body):
    points = body.problem.points
    shape = (4, 3, 4)[: points.shape[1]]
    slope = torch.randn(5, points.shape[1], generator=torch.Generator().manual_seed(0)).double()
    grid = torch.einsum("ci,i...->c...", slope, coordinates(points, shape)) + 0.5
    read = Immersion(points, shape).read(grid[None].float())[0]
    assert torch.allclose(read, (points @ slope.T + 0.5).float(), atol=1e-5)


def test_spreading_is_the_adjoint_of_interpolation(body):
    """It therefore preserves the total force and moment."""
    immersion = Immersion(body.problem.points, (4, 3, 5)[: body.problem.shape[1]])
    force = field(body)
    grid = torch.randn(3, force.shape[2], *immersion.shape)
    left = (immersion.spread(force) * grid).sum()
    assert torch.allclose(left, (force * immersion.read(grid)).sum(), rtol=1e-4, atol=1e-3)


def test_filling_sums_to_the_volume_of_the_body(body):
    problem = body.problem
    sides = problem.points.amax(0) - problem.points.amin(0)
    for shape in ((5, 3, 4), (11, 8, 9)):
        shape = shape[: len(sides)]
        voxel = torch.ones(()).double()
        for n in shape:
            width = torch.tensor([0.5, *[1.0] * (n - 2), 0.5]).double() / (n - 1)
            voxel = voxel[..., None] * width
        filled = filling(problem, shape)
        volume = problem.dV.expand(len(problem.cells), -1).sum()
        assert torch.isclose((filled * voxel).sum() * sides.prod(), volume)
        assert filled.min() >= 0
        assert filled.max() < 1.2


def test_only_bodies_with_holes_have_a_volume_fraction_channel(ring, unstructured):
    net = network(ring)
    held, filled = net.constant
    middle = [n // 2 for n in filled.shape]
    assert filled[*middle] == 0
    assert filled[0].min() > 0.5
    assert held.max() > 0.5
    assert held.min() == 0
    assert len(network(unstructured).constant) == 1
    assert any("volume fraction" in line for line in network(unstructured).skipped_work())
    assert net.skipped_work() == []


def test_a_missing_cell_of_a_grid_of_nodes_is_detected(make_scene):
    net = network(make_scene(mesh=rectangle([1.0, 1.0], [5, 5]).remove_elements(np.array([5]))))
    assert is_exact(net)
    _, filled = net.constant
    assert sorted(filled.unique().tolist()) == [0.75, 1.0]
    assert len(net.skipped_work()) == 1


def test_fixed_degrees_of_freedom_have_a_channel_for_each_distinct_component(make_scene, scene):
    (held,) = network(scene).constant
    assert torch.equal(held, (torch.arange(5) == 0).float()[:, None, None].expand(5, 3, 3))
    free = scene.problem.free.clone()
    free[scene.problem.points[:, 0] == scene.problem.points[:, 0].max(), 2] = False
    sliding = make_scene(fixed=(~free).numpy())
    assert len(network(sliding).constant) == 3


def test_a_grid_has_about_as_many_points_as_the_mesh_and_cubic_cells(ring, unstructured):
    for body in (ring, unstructured):
        points = body.problem.points
        shape = network(body).immersion.shape
        assert 0.4 * len(points) < math.prod(shape) <= len(points)
        spacing = (points.amax(0) - points.amin(0)) / (torch.tensor(shape) - 1)
        assert spacing.max() < 1.6 * spacing.min()


def test_the_number_of_grid_points_can_be_set(scene):
    net = network(scene, grid=5)
    assert net.skipped_work() == [
        "no interpolation: the nodes lie on a grid of 5 x 3 x 3 points",
        "no input for the volume fraction: the body fills the grid",
    ]
    assert network(scene, grid=9).immersion.shape == (9, 3, 3)
    assert not is_exact(network(scene, grid=8))
    assert network(scene, grid=2).immersion.shape == (2, 2, 2)


# ------------------------------------------------------------------ the network


@pytest.mark.parametrize(
    ("shape", "smooth"),
    [((17, 5, 5), False), ((31, 6, 3), True), ((7, 2), False), ((2, 13), True)],
)
def test_any_number_of_grid_points_is_accepted(shape, smooth):
    sizes = cnn._sizes(shape, None)
    assert max(sizes[-1]) <= 3
    assert min(min(size) for size in sizes) == min(min(shape), 2)
    net = cnn.UNet(2, 3, sizes, [2] * len(sizes), smooth=smooth)
    assert net(torch.randn(1, 2, *shape)).shape == (1, 3, *shape)


@pytest.mark.parametrize(("shape", "smooth"), [((17, 5, 5), False), ((33, 9), True)])
def test_every_output_depends_on_every_input(shape, smooth):
    """The gradient at one end with respect to the input at the other is not zero."""
    torch.manual_seed(0)
    sizes = cnn._sizes(shape, None)
    net = cnn.UNet(1, 1, sizes, [4 * 2**level for level in range(len(sizes))], smooth=smooth)
    for part in net.modules():
        if isinstance(part, cnn.Residual):
            torch.nn.init.normal_(part.second.weight)  # zero at first
    force = torch.zeros(1, 1, *shape, requires_grad=True)
    net(force)[(0, 0, *[-1] * len(shape))].backward()
    assert (force.grad != 0).all()


def test_a_smooth_network_has_no_residual_block_on_the_finest_grid(scene):
    net = network(scene, smooth=True)
    widths = [part.first.in_channels for part in net.modules() if isinstance(part, cnn.Residual)]
    assert min(widths) == 2 * net.net.inlets[0].out_channels
    assert net.skipped_work()[1].startswith("no residual blocks on the finest grid")


BEYOND = "parameters and a grid of .* GB; take a smaller model"


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"channels": 0}, ValueError, "channels = 0 must be 1 or more"),
        ({"steps": -1}, ValueError, "steps = -1 must be 0 or more"),
        ({"grid": 1}, ValueError, "grid = 1 must be 2 or more"),
        ({"steps": 3}, ValueError, "steps = 3 must be 2 or less: after them the grid of 5 x 3 x 3"),
        ({"grid": 10**6}, MemoryError, BEYOND),
        ({"channels": 10**6}, MemoryError, BEYOND),
        ({"channels": 4, "memory_limit": 1e-6}, MemoryError, r"there are 0\.0 GB"),
    ],
)
def test_invalid_options_are_refused_before_the_network_is_built(scene, options, error, message):
    with pytest.raises(error, match=message):
        CNN(scene, **options)
    CNN(scene, steps=2, channels=1)
    CNN(scene, steps=0, channels=4, memory_limit=0.01)
