"""Worker processes that end when their parent process ends."""

import ctypes
import multiprocessing
import os
import signal
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext
from typing import Any


def die_with_parent() -> None:
    """End this worker of `workers_with` as soon as its parent has ended, or at once if it has.

    The kernel does it (`prctl`) with the end of the server, which ends with the last process that
    holds a certain pipe. This worker closes it.
    """
    set_death_signal = 1  # PR_SET_PDEATHSIG
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    os.close(forkserver._forkserver._forkserver_alive_fd)  # type: ignore[attr-defined]
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():  # it ended before the lines above
        os._exit(1)


def workers_with(module: str) -> ForkServerContext:
    """Return a multiprocessing context whose workers have imported a module.

    A server process imports it once, beginning with this call, and forks the workers. It ends after
    this process and them. This process itself, which has BLAS threads, is not forked: that can hang
    a worker. SIGINT and SIGTERM are blocked in the workers; the parent handles them.
    """
    # processes of joblib have a start method that their own workers do not know
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        multiprocessing.set_start_method("forkserver", force=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module])
    resource_tracker.ensure_running()  # its start would unblock the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _forget_server() -> None:
    """Let a process that was forked from this one start a server of its own."""
    server: Any = forkserver._forkserver
    if server._forkserver_alive_fd is not None:
        os.close(server._forkserver_alive_fd)
    server.__init__()


os.register_at_fork(after_in_child=_forget_server)
