"""Order of the solutions of a call, and its budget."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpl.inference.request import FINISH, Candidate, Durations, Request


def candidate(residual, error, volume_ratio=0.5, *, converged=False):
    """Return a solution of which only the numbers of the order are known."""
    numbers = {"residual": residual, "volume_ratio": volume_ratio, "converged": converged}
    state = SimpleNamespace(**{name: torch.tensor([one]) for name, one in numbers.items()})
    return Candidate("prediction", state, error)


@pytest.mark.parametrize(
    ("options", "better"),
    [
        ((None, None, None), candidate(0.9, 0.1)),
        ((None, None, 1e-3), candidate(0.9, 0.1)),
        ((1e-6, None, 1e-3), candidate(0.9, 0.1)),
        ((1e-6, None, None), candidate(0.1, 0.9)),
        ((None, 10.0, None), candidate(0.1, 0.9)),
        ((1e-6, 10.0, None), candidate(0.1, 0.9)),
    ],
)
def test_an_inverted_solution_is_behind_every_valid_one(options, better):
    """Among valid ones the estimated error or the residual decides; NaN is last.

    Options are tol, budget_ms and error.
    """
    wanted = [
        candidate(0.9, 0.9, converged=True),
        better,
        candidate(0.5, 0.5),
        candidate(math.nan, None),
        candidate(1e-9, 1e-9, volume_ratio=-0.1),
        candidate(2e-9, 2e-9, volume_ratio=math.nan),
        candidate(math.nan, None, volume_ratio=0.0),
    ]
    request = Request(*options)
    ranks = [request.rank(one) for one in wanted]
    assert ranks == sorted(ranks)
    assert len(set(ranks)) == len(ranks)


@pytest.mark.parametrize("budget", [5.0, 10.0, 14.0, 30.0])
def test_calls_whose_stages_take_random_times_keep_their_budget(monkeypatch, budget):
    """At most 1 % of 1,000 calls exceed it by 20 %; stages that never fit are hardly tried."""
    now, rng, durations = [0.0], np.random.default_rng(0), Durations()
    clock = SimpleNamespace(perf_counter=lambda: now[0])
    monkeypatch.setattr("dpl.inference.request.time", clock)

    def run(stage, milliseconds):
        with durations.timed(stage):
            now[0] += 1e-3 * milliseconds * rng.lognormal(sigma=0.2)

    late = iterations = tried = 0
    for _ in range(1000):
        request = Request(budget_ms=budget, durations=durations)
        run("prediction", 1.0)
        while not request.over("iteration"):
            run("iteration", 1.0)
            iterations += 1
        if not request.over("Newton"):
            run("Newton", 100.0)
            tried += 1
        run(FINISH, 1.0)
        late += 1e3 * (now[0] - request.begin) > 1.2 * budget
    assert 1 <= late <= 10
    assert tried == 1
    assert iterations > 1000 * (budget - 4)


def test_one_slow_run_does_not_prevent_a_stage_for_ever():
    durations = Durations()
    request = Request(budget_ms=1e9, durations=durations)
    durations.add("iteration", 1e12)
    refused = 0
    while request.over("iteration"):
        refused += 1
    assert 100 < refused < 5000


def test_refusals_of_a_stage_without_a_time_do_not_hide_its_first_time():
    durations = Durations()
    request = Request(budget_ms=1.0, durations=durations)
    durations.add(FINISH, 10.0)
    assert all(request.over("iteration") for _ in range(30))
    durations.add("iteration", 5.0)
    assert durations.forecast("iteration") == 5.0
