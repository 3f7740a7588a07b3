"""Laws of the network-started Newton: as exact as Newton's, and never worse led than the classic.

The predictions are exact solutions with noise, and predictions that are useless.
"""

from itertools import cycle
from types import SimpleNamespace

import pytest
import torch

from dpl.fem import AndersonSolver, Load, Newton, Problem, Solution, Status, solve
from dpl.fem.linear import SuperLU
from dpl.inference import Direct, Hybrid, default_hybrid, prefer_prediction
from dpl.inference.hybrid import RULES


@pytest.fixture(scope="module")
def loads(scene) -> Load:
    """Four loads that need several iterations, the last one the largest."""
    drawn = scene.loads.sample((9, 9), range(12))
    largest = drawn.force.flatten(1).norm(dim=1).argsort()[-4:]
    return Load(drawn.force[largest], drawn.young[largest])


@pytest.fixture(scope="module")
def truth(scene, loads):
    """The displacements to far below any tolerance."""
    return solve(Newton(scene.problem, tol=1e-12, linear="superlu"), loads).displacement


def noise(truth, free, size):
    random = torch.Generator().manual_seed(0)
    return torch.where(
        free, size * torch.randn(truth.shape, generator=random, dtype=torch.float64), 0.0
    )


@pytest.fixture(scope="module")
def stubs(scene, loads, truth):
    """Predictions (B, N, D) by name."""
    free = scene.problem.free
    one_nan = truth.clone()
    one_nan[:, -1, 0] = torch.nan
    inverted = torch.where(free, -1.5 * scene.problem.points, 0.0).expand_as(truth).clone()
    return {
        "nan": torch.full_like(truth, torch.nan),
        "one nan": one_nan,
        "inf": torch.where(free, torch.inf, torch.zeros_like(truth)),
        "inverted": inverted,
        "huge": 1e6 * truth,
        "zero": torch.zeros_like(truth),
        "exact": truth.clone(),
        "half": 0.5 * truth,
        "minus": -truth,
        **{f"noise {e:g}": truth + noise(truth, free, e) for e in (1e-2, 1e-3, 1e-4, 1e-5)},
    }


USELESS = ["nan", "one nan", "inf", "inverted"]
STUBS = [*USELESS, "huge", "zero", "exact", "half", "minus"]
STUBS += [f"noise {e:g}" for e in (1e-2, 1e-3, 1e-4, 1e-5)]

RULED = pytest.mark.parametrize("rule", RULES)
EVERY = pytest.mark.parametrize("rule", [*RULES, "steps"])
MIXED = [*zip(STUBS, cycle([*RULES, "steps"]), strict=False)]
MIXED += [(name, "steps") for name in USELESS if (name, "steps") not in MIXED]


def hybrid(scene, loads, prediction, rule="natural_monotonicity"):
    """Return the hybrid whose network knows the answers to these loads."""

    def predict(load):
        same = (load.force[:, None] == loads.force[None]).flatten(2).all(dim=2)
        return prediction[same.double().argmax(dim=1)]

    if rule == "steps":
        return Hybrid(predict, scene.solver, steps=AndersonSolver(scene.solver))
    return Hybrid(predict, scene.solver, rule)


def first_of(load):
    return Load(load.force[-1:], load.young[-1:])


def same(one: Solution, other: Solution):
    """Whether two solutions agree to the last bit in all but the time that they took."""
    pairs = zip(one._replace(seconds=other.seconds), other, strict=True)
    return all(torch.equal(torch.nan_to_num(a), torch.nan_to_num(b)) for a, b in pairs)


@pytest.fixture
def counted(monkeypatch):
    """Counts of assembled tangents and of factorisations."""
    counts = {"linearise": 0, "factorise": 0}

    def count(owner, name):
        original = getattr(owner, name)

        def counting(*args, **kwargs):
            counts[name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, counting)

    count(Problem, "linearise")
    count(SuperLU, "factorise")
    return counts


@pytest.mark.parametrize(("name", "rule"), MIXED)
def test_whatever_is_predicted_the_answer_is_newtons(rule, scene, loads, truth, stubs, name):
    answer = solve(hybrid(scene, loads, stubs[name], rule), loads)
    assert answer.converged.all()
    assert (answer.residual < scene.solver.tol).all()
    assert (answer.volume_ratio > 0).all()
    assert torch.allclose(answer.displacement, truth, rtol=0, atol=1e-8)
    assert not answer.displacement[:, ~scene.problem.free].any()


