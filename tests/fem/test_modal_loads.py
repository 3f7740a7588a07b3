"""Laws of the modes and of the loads made of them: reproducible, bounded, where they may act."""

import pickle
from functools import partial

import numpy as np
import pytest
import scipy.sparse.linalg
import torch
from solving import LENGTH, YOUNG
from torch.testing import assert_close

from dpl import fem
from dpl.fem.loads import constant, fit, log_tail_mixture, logarithmic, modal, normal, uniform01
from dpl.fem.loads.sampling import SAMPLINGS

REFERENCE = {  # paper's beam, independent code: eigenvalues of K(0) [N/m]
    (8, 2): [21.24835125] * 2 + [163.64340492] + [536.30691952] * 2 + [867.54630154, 1433.87488669],
    (16, 4): [3.88134628] * 2 + [37.40358032] + [98.17128826] * 2 + [165.64636884],
    (8, 2, "tetra"): [30.27082, 41.36540],  # tetrahedra split the pair
}
HELD = fem.Plane(0, "min")


@pytest.fixture(scope="module")
def linear(beam):
    """The beam of 8 x 2 x 2 hexahedra with its factor."""
    return fem.LinearSolver(beam(fem.NeoHookeanLn(0.3)), linear="superlu")


@pytest.fixture(scope="module")
def loads(linear):
    return fem.ModalLoads(linear, n_modes=5)


@pytest.mark.parametrize(
    ("law", "mesh"),
    [
        (fem.SaintVenantKirchhoff(0.3), (8, 2)),
        *((fem.NeoHookeanLn(0.3), mesh) for mesh in REFERENCE),
    ],
)
def test_eigenvalues_are_those_of_an_independent_code(beam, law, mesh):
    expected, (n, m, *cell) = REFERENCE[mesh], mesh
    problem = beam(law, n, m, cell=cell[0] if cell else "hexahedron")
    found = fem.eigenmodes(fem.LinearSolver(problem, linear="superlu"), len(expected)).values
    assert found[: len(expected)].numpy() * YOUNG * LENGTH == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("cell", ["hexahedron", "tetra"])
def test_modes_do_not_depend_on_the_start_of_the_iteration(beam, monkeypatch, cell):
    problem = beam(fem.NeoHookeanLn(0.3), 8, 2, cell=cell)
    first = fem.eigenmodes(fem.LinearSolver(problem, linear="superlu"), 5)
    original = scipy.sparse.linalg.eigsh

    def restarted(matrix, count, *, v0, **options):
        start = np.random.default_rng(1).uniform(-1, 1, len(v0))
        return original(matrix, count, v0=start, **options)

    monkeypatch.setattr(modal, "eigsh", restarted)
    again = fem.eigenmodes(fem.LinearSolver(problem, linear="superlu"), 5)
    assert torch.allclose(again.vectors, first.vectors, rtol=0, atol=1e-8)


def test_modes_depend_neither_on_the_backend_nor_on_size(linear):
    """Signs and pairs are chosen by the shape, not by the last bit of its coordinates."""
    bodies = [
        fem.Problem.build(fem.box(size, [9, 3, 3]), fem.NeoHookeanLn(0.3), fixed=HELD)
        for size in ([1.0, 0.25, 0.25], [0.3, 0.075, 0.075])
    ]
    solvers = [fem.LinearSolver(body, linear="superlu") for body in bodies]
    backends = set(fem.installed_backends()) & {"pardiso"}
    solvers += [fem.LinearSolver(linear.problem, linear=name) for name in backends]
    expected = fem.eigenmodes(linear, 5).vectors
    for solver in solvers:
        found = fem.eigenmodes(solver, 5).vectors
        assert torch.allclose(found, expected, rtol=0, atol=1e-8)


def test_a_family_of_modes_is_kept_whole(linear):
    given = [len(fem.eigenmodes(linear, requested).values) for requested in range(1, 6)]
    assert given == [2, 2, 3, 5, 5]


def test_neighbouring_eigenvalues_are_one_family():
    """A bar of nearly square section: its two bending planes differ by 2 %, both are excited."""
    mesh = fem.box([4.0, 1.0, 1.01], [9, 3, 3])
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), fixed=HELD)
    modes = fem.eigenmodes(fem.LinearSolver(problem, linear="superlu"), 1)
    assert len(modes.values) == 2
    assert 1e-3 < float(modes.values[1] / modes.values[0] - 1) < 0.05


