"""Calls on several threads."""

import threading

import pytest
import torch

from dpl.system.threads import on_threads, one_thread


@pytest.fixture
def two_threads():
    """Let torch use two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_calls_run_on_as_many_threads_as_torch_uses(two_threads):
    meeting = threading.Barrier(2, timeout=20)  # breaks if one thread makes both calls
    assert sorted(on_threads(lambda _: meeting.wait(), range(2))) == [0, 1]


def test_results_have_the_order_of_the_items(two_threads):
    assert on_threads(lambda k: k * k, range(9)) == [k * k for k in range(9)]


def test_one_thread_makes_all_calls_itself(two_threads):
    with one_thread():
        assert on_threads(lambda _: threading.get_ident(), range(3)) == [threading.get_ident()] * 3