@pytest.mark.parametrize(("name", "rule"), [one for one in MIXED if one[0] in USELESS])
def test_a_useless_prediction_leaves_the_classic_path_bit_for_bit(rule, scene, loads, stubs, name):
    """The classic step is taken once, not thrown away and taken again."""
    load = first_of(loads)
    _, *path = hybrid(scene, loads, stubs[name], rule).iterate(load)
    _, *classic = scene.solver.iterate(load)
    assert torch.equal(path[0].displacement, classic[0].displacement)
    assert torch.equal(path[-1].displacement, classic[-1].displacement)
    assert torch.equal(path[-1].residual, classic[-1].residual)
    inner = [state.displacement.numpy().tobytes() for state in path]
    assert list(dict.fromkeys(inner)) == [s.displacement.numpy().tobytes() for s in classic]
    assert torch.equal(path[-1].iterations, classic[-1].iterations)


@EVERY
def test_an_exact_prediction_costs_no_iteration_no_tangent_and_no_factor(
    rule, scene, loads, stubs, counted
):
    """The counters see what Newton's method assembles for another prediction."""
    solve(hybrid(scene, loads, torch.zeros_like(loads.force)), first_of(loads))
    assert counted["linearise"] >= counted["factorise"] >= 2
    counted.update(linearise=0, factorise=0)
    states = list(hybrid(scene, loads, stubs["exact"], rule).iterate(loads))
    assert counted == {"linearise": 0, "factorise": 0}
    assert len(states) == 1
    assert states[-1].converged.all()
    assert not states[-1].iterations.any()
    assert not states[-1].factorisations.any()
    assert torch.equal(states[-1].displacement, stubs["exact"])


@pytest.mark.parametrize("name", [name for name in STUBS if name != "exact"])
def test_the_prediction_is_used_exactly_where_its_residual_is_smaller(scene, loads, stubs, name):
    load, problem = first_of(loads), scene.problem
    guess = stubs[name][-1:]
    predicted, first, *rest = hybrid(scene, loads, stubs[name], "paper").iterate(load)
    assert not predicted.converged
    _, classic, *_ = scene.solver.iterate(load)
    assert torch.equal(first.displacement, classic.displacement)
    ratio_p = float(problem.relative_residual(guess, load.force))
    ratio_1 = float(problem.relative_residual(classic.displacement, load.force))
    valid = bool(problem.volume_ratio(guess) > 0)
    used = valid and ratio_p < ratio_1  # False where ratio_p is NaN
    assert prefer_prediction(predicted, first) == used
    start = guess if used else classic.displacement
    assert any(torch.equal(state.displacement, start) for state in (first, *rest))


@pytest.mark.parametrize(
    ("ratio_p", "ratio_1", "volume", "used"),
    [
        (0.5, 1.0, 0.9, True),
        *((ratio, 1.0, 0.9, False) for ratio in (1.0, 2.0, torch.nan, torch.inf)),
        *((0.5, 1.0, volume, False) for volume in (0.0, -1.0, -torch.inf, torch.nan)),
    ],
)
def test_the_pick_rule_is_a_smaller_residual_with_nothing_inverted(ratio_p, ratio_1, volume, used):
    predicted, first = (
        SimpleNamespace(residual=torch.tensor([r]), volume_ratio=torch.tensor([v]))
        for r, v in ((ratio_p, volume), (ratio_1, 0.9))
    )
    assert prefer_prediction(predicted, first) is used


@pytest.mark.parametrize("size", [1e-3, 1e-5])
def test_from_a_good_prediction_no_tangent_is_needed(scene, loads, stubs, size, counted):
    scene.solver.linear_solver.corotational  # noqa: B018  # its factor is the scene's
    before = dict(counted)
    states = list(hybrid(scene, loads, stubs[f"noise {size:g}"], "steps").iterate(loads))
    assert counted == before
    assert states[-1].converged.all()
    assert not states[-1].factorisations.any()
    assert states[-1].from_guess.all()


def test_the_hybrid_that_suits_a_scene_has_its_tolerance(scene, stubs):
    for tol, wanted in ((None, scene.solver.tol), (1e-3, 1e-3)):
        suited = default_hybrid(lambda load: 0 * load.force, scene, tol)
        assert suited.newton.tol == wanted
        assert suited.newton.linear_solver is scene.solver.linear_solver
        assert (suited.steps is not None) == scene.is_compact
    for compact in (False, True):
        body = SimpleNamespace(corrector=scene.solver, is_compact=compact)
        suited = default_hybrid(lambda load: load.force, body)
        assert suited.newton is scene.solver
        assert (suited.steps is not None) == compact
        assert not compact or suited.steps.newton is scene.solver