@pytest.mark.parametrize("deflection", [0.1, 0.4, 1.0])
def test_the_softest_mode_at_its_largest_reaches_the_deflection(linear, deflection):
    loads = fem.ModalLoads(linear, n_modes=3, deflection=deflection)
    answer = linear.solve(loads.q_max[0] * loads.eigenmodes.vectors[..., 0])
    assert float(answer.norm(dim=1).max()) == pytest.approx(deflection, rel=1e-8)


def test_workers_get_the_modes_and_no_factor(linear):
    copy = pickle.loads(pickle.dumps(fem.ModalLoads(linear, n_modes=3)))
    assert "eigenmodes" in copy.__dict__
    assert "factor" not in copy.linear.__dict__


def point_of(loads, *q, centre=0.0, radius=0.0, amplitude=0.0, young=0.0):
    """Return a point of the unit cube (1, d); the modal loads left out are 0."""
    q = [*q, *[0.5] * (loads.n_random - 4 - len(q))]
    return torch.tensor([[*q, centre, radius, amplitude, young]], dtype=torch.float64)


def test_coordinates_of_a_point_are_the_modal_loads_in_their_order(linear):
    loads = fem.ModalLoads(linear, n_modes=5, patch_radius=(2.0, 2.0))
    for k in range(5):
        for t, share in ((0.0, -1.0), (0.5, 0.0), (0.75, 0.5)):
            force = loads.loads_at(point_of(loads, *[0.5] * k, t)).force[0]
            expected = share * loads.q_max[k] * loads.eigenmodes.vectors[..., k]
            expected = torch.where(loads.loadable_dofs, expected, 0.0)
            assert torch.allclose(force, expected, rtol=1e-14, atol=0)


def test_coordinates_besides_are_centre_radius_amplitude_and_modulus(linear):
    """Each of them changes what it is for, and nothing else."""
    quantiles = {"amplitude": uniform01, "distribution": constant}
    options = {"patch_radius": (0.1, 1.0), "young": [1.0, 3.0], **quantiles}
    loads = fem.ModalLoads(linear, n_modes=2, **options)
    middle = {"centre": 0.5, "radius": 0.3, "amplitude": 0.5, "young": 0.5}
    usual = loads.loads_at(point_of(loads, **middle))
    loaded = usual.force[0].any(dim=1)

    def changed(**options):
        return loads.loads_at(point_of(loads, **{**middle, **options}))

    assert changed(young=0.75).young.item() == 2.5
    assert torch.equal(changed(young=0.75).force, usual.force)
    half = changed(amplitude=0.25)
    assert torch.allclose(half.force, usual.force / 2, rtol=1e-14, atol=0)
    larger = changed(radius=0.9).force[0]
    assert int(larger.any(dim=1).sum()) > int(loaded.sum())
    assert torch.equal(larger[loaded], usual.force[0][loaded])
    moved = changed(centre=0.05).force[0].any(dim=1)
    assert not torch.equal(moved, loaded)


def test_every_point_of_the_closed_cube_below_one_has_a_load(linear):
    last = 1 - 2.0**-53
    quantiles = {"distribution": normal, "radius": logarithmic}
    loads = fem.ModalLoads(linear, n_modes=2, young=[1.0, 3.0], **quantiles)
    for value in (0.0, last):
        load = loads.loads_at(torch.full((1, loads.n_random), value, dtype=torch.float64))
        assert load.force.isfinite().all()
        assert load.force.any()
        assert 1.0 <= load.young.item() <= 3.0


def test_forces_act_on_all_free_nodes_of_the_boundary_and_on_no_inner_node(loads):
    problem = loads.problem
    acts = loads.sample((0, 0), range(40)).force.any(dim=2).any(dim=0)
    assert (~problem.boundary).any()
    assert torch.equal(acts, problem.boundary & problem.free.any(dim=1))


@pytest.mark.parametrize("radius", [0.0, 0.2, 0.5])
def test_the_loaded_area_has_the_radius_of_the_patch(linear, radius):
    loads = fem.ModalLoads(linear, n_modes=3, patch_radius=(radius, radius))
    points = linear.problem.points
    sizes = []
    for force in loads.sample((0, 0), range(20)).force:
        loaded = points[force.any(dim=1)]
        reach = torch.cdist(points[linear.problem.boundary], loaded).amax(dim=1).min()
        assert float(reach) <= radius * (1 + 1e-6)
        sizes.append(len(loaded))
    assert sizes == [1] * 20 if radius == 0 else max(sizes) > 1


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_positions_of_loads_know_nothing_of_their_moduli(linear, sampling):
    """So that a data set serves every range of moduli."""
    kinds = [4500.0, [1e9, 2e11], [1.0, 1.0]]
    points = [fem.ModalLoads(linear, young=y, sampling=sampling).points(0, range(5)) for y in kinds]
    assert torch.equal(points[0], points[1])
    assert torch.equal(points[0], points[2])
    moved = points[0].clone()
    moved[:, -1] = 0.123
    loads = fem.ModalLoads(linear, young=kinds[1], sampling=sampling)
    assert torch.equal(loads.loads_at(moved).force, loads.loads_at(points[0]).force)
    assert not torch.equal(loads.loads_at(moved).young, loads.loads_at(points[0]).young)


