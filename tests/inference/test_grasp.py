"""Laws of grasps: the motion is met, the forces of the gripper are those of finite elements."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from simulators import linear_network, simulator_of

from dpl import fem
from dpl.inference.held_body import MAX_ITER, MOTION_TOL

E = 4500.0
L = 100.0
END = fem.Plane(axis=0, at="max")
TRANSLATION = [1.0, 6.0, 3.0]  # longer: a shorter column would buckle under dead forces
ROTATION = [0.08, 0.03, -0.05]
ONE = torch.ones(1, dtype=torch.float64)


@pytest.fixture(scope="module")
def sim(scene):
    return simulator_of(scene, linear_network(scene))


@pytest.fixture(scope="module")
def solved(sim):
    return sim.grasp(END, TRANSLATION, ROTATION, tol=1e-9)


def end_nodes(scene):
    return scene.problem.points[:, 0] == 1


def with_supports(scene, *supports):
    """Return the solution of the body of a scene with moved supports, (N, D) [m]."""
    old = scene.problem
    body = fem.Problem.build(
        old.mesh.scaled(L),
        old.material,
        fixed=fem.Plane(axis=0, at="min"),
        supports=supports,
        length=L,
    )
    rest = torch.zeros(1, *body.shape, dtype=torch.float64)
    state = fem.solve(fem.Newton(body, tol=1e-10), fem.Load(rest, ONE))
    assert state.converged
    return L * state.displacement[0].numpy()


def test_a_translated_patch_is_a_moved_support(scene, sim):
    found = sim.grasp(END, TRANSLATION, tol=1e-9)
    exact = with_supports(scene, fem.DirichletBC(END, TRANSLATION))
    assert found.converged
    assert np.abs(found.displacement - exact).max() < 1e-7 * L


SIDE = fem.Box([20, 0, 25], [55, 25, 25])  # a part of the upper side


def test_two_grippers_move_their_patches_each_on_its_own(scene, sim):
    moves = [[1.0, 6.0, 3.0], [0.0, 0.5, None]]
    found = sim.grasp([END, SIDE], moves, tol=1e-9)
    exact = with_supports(scene, *map(fem.DirichletBC, [END, SIDE], moves))
    assert found.converged
    assert np.abs(found.displacement - exact).max() < 1e-7 * L
    assert np.allclose(found.force.sum(axis=0), found.nodal_force.sum(axis=0))
    assert found.force[1, 2] == 0
    assert found.force.shape == found.moment.shape == (2, 3)
    assert found.force_error.shape == found.moment_error.shape == (2,)
    turned = sim.grasp([END, SIDE], moves, [ROTATION, None], tol=1e-9)
    assert np.linalg.norm(turned.moment[0] - found.moment[0]) > 0.1 * np.linalg.norm(
        found.moment[0]
    )
    alone = sim.grasp([END], [TRANSLATION], [ROTATION])
    same = sim.grasp(END, TRANSLATION, ROTATION)
    assert np.array_equal(alone.force, same.force[None])
    assert np.array_equal(alone.displacement, same.displacement)


def stiffness_by_differences(sim, regions, at):
    """Return force and moment by translation and rotation at a motion, (P, 6), over their size."""
    columns, small = [], 1e-3
    for motion in small * np.eye(at.size):
        ends = []
        for step in (motion, -motion):
            moves, turns = np.split(at + step.reshape(at.shape), 2, axis=1)
            answer = sim.grasp(regions, moves.tolist(), turns.tolist(), tol=1e-10)
            ends.append(np.hstack([answer.force, answer.moment]).ravel())
        columns.append((ends[0] - ends[1]) / (2 * small))
    matrix = np.array(columns).T
    return matrix, np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))


@pytest.mark.parametrize("regions", [[END], [END, SIDE]])
def test_the_stiffness_is_that_of_small_motions(sim, regions):
    """It is symmetric and positive, as the energy of the body is."""
    rest = np.zeros((len(regions), 6))
    exact, size = stiffness_by_differences(sim, regions, rest)
    found = sim.grasp(regions, rest[:, :3].tolist()).stiffness / size
    assert np.array_equal(found, found.T)
    assert np.linalg.eigvalsh(found)[0] > 0
    assert np.allclose(found, exact / size, rtol=0, atol=1e-4)


def test_the_stiffness_turns_with_the_patch(sim):
    """At a twist of 0.3 rad it differs by up to 15 % from that of the deformed body."""
    at = np.array([[0.0, 1.0, 0.5, 0.3, 0.0, 0.0]])
    exact, size = stiffness_by_differences(sim, [END], at)
    found = sim.grasp([END], at[:, :3], at[:, 3:]).stiffness
    assert np.allclose(found, found.T, rtol=0, atol=1e-12 * size.max())
    assert np.allclose(found / size, exact / size, rtol=0, atol=0.15)


def test_a_direction_without_a_value_is_free(scene, sim):
    found = sim.grasp(END, [None, 6.0, None], tol=1e-9)
    exact = with_supports(scene, fem.DirichletBC(END, [None, 6.0, None]))
    assert np.abs(found.displacement - exact).max() < 1e-7 * L
    assert (found.nodal_force[:, [0, 2]] == 0).all()
    assert abs(found.force[1]) > 0


def test_a_sliding_patch_is_a_roller_that_moves(scene, sim):
    """The normal motion is met, the reaction in the plane of the patch is zero."""
    for region, axis, motion in (
        (END, 0, [6.0, 1.0, -2.0]),
        (fem.Box([40, 0, 25], [100, 25, 25]), 2, [3.0, 0.0, 1.5]),
    ):
        found = replace(sim.grasp, sliding=True)(region, motion, tol=1e-9)
        normal = [g if i == axis else None for i, g in enumerate(motion)]
        exact = with_supports(scene, fem.DirichletBC(region, normal))
        assert found.converged
        assert np.abs(found.displacement - exact).max() < 1e-7 * L
        across = [i for i in range(3) if i != axis]
        assert (found.nodal_force[:, across] == 0).all()
        assert abs(found.force[axis]) > 0
        assert np.abs(found.displacement[:, across]).max() > 1e-3
        held = np.abs(found.nodal_force[:, axis]) > 0
        assert np.allclose(found.displacement[held, axis], motion[axis], atol=1e-9 * L)


def test_a_sliding_patch_that_turns_has_the_normal_displacement_of_the_rotation(scene, sim):
    found = replace(sim.grasp, sliding=True)(END, [1.0, 0.0, 0.0], ROTATION, tol=1e-9)
    rigid = sim.grasp(END, [1.0, 0.0, 0.0], ROTATION, tol=1e-9)
    where = end_nodes(scene).numpy()
    assert found.converged
    assert np.allclose(found.displacement[where, 0], rigid.displacement[where, 0], atol=1e-9 * L)
    assert (found.nodal_force[:, 1:] == 0).all()
    assert np.abs(rigid.nodal_force[:, 1:]).max() > 0


def test_a_plate_holds_the_largest_flat_part_of_a_patch(scene):
    """A ball around an edge has nodes of two faces; the plate touches the larger one."""
    points = scene.problem.points
    region = fem.Box([50.0, 0.0, 0.0], [100.0, 25.0, 25.0])
    above = fem.Box([50.0, 0.0, 12.0], [100.0, 25.0, 25.0])  # top, end and parts of two sides
    for part, axis, place in ((END, 0, 1.0), (above, 2, 0.25)):
        patch = fem.RigidPatch.of(scene.linear, part, [True] * 3, sliding=True)
        assert patch.held.any(dim=0).tolist() == [i == axis for i in range(3)]
        assert (points[patch.nodes, axis] == place).all()
    whole = fem.RigidPatch.of(scene.linear, region, [True] * 3, sliding=True)
    assert whole.held.any(dim=0).sum() == 1
    again = fem.RigidPatch.of(scene.linear, whole.nodes.numpy(), [True] * 3, sliding=True)
    assert torch.equal(again.held, whole.held)


def test_a_network_finds_the_forces_of_a_sliding_patch(scene):
    found = replace(simulator_of(scene, steps=0).grasp, sliding=True)(
        END, [2.0, 0.0, 0.0], ROTATION
    )
    exact = replace(simulator_of(scene).grasp, sliding=True)(
        END, [2.0, 0.0, 0.0], ROTATION, tol=1e-9
    )
    assert found.method == "prediction"
    assert found.motion_error < 1e-3 * L
    assert abs(found.force[0] - exact.force[0]) < 0.01 * abs(exact.force[0])


def test_the_patch_moves_as_a_rigid_body_and_the_gripper_balances_the_supports(scene, solved):
    """Internal forces have no resultant and no moment about the displaced body."""
    where = end_nodes(scene).numpy()
    before = L * scene.problem.points.numpy()[where]
    after = before + solved.displacement[where]
    apart = lambda x: np.linalg.norm(x[:, None] - x[None], axis=-1)  # noqa: E731
    assert np.allclose(apart(after), apart(before), atol=1e-9 * L)
    assert np.allclose(after.mean(0) - before.mean(0), TRANSLATION, atol=1e-9 * L)
    assert solved.motion_error < 1e-12 * L
    u = torch.from_numpy(solved.displacement)[None] / L
    internal = (scene.problem.evaluate(u).internal[0] * E * L**2).numpy()
    held = ~scene.problem.free.numpy()
    assert np.allclose(
        internal[held.any(1)].sum(0), -solved.force, atol=1e-6 * abs(solved.force).max()
    )
    assert np.allclose(internal[where], solved.nodal_force[where])
    place = L * scene.problem.points.numpy() + solved.displacement
    arms = place - place[where].mean(0)
    assert np.allclose(np.cross(arms[where], internal[where]).sum(0), solved.moment)
    assert np.allclose(np.cross(arms, internal).sum(0), 0, atol=1e-6 * abs(solved.moment).max())


def test_an_exact_network_meets_the_motion_and_has_the_reaction(scene, solved):
    found = simulator_of(scene, steps=0).grasp(END, TRANSLATION, ROTATION)
    assert found.method == "prediction"
    assert found.forces_found
    assert not found.converged, "a motion that is met to a tolerance is no equilibrium"
    assert 0 < found.motion_error < 1e-3 * L
    assert np.linalg.norm(found.force - solved.force) < 0.01 * np.linalg.norm(solved.force)
    assert np.linalg.norm(found.moment - solved.moment) < 0.01 * np.linalg.norm(solved.moment)
    wrong = np.linalg.norm(found.displacement - solved.displacement)
    assert wrong < found.error * np.linalg.norm(solved.displacement) * 3
    assert wrong < 0.01 * np.linalg.norm(solved.displacement)


def test_a_correction_reduces_the_error_and_meets_the_motion(scene, solved, sim):
    network = simulator_of(scene, linear_network(scene), steps=0)
    raw, better = (one.grasp(END, TRANSLATION, ROTATION) for one in (network, sim))
    assert (raw.method, better.method) == ("prediction", "corrected")
    off = lambda one: np.linalg.norm(one.displacement - solved.displacement)  # noqa: E731
    assert off(better) < 0.1 * off(raw)
    assert better.motion_error < 1e-12 * L
    assert better.error < raw.error


@pytest.mark.parametrize(("size", "tol"), [(1e-300, 1e-6), (1e-30, None), (1e-12, 1e-6)])
def test_a_tiny_motion_has_the_linear_answer_and_a_vanishing_one_has_rest(scene, sim, size, tol):
    motion = [[size * x for x in vector] for vector in (TRANSLATION, ROTATION)]
    found = sim.grasp(END, *motion, tol=tol)
    patch = fem.RigidPatch.of(scene.linear, END, [True] * 3)
    arms = scene.problem.points[patch.nodes] - scene.problem.points[patch.nodes].mean(dim=0)
    translation, rotation = torch.tensor(motion, dtype=torch.float64)
    goal = (translation / L + torch.linalg.cross(rotation[None], arms)).flatten()
    goal = goal if size > 1e-280 else 0 * goal
    force = patch.at(patch.stiffness_times(goal)) * E * L**2
    moved = L * scene.linear.solve_force(force / (E * L**2)).numpy()
    assert found.converged
    assert found.error < 1e-6
    assert np.allclose(found.displacement, moved, rtol=0, atol=1e-6 * abs(moved).max())
    assert np.allclose(found.nodal_force, force, rtol=0, atol=1e-5 * float(force.abs().max()))


@pytest.mark.parametrize("region", [END, fem.Box([40, 0, 20], [100, 25, 25])])
def test_errors_of_force_and_moment_are_seen(scene, region):
    """Of small to large motions, of an accurate and a poor network, with and without a tolerance.

    No estimate below 10 % is less than a third of the error.
    """
    rng, ratios = np.random.default_rng(0), []
    sims = [
        simulator_of(scene, predict, steps=steps)
        for predict, steps in ((1.0, 0), (linear_network(scene), 0), (linear_network(scene), 6))
    ]
    for size in (0.3, 5.0, 20.0):
        for part in (0.0, 1.0):
            translation = (size * rng.normal(size=3) * [0.2, 0.6, 0.6]).tolist()
            rotation = (part * size / 40 * rng.normal(size=3)).tolist()
            exact = sims[-1].grasp(region, translation, rotation, tol=1e-8)
            for sim in sims[size > 1 :]:  # the forces of large motions take many exact solutions
                for tol in (None, 1e-2):
                    found = sim.grasp(region, translation, rotation, tol=tol)
                    for name in ("force", "moment"):
                        true, estimate = getattr(exact, name), getattr(found, f"{name}_error")
                        off = np.linalg.norm(getattr(found, name) - true) / np.linalg.norm(true)
                        ratios += [estimate / off] if estimate < 0.1 else []
    assert len(ratios) > 30
    assert min(ratios) > 1 / 3
    assert 0.8 < np.median(ratios) < 1.25


@pytest.mark.parametrize(("value", "steps"), [(0.0, 0), (math.nan, 6)])
def test_a_useless_network_is_reported_and_corrected(scene, solved, value, steps):
    useless = simulator_of(scene, lambda load: torch.full_like(load.force, value), steps=steps)
    found = useless.grasp(END, TRANSLATION, ROTATION)
    off = np.linalg.norm(found.displacement - solved.displacement)
    off /= np.linalg.norm(solved.displacement)
    assert np.isfinite(found.displacement).all()
    assert found.motion_error < 1e-6 * L
    assert not found.forces_found
    assert found.error > off / 3 > 0
    assert not math.isnan(found.force_error)
    assert found.summary.startswith(f"motion error {found.motion_error:.1e} m; displacement")
    exact = useless.grasp(END, TRANSLATION, ROTATION, tol=1e-9)
    assert exact.converged
    assert exact.method in ("hybrid", "full Newton")
    assert np.abs(exact.displacement - solved.displacement).max() < 1e-6 * L


@pytest.mark.parametrize("angle", [1.2, 2.0])
def test_a_large_rotation_is_made_in_parts(sim, angle):
    """The linear network, and its linear displacement, are far from these equilibria."""
    exact = sim.grasp(END, [-3.0, 0, 0], [angle, 0, 0], tol=1e-9)
    found = sim.grasp(END, [-3.0, 0, 0], [angle, 0, 0])
    off = np.linalg.norm(found.displacement - exact.displacement)
    assert exact.converged
    assert (found.method, found.motion_error < 1e-12 * L) == ("corrected", True)
    assert off < 1e-3 * np.linalg.norm(exact.displacement)
    assert off < 3 * found.error * np.linalg.norm(exact.displacement)


def test_a_moving_hand_continues_from_its_last_state(scene):
    """Each frame is as accurate as a grasp from rest, without a prediction, and needs less work."""
    calls = []

    def predict(load):
        calls.append(load)
        return linear_network(scene)(load)

    sim = simulator_of(scene, predict)
    motions = [([0.02 * k, 0.3 * k, 0.1 * k], [0.01 * k, 0.0, 0.0]) for k in range(1, 9)]
    frames = [replace(sim.grasp, warm=True)(END, *motion) for motion in motions]
    asked = len(calls)
    cold = [sim.grasp(END, *motion) for motion in motions]
    assert 0 < asked < len(calls) / 4
    for motion, frame in zip(motions, frames, strict=True):
        exact = sim.grasp(END, *motion, tol=1e-9).displacement
        off = np.linalg.norm(frame.displacement - exact) / np.linalg.norm(exact)
        assert off < 1e-3
        assert frame.motion_error < 1e-12 * L
        assert frame.error > off / 3
    assert sum(one.iterations for one in frames[1:]) < sum(one.iterations for one in cold[1:])


def test_a_new_patch_is_prepared_over_several_calls_of_a_budget(scene):
    sim = simulator_of(scene, linear_network(scene))
    answers = [sim.grasp(END, TRANSLATION, ROTATION, budget_ms=1e-3) for _ in range(30)]
    first = answers[0]
    assert (first.method, first.stopped, first.error) == ("rest", True, math.inf)
    assert not first.displacement.any()
    assert first.motion_error > np.linalg.norm(TRANSLATION)
    assert "displacement unknown" in first.summary
    assert answers[-1].method == "corrected"
    assert answers[-1].motion_error < 1e-12 * L


def test_a_motion_that_the_network_misses_is_closed_by_the_linear_displacement(scene):
    """The network does not move at all: a jump of the patch inverts the elements beside it."""
    raw = simulator_of(scene, lambda load: torch.zeros_like(load.force), steps=0)
    deaf = simulator_of(scene, lambda load: torch.zeros_like(load.force))
    motion = [-26.0, 4.0, 2.0]  # m; cells are 25 m long
    patch = fem.RigidPatch.of(scene.linear, END, [True] * 3)
    goal = patch.displacement([x / L for x in motion], ROTATION)
    found = raw.grasp(END, motion, ROTATION)
    moved = torch.from_numpy(found.displacement) / L
    torch.testing.assert_close(patch.of_field(moved), goal, rtol=0, atol=1e-6)
    assert float(scene.problem.evaluate(patch.at(goal)[None]).volume_ratio) < 0
    assert found.volume_ratio > 0.3
    linear = scene.linear.solve_force(patch.at(patch.stiffness_times(goal)))
    torch.testing.assert_close(linear, moved, rtol=0, atol=1e-9)
    assert deaf.grasp(END, motion, ROTATION).method == "corrected"


def test_a_budget_ends_the_search_for_forces(scene):
    """Of a network that moves the other way, whose forces are never found."""
    slow = simulator_of(scene, lambda load: -linear_network(scene)(load), steps=0)
    free = slow.grasp(END, TRANSLATION)
    found = slow.grasp(END, TRANSLATION, budget_ms=1e-3)
    assert (free.stopped, found.stopped) == (False, True)
    assert found.iterations == 1 < free.iterations
    assert found.motion_error > 0
    assert found.summary.endswith("stopped by the budget of 0.001 ms")
    assert np.isfinite(found.displacement).all()


def test_a_budget_ends_newtons_method_and_the_answer_is_the_best_state(scene, monkeypatch):
    sim = simulator_of(scene, linear_network(scene))
    sim.grasp(END, TRANSLATION, ROTATION)  # prepares the patch
    now, original = [0.0], fem.Newton.iterate

    def slowly(newton, *more, **options):
        for state in original(newton, *more, **options):
            yield state
            now[0] += 10.0

    monkeypatch.setattr(fem.Newton, "iterate", slowly)
    monkeypatch.setattr("dpl.inference.request.time.perf_counter", lambda: now[0])
    found = sim.grasp(END, TRANSLATION, ROTATION, tol=1e-14, budget_ms=15e3)
    assert found.stopped
    assert not found.converged
    assert "stopped by the budget" in found.summary
    assert found.motion_error < 1e-12 * L
    now[0] = 0.0
    met = sim.grasp(END, TRANSLATION, ROTATION, tol=1e-6, budget_ms=1e6)
    assert met.converged
    assert not met.stopped
    assert "budget" not in met.summary


def test_errors_that_frames_leave_one_after_the_other_are_seen(sim):
    """The first iteration of a frame hardly reduces the soft error of the frames before it."""
    hand = replace(sim.grasp, warm=True)
    for k in range(1, 121):
        found = hand(END, [0, 0, 0], [1.0 * k / 120, 0, 0])
        if k % 20 == 0:
            exact = sim.grasp(END, [0, 0, 0], [1.0 * k / 120, 0, 0], tol=1e-9).displacement
            off = np.linalg.norm(found.displacement - exact) / np.linalg.norm(exact)
            assert off / 3 < found.error < 1e-3


def test_a_warm_start_needs_fewer_predictions(scene):
    sim = simulator_of(scene, steps=0)
    cold = sim.grasp(END, TRANSLATION, ROTATION)
    again = replace(sim.grasp, warm=True)(END, TRANSLATION, ROTATION)
    assert again.iterations == 1 < cold.iterations
    other = replace(sim.grasp, warm=True)(fem.Sphere([100, 25, 25], 10.0), [0, 1.0, 0])
    assert other.motion_error < MOTION_TOL * 1.01, "forces of another patch are not used"


def test_reactions_scale_with_youngs_modulus_and_displacements_do_not(make_scene):
    sim = simulator_of(make_scene(young=[1000.0, 9000.0]))
    soft, stiff = (sim.grasp(END, TRANSLATION, young=E, tol=1e-9) for E in (1000.0, 9000.0))
    assert np.allclose(soft.displacement, stiff.displacement, atol=1e-9 * L)
    assert np.allclose(9 * soft.force, stiff.force, rtol=1e-6)


def test_parameters_of_the_law_are_those_of_the_call(make_scene):
    sim = simulator_of(make_scene(poisson=[0.2, 0.4]))
    one = simulator_of(make_scene(poisson=0.4))
    found = sim.grasp(END, TRANSLATION, parameters={"poisson": 0.4}, tol=1e-9)
    exact = one.grasp(END, TRANSLATION, tol=1e-9)
    assert found.converged
    assert np.abs(found.displacement - exact.displacement).max() < 1e-7 * L
    other = sim.grasp(END, TRANSLATION, parameters={"poisson": 0.2}, tol=1e-9)
    assert np.abs(other.displacement - exact.displacement).max() > 1e-3


def test_further_forces_act_at_the_same_time(scene, sim):
    load = np.zeros(scene.problem.shape)
    load[scene.problem.points[:, 0] == 0.5, 2] = 1000.0
    assert simulator_of(scene, steps=0).grasp(END, [0, 0, 0], force=load).iterations < MAX_ITER
    found = sim.grasp(END, [0, 0, 0], force=load, tol=1e-9)
    assert found.converged
    u = torch.from_numpy(found.displacement)[None] / L
    rest = (scene.problem.evaluate(u).internal[0] * E * L**2).numpy() - load
    free = scene.problem.free & ~end_nodes(scene)[:, None]
    assert abs(rest[free.numpy()]).max() < 1e-6 * abs(load).max()
    assert abs(found.displacement[end_nodes(scene).numpy()]).max() == 0
    assert abs(found.displacement).max() > 1e-3


def test_a_constant_force_of_the_scene_acts_if_no_force_is_given(scene, make_scene):
    force = torch.zeros(scene.problem.shape, dtype=torch.float64)
    force[scene.problem.points[:, 0] == 0.5, 2] = 1e-5
    sim = simulator_of(make_scene(constant_force=force))
    newtons = force * E * L**2
    for young in (E, 2 * E):
        left_out = sim.grasp(END, [0, 0, 0], young=young, tol=1e-9)
        given = sim.grasp(END, [0, 0, 0], force=newtons, young=young, tol=1e-9)
        assert abs(left_out.displacement).max() > 1e-4
        assert np.allclose(left_out.displacement, given.displacement, atol=1e-9 * L)


def test_a_mask_of_nodes_is_a_patch_too(scene, sim):
    mask = end_nodes(scene).numpy()
    assert np.array_equal(
        sim.grasp(mask, TRANSLATION, tol=1e-6).displacement,
        sim.grasp(END, TRANSLATION, tol=1e-6).displacement,
    )


def test_supports_in_the_region_stay_where_they_are(scene, sim):
    found = sim.grasp(fem.Plane(axis=1, at="max"), [0.0, 1.0, 0.0], tol=1e-9)
    fixed = ~scene.problem.free.any(dim=1).numpy()
    assert found.converged
    assert (found.displacement[fixed] == 0).all()


def test_a_body_in_the_plane_turns_by_an_angle(make_scene):
    scene = make_scene(mesh=fem.rectangle((100.0, 25.0), (5, 3)))
    found = simulator_of(scene).grasp(END, [0.0, 5.0], 0.2, tol=1e-9)
    where = (scene.problem.points[:, 0] == 1).numpy()
    x = L * scene.problem.points.numpy()[where]
    arms = x - x.mean(0)
    turned = arms @ np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    assert found.converged
    assert np.allclose(found.displacement[where], turned - arms + [0, 5.0], atol=1e-9 * L)
    assert found.force.shape == (2,)
    assert found.moment.shape == (1,)


STILL = [0, 0, 0]
REFUSED = [
    ((fem.Sphere([1e4, 0, 0], 1.0), STILL), {}, "no node"),
    ((fem.Plane(axis=0, at="min"), [0, 0, 1.0]), {}, "free to move"),
    ((fem.Box([40, 10, 10], [60, 14, 14]), [0, 0, 1.0]), {}, "boundary"),
    ((np.ones(3, dtype=bool), STILL), {}, "mask"),
    ((END, [0, 1.0]), {}, "3 lengths"),
    ((END, [0, math.nan, 0]), {}, "finite"),
    ((END, [0, 1e12, 0]), {}, r"at most 1e\+06 L"),
    ((END, [0, 1e300, 0]), {}, r"at most 1e\+06 L"),
    ((END, STILL, [0, -1e300, 0]), {}, "and rad"),
    ((END, [None, None, None]), {}, "hold"),
    ((END, STILL, 0.3), {}, "angles"),
    ((END, [0, 0, "a"]), {}, "real numbers"),
    ((END, STILL), {"force": [[1.0]]}, "force"),
    ((END, STILL), {"force": np.zeros((2, 45, 3))}, "one load"),
    ((END, STILL), {"tol": 2.0}, "tol"),
    ((END, STILL), {"young": -1.0}, "young"),
    ((END, STILL), {"budget_ms": 0}, "budget_ms"),
    (([END, SIDE], [STILL]), {}, "lengths"),
    (([END, END], [STILL, STILL]), {}, "in common"),
]


def test_invalid_arguments_are_refused_in_one_line(sim):
    plate = replace(sim.grasp, sliding=True)
    calls = [(sim.grasp, *row) for row in REFUSED]
    calls.append((plate, (END, [None, 0, 0]), {}, "hold"))
    calls.append((plate, (fem.Sphere([100, 25, 25], 1.0), STILL), {}, "sliding"))
    for grasp, arguments, options, words in calls:
        with pytest.raises(ValueError, match=words) as raised:
            grasp(*arguments, **options)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("steps", [0, 6])
def test_a_grasp_is_out_of_distribution_if_its_forces_and_its_error_are(scene, steps):
    answer = simulator_of(scene, linear_network(scene), steps=steps).grasp(
        END, [0, 0, 40.0], [1.0, 0, 0]
    )
    assert answer.amplitude > 1
    assert answer.out_of_distribution == (answer.error > 0.1) == (steps == 0)
    assert ("unlike the training" in answer.summary) == (steps == 0)
