"""Laws of the simulator: its answers meet the request or say that they do not, in SI units."""

import itertools
import math
import shutil
import warnings
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from simulators import newton_everywhere, simulator_of, solution, with_errors

import dpl
import dpl.inference.request as request_module
import dpl.inference.simulator as simulator_module
from dpl.config import build
from dpl.fem import SubspaceNewton, solve
from dpl.inference import Hybrid, Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

E = 4500.0


@pytest.fixture(scope="module")
def truth(scene, loads):
    """Their displacements, (B, N, D) [m]."""
    return scene.length * solution(scene, loads)


@pytest.fixture(scope="module")
def sim(scene):
    """A simulator whose predictions are half the solution."""
    return simulator_of(scene, 0.5)


def test_a_tolerance_is_kept_and_the_answer_is_newtons(scene, forces, truth, sim):
    for tol in (1e-3, 1e-6, 1e-8):
        answer = sim(forces, tol=tol)
        assert answer.converged.all()
        assert (answer.residual < tol).all()
        assert (answer.volume_ratio > 0).all()
        problem = scene.problem
        u = answer.displacement / scene.length
        ours = problem.relative_residual(u, forces / (E * scene.force_unit))
        dimensionless = forces / (E * scene.force_unit)
        off = (ours - answer.residual).abs() * dimensionless.flatten(1).norm(dim=1)
        assert (off <= problem.roundoff_bound(u)).all()  # metres and back round u
    assert torch.allclose(answer.displacement, truth, rtol=0, atol=1e-6 * scene.length)
    exact = simulator_of(scene, 1.0)(forces, tol=1e-6)
    assert exact.method == ["prediction"] * 4
    assert exact.converged.all()
    assert not exact.iterations.any()


def test_without_a_tolerance_the_network_answers_and_says_how_wrong_it_is(
    scene, forces, truth, sim
):
    answer = sim(forces)
    assert answer.method == ["prediction"] * 4
    assert torch.allclose(answer.displacement, 0.5 * truth)
    assert not answer.converged.any()
    assert not answer.iterations.any()
    assert not any("stab" in words or "converged" in words for words in answer.summary)


BAD = {
    "nan": lambda u: torch.full_like(u, torch.nan),
    "inverted": lambda u: u - 3.0,
    "huge": lambda u: 1e6 * u,
    "minus": lambda u: -u,
    "zero": lambda u: 0 * u,
}


@pytest.mark.parametrize("name", BAD)
def test_whatever_the_network_says_a_tolerance_is_kept(scene, forces, truth, name):
    def predict(load):
        u = BAD[name](solution(scene, load))
        return torch.where(scene.problem.free, u, 0.0) if name != "nan" else u

    answer = simulator_of(scene, predict)(forces, tol=1e-8)
    assert answer.converged.all()
    assert torch.allclose(answer.displacement, truth, rtol=0, atol=1e-6 * scene.length)


def test_numpy_in_numpy_out_and_one_load_gives_one_answer(scene, forces, sim):
    several, single = sim(forces.numpy(), tol=1e-6), sim(forces[1].numpy(), tol=1e-6)
    assert isinstance(several.displacement, np.ndarray)
    assert several.displacement.shape == forces.shape
    assert isinstance(several.residual, np.ndarray)
    assert several.method.shape == several.summary.shape == (len(forces),)
    assert isinstance(single.displacement, np.ndarray)
    assert single.displacement.shape == forces.shape[1:]
    assert isinstance(single.residual, float)
    assert isinstance(single.converged, bool)
    assert isinstance(single.summary, str)
    assert isinstance(single.method, str)
    assert np.array_equal(single.displacement, several.displacement[1])
    tensors = sim(forces, tol=1e-6)
    assert isinstance(tensors.displacement, torch.Tensor)
    assert np.array_equal(tensors.displacement.numpy(), several.displacement)
    tensors.displacement.mul_(2.0)  # not a tensor of inference mode


def test_answers_scale_with_youngs_modulus(scene, forces, sim):
    soft, stiff = sim(forces, tol=1e-8), sim(1e6 * forces, young=1e6 * E, tol=1e-8)
    assert torch.allclose(soft.displacement, stiff.displacement, rtol=1e-9)
    mixed = sim(forces, young=[E, 2 * E, E, E], tol=1e-8)
    assert mixed.displacement[1].norm() < soft.displacement[1].norm()
    assert torch.equal(mixed.displacement[0], soft.displacement[0])