@pytest.mark.parametrize(("equal", "exponent"), [(0, 0.5), (1, 1.0), (2, 0.0)])
def test_the_exponent_decides_whether_energies_displacements_or_forces_are_equal(
    linear, equal, exponent
):
    loads = fem.ModalLoads(linear, n_modes=5, eigenvalue_exponent=exponent)
    forces = [q * loads.eigenmodes.vectors[..., k] for k, q in enumerate(loads.q_max)]
    pairs = [(force, linear.solve(force)) for force in forces]
    sizes = [torch.stack([(f * u).sum(), u.norm(), f.norm()]) for f, u in pairs]
    for kind, values in enumerate(torch.stack(sizes).T):
        assert (float(values.max() / values.min()) - 1 < 1e-8) == (kind == equal)
    assert float(pairs[0][1].norm(dim=1).max()) == pytest.approx(0.4, rel=1e-8)
    assert loads.largest_force == pytest.approx(float(sum(forces).norm()), rel=1e-10)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mode_that_is_zero_at_the_loaded_node_has_no_part_in_its_force(monkeypatch, axis):
    """Torsion moves the axis of the beam by rounding errors only."""
    problem = fem.Problem.build(fem.box((4, 1, 1), (9, 3, 3)), fem.NeoHookeanLn(0.3), fixed=HELD)
    loads = fem.ModalLoads(fem.Newton(problem).linear_solver, n_modes=3, deflection=0.2)
    middle = torch.tensor([1.0, 0.5, 0.5]) / 4
    node = int((problem.points - middle).norm(dim=1).argmin())
    forces = torch.zeros(2, *problem.shape, dtype=torch.float64)
    forces[0, node, axis] = forces[1, node, axis] = 1e-3
    forces[1, -1] = 1e-3
    found = loads.project(forces)
    monkeypatch.setattr(fit, "_inverse_root", lambda matrix: (matrix, np.zeros(len(matrix))))
    for one, by_eigenvalues in zip(found, loads.project(forces), strict=True):
        assert_close(one, by_eigenvalues, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"n_modes": 0}, "n_modes = 0 must be a number from 1"),
        ({"deflection": -1.0}, r"deflection = -1\.0 must be a number from 1e-12 to 10 \[times L\]"),
        ({"deflection": 11.0}, r"deflection = 11\.0"),
        ({"deflection": float("nan")}, "deflection = nan"),
        ({"patch_radius": (-0.1, 0.1)}, r"patch_radius = .* numbers? from 0 \[times L\]"),
        ({"patch_radius": (0.0, float("inf"))}, "patch_radius = "),
        ({"patch_radius": (0.1,)}, "patch_radius = "),
        ({"eigenvalue_exponent": -1.1}, r"eigenvalue_exponent = -1\.1 must be .* from -1 to 2$"),
        ({"eigenvalue_exponent": float("nan")}, "eigenvalue_exponent = nan"),
        ({"sampling": "halton"}, "sampling = 'halton' must be independent or sobol"),
        ({"sampling": None}, "sampling = None"),
        ({"distribution": lambda t: 2 * t}, r"distribution draws numbers outside \[-1, 1\]"),
        ({"distribution": lambda t: np.nan * t}, "distribution draws"),
        ({"radius": normal}, r"radius draws numbers outside \[0, 1\]"),
        ({"amplitude": lambda t: 1 + t}, "amplitude draws"),
        ({"amplitude": partial(log_tail_mixture, part=1.5)}, r"part = 1\.5"),
        ({"radius": partial(logarithmic, low=0.0)}, r"low = 0\.0"),
        *[({"modes": modes}, r"modes = \[") for modes in ([], [-1], [3, 0], [1, 1], [True], [0.0])],
        ({"modes": [500]}, r"modes = \[500\] must lie between 0 and"),
        *[({"young": young}, f"young = {young}") for young in (0.0, float("inf"), float("nan"))],
        ({"young": -1.0}, r"young = -1\.0 must be a number, .*, above 0 \[Pa\]"),
        ({"young": [1.0, 2.0, 3.0]}, r"young = \[1\.0, 2\.0, 3\.0\] must be"),
        ({"young": {"low": 1.0}}, r"young = \{'low': 1\.0\} must be"),
        ({"young": {"low": 1.0, "high": 2.0, "mean": 1.5}}, r"young = .*distribution}"),
        ({"young": {"low": 2.0, "high": 1.0}}, r"young = .* ascending range"),
        ({"young": {"low": 0.0, "high": 1.0}}, r"young = .* above 0 \[Pa\]"),
        ({"young": {"low": 1.0, "high": 2.0, "distribution": "normal"}}, r"young\.distribution = "),
    ],
)
def test_options_out_of_range_are_refused_by_name(linear, options, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        fem.ModalLoads(linear, **options).eigenmodes  # noqa: B018


@pytest.mark.parametrize("count", [0, 100])
def test_a_number_of_modes_that_the_body_does_not_have_is_refused(beam, count):
    problem = beam(fem.NeoHookeanLn(0.3), 4, 1)
    with pytest.raises(ValueError, match=f"n_modes = {count} must lie between 1 and 16"):
        fem.eigenmodes(fem.LinearSolver(problem, linear="superlu"), count)


def test_selected_modes_are_those_of_their_numbers(linear):
    numbers = [0, 3, 4]
    every, chosen = fem.ModalLoads(linear, n_modes=5), fem.ModalLoads(linear, modes=numbers)
    values, vectors = every.eigenmodes
    assert_close(chosen.eigenmodes.values, values[numbers], rtol=1e-12, atol=0)
    assert_close(chosen.eigenmodes.vectors, vectors[..., numbers], rtol=0, atol=1e-8)
    assert chosen.n_force == 3 + 3
    assert float(chosen.project(chosen.sample(0, range(4)).force)[1].max()) < 1e-8


def test_one_mode_of_a_pair_with_equal_eigenvalues_can_be_selected(linear):
    """The square beam bends alike along y and z: mode 0 is the one that leans on y."""
    pair = [fem.ModalLoads(linear, modes=[k]).eigenmodes for k in (0, 1)]
    assert float(pair[0].values) == pytest.approx(float(pair[1].values), rel=1e-9)
    mean = torch.stack([modes.vectors[..., 0].mean(dim=0) for modes in pair])  # (2, D)
    assert (mean[0, 1] > 0) & (mean[1, 2] > 0)
    assert torch.allclose(mean[0, [0, 2]], torch.zeros(2).double(), atol=1e-8)
    assert torch.allclose(mean[1, :2], torch.zeros(2).double(), atol=1e-8)


@pytest.mark.parametrize("distribution", ["uniform", "log"])
@pytest.mark.parametrize("low", [1e6, 1e-3])
def test_moduli_fill_their_range_by_their_distribution(linear, low, distribution):
    """Kolmogorov-Smirnov distance of 2,000 moduli from the distribution that is wanted."""
    high = 1e5 * low
    young = {"low": low, "high": high, "distribution": distribution}
    loads = fem.ModalLoads(linear, n_modes=1, young=young)
    ends = torch.tensor([[0.0] * loads.n_random, [1 - 2.0**-53] * loads.n_random]).double()
    least, most = loads.young_at(ends).tolist()
    assert least == low
    assert most <= high
    assert most == pytest.approx(high, rel=1e-12)
    moduli = loads.young_at(loads.points(0, range(2000))).sort().values
    assert ((moduli >= low) & (moduli <= high)).all()
    part = (moduli / low).log10() / 5 if distribution == "log" else (moduli - low) / (high - low)
    assert float((part - torch.linspace(0, 1, 2000).double()).abs().max()) < 0.04
    assert torch.allclose(loads.moduli.normalise(moduli), 2 * part - 1, atol=1e-12)


@pytest.mark.parametrize("distribution", ["uniform", "log"])
def test_one_modulus_is_a_range_without_width(distribution):
    ends = {"low": 4500.0, "high": 4500.0}
    of_young = partial(fem.ParameterRange.of, "young", is_modulus=True)
    moduli = of_young({**ends, "distribution": distribution})
    t = torch.linspace(0, 1, 7).double()
    assert_close(moduli.at(t), torch.full_like(t, 4500.0), rtol=1e-15, atol=0)
    assert float(moduli.normalise(torch.tensor(4500.0).double())) == 0
    assert moduli.middle == pytest.approx(4500.0)
    same = of_young([4500.0, 4500.0])
    assert (moduli == same) == (distribution == "uniform")
    assert (moduli != same) == (distribution == "log")
    assert same == of_young(4500.0)
    assert of_young(moduli) == moduli
