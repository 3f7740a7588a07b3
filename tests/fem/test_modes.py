"""Laws of the modes and of the loads made of them: reproducible, bounded, where they may act."""

from functools import partial

import numpy as np
import pytest
import scipy.sparse.linalg
import torch

from dpl.fem import modes as modes_module
from dpl.fem.linear import full_matrix
from dpl.fem.materials import NeoHookeanLn, SaintVenantKirchhoff
from dpl.fem.mesh import box, rectangle
from dpl.fem.modes import ModalLoads, eigenmodes, normal, uniform
from dpl.fem.newton import Linear, Newton
from dpl.fem.problem import Problem
from dpl.fem.solution import Load, solve

YOUNG, LENGTH = 4500.0, 100.0
REFERENCE = {  # VERIFICATION 1.8e: eigenvalues of K(0) [N/m]
    (8, 2): [21.24835125] * 2 + [163.64340492] + [536.30691952] * 2 + [867.54630154, 1433.87488669],
    (16, 4): [3.88134628] * 2 + [37.40358032] + [98.17128826] * 2 + [165.64636884],
}


@pytest.fixture(scope="module")
def linear(beam):
    """The beam of 8 x 2 x 2 hexahedra with its factor."""
    return Linear(beam(NeoHookeanLn(0.3)), linear="superlu")


@pytest.fixture(scope="module")
def loads(linear):
    return ModalLoads(linear, n_modes=5)


def stiffness(problem):
    rest = torch.zeros(1, *problem.shape, dtype=torch.float64)
    return full_matrix(problem.pattern, problem.tangent(rest)[0].numpy())


def free_vectors(modes, problem):
    return modes.vectors[problem.free].numpy()  # (n, M)


@pytest.mark.parametrize("cells", REFERENCE, ids=lambda cells: f"{cells[0]}x{cells[1]}x{cells[1]}")
def test_eigenvalues_are_those_of_the_verification_dossier(beam, law, cells):
    expected = REFERENCE[cells]
    found = eigenmodes(Linear(beam(law, *cells), linear="superlu"), len(expected)).values
    assert found[: len(expected)].numpy() * YOUNG * LENGTH == pytest.approx(expected, rel=1e-6)


def test_tetrahedra_split_the_pair(beam):
    problem = beam(NeoHookeanLn(0.3), 8, 2, cell="tetra")
    found = eigenmodes(Linear(problem, linear="superlu"), 2).values[:2].numpy() * YOUNG * LENGTH
    assert found == pytest.approx([30.27082, 41.36540], rel=1e-6)


def test_modes_are_orthonormal_eigenvectors(linear):
    problem, modes = linear.problem, eigenmodes(linear, 7)
    vectors, K = free_vectors(modes, problem), stiffness(problem)
    assert vectors.T @ vectors == pytest.approx(np.eye(vectors.shape[1]), abs=1e-10)
    residual = K @ vectors - vectors * modes.values.numpy()
    assert np.abs(residual).max() < 1e-10
    assert (np.diff(modes.values.numpy()) > -1e-12).all()


def test_modes_are_the_lowest_ones(linear):
    modes = eigenmodes(linear, 7)
    every = np.linalg.eigvalsh(stiffness(linear.problem).toarray())
    assert modes.values.numpy() == pytest.approx(every[: len(modes.values)], rel=1e-9)


def test_modes_vanish_where_the_body_is_held(linear):
    held = ~linear.problem.free
    assert not eigenmodes(linear, 5).vectors[held].any()


@pytest.mark.parametrize("cell", ["hexahedron", "tetra"])
def test_modes_do_not_depend_on_the_start_of_the_iteration(beam, monkeypatch, cell):
    problem = beam(NeoHookeanLn(0.3), 8, 2, cell=cell)
    first = eigenmodes(Linear(problem, linear="superlu"), 5)
    original = scipy.sparse.linalg.eigsh
    for seed in (1, 2, 3):

        def restarted(matrix, count, *, v0, seed=seed, **options):
            start = np.random.default_rng(seed).uniform(-1, 1, len(v0))
            return original(matrix, count, v0=start, **options)

        monkeypatch.setattr(modes_module, "eigsh", restarted)
        again = eigenmodes(Linear(problem, linear="superlu"), 5)
        assert torch.allclose(again.vectors, first.vectors, rtol=0, atol=1e-8)


