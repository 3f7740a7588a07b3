"""Worker processes that end when their parent process ends."""

import multiprocessing
import os
import signal
import threading
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext


def die_with_parent() -> None:
    """End this worker process as soon as its parent process has ended, or at once if it has."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    if not parent.is_alive():
        os._exit(1)
    threading.Thread(target=wait, daemon=True).start()


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
