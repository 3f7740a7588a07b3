"""Laws of load families: resultants, units, regions, ranges, and how they recognise their loads."""

import math
import pickle
import re
from functools import partial
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from dpl import fem
from dpl.fem.loads.forces import traction
from dpl.fem.loads.sampling import SAMPLINGS, direction, logarithmic
from dpl.fem.loads.sized import softest_node
from dpl.inference.answer import RangeCheck

END = fem.Plane(0, "max")
CABLE = [
    [[0.0, 5.0, 5.0], [50.0, 8.0, 5.0], [100.0, 5.0, 5.0]],
    [[10.0, 20.0, 20.0], [90.0, 20.0, 20.0]],
]


def body(*, scale=1.0, young=4500.0, nodes=(6, 3, 3)):
    """A beam 100 x 25 x 25 times `scale` m, held at x = 0."""
    mesh = fem.box([100.0 * scale, 25.0 * scale, 25.0 * scale], nodes)
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"), young=young)
    return fem.LinearSolver(problem, linear="superlu")


class SumLoads(fem.RandomLoads):
    """Random forces on all nodes of the boundary, which this family does not recognise."""

    largest_force = 1.0

    @property
    def n_force(self):
        return int(self.loadable_dofs.sum())

    def force_at(self, point):
        force = torch.zeros(self.problem.shape, dtype=torch.float64)
        force[self.loadable_dofs] = torch.from_numpy(point) / len(point) ** 0.5
        return force


@pytest.fixture(scope="module")
def linear():
    return body()


@pytest.fixture(scope="module")
def path(tmp_path_factory, linear):
    """A file of three forces."""
    path = tmp_path_factory.mktemp("forces") / "forces.npy"
    np.save(path, np.random.default_rng(0).normal(size=(3, *linear.problem.shape)))
    return str(path)


@pytest.fixture(scope="module")
def build(path):
    """Builds each family by name, with options."""
    families = {
        "modal": partial(fem.ModalLoads, n_modes=3),
        "patch": fem.PatchLoads,
        "point": fem.PointLoads,
        "traction": partial(fem.FaceTractions, region=END),
        "pressure": partial(fem.FacePressure, region=END),
        "gravity": fem.GravityLoads,
        "cable": partial(fem.CableLoads, cables=CABLE),
        "file": partial(fem.FileLoads, path=path, factor=None),
    }
    families["unrecognised"] = SumLoads
    members = {name: families[name] for name in FAMILIES[:-1]}
    families["mixture"] = partial(fem.MixtureLoads, families=members)

    def build(name, linear, **options):
        return families[name](linear, young=linear.problem.young or [1e3, 1e5], **options)

    return build


FAMILIES = (
    *["modal", "patch", "point", "traction", "pressure", "gravity", "cable", "file", "mixture"],
)
SIZED = FAMILIES[1:-1]


def total(force):
    """Return the resultants of forces (B, N, D), (B, D)."""
    return force.sum(dim=1)


@pytest.mark.parametrize(("name", "sampling"), list(zip(FAMILIES, cycle(SAMPLINGS))))
def test_a_load_is_a_function_of_seed_and_number(build, linear, name, sampling):
    loads = build(name, linear, sampling=sampling)
    drawn = loads.sample(3, range(6)).force
    assert torch.equal(drawn, build(name, linear, sampling=sampling).sample(3, range(6)).force)
    assert torch.equal(drawn[4:5], loads.sample(3, [4]).force)
    assert torch.equal(2 * drawn, loads.sample(3, range(6), amplitude=2.0).force)
    assert torch.equal(drawn, pickle.loads(pickle.dumps(loads)).sample(3, range(6)).force)
    assert not torch.equal(drawn, loads.sample(4, range(6)).force)
    assert loads.points(0, range(2)).shape == (2, loads.n_random)