def test_the_discarded_classic_step_is_counted(scene, loads, stubs):
    load = first_of(loads)
    guess = stubs["noise 0.0001"][-1:]
    predicted, first, *_ = hybrid(scene, loads, stubs["noise 0.0001"], "paper").iterate(load)
    assert prefer_prediction(predicted, first)
    from_guess = [*scene.solver.iterate(load, guess=guess)][-1]
    answer = solve(hybrid(scene, loads, stubs["noise 0.0001"], "paper"), load)
    assert int(answer.iterations) == int(from_guess.iterations) + 1


class Scripted:
    """A corrector whose iterates are given: lengths along one degree of freedom.

    Attributes:
        problem, tol: As of any corrector.
        guessed: Iterates from a guess, the guess first.
        classic: Iterates from rest.
        ends: Which iterate from the guess is in balance; None: none is.
        lost: From which iterate on it does not go on from the guess any more.
    """

    def __init__(self, problem, guessed, *, ends=None, lost=None):
        self.problem, self.tol = problem, 1e-8
        self.guessed, self.classic = guessed, (0.0, 7.0, 8.0)
        self.ends, self.lost = ends, lost

    def iterate(self, load, *, guess=None):
        way = self.classic if guess is None else self.guessed
        for k, x in enumerate(way):
            ended = k == (2 if guess is None else self.ends)
            u = torch.zeros_like(load.force)
            u[:, -1, 0] = x
            good = int(Status.CONVERGED if ended else Status.NOT_CONVERGED)
            yield Solution(
                displacement=u,
                internal=u,
                residual=torch.ones(1),
                volume_ratio=torch.ones(1),
                status=torch.tensor([good]),
                negative_pivots=torch.zeros(1, dtype=torch.int64),
                iterations=torch.tensor([k]),
                factorisations=torch.tensor([10 * k]),
                load_factor=torch.zeros(1),
                seconds=torch.tensor([100.0 * k]),
                from_guess=torch.tensor([guess is not None and (not self.lost or k < self.lost)]),
            )


def followed(scene, loads, guessed, **how):
    """Return the iterates that a hybrid shows of a scripted corrector, and their iterations."""
    corrector = Scripted(scene.problem, guessed, **how)
    states = list(Hybrid(lambda load: load.force, corrector).iterate(first_of(loads)))
    assert all(s.factorisations == 10 * s.iterations for s in states)
    assert all(s.seconds == 100 * s.iterations for s in states)
    return [float(s.displacement[0, -1, 0]) for s in states], [int(s.iterations) for s in states]


@pytest.mark.parametrize(
    ("guessed", "goes_on"),
    [
        # the first correction is less than half of where it leads, upwards and downwards
        *(((1.0, x), True) for x in (1.99, 0.67)),
        *(((1.0, x), False) for x in (2.01, 2.0, 0.66, torch.nan, torch.inf)),
        ((0.0, 1e-9), False),
        # the second one is less than half of the first, or a tenth of where it leads
        *(((1.0, 1.4, x), x < 1.6) for x in (1.59, 1.61)),
        *(((1.0, 1.01, x), x < 1.125) for x in (1.12, 1.13)),
        ((1.0, 1.0, 1.11), True),
        # the third one and those that follow are less than half of the one before
        *(((1.0, 1.2, 1.28, x), x < 1.32) for x in (1.319, 1.321)),
        ((1.0, 1.2, 1.21, 1.2151), False),
        *(((1.0, 1.2, 1.28, 1.31, x), x < 1.325) for x in (1.324, 1.326)),
    ],
)
def test_newton_goes_on_from_a_prediction_while_its_corrections_contract(
    scene, loads, guessed, goes_on
):
    """The rule that `Hybrid` states, at its limits."""
    shown, counts = followed(scene, loads, guessed)
    if goes_on:
        assert shown == list(guessed)
        assert counts == list(range(len(guessed)))
        return
    spent = len(guessed) - 1
    assert shown == [*guessed[:-1], 7.0, 8.0], "the classic path, its start at rest left out"
    assert counts == [*range(spent), spent + 1, spent + 2], "what was discarded counts"


def test_an_answer_is_taken_whatever_correction_led_to_it_and_a_guess_is_given_up_with_newton(
    scene, loads
):
    """Newton would go on in load steps from the last equilibrium; the classic path is known."""
    assert followed(scene, loads, (1.0, 5.0), ends=1) == ([1.0, 5.0], [0, 1])
    assert followed(scene, loads, (1.0, 1.2, 9.0), ends=2) == ([1.0, 1.2, 9.0], [0, 1, 2])
    lost = followed(scene, loads, (1.0, 1.2, 1.21, 1.211), lost=2)
    assert lost == ([1.0, 1.2, 7.0, 8.0], [0, 1, 3, 4])


