"""Laws of load stepping and of the guard against inverted elements."""

import math
from typing import NamedTuple

import pytest

from dpl.fem.solvers.load_stepping import LoadStepping, longest_valid_step


def test_whole_load_comes_first():
    steps = LoadStepping(0.1)
    assert steps.target == 1
    steps.accept()
    assert steps.factor == 1


def test_failed_steps_are_halved_and_accepted_steps_doubled():
    steps = LoadStepping(0.01)
    steps.reject()
    steps.reject()
    assert steps.target == 0.25
    steps.accept()
    assert (steps.factor, steps.step, steps.target) == (0.25, 0.5, 0.75)
    steps.accept()
    assert steps.target == 1  # not 0.75 + 1
    steps.reject()
    assert steps.step == 0.125  # half of the part that was left


def test_steps_below_the_smallest_one_are_exhausted():
    steps = LoadStepping(0.25)
    steps.reject()
    steps.reject()
    assert not steps.exhausted
    steps.reject()
    assert steps.exhausted


class State(NamedTuple):
    """A state after a step."""

    length: float
    volume_ratio: float


@pytest.mark.parametrize(("largest", "expected"), [(2.0, 1.0), (0.3, 0.25), (2**-9, 2**-9)])
def test_longest_step_that_inverts_nothing_is_taken(largest, expected):
    found = longest_valid_step(lambda s: State(s, 1.0 if s <= largest else -1.0), 0.2)
    assert found == State(expected, 1.0)


@pytest.mark.parametrize("ratio", [0.2, -1.0, math.nan])
def test_no_step_is_taken_where_all_violate_the_bound(ratio):
    tried = []

    def state_after(length):
        tried.append(length)
        return State(length, ratio)

    assert longest_valid_step(state_after, 0.2, halvings=3) is None
    assert tried == [1.0, 0.5, 0.25, 0.125]