@pytest.mark.parametrize("name", FAMILIES)
def test_loads_act_on_loadable_degrees_of_freedom_and_add_the_constant_force(build, linear, name):
    loads = build(name, linear)
    drawn = loads.sample(0, range(20)).force
    free = linear.problem.free
    assert not drawn[:, free & ~loads.loadable_dofs].any()
    assert (loads.loadable_dofs <= free).all()
    constant = torch.full(linear.problem.shape, 1e-3, dtype=torch.float64)
    more = build(name, linear, constant_force=constant)
    assert_close(more.sample(0, range(20)).force, drawn + constant, rtol=0, atol=1e-15)
    for a, b in zip(more.project(drawn + constant), loads.project(drawn), strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", FAMILIES)
def test_own_loads_are_in_range_and_doubled_ones_are_larger(build, linear, name):
    loads = build(name, linear)
    force = loads.sample(0, range(40)).force
    amplitude, distance = loads.project(force)
    assert amplitude.shape == distance.shape == (40,)
    assert (amplitude <= 1 + 1e-9).all()
    assert (distance < 1e-9).all()
    assert (loads.problem.acting(force).flatten(1).norm(dim=1) <= loads.largest_force * 1.001).all()
    if name != "mixture":  # the doubled load of one family can belong to another
        assert_close(loads.project(2 * force)[0], 2 * amplitude, rtol=1e-9, atol=0)
    zero = loads.project(torch.zeros_like(force[:1]))
    assert [float(one) for one in zero] == [0.0, 0.0]


def placed(loads, force):
    """Return the words of `RangeCheck` for forces (B, N, D)."""
    predictor = SimpleNamespace(reads_young=False)
    surrogate = SimpleNamespace(scene=SimpleNamespace(loads=loads), predictor=predictor)
    load = loads.sample(0, [0] * len(force))._replace(force=force)
    places = RangeCheck.of(surrogate, load)
    return {"out" if one.outside else "in" if one.inside else "unknown" for one in places}


PUSH = partial(fem.FacePressure, region=END, pressure=[10.0, 30.0])
PULL = partial(fem.CableLoads, cables=CABLE, tension=[1.0, 2.0])
WHOLE = {"patch_radius": (2.0, 2.0), "distribution": partial(logarithmic, low=0.2)}
UNSURE = "in/unknown out out/unknown out/unknown out unknown"
PLACES = [  # own, 3 times the largest, 0.01 times, reversed, on inner nodes, a squeezing pair
    ("modal", {}, "in out in in out out"),
    ("modal", WHOLE, "in out out out out out"),
    ("patch", {}, "in out in in out out"),
    ("point", {}, "in out in in out in"),
    ("traction", {}, "in out in in out out"),
    ("pressure", {}, "in out in out out out"),
    ("pressure", {"pressure": [10.0, 30.0]}, "in out out out out out"),
    ("pressure", {"pressure": [-30.0, 30.0]}, "in out in in out out"),
    ("pressure", {"pressure": [-30.0, -10.0]}, "in out out out out out"),
    ("gravity", {}, "in out in in out out"),
    ("gravity", {"density": 1.0, "acceleration": [5.0, 10.0]}, "in out out in out out"),
    ("cable", {}, "in out in out out out"),
    ("cable", {"tension": [1.0, 2.0]}, "in out out out out out"),
    ("file", {}, "in out in out out out"),
    ("file", {"factor": [0.5, 1.0]}, "in out out out out out"),
    ("file", {"factor": [-1.0, 1.0]}, "in out in in out out"),
    ("mixture", {}, "in out in in/out out in"),
    ("mixture", {"families": {"a": fem.PatchLoads, "b": fem.GravityLoads}}, "in out in in out out"),
    ("mixture", {"families": {"a": PUSH, "b": PULL}}, "in out out out out out"),
    ("unrecognised", {}, "unknown out unknown unknown out unknown"),
    ("mixture", {"families": {"a": PUSH, "b": SumLoads}}, UNSURE),
]


@pytest.mark.parametrize(("name", "options", "truth"), PLACES)
def test_the_range_check_tells_own_loads_from_others(build, linear, name, options, truth):
    loads, problem = build(name, linear, **options), linear.problem
    force = torch.cat([loads.sample(seed, range(20)).force for seed in range(3)])
    least, x = force.flatten(1).norm(dim=1).min(), problem.points
    inner, pair = torch.zeros(2, *problem.shape, dtype=torch.float64)
    inner[~problem.boundary] = (1 + x[~problem.boundary]).sin()
    for z, size in ((0.0, 1.0), (0.25, -1.0)):
        pair[(x - x.new_tensor([0.6, 0.125, z])).norm(dim=1).argmin(), 2] = size
    foreign = [least * one / one.norm() for one in (inner, pair)]
    largest = force / loads.project(force)[0][:, None, None]
    cases = force, 3 * largest, 0.01 * force, -force, *(one[None] for one in foreign)
    for case, expected in zip(cases, truth.split(), strict=True):
        assert placed(loads, case) == set(expected.split("/"))


@pytest.mark.parametrize("name", SIZED)
def test_the_largest_load_deflects_the_body_as_far_as_requested(build, linear, name):
    loads = build(name, linear, deflection=0.3)
    drawn = loads.sample(0, range(200)).force
    reached = torch.stack([linear.solve(force).norm(dim=1).max() for force in drawn])
    assert float(reached.max()) <= 0.3 * (1 + 1e-9)
    assert float(reached.max()) > (0.05 if name in ("point", "cable") else 0.2)
    larger = build(name, linear, deflection=0.6).sample(0, range(3)).force
    assert_close(larger, 2 * drawn[:3], rtol=1e-9, atol=1e-15)


def test_the_softest_node_of_a_cantilever_is_at_its_tip(linear):
    problem = linear.problem
    nodes = problem.boundary.nonzero()[:, 0]
    found = softest_node(linear, nodes)
    assert problem.points[found, 0] == problem.points[:, 0].max()
    near = (problem.points[:, 0] < 0.5).nonzero()[:, 0]
    assert problem.points[softest_node(linear, near), 0] == problem.points[near, 0].max()


def test_directions_are_uniform_on_the_sphere():
    for dim in (2, 3):
        t = np.random.default_rng(0).random((20000, dim - 1))
        found = np.array([direction(row) for row in t])
        assert_close(np.linalg.norm(found, axis=1), np.ones(len(t)), rtol=1e-12, atol=0)
        assert np.abs(found.mean(axis=0)).max() < 0.02
        assert np.abs(found.T @ found / len(t) - np.eye(dim) / dim).max() < 0.01


OPTIONS = {  # in SI units, and the factors of length and of stress by which they are multiplied
    "patch": {"largest": lambda L, E: 9.0 * E},
    "point": {"largest": lambda L, E: 900.0 * E * L**2},
    "traction": {"largest": lambda L, E: 9.0 * E},
    "pressure": {"pressure": lambda L, E: [-9.0 * E, 20.0 * E]},
    "gravity": {"density": lambda L, E: 0.01 * E / L, "acceleration": lambda L, E: [1.0, 9.81]},
    "cable": {
        "tension": lambda L, E: [100.0 * E * L**2, 900.0 * E * L**2],
        "cables": lambda L, E: (L * np.array(CABLE[1:])).tolist(),
    },
}


@pytest.mark.parametrize("name", OPTIONS)
def test_forces_depend_on_ratios_to_size_and_modulus_only(build, name):
    found = []
    for length, stress in ((1.0, 1.0), (3.0, 1.0), (1.0, 7.0)):
        beam = body(scale=length, young=4500.0 * stress)
        options = {key: option(length, stress) for key, option in OPTIONS[name].items()}
        loads = build(name, beam, **options)
        found.append((loads.sample(0, range(4)).force, loads.identity()))
        assert "deflection" not in loads.identity()
    (force, identity), *others = found
    for other, same in others:
        assert_close(other, force, rtol=1e-10, atol=1e-16)
        assert same == identity
    changed = body(young=9000.0)
    options = {key: option(1.0, 1.0) for key, option in OPTIONS[name].items()}
    assert build(name, changed, **options).identity() != identity


@pytest.mark.parametrize("name", OPTIONS)
def test_sizes_in_SI_units_need_one_modulus(build, name):
    beam = body(young=None)
    options = {key: option(1.0, 1.0) for key, option in OPTIONS[name].items()}
    key = next(iter(options))
    loads = build(name, beam, **options)
    with pytest.raises(ValueError, match=rf"^{key} = .* must be divided by one Young's modulus"):
        loads.largest_force  # noqa: B018


def sizes_of(force, problem):
    return total(force) * problem.young * problem.length**2


def test_tractions_add_up_to_area_times_stress(linear):
    problem = linear.problem
    loads = fem.FaceTractions(linear, 12.0, region=END, young=problem.young)
    drawn = loads.sample(0, range(300))
    found = sizes_of(drawn.force, problem).norm(dim=1) / 25.0**2  # [Pa]
    assert 11.5 < float(found.max()) <= 12.0
    assert float(found.min()) < 0.5
    middle = torch.tensor([1.0, 0.125, 0.125], dtype=torch.float64)
    for force in drawn.force[:3]:
        moment = torch.linalg.cross(problem.points - middle, force).sum(dim=0)
        assert moment.abs().max() < 1e-15


def test_pressure_acts_inwards_and_that_on_a_closed_surface_is_in_balance(linear):
    problem = linear.problem
    loads = fem.FacePressure(linear, [2.0, 2.0], region=END, young=problem.young)
    found = sizes_of(loads.sample(0, [0]).force, problem)[0]
    assert_close(found, torch.tensor([-2.0 * 25**2, 0, 0]).double(), rtol=1e-12, atol=1e-9)
    force = fem.FacePressure(linear, [2.0, 2.0], young=problem.young).sample(0, [0]).force
    assert total(force).abs().max() < 1e-16
    moment = torch.linalg.cross(problem.points, force[0]).sum(dim=0)
    assert moment.abs().max() < 1e-16
    assert force.abs().max() > 1e-6


def test_gravity_adds_up_to_the_weight(linear):
    problem = linear.problem
    loads = fem.GravityLoads(linear, 0.01, [9.81, 9.81], young=problem.young)
    found = sizes_of(loads.sample(0, range(20)).force, problem).norm(dim=1)
    weight = torch.full((20,), 0.01 * 9.81 * 100 * 25 * 25, dtype=torch.float64)
    assert_close(found, weight, rtol=1e-12, atol=0)


def test_a_cable_is_in_equilibrium_and_pulls_its_ends_together(linear):
    problem = linear.problem
    loads = fem.CableLoads(linear, CABLE, [70.0, 70.0], young=problem.young)
    force = loads.sample(0, [0]).force
    assert total(force).abs().max() < 1e-17
    moment = torch.linalg.cross(problem.points, force[0]).sum(dim=0)
    assert moment.abs().max() < 1e-17
    straight = fem.CableLoads(linear, CABLE[1:], [70.0, 70.0], young=problem.young)
    pulls = straight.sample(0, [0]).force[0] * problem.young * problem.length**2
    left = problem.points[:, 0] < 0.5
    assert_close(pulls[left].sum(dim=0), torch.tensor([70.0, 0, 0]).double(), rtol=1e-12, atol=1e-9)
    assert not loads.shapes[0][:, 2].any(), "the first cable lies in a plane"


def test_the_families_of_the_surface_accept_every_element(kind):
    cell, degree = kind
    dim = 3 if cell in ("tetra", "hexahedron") else 2
    mesh = (fem.box if dim == 3 else fem.rectangle)([2.0, 1.0, 1.0][:dim], [5, 4, 4][:dim], cell)
    problem = fem.Problem.build(
        mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"), degree=degree
    )
    linear = fem.LinearSolver(problem, linear="superlu")
    area = 0.5 ** (dim - 1)
    for family in (fem.PatchLoads, fem.PointLoads, partial(fem.FaceTractions, region=END)):
        loads = family(linear)
        drawn = loads.sample(0, range(10)).force
        assert drawn.isfinite().all()
        assert (problem.acting(drawn).flatten(1).norm(dim=1) > 0).all()
        assert placed(loads, drawn) == {"in"}
    assert float(loads.weights.sum()) == pytest.approx(area, rel=1e-12)
    patches = fem.PatchLoads(linear, patch_radius=(10.0, 10.0), region=END)
    assert float(patches.weights_of(int(patches.centres[0]), 10.0).sum()) == pytest.approx(area)
    ends = [[0.3] * dim, [1.7, 0.6, 0.4][:dim]]
    cable = fem.CableLoads(linear, [ends])
    assert total(cable.shapes).abs().max() < 1e-14


def horseshoe(gap):
    """Two legs 10 m long and 1 m wide along x, `gap` apart and joined at x = 0 only."""
    mesh = fem.box([10.0, 2.0 + gap, 1.0], [21, 11, 3])
    middle = mesh.p[:, mesh.t].mean(axis=1)
    y = np.linspace(0, 2 + gap, 11)
    inside = (middle[0] > 1.0) & (middle[1] > y[4]) & (middle[1] < y[6])
    return mesh.remove_elements(np.flatnonzero(inside)).remove_unused_nodes()


def test_a_geodesic_disc_does_not_jump_across_a_gap():
    mesh = horseshoe(0.2)
    problem = fem.Problem.build(mesh, fem.NeoHookeanLn(0.3), fixed=fem.Plane(0, "min"))
    loads = fem.PatchLoads(fem.LinearSolver(problem, linear="superlu"))
    points = problem.points
    inner = (points[:, 0] == points[:, 0].max()) & (points[:, 1] < 0.11)
    tip = int(torch.where(inner, points[:, 1], -1.0).argmax())
    radius = 0.3  # three times the width of a leg, and more than the gap
    loaded = loads.weights_of(tip, radius) > 0
    near = (points - points[tip]).norm(dim=1) < radius / 2
    assert (near & (points[:, 1] > 0.11)).any(), "the other leg is near"
    assert loaded.any()
    assert not loaded[points[:, 1] > 0.12].any()
    assert (points[loaded, 0] > points[tip, 0] - radius - 1e-9).all()


def test_small_discs_have_the_facets_around_their_centre():
    linear = body(nodes=(9, 5, 5))
    loads = fem.PatchLoads(linear, 3.0, (0.0, 0.0), young=4500.0, region=END)
    face = 25.0 / 100 / 4
    sizes = {round(float(loads.weights_of(int(v), 0.0).sum()) / face**2, 6) for v in loads.centres}
    assert sizes == {1.0, 2.0, 4.0}, "corners, edges and the middle of the end"
    for force in loads.sample(0, range(5)).force:
        assert (linear.problem.points[force.any(dim=1), 0] == 1.0).all()


@pytest.mark.parametrize("cell", ["tetra", "hexahedron"])
def test_patches_are_recognised_between_rollers_also(cell):
    problem = fem.Problem.build(
        fem.box([4.0, 1.0, 1.0], [7, 4, 4], cell), fem.NeoHookeanLn(0.3), fixed=END
    )
    at_0 = problem.points.numpy() < 1e-9
    fixed = at_0 | ~problem.free.numpy()  # each of three faces slides along itself
    linear = fem.LinearSolver(fem.Problem.build(problem.mesh, fem.NeoHookeanLn(0.3), fixed=fixed))
    loads = fem.PatchLoads(linear)
    points = loads.points(0, range(200))
    amplitude, distance = loads.project(loads.loads_at(points).force)
    assert (distance < 1e-9).all()
    assert (amplitude <= points[:, 2] * (1 + 1e-9)).all()  # rollers take a part of some
    assert float((amplitude / points[:, 2]).median()) == pytest.approx(1.0)


def test_a_traction_that_is_not_uniform_is_no_patch(linear):
    loads = fem.PatchLoads(linear)
    growing = partial(np.multiply, [[[1.0]], [[1.0]], [[0.5]]])
    force = traction(linear.problem, fem.Plane(2, "max"), lambda x: growing(x[:1]))
    uniform = traction(linear.problem, fem.Plane(2, "max"), lambda x: growing(np.ones_like(x[:1])))
    distance = loads.project(torch.stack([uniform, force, -force]))[1]
    assert distance[0] < 1e-9
    assert (distance[1:] > 0.1).all()


def test_coefficients_that_no_fit_tells_apart_are_in_range_if_some_are(linear):
    same = [[[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]], [[40.0, 0.0, 0.0], [80.0, 0.0, 0.0]]]
    both = [[[0.0, 0.0, 0.0], [80.0, 0.0, 0.0]]]  # the sum of these
    cables = fem.CableLoads(linear, [*same, *both], tension=[1.0, 2.0])
    assert placed(cables, torch.stack([cables.force_at(one) for one in np.eye(3)])) == {"in"}
    nodes = fem.ModalLoads(linear, n_modes=5, patch_radius=(0.0, 0.0))  # 3 components, 5 modes
    assert placed(nodes, nodes.sample(0, range(200)).force) == {"in"}


def test_point_forces_act_on_as_many_nodes_as_drawn(linear):
    loads = fem.PointLoads(linear, 50.0, (2, 4), young=4500.0)
    force = loads.sample(0, range(300)).force
    counts = force.any(dim=2).sum(dim=1)
    assert set(counts.tolist()) == {2, 3, 4}
    largest = force.norm(dim=2).amax() * 4500.0 * 100.0**2
    assert 48.0 < float(largest) <= 50.0
    assert not force[:, linear.problem.points[:, 0] == 0].any()


@pytest.mark.parametrize("name", ["modal", "patch", "point"])
def test_a_region_restricts_where_loads_act(build, linear, name):
    top = fem.Plane(2, "max")
    usual, loads = build(name, linear), build(name, linear, region=top)
    force = loads.sample(0, range(20)).force
    points = linear.problem.points
    assert force.any()
    assert not force[:, points[:, 2] < points[:, 2].max()].any()
    assert "region" not in usual.identity()
    assert loads.identity() != usual.identity()
    same = fem.Box([0.0, 0.0, 25.0], [100.0, 25.0, 25.0])  # the same facets
    assert build(name, linear, region=same).identity() == loads.identity()


@pytest.mark.parametrize("name", ["modal", "patch", "point", "traction", "pressure"])
def test_a_fixed_region_is_refused_in_one_line(build, linear, name):
    fixed = build(name, linear, region=fem.Plane(0, "min"))
    with pytest.raises(ValueError, match=r"fixed everywhere|free node"):
        (fixed.loadable_dofs, fixed.largest_force)  # noqa: B018


NEGATIVE = partial(fem.PatchLoads, largest=-1.0)
NOWHERE = partial(fem.PatchLoads, region=fem.Plane(0, 7.0))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("patch", {"largest": 0.0}, "largest = 0.0 must be a number above 0 [Pa], or null"),
        ("patch", {"largest": math.inf}, "largest = inf must be"),
        ("patch", {"deflection": 0.0}, "deflection = 0.0 must be a number from 1e-12 to 10 [times"),
        ("point", {"count": (0, 2)}, "count = [0, 2] must be a smallest and a largest number from"),
        ("point", {"count": (3, 2)}, "count = [3, 2] must"),
        ("pressure", {"pressure": (2.0, 1.0)}, "pressure = [2.0, 1.0] must be a smallest and a"),
        ("pressure", {"pressure": (0.0, 0.0)}, "pressure = [0.0, 0.0] must contain a number other"),
        ("gravity", {"density": -1.0}, "density = -1.0 must be a number above 0 [kg/m^3]"),
        ("gravity", {"acceleration": (-1.0, 1.0)}, "acceleration = [-1.0, 1.0] must be"),
        ("cable", {"tension": (1.0, math.nan)}, "tension = [1.0, nan] must be"),
        ("cable", {"cables": []}, "cables = [] must contain a cable"),
        ("cable", {"cables": [[[0.0, 0.0, 0.0]]]}, "cables.0: points = [[0.0, 0.0, 0.0]] must be"),
        ("cable", {"cables": [[[0, 0], [1, 1]]]}, "cables.0: points = [[0, 0], [1, 1]] must be"),
        (
            "cable",
            {"cables": [[[1, 1, 1]] * 2]},
            "cables.0: points = [[1, 1, 1], [1, 1, 1]] must not",
        ),
        ("cable", {"cables": [CABLE[0], [[1, 1, 1], [1, 1, 99]]]}, "cables.1: the point [1.0, 1.0"),
        ("file", {"factor": (1.0,)}, "factor = [1.0] must be"),
        ("mixture", {"families": {}}, "families must contain one with a weight above 0"),
        ("mixture", {"weights": {"patch": -1.0}}, "weights.patch = -1.0 must be a number from 0"),
        ("mixture", {"weights": {"patches": 1.0}}, "weights.patches: there is no such family"),
        ("mixture", {"families": {"b": NEGATIVE}}, "families.b: largest = -1.0 must"),
        (
            "mixture",
            {"families": {"b": NOWHERE}},
            "families.b: region = Plane(axis=0, at=7.0) holds",
        ),
        ("patch", {"region": fem.Plane(0, 7.0)}, "region = Plane(axis=0, at=7.0) holds no facet"),
        ("point", {"count": (1, 60)}, "count = [1, 60] must be at most 41"),
    ],
)
def test_options_out_of_range_are_refused_in_one_line(build, linear, name, options, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}.*$"):
        build(name, linear, **options).largest_force  # noqa: B018