def test_a_body_without_load_is_at_rest(scene, forces):
    answer = simulator_of(scene, lambda load: 0.1 * torch.ones_like(load.force))(
        0 * forces[0], tol=1e-6
    )
    assert (answer.method, answer.converged) == ("rest", True)
    assert not answer.displacement.any()
    assert "at rest" in answer.summary


@pytest.mark.parametrize("known", [math.inf, 0.02])
@pytest.mark.parametrize("has_modes", [False, True])
def test_the_error_of_a_prediction_is_that_of_its_answer(scene, forces, loads, has_modes, known):
    newton = newton_everywhere(scene) if has_modes else None
    near = lambda load: 1.03 * solution(scene, load)  # noqa: E731
    sim = with_errors(simulator_of(scene, near, newton=newton, steps=0), known, 1e-6)
    stated = list(map(sim.prediction_error, loads.unbatch(), near(loads).split(1)))
    assert stated == pytest.approx(sim(forces).error.tolist())


def test_steps_in_the_modes_follow_while_the_estimated_error_is_large(scene, forces, truth):
    near = lambda load: 1.03 * solution(scene, load)  # noqa: E731
    sim = with_errors(simulator_of(scene, near, newton=newton_everywhere(scene)), 0.05, 1e-6)

    def errors(answer):
        return (answer.displacement - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)

    found = [sim(forces, error=wanted) for wanted in (10.0, 0.01, 1e-5)]
    assert found[0].method == ["prediction"] * 4
    assert found[2].method == ["corrected"] * 4
    assert "corrected" in found[1].method
    assert (found[1].error <= 0.01 + 1e-6).all()
    assert (errors(found[1]) < errors(found[0]) / 2).any()
    assert (errors(found[2]) < 5e-3).all()
    assert (found[0].error > 0.01).any(), "a part of the displacement is missing"
    assert (found[0].iterations == 0).all()
    assert (found[2].iterations >= found[1].iterations).all()
    without = simulator_of(scene, near, newton=newton_everywhere(scene), steps=0)(forces)
    assert without.method == ["prediction"] * 4
    assert without.error.isfinite().all()


@pytest.mark.parametrize(("after", "method"), [(0.2, "corrected"), (0.5, "prediction")])
def test_a_prediction_alone_is_corrected_where_steps_leave_less_than_a_third(
    scene, forces, truth, after, method
):
    """The stated error of 0.15 % would suffice; a smaller one than 0.1 % is left."""
    near = lambda load: 1.001 * solution(scene, load)  # noqa: E731
    simulator = simulator_of(scene, near, newton=newton_everywhere(scene))
    small = with_errors(simulator, 9e-4, after * 9e-4)
    assert small(forces).method == ["prediction"] * 4
    sim = with_errors(simulator, 1.5e-3, after * 1.5e-3)
    answer = sim(forces)
    error = (answer.displacement - truth).flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1)
    assert answer.method == [method] * 4
    assert ((error < 5e-4) == (method == "corrected")).all()
    assert sim(forces, error=2e-3).method == ["prediction"] * 4, "a wish that is met"


def test_a_step_that_makes_an_answer_worse_is_not_taken(scene, forces, truth):
    wrong = simulator_of(scene, lambda load: 30 * torch.randn(load.force.shape).double())
    sim = Simulator(wrong.surrogate, newton=newton_everywhere(scene))
    answer = sim(forces)
    assert answer.method == ["prediction"] * 4
    assert (answer.error == torch.inf).all()
    assert all(words.startswith("NOT VALID") for words in answer.summary)
    assert sim(forces, tol=1e-6).converged.all()


@pytest.fixture
def clock(monkeypatch):
    """A clock that goes on by a millisecond whenever the simulator reads it."""
    reads = itertools.count(1000)
    fake = SimpleNamespace(perf_counter=lambda: 1e-3 * next(reads))
    for module in (simulator_module, request_module):
        monkeypatch.setattr(module, "time", fake)
    return reads