def test_a_guess_that_newton_never_took_leaves_its_path_alone(scene, loads):
    """Newton began at rest: there is nothing to go back to."""
    corrector = Scripted(scene.problem, (0.0, 5.0, -9.0, 3.0))
    original = corrector.iterate
    corrector.iterate = lambda load, guess=None: (
        state._replace(from_guess=torch.tensor([False])) for state in original(load, guess=guess)
    )
    states = list(Hybrid(lambda load: load.force, corrector).iterate(first_of(loads)))
    assert [float(s.displacement[0, -1, 0]) for s in states] == [0.0, 5.0, -9.0, 3.0]


class Steps:
    """Scripted steps from a guess: places, residuals, volume ratios; the last may be an answer."""

    def __init__(self, *steps, ends=False):
        self.steps, self.ends = steps, ends

    def iterate(self, load, *, guess, evaluation=None):
        for k, (x, residual, volume) in enumerate(self.steps):
            (state,) = list(Scripted(None, (x,), ends=None).iterate(load, guess=guess))
            ended = self.ends and k == len(self.steps) - 1
            yield state._replace(
                residual=torch.tensor([residual]),
                volume_ratio=torch.tensor([volume]),
                iterations=torch.tensor([k]),
                status=torch.tensor([int(Status.CONVERGED if ended else Status.NOT_CONVERGED)]),
            )


def stepped(scene, loads, steps):
    """Return what a hybrid shows after scripted steps, their iterations, and Newton's guesses."""
    corrector, guesses = Scripted(scene.problem, (3.0, 3.1, 3.11)), []
    original = corrector.iterate

    def iterate(load, *, guess=None):
        guesses.append(float(guess[0, -1, 0]))
        return original(load, guess=guess)

    corrector.iterate = iterate
    given = torch.full_like(first_of(loads).force, 4.0)
    states = list(Hybrid(lambda load: given, corrector, steps=steps).iterate(first_of(loads)))
    places = [float(s.displacement[0, -1, 0]) for s in states]
    return places, [int(s.iterations) for s in states], guesses


@pytest.mark.parametrize("least", range(3))
def test_newton_goes_on_from_the_step_with_the_smallest_residual(scene, loads, least):
    residuals = [0.5, 0.4, 0.3]
    residuals[least] = 0.1
    steps = Steps(*((float(10 + k), r, 1.0) for k, r in enumerate(residuals)))
    shown, counts, guesses = stepped(scene, loads, steps)
    assert guesses == [10.0 + least]
    assert shown == [10.0, 11.0, 12.0, 3.1, 3.11], "Newton's start has been shown"
    assert counts == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("volume", [0.0, -1.0, torch.nan])
def test_a_step_that_inverts_an_element_is_not_shown_and_not_gone_on_from(scene, loads, volume):
    steps = Steps((10.0, 0.5, 1.0), (11.0, 1e-3, volume), (12.0, 1e-6, 1.0))
    shown, counts, guesses = stepped(scene, loads, steps)
    assert guesses == [10.0]
    assert shown == [10.0, 3.1, 3.11]
    assert counts == [0, 2, 3], "it counts"
    shown, counts, guesses = stepped(scene, loads, Steps((10.0, 0.5, volume), (11.0, 0.1, 1.0)))
    assert guesses == [4.0], "Newton says itself what it starts from"
    assert shown == [3.0, 3.1, 3.11]


def test_steps_that_end_at_the_answer_need_no_newton(scene, loads):
    steps = Steps((10.0, 0.5, 1.0), (11.0, 1e-9, 1.0), ends=True)
    assert stepped(scene, loads, steps) == ([10.0, 11.0], [0, 1], [])


@pytest.mark.parametrize("rule", ["", "Best", "papers", None])
def test_a_rule_that_there_is_not_is_refused(scene, rule):
    with pytest.raises(ValueError, match="must be natural_monotonicity or paper"):
        Hybrid(lambda load: load.force, scene.solver, rule)


@RULED
def test_it_is_said_what_goes_on_from_a_guess(scene, loads, stubs, rule):
    load = first_of(loads)
    for name, guessed in (("noise 0.0001", True), ("nan", False)):
        first, *_, last = hybrid(scene, loads, stubs[name], rule).iterate(load)
        assert bool(first.from_guess) == (guessed or rule == "paper")
        assert bool(last.from_guess) == guessed


