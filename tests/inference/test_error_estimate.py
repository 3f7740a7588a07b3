"""Laws of the estimated error: all methods report it, and a tolerance for it is met."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from simulators import simulator_of, solution, with_errors

import dpl.inference.simulator as simulator_module
from dpl.fem import LinearSolver, Load, Problem, Status, SubspaceNewton, estimate_error, solve
from dpl.inference import default_hybrid
from dpl.inference.answer import RangeCheck, summarise

E = 4500.0


@pytest.fixture(scope="module")
def truth(scene, loads):
    """Their displacements, (B, N, D) [-]."""
    return solution(scene, loads)


def softest_mode(scene):
    """Return Newton's method in one mode."""
    vectors = scene.loads.eigenmodes.vectors[..., :1]
    return SubspaceNewton(scene.problem, vectors / vectors.norm())


def errors_of(answer, scene, truth):
    u = answer.displacement / scene.length
    return (u - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)


@pytest.mark.parametrize("part", [0.95, 1.001, 1 + 1e-6])
def test_a_network_without_modes_reports_its_error_within_a_factor_of_five(
    scene, forces, truth, part
):
    answer = simulator_of(scene, part)(forces)
    assert answer.method == ["prediction"] * 4
    ratio = answer.error / errors_of(answer, scene, truth)
    assert (ratio > 0.5).all()
    assert (ratio < 5.0).all()


def test_the_estimate_does_not_depend_on_the_linear_solver(scene, loads, truth):
    """With `cg` the factor of K(0) is a preconditioner, and its solves are iterative."""
    one, u = loads.unbatch()[0], 0.99 * truth[:1]
    solvers = [LinearSolver(scene.problem, linear=name) for name in ("band", "superlu", "cg")]
    expected, *others = (estimate_error(solver, one, u).error for solver in solvers)
    assert others == pytest.approx([expected] * 2, rel=0.05)
    assert expected == pytest.approx(0.01, rel=0.5)


def test_the_residual_of_a_prediction_is_evaluated_once(scene, forces, monkeypatch):
    sim, evaluate, seen = simulator_of(scene, 0.99), Problem.evaluate, []
    u = sim.surrogate.predict(scene.load_of(forces[:1], torch.tensor([E])))
    sim.surrogate.predict = lambda load: u

    def counted(problem, displacement):
        seen.append(displacement)
        return evaluate(problem, displacement)

    monkeypatch.setattr(Problem, "evaluate", counted)
    assert math.isfinite(sim(forces[0]).error)
    assert [torch.equal(one, u) for one in seen].count(True) == 1


@pytest.mark.parametrize("wanted", [1e-2, 1e-4, 1e-6])
def test_a_tolerance_for_the_error_is_met_without_modes(scene, forces, truth, wanted):
    sim = simulator_of(scene, 0.7)
    answer, exact = sim(forces, error=wanted), sim(forces, tol=scene.solver.tol)
    assert (answer.error <= wanted).all()
    assert (errors_of(answer, scene, truth) < 3 * answer.error).all()
    assert set(answer.method) <= {"hybrid", "full Newton"}
    assert (answer.iterations > 0).all()
    assert (answer.iterations < exact.iterations).any()
    assert (answer.iterations <= exact.iterations).all()
    assert not answer.converged.all()
    near = simulator_of(scene, 1 + wanted / 10)(forces, error=wanted)
    assert near.method == ["prediction"] * 4


def test_errors_outside_of_the_modes_are_corrected_where_they_are_large(scene, forces, truth):
    """The predictions have a dent, the linear displacement under forces that pinch two nodes."""
    pinch = torch.zeros(scene.problem.shape, dtype=torch.float64)
    pinch[-1], pinch[-2] = 1.0, -1.0
    dent = scene.linear.solve(pinch)
    sizes = truth.flatten(1).norm(dim=1)[:, None, None]
    modes = torch.linalg.qr(scene.loads.eigenmodes.vectors[scene.problem.free]).Q
    vectors = torch.zeros_like(scene.loads.eigenmodes.vectors)
    vectors[scene.problem.free] = modes
    newton = SubspaceNewton(scene.problem, vectors)
    plain, sim = (simulator_of(scene, 1.0, newton=newton, steps=steps) for steps in (0, 6))
    for part, corrected in ((1e-4, False), (0.02, True)):
        answers = []
        for one in (plain, sim):
            one.surrogate.predict = lambda load: truth + part * sizes / dent.norm() * dent  # noqa: B023
            answers.append(one(forces))
        before, after = (errors_of(answer, scene, truth) for answer in answers)
        assert before.tolist() == pytest.approx([part] * 4, rel=1e-6)
        assert (after < 0.2 * before).all() == corrected
        assert (answers[1].iterations > 0).all() == corrected
        assert (answers[1].iterations <= 6).all()
        assert not answers[0].iterations.any()