def test_a_budget_ends_it_and_the_best_so_far_is_returned(scene, forces, clock):
    sim = simulator_of(scene, 0.5)
    whole = sim(forces[0], tol=1e-10, budget_ms=1e6)  # times all stages
    assert whole.converged
    found = []
    for budget in range(1, 80, 6):
        answer = sim(forces[0], tol=1e-10, budget_ms=budget)
        found.append(answer)
        # the prediction is always given; each reading of the clock takes 1 ms, one for a check
        assert answer.milliseconds < max(budget, 7) + 2.5
        assert "prediction" in answer.method or answer.iterations > 0
        assert not answer.converged or answer.iterations == whole.iterations
    counts = [answer.iterations for answer in found]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert found[0].method == "prediction"
    assert len(set(counts)) >= 3
    assert found[-1].converged
    ended = [answer for answer in found if not answer.converged]
    assert all(answer.residual <= found[0].residual for answer in ended)


def test_steps_leave_time_for_the_estimate_of_a_load_out_of_range(scene, clock, monkeypatch):
    sim = simulator_of(scene, 0.9, newton=newton_everywhere(scene))

    def slow(function, milliseconds):
        def call(*args, **options):
            for _ in range(milliseconds):
                next(clock)
            return function(*args, **options)

        return call

    monkeypatch.setattr(
        simulator_module, "estimate_error", slow(simulator_module.estimate_error, 15)
    )
    monkeypatch.setattr(SubspaceNewton, "_step", slow(SubspaceNewton._step, 6))
    force = 3 * scene.loads.sample((0, 9), range(1)).force[0] * scene.force_unit * E
    least = max(sim(force, budget_ms=1e-3).milliseconds for _ in range(3))
    sim(force, budget_ms=1e6)  # times all stages
    for budget in range(10, 60):
        assert sim(force, budget_ms=budget).milliseconds < max(budget, least) + 2.5


def test_several_loads_share_the_time_that_they_took(scene, forces, clock):
    begin = next(clock)
    answer = simulator_of(scene, 0.5)(forces, tol=1e-6)
    spent = next(clock) - begin
    assert (answer.milliseconds > 0).all()
    assert 0.5 * spent < float(answer.milliseconds.sum()) <= spent


@pytest.mark.parametrize("factor", [0.1, 1.0])
def test_loads_of_the_family_lie_inside(scene, factor, sim):
    drawn = scene.loads.sample((0, 10), range(20), amplitude=factor)
    answer = sim(drawn.force * scene.force_unit * E)
    assert (answer.out_of_span < 1e-9).all()
    assert not answer.out_of_distribution.any()


def test_how_far_a_load_lies_outside_is_said(scene, sim):
    largest = scene.loads.eigenmodes.vectors @ (2.5 * scene.loads.q_max)
    reach = torch.where(scene.loads.loadable_dofs, largest, 0.0) * scene.force_unit * E
    answer = sim(reach)
    assert answer.out_of_distribution
    assert answer.amplitude == pytest.approx(2.5)
    assert "out of range by 1.5 times the training's largest" in answer.summary
    inner = torch.zeros(scene.problem.shape, dtype=torch.float64)
    inner[~scene.problem.boundary] = 1.0
    inside = sim(inner)
    assert inside.out_of_distribution
    assert inside.out_of_span == pytest.approx(1.0)
    assert "unlike the training's" in inside.summary


def test_an_unstable_answer_is_said_to_be_unstable(make_scene):
    """A straight column beyond its critical load, which a network holds straight."""
    scene = make_scene(size=(10.0, 1.0, 1.0), nodes=(11, 3, 3))
    force = torch.zeros(1, *scene.problem.shape, dtype=torch.float64)
    end = scene.problem.points[:, 0] == 1.0
    force[:, end, 0] = -2 * math.pi**2 / 4 * (0.1**4 / 12) / int(end.sum())
    sim = simulator_of(scene, lambda load: scene.linear.solve(load.force[0])[None])
    answer = sim(force[0] * E * scene.force_unit, tol=1e-8, stability=True)
    assert answer.converged
    assert answer.negative_pivots > 0
    assert "UNSTABLE" in answer.summary


def test_a_load_without_an_answer_is_said_to_have_none(scene, forces, sim):
    answer = sim(1e6 * forces[0], tol=1e-8)
    assert not answer.converged
    assert "converged" not in answer.summary
    assert "times the training's largest" in answer.summary


def test_the_last_answer_starts_the_next_where_it_is_nearer(scene, forces, truth):
    sim = simulator_of(scene, lambda load: 0.2 * scene.linear.solve(load.force[0])[None])
    first = sim(forces[0], tol=1e-8)
    again = sim(1.001 * forces[0], tol=1e-8, warm=True)
    cold = sim(1.001 * forces[0], tol=1e-8)
    assert (again.method, cold.method) == ("hybrid", "full Newton")
    assert torch.allclose(again.displacement, cold.displacement, atol=1e-6 * scene.length)
    assert not torch.equal(again.displacement, first.displacement)