def test_a_member_of_a_mixture_must_be_random_loads(linear):
    with pytest.raises(TypeError, match=r"families\.c gives dict; it must give a RandomLoads"):
        fem.MixtureLoads(linear, {"c": dict})


def test_loads_of_a_file_are_its_forces_times_a_factor(linear, path):
    problem = linear.problem
    loads = fem.FileLoads(linear, path, [0.5, 2.0], young=problem.young)
    force = loads.sample(0, range(60)).force * problem.young * problem.length**2
    given = torch.from_numpy(np.load(path))
    seen = set()
    for one in force:
        ratio = one / given  # (S, N, D)
        (number,) = (ratio.flatten(1).std(dim=1) < 1e-9).nonzero()[:, 0].tolist()
        assert 0.5 <= float(ratio[number].mean()) <= 2.0
        seen.add(number)
    assert seen == {0, 1, 2}


def test_a_file_is_identified_by_its_forces(linear, path, tmp_path):
    copy, other = tmp_path / "copy.npz", tmp_path / "other.npy"
    np.savez(copy, forces=np.load(path))
    np.save(other, np.load(path)[:2])
    one, same, less = (fem.FileLoads(linear, p, young=4500.0) for p in (path, copy, other))
    assert one.identity() == same.identity() != less.identity()
    assert fem.FileLoads(body(young=9000.0), path, young=9000.0).identity() != one.identity()