def test_modes_do_not_depend_on_the_backend(linear):
    pytest.importorskip("pypardiso")
    ours = eigenmodes(linear, 5)
    theirs = eigenmodes(Linear(linear.problem, linear="pardiso"), 5)
    assert torch.allclose(ours.vectors, theirs.vectors, rtol=0, atol=1e-8)


def test_modes_do_not_depend_on_size(beam):
    """Signs and pairs are chosen by the shape, not by the last bit of its coordinates."""
    shapes = []
    for size in ([100.0, 25.0, 25.0], [1.0, 0.25, 0.25], [0.3, 0.075, 0.075]):
        problem = Problem.build(
            box(size, [9, 3, 3]), NeoHookeanLn(0.3), fixed=lambda points: points[:, 0] == 0
        )
        shapes.append(eigenmodes(Linear(problem, linear="superlu"), 5).vectors)
    assert torch.allclose(shapes[0], shapes[1], rtol=0, atol=1e-8)
    assert torch.allclose(shapes[0], shapes[2], rtol=0, atol=1e-8)


@pytest.mark.parametrize(("asked", "given"), [(1, 2), (2, 2), (3, 3), (4, 5), (5, 5)])
def test_a_family_of_modes_is_kept_whole(linear, asked, given):
    assert len(eigenmodes(linear, asked).values) == given


def test_neighbouring_eigenvalues_are_one_family(monkeypatch):
    """A bar of nearly square section: its two bending planes differ by 2 %, both are excited."""
    mesh = box([4.0, 1.0, 1.01], [9, 3, 3])
    problem = Problem.build(mesh, NeoHookeanLn(0.3), fixed=lambda points: points[:, 0] == 0)
    modes = eigenmodes(Linear(problem, linear="superlu"), 1)
    assert len(modes.values) == 2
    assert 1e-3 < float(modes.values[1] / modes.values[0] - 1) < 0.05


def test_small_loads_along_a_mode_move_the_body_along_it(beam, law):
    """F = q phi_k gives q phi_k / lambda_k, but for a deviation that is linear in q."""
    problem = beam(law)
    newton = Newton(problem, tol=1e-10, linear="superlu")
    modes = eigenmodes(newton.rest, 3)
    for k, value in enumerate(modes.values):
        deviations = []
        for size in (1e-4, 1e-5):
            q = size * float(value)
            load = Load(q * modes.vectors[None, ..., k], torch.ones(1))
            expected = q * modes.vectors[..., k] / value
            answer = solve(newton, load).displacement[0]
            deviations.append(float((answer - expected).norm() / expected.norm()))
        assert deviations[0] < 1e-3
        assert deviations[1] < 0.2 * deviations[0]


@pytest.mark.parametrize("deflection", [0.1, 0.4, 1.0])
def test_the_softest_mode_at_its_largest_reaches_the_deflection(linear, deflection):
    loads = ModalLoads(linear, n_modes=3, deflection=deflection)
    answer = linear.respond(loads.q_max[0] * loads.modes.vectors[..., 0])
    assert float(answer.norm(dim=1).max()) == pytest.approx(deflection, rel=1e-8)


def test_largest_modal_loads_have_equal_energy(linear, loads):
    energies = [
        float((force * linear.respond(force)).sum())
        for force in (q * loads.modes.vectors[..., k] for k, q in enumerate(loads.q_max))
    ]
    assert energies == pytest.approx([energies[0]] * len(energies), rel=1e-8)
    assert loads.largest_force == pytest.approx(
        float((loads.modes.vectors @ loads.q_max).norm()), rel=1e-10
    )