@pytest.mark.parametrize("part", [-1.0, 0.5, 1.5])
def test_a_poor_prediction_is_given_up_for_the_classic_path(scene, loads, truth, part):
    """Newton itself would go on from it: 8 to 13 iterations where 6 from rest are enough."""
    load, guess = first_of(loads), part * truth[-1:]
    states = list(Hybrid(lambda load: guess, scene.solver).iterate(load))
    alone = [*scene.solver.iterate(load, guess=guess)][-1]
    _, *classic = scene.solver.iterate(load)
    assert states[0].from_guess.all()
    assert not states[-1].from_guess.any()
    spent = int(states[-1].iterations - classic[-1].iterations)
    assert 1 <= spent <= 3
    assert int(states[-1].iterations) < int(alone.iterations) + spent
    for one, other in zip(states[-len(classic) :], classic, strict=True):
        assert torch.equal(one.displacement, other.displacement)
        assert int(one.iterations - other.iterations) == spent


@pytest.mark.parametrize("size", [1e-3, 1e-5])
def test_a_good_prediction_is_kept_to_the_end(scene, loads, stubs, size):
    load, guess = first_of(loads), stubs[f"noise {size:g}"][-1:]
    states = list(Hybrid(lambda load: guess, scene.solver).iterate(load))
    alone = list(scene.solver.iterate(load, guess=guess))
    assert all(state.from_guess.all() for state in states)
    assert len(states) == len(alone)
    assert all(same(one, other) for one, other in zip(states, alone, strict=True))
    assert int(states[-1].iterations) < int(solve(scene.solver, load).iterations)


@EVERY
def test_a_batch_is_its_members(rule, scene, loads, stubs):
    names = ("nan", "exact", "noise 0.001", "inverted")
    mixed = torch.stack([stubs[name][k] for k, name in enumerate(names)])
    whole = solve(hybrid(scene, loads, mixed, rule), loads)
    parts = [solve(hybrid(scene, loads, mixed, rule), load) for load in loads.unbatch()]
    assert same(whole, Solution(*(torch.cat(column) for column in zip(*parts, strict=True))))


def test_no_load_costs_nothing(scene, counted):
    rest = Load(torch.zeros(1, *scene.problem.shape, dtype=torch.float64), torch.ones(1))
    zero = solve(Hybrid(lambda load: torch.zeros_like(load.force), scene.solver), rest)
    assert zero.converged
    assert not zero.displacement.any()
    assert counted == {"linearise": 0, "factorise": 0}
    bent = solve(Hybrid(lambda load: load.force + 0.01 * scene.problem.free, scene.solver), rest)
    assert bent.converged
    assert not bent.displacement.any(), "a body without load is at rest, whatever is predicted"


def test_a_single_load_is_answered_with_one_call_of_the_network(scene, loads, stubs):
    calls = []

    def predict(load):
        calls.append(len(load.force))
        assert not torch.is_grad_enabled()
        return stubs["half"]

    solve(Hybrid(predict, scene.solver), loads)
    assert calls == [4]


@pytest.mark.parametrize("name", [*USELESS, "huge", "exact", "noise 0.001"])
def test_the_network_alone_is_judged_at_what_it_says(scene, loads, stubs, name, counted):
    solver = Direct(lambda load: stubs[name], scene.problem)
    (answer,) = solver.iterate(loads)
    problem = scene.problem
    assert torch.equal(torch.nan_to_num(answer.displacement), torch.nan_to_num(stubs[name]))
    ratio = problem.relative_residual(stubs[name], loads.force)
    assert torch.equal(torch.nan_to_num(answer.residual), torch.nan_to_num(ratio))
    assert torch.equal(answer.volume_ratio, problem.evaluate(stubs[name]).volume_ratio)
    assert answer.converged.all() == (name == "exact")
    assert answer.converged.any() == (name == "exact")
    assert not answer.iterations.any()
    assert answer.from_guess.all()
    assert counted == {"linearise": 0, "factorise": 0}


def test_the_network_alone_converges_where_its_own_tolerance_is_met(scene, loads, stubs):
    guess = stubs["noise 1e-05"]
    ratio = float(scene.problem.relative_residual(guess, loads.force).max())
    for tol, met in ((1.01 * ratio, True), (0.99 * ratio, False)):
        answer = solve(Direct(lambda load: guess, scene.problem, tol), loads)
        assert bool(answer.converged.all()) is met