def test_files_that_cannot_be_used_are_refused_in_one_line(linear, tmp_path):
    shape = linear.problem.shape
    bad = {
        "shape.npy": (np.zeros((2, 3, 3)), "must be numbers of shape|must be numbers (S, 54, 3)"),
        "flat.npy": (np.ones(shape), "must be numbers (S, 54, 3)"),
        "none.npy": (np.ones((0, *shape)), "must be numbers (S, 54, 3)"),
        "text.npy": (np.full((1, *shape), "a"), "must be numbers (S, 54, 3)"),
        "nan.npy": (np.full((1, *shape), np.nan), "force 0 must have finite components"),
        "zero.npy": (np.zeros((1, *shape)), "force 0 must act on a free degree of freedom"),
        "object.npy": (np.array([{}], dtype=object), "must be numbers (S, 54, 3)"),
        "forces.csv": (None, "the file must be .npy or .npz"),
        "missing.npy": (None, "No such file or directory"),
    }
    for name, (array, message) in bad.items():
        path = tmp_path / name
        if array is not None:
            np.save(path, array)
        with pytest.raises(ValueError, match=r".") as caught:
            fem.FileLoads(linear, str(path))
        assert str(caught.value).startswith(f"path = {path}: ")
        assert any(part in str(caught.value) for part in message.split("|"))
        assert "\n" not in str(caught.value)