def test_forces_on_held_nodes_change_nothing(scene, forces, truth):
    """Programs export reactions with the loads; 1e10 N on a clamp are nothing either."""
    held = ~scene.problem.free
    reactions = scene.problem.internal_force(truth / scene.length) * E * scene.force_unit
    seen = []

    def predict(load):
        seen.append(load.force)
        return 0.5 * solution(scene, load)

    sim = simulator_of(scene, predict)
    for tol in (None, 1e-6):
        plain = sim(forces, tol=tol)
        for extra in (-reactions, torch.tensor(1e10, dtype=torch.float64)):
            loaded = sim(torch.where(held, extra, forces), tol=tol)
            assert torch.equal(loaded.displacement, plain.displacement)
            assert torch.equal(loaded.residual, plain.residual)
            assert torch.equal(loaded.amplitude, plain.amplitude)
            assert torch.equal(loaded.out_of_span, plain.out_of_span)
            assert loaded.summary == plain.summary
            assert loaded.method == plain.method
    assert not any(force[:, held].any() for force in seen)
    only = sim(1e10 * held.double(), tol=1e-6)
    assert (only.method, only.amplitude, only.out_of_span) == ("rest", 0.0, 0.0)
    assert not only.displacement.any()


def test_a_network_is_not_told_of_forces_on_held_nodes(make_scene):
    """With weight on all nodes in training it hears of that and of nothing else."""
    weight = torch.full((45, 3), -1e-5, dtype=torch.float64)
    for scene in (make_scene(), make_scene(constant_force=weight)):
        surrogate = Surrogate(FCNN(scene, width=4), MSE(), scene).eval()
        load = scene.loads.sample((0, 9), [0])
        held = load._replace(force=torch.where(scene.problem.free, load.force, 7.0))
        with torch.no_grad():
            assert torch.equal(surrogate.predict(held), surrogate.predict(load))
            scaled, _ = surrogate.predictor.examples(dpl.Sample(load.force, load.force, load.young))
        assert torch.equal(scaled, load.force / surrogate.predictor.force_scale)


@pytest.mark.parametrize(("size", "tol"), [(1e-158, 1e-6), (1e-280, 1e-12)])
def test_tiny_forces_are_answered_as_small_ones_are(scene, forces, size, tol):
    """Their squares are 0 in float64, and so was once ||R|| / ||f||."""
    linear = scene.length * scene.linear.solve(forces[0] / (E * scene.force_unit))
    zero = simulator_of(scene, lambda load: 0 * load.force)
    answer = zero(size * forces[0], tol=tol)
    assert answer.converged
    assert torch.allclose(answer.displacement / size, linear, rtol=1e-9, atol=0)
    assert answer.residual > 0
    assert not zero(size * forces[0]).converged
    stiff = zero(forces[0], young=E / size, tol=tol)
    assert stiff.converged
    assert torch.allclose(stiff.displacement / size, linear, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("size", "tol"), [(1e158, None), (1e290, 1e-6)])
def test_huge_forces_are_never_in_balance(scene, forces, size, tol):
    answer = simulator_of(scene, lambda load: 0 * load.force)(size * forces[0], tol=tol)
    assert not answer.converged
    assert answer.residual == pytest.approx(1.0)


def test_a_tolerance_that_rounding_does_not_allow_is_said_not_to_be_kept(scene, forces, truth, sim):
    with pytest.warns(UserWarning, match="rounding allows no less"):
        answer = sim(forces[0], tol=1e-15, stability=True)
    assert not answer.converged
    assert 1e-15 <= answer.residual < 1e-11
    assert "of the load, the least that rounding allows, " in answer.summary
    assert answer.summary.endswith(", stable")
    assert "converged" not in answer.summary
    assert torch.allclose(answer.displacement, truth[0], rtol=0, atol=1e-6 * scene.length)


REALS = {
    "float32": lambda f: f.astype(np.float32),
    "long double": lambda f: f.astype(np.longdouble),
    "nested lists": lambda f: f.tolist(),
    "objects": lambda f: f.astype(object),
    "negative strides": lambda f: f[::-1, ::-1].copy()[::-1, ::-1],
    "every other": lambda f: np.repeat(f, 2, axis=0)[::2],
    "list of tensors": lambda f: list(torch.from_numpy(f)),
    "tensor with gradient": lambda f: torch.from_numpy(f).requires_grad_(),
    "transposed tensor": lambda f: torch.from_numpy(f.T.copy()).T,
    "half": lambda f: torch.from_numpy(f).half(),
}


