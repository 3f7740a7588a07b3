"""Calls on several threads."""

import contextlib
import threading

import pytest
import torch

from dpl.system.threads import FEWEST, on_threads, one_thread


@pytest.fixture
def two_threads():
    """Let torch use two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_calls_run_on_as_many_threads_as_torch_uses(two_threads):
    meeting = threading.Barrier(2, timeout=20)  # breaks if one thread makes both calls
    found = on_threads(lambda _: meeting.wait(), range(2 * FEWEST))
    assert sorted(found) == [0] * FEWEST + [1] * FEWEST


def test_results_have_the_order_of_the_items(two_threads):
    assert on_threads(lambda k: k * k, range(50)) == [k * k for k in range(50)]


@pytest.mark.parametrize("count", [2 * FEWEST - 1, 2 * FEWEST])
def test_one_thread_makes_all_calls_itself_if_they_are_few_or_it_is_alone(two_threads, count):
    with one_thread() if count >= 2 * FEWEST else contextlib.nullcontext():
        found = on_threads(lambda _: threading.get_ident(), range(count))
    assert found == [threading.get_ident()] * count


def test_few_items_are_shared_by_the_threads_that_are_asked_for():
    meeting = threading.Barrier(2, timeout=20)
    assert sorted(on_threads(lambda _: meeting.wait(), range(2), 2)) == [0, 1]