def test_a_mixture_draws_its_families_by_weight_and_names_them(linear):
    modal = partial(fem.ModalLoads, n_modes=3)
    families = {"modal": modal, "point": fem.PointLoads, "none": fem.GravityLoads}
    loads = fem.MixtureLoads(linear, families, {"modal": 3.0, "none": 0.0})
    assert tuple(loads.families) == ("modal", "point", "none")
    points = loads.points(0, range(4000))
    counts = torch.bincount(loads.family_of(points), minlength=3)
    assert counts[2] == 0
    assert float(counts[0]) / 4000 == pytest.approx(0.75, abs=0.03)
    members = loads.family_of(points[:30])
    force = loads.loads_at(points[:30]).force
    distances = torch.stack([member.project(force)[1] for member in loads.members[:2]])
    assert (distances[members, range(30)] < 1e-9).all()
    for point, one, member in zip(points[:30], force, members.tolist(), strict=True):
        family = loads.members[member]
        assert torch.equal(one, family.force_at(point[1 : 1 + family.n_force].numpy()))
    assert loads.n_random == 2 + max(family.n_force for family in loads.members)
    twice = fem.MixtureLoads(linear, families, {"modal": 6.0, "point": 2.0, "none": 0.0})
    assert twice.identity() == loads.identity()


def test_mixtures_share_young_and_parameters_of_the_law():
    mesh = fem.box([4.0, 1.0, 1.0], [5, 3, 3])
    law = fem.NeoHookeanLn([0.2, 0.4])
    problem = fem.Problem.build(mesh, law, fixed=fem.Plane(0, "min"), young=None)
    linear = fem.LinearSolver(problem, linear="superlu")
    families = {"patch": fem.PatchLoads, "point": fem.PointLoads}
    loads = fem.MixtureLoads(linear, families, young=[1e3, 1e5])
    load = loads.sample(0, range(50))
    assert float(load.young.min()) < 2e4 < 8e4 < float(load.young.max())
    assert float(load.parameters.min()) < 0.25 < 0.35 < float(load.parameters.max())