@pytest.mark.parametrize("kind", REALS)
def test_real_numbers_are_taken_however_they_are_held(scene, forces, kind, sim):
    array = forces[0].numpy()
    given = REALS[kind](array)
    read_only = array.copy()
    read_only.flags.writeable = False
    answer, plain = sim(given), sim(read_only)
    assert isinstance(answer.displacement, torch.Tensor) == isinstance(given, torch.Tensor)
    exact = "half" not in kind and kind != "float32"
    found = np.asarray(answer.displacement)
    close = {"rtol": 0, "atol": 0} if exact else {"rtol": 0, "atol": 1e-2 * scene.length}
    np.testing.assert_allclose(found, plain.displacement, **close)
    assert answer.residual == pytest.approx(plain.residual, rel=1e-12 if exact else 1e-1)


def test_what_is_given_is_not_changed(scene, forces, sim):
    array = forces[0].numpy().copy()
    before = array.copy()
    held = torch.from_numpy(array)
    sim(array, tol=1e-3)
    sim(held, tol=1e-3)
    assert np.array_equal(array, before)


@pytest.mark.parametrize(
    "value",
    [int(2 * E), np.float32(2 * E), [2 * E], torch.tensor(2 * E), Fraction(int(2 * E))],
    ids=repr,
)
def test_a_modulus_is_any_real_number(scene, forces, value, sim):
    for k in (slice(0, 1), 0):
        found, wanted = sim(forces[k], young=value), sim(forces[k] / 2)
        assert torch.equal(found.displacement, wanted.displacement)


@pytest.mark.parametrize("value", [np.float32(1e-3), np.array(1e-3), torch.tensor(1e-3)])
def test_a_tolerance_is_any_real_number(scene, forces, value, sim):
    answer = sim(forces[0], tol=value, budget_ms=1e9 * value)
    assert answer.converged
    assert answer.residual < 1.001e-3


ABSURD = {
    "text": "1e-3",
    "boolean": True,
    "complex": 1e-3 + 1e-3j,
    "date": np.datetime64("2020-01-01"),
    "number too large": 10**400,
    "unequal rows": [[1.0, 2.0], [3.0]],
    "empty": [],
    "text in objects": np.array(["1e-3"], dtype=object),
    "nothing in objects": np.array([None, 1e-3], dtype=object),
    "masked": np.ma.masked_array([1e-3], [True]),
    "meta tensor": torch.empty(3, device="meta"),
    "sparse tensor": torch.eye(3).to_sparse(),
    "complex tensor": torch.ones(1, dtype=torch.complex128),
    "boolean tensor": torch.ones(1, dtype=torch.bool),
    "NaN": math.nan,
    "infinite": math.inf,
    "minus": -1.0,
}


@pytest.mark.parametrize("kind", ABSURD)
def test_what_is_no_real_number_is_refused_in_a_line_that_names_it(scene, forces, kind, sim):
    for name in ("force", "young", "tol", "budget_ms"):
        requested = {"force": forces[0].numpy(), name: ABSURD[kind]}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(ValueError, match=f"^{name}") as caught:
                sim(**requested)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 300


def test_forces_that_are_refused(scene, forces, sim):
    """Of the right shape, and not real numbers; not finite; or beyond float64 over the modulus."""
    array, free = forces[0].numpy(), scene.problem.free
    gap = [row[:-1] if k == 3 else row for k, row in enumerate(array.tolist())]
    words = r"^force must be real numbers"
    refused = [(np.ma.masked_array(array, array > 0), E, words), (gap, E, words)]
    refused.append(([[1.0, 2.0, 3.0], [1.0]], E, words + "; .*inhomogeneous"))
    for bad in (math.nan, math.inf):
        refused.append((torch.where(free, forces[0], bad), E, "force: a number is not finite"))
    extremes = [(1e-300, E), (5e-324, E), (1.0, 1e300), (1.0, 1e308), (1e300, 1e-300)]
    for size, young in (*extremes, (1.0, 5e-324)):
        words = r"force: its largest entry over E L\^2 must be 0"
        refused.append((size * free.double(), young, words))
        assert sim(0 * forces[0], young=young).method == "rest"
    for force, young, words in refused:
        with pytest.raises(ValueError, match=words) as caught:
            sim(force, young=young)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ratio", [-1.0, -1.5, 0.5, 0.7])