@pytest.mark.parametrize(("tol", "wanted"), [(1e-2, 1e-6), (1e-7, 1e-1)])
def test_tolerances_for_residual_and_error_are_both_met(scene, forces, tol, wanted):
    answer = simulator_of(scene, 0.9)(forces, tol=tol, error=wanted, stability=True)
    assert (answer.residual < tol).all()
    assert (answer.error <= wanted).all()
    assert answer.converged.all()
    assert all("(converged)" in words and "stable" in words for words in answer.summary)
    assert (answer.negative_pivots == 0).all()


def test_all_methods_report_their_error(scene, forces):
    near, far = simulator_of(scene, 0.99), simulator_of(scene, math.nan)
    found = [far(1e-7 * forces[0], tol=1e-3), near(forces[0], tol=1e-8)]
    found.append(far(8 * forces[0], tol=1e-8))
    assert [answer.method for answer in found] == ["linear", "hybrid", "full Newton"]
    assert all(0 < answer.error < 1e-3 for answer in found)
    assert max(answer.error for answer in found[1:]) < 1e-6


@pytest.mark.parametrize("factor", [-1.0, math.nan])
def test_newton_starts_from_rest_where_a_prediction_is_far(scene, forces, factor, monkeypatch):
    starts = []

    def listen(predict, scene, tol):
        starts.append(predict(None))
        return default_hybrid(predict, scene, tol)

    monkeypatch.setattr(simulator_module, "default_hybrid", listen)
    far, near = simulator_of(scene, factor), simulator_of(scene, 0.99)
    answers = [sim(0.5 * forces[0], tol=1e-8) for sim in (far, near)]
    assert [answer.method for answer in answers] == ["full Newton", "hybrid"]
    assert len(starts) == 1
    load = scene.load_of(0.5 * forces[:1], torch.tensor([E]))
    assert torch.equal(starts[0], near.surrogate.predict(load))
    alone = solve(scene.corrector, load)
    assert answers[0].iterations == int(alone.iterations)
    assert all(answer.converged for answer in answers)


def compressed(scene, part, across):
    """Return an axial load on the end, its solution, and a soft error of the solution's size.

    The load is the part [-] of the critical one and has a component across [-].
    """
    problem, newton = scene.problem, replace(scene.solver, tol=1e-10)
    end = problem.points[:, 0] > problem.points[:, 0].max() - 1e-9
    axial, side = (torch.zeros(problem.shape, dtype=torch.float64) for _ in range(2))
    axial[end, 0], side[end, 2] = -1 / end.sum(), 1 / end.sum()

    def solution(size, across):
        load = Load(size * (axial + across * side)[None], torch.ones(1, dtype=torch.float64))
        return load, solve(newton, load)

    low, high = 1e-5, 1e-2
    for _ in range(12):
        middle = (low + high) / 2
        _, found = solution(middle, 0.0)
        stable = found.converged and not newton.stability(found.displacement)
        low, high = (middle, high) if stable else (low, middle)
    load, found = solution(part * low, across)
    soft = scene.linear.solve_force(side)[None]
    return load, found.displacement, soft * found.displacement.norm() / soft.norm()


@pytest.mark.parametrize("part", [0.5, 0.8, 0.95])
def test_the_estimate_sees_that_compression_softens_the_body(scene, part):
    load, exact, soft = compressed(scene, part, 1e-3)
    for size in (1e-3, 1e-2):
        wrong = exact + size * soft
        error = float((wrong - exact).norm() / wrong.norm())
        assert error / 3 < estimate_error(scene.linear, load, wrong).error < 6 * error
    alone = estimate_error(scene.linear, load, wrong, products=0).error
    assert (alone < error / 3) == (part > 0.6), "without the tangent it misses the softening"


def test_negative_curvature_near_equilibrium_is_reported(scene, forces):
    """The straight beam above the critical load is nearly in equilibrium and unstable."""
    load, straight, _ = compressed(scene, 1.2, 0.0)
    bent = scene.linear.solve_force(load.force[0].roll(2, dims=1))[None]
    straight = straight + 1e-4 * bent * straight.norm() / bent.norm()
    found = estimate_error(scene.linear, load, straight)
    assert found.is_indefinite
    assert found.error == math.inf
    sim = simulator_of(scene, lambda load: straight)
    answer = sim(load.force[0] * E * scene.force_unit)
    assert answer.negative_pivots == 1
    assert "negative curvature" in answer.summary


@pytest.mark.parametrize("value", [math.nan, math.inf, -3.0, 0.0])
def test_the_error_of_a_useless_prediction_is_infinite(scene, forces, value):
    """The body is inverted, or not displaced at all."""
    useless = torch.where(scene.problem.free, value, 0.0).double()
    sim = simulator_of(scene, lambda load: useless[None].expand(load.force.shape))
    answer = sim(forces[0])
    assert answer.error == math.inf
    assert "within" not in answer.summary
    assert answer.summary.startswith("NOT VALID") == (value != 0.0)
    assert not answer.converged
    assert sim(forces[0], error=1e-3).error <= 1e-3


def test_steps_in_modes_are_followed_by_the_hybrid_on_request_only(scene, forces):
    newton = softest_mode(scene)
    sim = simulator_of(scene, 0.8, newton=newton)
    plain = sim(forces)
    assert set(plain.method) <= {"prediction", "corrected"}
    assert (plain.error > 1e-3).any(), "one mode is too few"
    asked = sim(forces, error=1e-3)
    assert (asked.error <= 1e-3).all()
    assert {"hybrid", "full Newton"} & {*asked.method}


