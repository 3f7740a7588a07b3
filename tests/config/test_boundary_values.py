"""Boundary values of a configuration are in SI units: closed forms in metres, and refusals."""

import math
from dataclasses import replace

import pytest
import torch

from dpl import ConfigError
from dpl.config import build, plain
from dpl.data import DataModule
from dpl.fem import DirichletBC, Plane, Problem, RobinBC, Traction, box
from dpl.fem.units import Units
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate
from dpl.viewer import Body

E, L = 4500.0, 100.0  # Young's modulus [Pa] and length [m] of the bar
BAR = ["mesh.nodes=[5,3,3]", "material=linear_elastic", "material.poisson=0.0"]
BAR += ["loads.n_modes=1", "solver.linear=superlu"]
END = "region: {_target_: dpl.fem.Plane, axis: 0, at: max}"
START = "region: {_target_: dpl.fem.Plane, axis: 0, at: min}"
PULL = f"+forces.pull={{_target_: dpl.fem.Traction, value: [45.0, 0, 0], {END}}}"
WEIGHT = "+forces.weight={_target_: dpl.fem.BodyForce, acceleration: [-9.81, 0, 0], density: 0.05}"
PUSH = "+forces.push={_target_: dpl.fem.BodyForce, value: [-0.4905, 0, 0]}"
BED = f"+supports.bed={{_target_: dpl.fem.RobinBC, stiffness: 9.0, {START}}}"
MOVED = f"+supports.end={{_target_: dpl.fem.DirichletBC, value: [1.5, null, null], {END}}}"


def metres(scene):
    """Return the coordinate x, (N,) [m], and the linear displacement, (N, D) [m], of a scene."""
    problem = scene.problem
    force = scene.loads.constant_force
    force = torch.zeros(problem.shape, dtype=torch.float64) if force is None else force
    return L * problem.points[:, 0], L * scene.linear.solve(force)