def test_a_load_is_a_function_of_its_seed_and_index(linear, loads):
    whole = loads.sample((3, 0), range(6)).force
    assert torch.equal(loads.sample((3, 0), [4, 1]).force, whole[[4, 1]])
    assert torch.equal(loads.sample((3, 0), [5]).force[0], whole[5])
    fresh = ModalLoads(Linear(linear.problem, linear="superlu"), n_modes=5)
    assert torch.equal(fresh.sample((3, 0), range(6)).force, whole)


def test_streams_and_indices_give_different_loads(loads):
    drawn = torch.cat([loads.sample(seed, range(5)).force for seed in ((0, 0), (0, 1), (1, 0))])
    distance = torch.cdist(drawn.flatten(1), drawn.flatten(1))
    distance.fill_diagonal_(1.0)
    assert distance.min() > 1e-9


def test_forces_act_on_free_boundary_nodes_within_the_patch_only(loads):
    problem = loads.problem
    inner = ~problem.boundary
    assert inner.any()
    force = loads.sample((0, 0), range(40)).force
    assert not force[:, ~problem.free].any()
    assert not force[:, inner].any()
    assert not force[:, ~loads.reach].any()
    assert (force != 0).any(dim=2).any(dim=0)[problem.boundary & problem.free.any(dim=1)].all()


@pytest.mark.parametrize("radius", [0.0, 0.2, 0.5])
def test_the_loaded_area_has_the_radius_of_the_patch(linear, radius):
    loads = ModalLoads(linear, n_modes=3, patch=(radius, radius))
    points = linear.problem.points
    sizes = []
    for force in loads.sample((0, 0), range(20)).force:
        loaded = points[force.any(dim=1)]
        reach = torch.cdist(points[linear.problem.boundary], loaded).amax(dim=1).min()
        assert float(reach) <= radius * (1 + 1e-6)
        sizes.append(len(loaded))
    assert sizes == [1] * 20 if radius == 0 else max(sizes) > 1


def test_a_patch_over_the_whole_body_keeps_the_modal_force(linear):
    loads = ModalLoads(linear, n_modes=3, patch=(2.0, 2.0))
    force = loads.sample((0, 0), [0]).force[0]
    reach = loads.reach
    basis = loads.modes.vectors[reach].numpy()
    q, *_ = np.linalg.lstsq(basis, force[reach].numpy(), rcond=None)
    assert basis @ q == pytest.approx(force[reach].numpy(), abs=1e-12)
    assert (np.abs(q) <= loads.q_max.numpy() * (1 + 1e-9)).all()


def test_modal_loads_are_uniform_up_to_their_largest(linear):
    loads = ModalLoads(linear, n_modes=2, patch=(2.0, 2.0))
    reach = loads.reach
    basis = np.linalg.pinv(loads.modes.vectors[reach].numpy())
    drawn = loads.sample((0, 0), range(400)).force[:, reach].numpy() @ basis.T
    share = drawn / loads.q_max.numpy()
    assert np.abs(share).max() <= 1 + 1e-9
    assert share.mean(axis=0) == pytest.approx(0.0, abs=0.12)
    assert share.std(axis=0) == pytest.approx(3**-0.5, abs=0.05)
    assert abs(np.corrcoef(share.T)[0, 1]) < 0.2


def test_radii_and_centres_vary(loads):
    counts = {int(force.any(dim=1).sum()) for force in loads.sample((0, 0), range(30)).force}
    assert len(counts) > 10


def test_other_distributions_can_be_plugged_in(linear):
    def largest(rng, count):
        return np.ones(count)

    loads = ModalLoads(linear, n_modes=3, patch=(2.0, 2.0), distribution=largest)
    force = loads.sample((0, 0), [0]).force[0]
    expected = torch.where(loads.reach, loads.modes.vectors @ loads.q_max, 0.0)
    assert torch.allclose(force, expected, rtol=1e-12, atol=0)

    def scaled(rng, count, *, factor):
        return factor * np.ones(count)

    half = ModalLoads(linear, n_modes=3, patch=(2.0, 2.0), distribution=partial(scaled, factor=0.5))
    assert torch.allclose(half.sample((0, 0), [0]).force[0], expected / 2, rtol=1e-12, atol=0)