def test_the_estimate_does_not_depend_on_the_size_of_small_loads(scene, loads):
    load = loads.unbatch()[0]
    u = 1.1 * scene.linear.solve(load.force[0])[None]
    sizes = [1e-6, 1e-100, 1e-200, 1e-280]
    found = [
        estimate_error(scene.linear, load._replace(force=size * load.force), size * u).error
        for size in sizes
    ]
    assert found == pytest.approx([0.1 / 1.1] * len(sizes), rel=1e-4)


def test_a_value_of_the_law_needs_no_factor_for_the_estimate(make_scene):
    scene = make_scene(poisson=[0.2, 0.4])
    load = scene.loads.sample((0, 9), [0])
    load = load._replace(parameters=torch.tensor([[0.337]]).double())
    exact = solve(scene.solver, load).displacement
    sim = simulator_of(scene, lambda load: 0.99 * exact)
    solver = scene.linear.with_parameters(load.parameters)
    solver.__dict__.pop("factor", None)
    answer = sim(load.force[0] * E * scene.force_unit, parameters=load.parameters)
    assert answer.error == pytest.approx(0.01, rel=0.5)
    assert "factor" not in solver.__dict__


def state_of(residual=28.0, volume=0.7, status=Status.NOT_CONVERGED, pivots=-1):
    return SimpleNamespace(
        residual=residual, volume_ratio=volume, status=status, negative_pivots=pivots,
        converged=status <= Status.UNSTABLE, load_factor=0.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (0.00432, "displacement within about 0.43 % (estimated), residual 2.8e+01 of the load"),
        (0.157, "displacement within about 16 % (estimated), residual"),
        (1e-4, "displacement within about 0.01 % (estimated), residual"),
        (9.9e-5, "displacement within about 9.9e-05 (estimated), residual"),
        (1.3, "displacement unknown, its estimated error exceeds 100 %, residual"),
        (math.inf, "displacement unknown, its estimated error exceeds 100 %, residual"),
    ],
)
def test_a_summary_begins_with_the_error(error, words):
    summary = summarise(state_of(), False, error, RangeCheck(0.5, 0.0, False))
    assert summary.startswith(words)
    assert summary.endswith("of the load, nothing inverted")


def test_a_summary_states_inversion_convergence_stability_and_range():
    inverted = summarise(state_of(volume=-1.0), False, math.inf, RangeCheck(0.5, 0.0, False))
    assert inverted == "NOT VALID: an element is inverted"
    good = state_of(3.7e-8, status=Status.CONVERGED)
    assert summarise(good, True, 2e-8, RangeCheck(2.5, 0.0, True)) == (
        "displacement within about 2.0e-08 (estimated), residual 3.7e-08 of the load (converged), "
        "nothing inverted, stability not examined; "
        "the size of the load is out of range by 1.5 times the training's largest"
    )
    unknown = summarise(good, True, 2e-8, RangeCheck(0.5, math.nan, False))
    assert unknown.endswith("; the load family cannot recognise its loads")
    column = state_of(1e-9, status=Status.UNSTABLE, pivots=2)
    assert "UNSTABLE (2 negative eigenvalues)" in summarise(
        column, True, 1e-9, RangeCheck(1.0, 0.0, False)
    )


def test_known_errors_count_in_range_only_and_save_the_correction(scene, forces, monkeypatch):
    seen = []

    def counted(*arguments, **options):
        seen.append(arguments)
        return estimate_error(*arguments, **options)

    monkeypatch.setattr(simulator_module, "estimate_error", counted)
    newton = softest_mode(scene)
    sim = with_errors(simulator_of(scene, 1.0, newton=newton), 5e-3, 1e-4)
    assert sim(forces[0]).error == pytest.approx(1e-4, rel=1e-3), "that outside of the mode"
    assert not seen
    assert sim(forces[0], error=5e-3).error == 5e-3, "that of the prediction"
    assert not seen
    assert sim(forces[0], error=1e-5).error < 1e-6
    assert len(seen) == 1
    largest = scene.loads.eigenmodes.vectors @ (1.5 * scene.loads.q_max)
    outside = sim(torch.where(scene.loads.loadable_dofs, largest, 0.0) * scene.force_unit * E)
    assert outside.out_of_distribution
    assert outside.error < 1e-6
    assert len(seen) == 2
    unknown = simulator_of(scene, 1.0, newton=newton)
    assert unknown(forces[0]).error < 1e-6
    assert len(seen) == 3
    noisy = with_errors(simulator_of(scene, 1.0, newton=newton), 1e-4, 1e-4)
    noise = 6e-3 * torch.randn(scene.problem.shape, generator=torch.Generator().manual_seed(0))
    predict = noisy.surrogate.predict
    noisy.surrogate.predict = lambda load: predict(load) + noise * scene.problem.free
    answer = noisy(forces[0])
    assert answer.residual > 1
    assert len(seen) > 3, "the residual shows an error that the modes do not contain"