def test_a_bar_under_a_traction_in_pascals_stretches_by_stress_over_modulus(scene_of):
    x, u = metres(scene_of(*BAR, PULL))
    assert u[:, 0] == pytest.approx(45.0 / E * x, rel=1e-12, abs=1e-12)
    assert u[:, 1:].abs().max() < 1e-12
    assert float(u[:, 0].max()) == pytest.approx(1.0, rel=1e-12)
    _, stiffer = metres(scene_of(*BAR, PULL, "young=9e3"))
    assert stiffer == pytest.approx(u / 2, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("gravity", [WEIGHT, PUSH])
def test_a_column_settles_under_its_weight(scene_of, gravity):
    """Held at its foot, with the weight rho g [N/m^3]: u = -rho g x (2 L - x) / (2 E)."""
    x, u = metres(scene_of(*BAR, gravity))
    assert u[:, 0] == pytest.approx(-0.05 * 9.81 * x * (2 * L - x) / (2 * E), rel=1e-11, abs=1e-11)


def test_an_elastic_foundation_yields_by_stress_over_stiffness(scene_of):
    """A foundation of 9 N/m^3 under a traction of 45 Pa yields by 5 m at every modulus."""
    for young in (E, 9e3):
        x, u = metres(scene_of(*BAR, PULL, BED, "~fixed", f"young={young}"))
        assert u[:, 0] == pytest.approx(5.0 + 45.0 / young * x, rel=1e-10)


def test_a_prescribed_displacement_is_in_metres(scene_of):
    scene = scene_of(*BAR, MOVED)
    end = scene.problem.points[:, 0] > 1 - 1e-9
    moved = L * scene.problem.prescribed[end, 0]
    assert moved.tolist() == pytest.approx([1.5] * int(end.sum()), rel=1e-15)


def test_only_ratios_to_the_modulus_identify_a_scene(scene_of):
    """A data set serves every scene with the same boundary values over E."""
    usual = scene_of(*BAR, PULL, BED)
    doubled = [line.replace("45.0", "90.0").replace("9.0,", "18.0,") for line in (PULL, BED)]
    assert scene_of(*BAR, *doubled, "young=9e3").fingerprint == usual.fingerprint
    assert scene_of(*BAR, PULL, BED, "young=9e3").fingerprint != usual.fingerprint


@pytest.mark.parametrize("line", [PULL, BED, MOVED, None])
def test_a_plan_says_that_a_data_set_depends_on_boundary_values(scene_of, tmp_path, line):
    scene = scene_of(*BAR, *([line] if line else []))
    data = DataModule(scene, folder=str(tmp_path / "none"), workers=0)
    assert ("boundary values over E and L" in data.skipped_work()[0]) == (line is not None)


def test_prescribed_displacements_allow_a_range_of_moduli(scene_of):
    scene = scene_of(*BAR, MOVED, "young=[1e3,2e3]")
    assert scene.fingerprint == scene_of(*BAR, MOVED).fingerprint


def test_a_range_of_one_modulus_is_that_modulus(scene_of):
    bounds = scene_of(*BAR, PULL, "young=[4500,4500]")
    assert bounds.fingerprint == scene_of(*BAR, PULL).fingerprint


INFLATE = f"+forces.inflate={{_target_: dpl.fem.FollowerPressure, value: 45.0, {END}}}"
FIBRES = "directions: {_target_: dpl.fem.ConstantFibres, fibre: [1.0, 0.0, 0.0]}"
MUSCLE = f"+forces.muscle={{_target_: dpl.fem.ActiveStress, value: 45.0, {FIBRES}}}"
TENDON = "+forces.tendon={_target_: dpl.fem.FollowerCable, value: 45.0, points: [[0,5,5],[9,5,5]]}"
OUTSIDE = "region: {_target_: dpl.fem.Box, lower: [500, 0, 0], upper: [501, 1, 1]}"
BAD = {
    (PULL, "young=[1e3,2e3]"): r"forces\.pull: value = \[45\.0, 0, 0\] must be divided by one "
    r"Young's modulus \[Pa\], and young is a range; set young to one number",
    (WEIGHT, "young=[1e3,2e3]"): r"forces\.weight: acceleration = .* density = .* must be divided",
    (PUSH, "young=[1e3,2e3]"): r"forces\.push: value = .* must be divided by one Young's modulus",
    (BED, "young=[1e3,2e3]"): r"supports\.bed: stiffness = 9\.0 must be divided by one Young's",
    (PULL.replace(", 0, 0", ""),): r"forces\.pull: value = \[45\.0\] must be 3 finite numbers "
    r"\[Pa\]; give one for each direction",
    (PUSH.replace(", 0, 0", ""),): r"forces\.push: value = \[-0\.4905\] must be 3 .* \[N/m\^3\]",
    (WEIGHT.replace(", 0, 0", ""),): r"forces\.weight: acceleration = .* must be 3 .* \[m/s\^2\]",
    (WEIGHT.replace(", density: 0.05", ""),): r"forces\.weight: density = None must be given; give "
    r"value \[N/m\^3\] alone, or acceleration \[m/s\^2\] and density \[kg/m\^3\]",
    (WEIGHT.replace("0.05", "-1"),): r"density = -1 must be a number above 0 \[kg/m\^3\]",
    (WEIGHT.replace("acceleration", "value"),): r"density = 0\.05 must be left out where value is",
    (BED.replace("9.0", "-9.0"),): r"supports\.bed: stiffness = -9\.0 must be a positive number "
    r"\[N/m\^3\], or 3 numbers",
    (BED.replace("9.0", "[1.0, 2.0]"),): r"supports\.bed: stiffness = \[1\.0, 2\.0\] must be",
    (BED.replace("9.0", "stiff"),): r"supports\.bed\.stiffness = 'stiff' must be a number",
    (MOVED.replace("1.5, ", ""),): r"supports\.end: value = .* must be 3 lengths \[m\]",
    (INFLATE, "young=[1e3,2e3]"): r"forces\.inflate: value = 45.0 .*young is a range",
    (INFLATE.replace("45.0", "[2.0, 1.0]"),): r"forces\.inflate: value.* low below high",
    (INFLATE.replace("45.0", "[1.0, 2.0, 3.0]"),): r"forces\.inflate: value.* no direction",
    (INFLATE.replace("45.0", ".inf"),): r"forces\.inflate.value",
    (INFLATE.replace("45.0", "true"),): r"forces\.inflate.value",
    (INFLATE.replace("at: max", "at: 7.0"),): r"forces\.inflate: .*holds no facet",
    (TENDON, "young=[1e3,2e3]"): r"forces\.tendon: value = 45.0 .*young is a range",
    (TENDON.replace(",[9,5,5]", ""),): r"forces\.tendon: points = .* must be two or more points",
    (TENDON.replace("9,", "900,"),): r"forces\.tendon: the point \[900.*must lie in the body",
    (MUSCLE.replace(f", {FIBRES}", ""),): r"forces\.muscle: no fibre directions are known",
    (MUSCLE.replace("45.0", "[2.0, 1.0]"),): r"forces\.muscle: value.* low below high",
    (MUSCLE.replace("45.0", "[1.0, 2.0, 3.0]"),): r"forces\.muscle: value.* along the fibres",
    (MUSCLE.replace("45.0", ".inf"),): r"forces\.muscle.value",
    (MUSCLE.replace("[1.0, 0.0, 0.0]", "[0.0, 0.0, 0.0]"),): r"forces\.muscle.*fibre must be",
    (MUSCLE.replace(FIBRES, f"{FIBRES}, {OUTSIDE}"),): r"forces\.muscle: .*holds no cell",
}


@pytest.mark.parametrize("overrides", BAD, ids=" ".join)
def test_a_boundary_value_that_cannot_be_used_is_refused_by_its_key(
    compose, overrides, monkeypatch
):
    monkeypatch.setattr("dpl.fem.loads.modal.eigenmodes", pytest.fail)  # the first computation
    cfg = compose(*BAR, *overrides)

    def start():
        plain.check(cfg)
        build.build_scene(cfg)

    with pytest.raises(ConfigError, match=BAD[overrides]) as refusal:
        start()
    assert "\n" not in str(refusal.value)


def test_a_body_on_a_foundation_has_one_modulus(scene_of):
    """K(0) contains alpha / E: another modulus is another body."""
    scene = scene_of(*BAR, BED, PULL)
    torch.manual_seed(0)
    sim = Simulator(Surrogate(FCNN(scene, width=4), MSE(), scene))
    newtons = scene.loads.constant_force * E * scene.force_unit
    assert sim(newtons, tol=1e-6).converged
    assert sim(newtons, young=E, tol=1e-6).converged
    with pytest.raises(ValueError, match=r"young = 9000 must be 4500 \[Pa\]"):
        sim(newtons, young=9e3)
    assert Body(sim).young_range == (E, E)


def test_a_scene_refuses_loads_of_another_modulus_than_its_foundation(make_scene):
    scene = make_scene()
    problem = Problem.build(
        box((100.0, 25.0, 25.0), (5, 3, 3)),
        scene.problem.material,
        supports=[RobinBC(Plane(0, "min"), 9.0)],
        young=9e3,
    )
    with pytest.raises(ValueError, match=r"young = 4500 must be 9000 \[Pa\]"):
        replace(scene, problem=problem)


@pytest.mark.parametrize("young", [0.0, -1.0, math.nan, math.inf])
def test_a_body_has_a_positive_modulus(make_scene, young):
    material = make_scene().problem.material
    with pytest.raises(ValueError, match=r"young = .* must be a number above 0 \[Pa\]"):
        Problem.build(box((1, 1, 1), (2, 2, 2)), material, fixed=Plane(0, "min"), young=young)


def test_values_of_a_body_without_a_modulus_are_values_over_it(make_scene):
    """The default is E = 1 Pa."""
    material, mesh = make_scene().problem.material, box((4.0, 1.0, 1.0), (3, 2, 2))
    supports = [DirichletBC(Plane(0, "min"), [0.2, 0.0, 0.0]), RobinBC(Plane(1, "min"), 0.3)]
    one = Problem.build(mesh, material, supports=supports)
    steel = [supports[0], RobinBC(Plane(1, "min"), 0.3 * 2e11)]
    other = Problem.build(mesh, material, supports=steel, young=2e11)
    torch.testing.assert_close(one.springs.stiffness, other.springs.stiffness, rtol=1e-14, atol=0)
    assert torch.equal(one.prescribed, other.prescribed)
    pulled = Traction(Plane(0, "max"), [1e-3, 0.0, 0.0]).on(one)
    loaded = Traction(Plane(0, "max"), [2e8, 0.0, 0.0]).on(other)
    torch.testing.assert_close(pulled, loaded, rtol=1e-14, atol=1e-18)
    assert Units(4.0).displacement(0.2) == 0.05


@pytest.mark.parametrize("force", [INFLATE, MUSCLE])
def test_a_follower_load_in_pascals_shortens_a_bar_by_its_ratio_to_the_modulus(scene_of, force):
    scene = scene_of(*BAR, force)
    assert scene.loads.constant_force is None
    x, u = metres(scene)
    assert u[:, 0] == pytest.approx(-45.0 / E * x, rel=1e-12, abs=1e-12)


def test_a_follower_pressure_identifies_a_scene_by_its_ratio_to_the_modulus(scene_of):
    usual, plain = scene_of(*BAR, INFLATE), scene_of(*BAR)
    assert "pressure" not in plain.identity()
    assert usual.fingerprint != plain.fingerprint
    doubled = scene_of(*BAR, INFLATE.replace("45.0", "90.0"), "young=9e3")
    assert doubled.fingerprint == usual.fingerprint
    assert scene_of(*BAR, INFLATE, "young=9e3").fingerprint != usual.fingerprint


def test_a_range_of_pressures_has_the_name_of_the_force_and_is_in_pascals(scene_of):
    scene = scene_of(*BAR, INFLATE.replace("45.0", "[0.0, 45.0]"))
    assert scene.loads.parameter_ranges == {"inflate": (0.0, 45.0)}
    doubled = scene_of(*BAR, INFLATE.replace("45.0", "[0.0, 90.0]"), "young=9e3")
    assert doubled.fingerprint != scene.fingerprint  # its samples have other parameters
    assert "inflate from 0 to 45 Pa" in dict(scene.describe())["supports"]


def test_an_active_stress_has_the_name_of_the_force_and_the_directions_of_the_law(scene_of):
    law = ["material=guccione", "material.directions.fibre=[1.0,0.0,0.0]"]
    own = MUSCLE.replace(f", {FIBRES}", "").replace("45.0", "[0.0, 45.0]")
    scene = scene_of(BAR[0], *BAR[-2:], *law, own)
    assert scene.loads.parameter_ranges == {"muscle": (0.0, 45.0)}
    assert "muscle from 0 to 45 Pa" in dict(scene.describe())["supports"]
    force = scene.problem.with_parameters(torch.tensor([[45.0]]).double()).force_at_rest
    expected = scene_of(*BAR, MUSCLE).problem.force_at_rest
    torch.testing.assert_close(force, expected, rtol=1e-9, atol=1e-14)
