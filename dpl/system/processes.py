"""Worker processes that end when their parent process ends."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext


def die_with_parent() -> None:
    """End this worker process as soon as its parent process has ended, or at once if it has.

    The kernel does it (`prctl`). The end of the parent's thread that started this process counts.
    """
    set_death_signal = 1  # PR_SET_PDEATHSIG
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None and os.getppid() != parent.pid:  # it ended before the lines above
        os._exit(1)


def spawn_context() -> SpawnContext:
    """Return a multiprocessing context that spawns workers.

    Workers are not forked, because forking a process with BLAS threads can hang it.
    """
    # processes of joblib have a start method that their own workers do not know
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        multiprocessing.set_start_method("spawn", force=True)
    return multiprocessing.get_context("spawn")


@contextlib.contextmanager
def block_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals in the processes that are started in this context; the parent handles them."""
    resource_tracker.ensure_running()  # its start would unblock them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