def test_a_poisson_ratio_that_no_solid_has_is_refused(make_scene, ratio):
    scene = make_scene(poisson=[0.2, 0.4])
    sim = simulator_of(scene, lambda load: 0 * load.force)
    force = scene.loads.sample((0, 9), [0]).force[0] * E * scene.force_unit
    with pytest.raises(ValueError, match=r"poisson = .* must lie between -1 and 0\.5"):
        sim(force, parameters={"poisson": ratio})
    with pytest.raises(
        ValueError, match=r"parameters must be one value for each of \['poisson'\].*; it is missing"
    ):
        sim(force)
    for inside in (-0.9, 0.3, 0.49):
        assert sim(force, parameters=[[inside]]).out_of_distribution == (inside != 0.3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"force": np.zeros((3, 3))}, "force: its shape is"),
        ({"force": np.zeros(7)}, "force: its shape is"),
        *(({"error": value}, "error = .* must be above 0") for value in (0.0, -1, math.nan)),
        ({"tol": 0.0}, "tol = 0.0"),
        ({"tol": math.nan}, "tol = nan"),
        ({"tol": 1.0}, "tol = 1.0 must be at least 1e-15 and below 1"),
        ({"tol": 100}, "tol = 100.0 must be"),
        ({"tol": 1e-20}, "tol = 1e-20 must be"),
        ({"tol": [1e-3]}, "tol must be one number"),
        ({"budget_ms": -1.0}, "budget_ms = -1.0"),
        ({"young": 0.0}, "young: a modulus"),
        ({"young": [1.0, 2.0]}, "young: 2 numbers for 1 loads"),
        ({"young": [[E]]}, "young: 1 numbers for 1 loads"),
        ({"young": math.inf}, "young: a number is not finite"),
        (
            {"parameters": {"poisson": 0.3}},
            r"parameters = {'poisson': 0.3} must be .* each of \[\]",
        ),
        ({"parameters": [[0.3]]}, r"parameters must be .* of \[\].* it is of shape \(1, 1\)"),
    ],
    ids=str,
)
def test_what_cannot_be_asked_is_refused_in_words(scene, forces, arguments, words, sim):
    requested = {"force": forces[0].numpy()} | arguments
    with pytest.raises(ValueError, match=words):
        sim(**requested)


def test_a_range_of_moduli_wants_to_know_which(make_scene):
    scene = make_scene(young=[1e9, 2e9])
    sim = simulator_of(scene)
    force = torch.zeros(scene.problem.shape, dtype=torch.float64)
    with pytest.raises(ValueError, match="young: the scene has a range"):
        sim(force)
    with pytest.raises(ValueError, match="steps = -1 must be 0 or more"):
        simulator_of(scene, steps=-1)
    assert sim(force, young=1e12).method == "rest"


def test_a_trained_run_becomes_a_simulator(trained_run, tmp_path):
    run = shutil.copytree(trained_run, tmp_path / "run")
    sim = dpl.load(run)
    force = sim.scene.loads.sample((0, 9), [0]).force[0] * sim.scene.force_unit * E
    answer = sim(force, tol=1e-6)
    assert answer.converged
    assert answer.method in ("hybrid", "full Newton")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("poisson: 0.3", "poisson: 0.35"))
    with pytest.raises(build.ConfigError, match=r"law\.poisson: 0\.3 there, 0\.35 here"):
        dpl.load(run)
    config.write_text(config.read_text().replace("- 5\n  - 3\n  - 3", "- 6\n  - 3\n  - 3"))
    with pytest.raises(build.ConfigError):
        dpl.load(run)


def test_the_corrector_is_the_solver_with_the_same_stiffness(scene):
    assert scene.corrector.linear_solver is scene.solver.linear_solver
    assert scene.corrector.tol == scene.solver.tol
    load = scene.loads.sample((0, 9), [3])
    ours, theirs = (
        solve(Hybrid(lambda load: 0 * load.force, newton), load)
        for newton in (scene.corrector, scene.solver)
    )
    assert torch.allclose(ours.displacement, theirs.displacement, atol=1e-8)
    assert ours.status.tolist() == theirs.status.tolist() == [int(dpl.fem.Status.CONVERGED)]