@pytest.mark.parametrize("distribution", [uniform, normal])
def test_distributions_stay_within_one(distribution):
    drawn = distribution(np.random.default_rng(0), 10_000)
    assert drawn.shape == (10_000,)
    assert np.abs(drawn).max() <= 1
    assert drawn.mean() == pytest.approx(0.0, abs=0.02)
    assert drawn.std() == pytest.approx({uniform: 3**-0.5, normal: 1 / 3}[distribution], abs=0.01)


def test_a_range_of_moduli_is_drawn_from_and_changes_no_force(linear, loads):
    ranged = ModalLoads(linear, n_modes=5, young=[1e9, 2e11])
    drawn = ranged.sample((0, 0), range(200))
    assert drawn.young.min() >= 1e9
    assert drawn.young.max() <= 2e11
    assert drawn.young.min() < 0.1 * 2e11
    assert drawn.young.max() > 0.9 * 2e11
    assert drawn.young.dtype == torch.float64
    assert torch.equal(drawn.force[:5], loads.sample((0, 0), range(5)).force)


def test_one_modulus_is_that_of_every_load(linear):
    loads = ModalLoads(linear, n_modes=2, young=4500.0)
    assert (loads.sample((0, 0), range(5)).young == 4500.0).all()


def test_the_amplitude_is_a_factor_on_the_forces(loads):
    one, twice = (loads.sample((0, 0), range(4), amplitude=a) for a in (1.0, 2.0))
    assert torch.equal(twice.force, 2 * one.force)
    assert torch.equal(twice.young, one.young)


def test_plane_bodies_have_modal_loads_too():
    mesh = rectangle([4.0, 1.0], [9, 3])
    problem = Problem.build(mesh, SaintVenantKirchhoff(0.3), fixed=lambda points: points[:, 0] == 0)
    newton = Newton(problem, linear="superlu")
    loads = ModalLoads(newton.rest, n_modes=3)
    answer = solve(newton, loads.sample((0, 0), range(3)))
    assert answer.converged.all()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"n_modes": 0}, "n_modes = 0"),
        ({"deflection": 0.0}, r"deflection = 0\.0"),
        ({"deflection": -1.0}, r"deflection = -1\.0"),
        ({"deflection": 11.0}, r"deflection = 11\.0"),
        ({"deflection": float("nan")}, "deflection = nan"),
        ({"patch": (0.5, 0.1)}, "patch = "),
        ({"patch": (-0.1, 0.1)}, "patch = "),
        ({"patch": (0.0, float("inf"))}, "patch = "),
        ({"patch": (0.1,)}, "patch = "),
        ({"young": 0.0}, r"young = 0\.0"),
        ({"young": -1.0}, r"young = -1\.0"),
        ({"young": float("inf")}, "young = inf"),
        ({"young": float("nan")}, "young = nan"),
        ({"young": [2.0, 1.0]}, "young = "),
    ],
)
def test_options_out_of_range_are_refused_by_name(linear, options, named):
    with pytest.raises(ValueError, match=named):
        ModalLoads(linear, **options)


@pytest.mark.parametrize("count", [0, 100])
def test_a_number_of_modes_that_the_body_does_not_have_is_refused(beam, count):
    problem = beam(NeoHookeanLn(0.3), 4, 1)
    with pytest.raises(ValueError, match=f"n_modes = {count} must lie between 1 and 16"):
        eigenmodes(Linear(problem, linear="superlu"), count)


def test_a_loose_body_is_refused_before_anything_is_factorised(monkeypatch):
    problem = Problem.build(box([1.0, 1.0, 1.0], [4, 4, 4]), NeoHookeanLn(0.3))
    linear = Linear(problem, linear="superlu")
    with pytest.raises(ValueError, match="6 rigid modes are unconstrained"):
        eigenmodes(linear, 3)
    assert "factor" not in linear.__dict__
