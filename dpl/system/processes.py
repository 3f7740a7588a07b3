"""Worker processes that end with the process that started them."""

import contextlib
import inspect
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import popen_spawn_posix, resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

_starting = threading.Lock()


def die_with_parent(parent: int) -> None:
    """End this process as soon as the one that started it has ended.

    Linux does that by itself (`prctl`), from then on and whatever this process does; elsewhere a
    thread looks twice a second. On Linux the parent's thread that started this process counts.

    Args:
        parent: Number of the process that started this one.
    """
    # imports are in here: a new process is given the source of this function alone
    import os
    import sys

    if sys.platform == "linux":
        import ctypes
        import signal

        set_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    else:
        import threading
        import time

        def watch() -> None:
            while os.getppid() == parent:
                time.sleep(0.5)
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
    if os.getppid() != parent:  # it has ended before
        os._exit(1)


class _Popen(popen_spawn_posix.Popen):
    """A process that calls `die_with_parent` before it imports anything else.

    What `multiprocessing` starts first imports the main module and what its task needs, which takes
    seconds, so that the command of its interpreter has to do it.
    """

    def _launch(self, process_obj: Any) -> None:
        plain = spawn.get_command_line

        def command_line(**fields: Any) -> list[str]:
            words = plain(**fields)
            if "-c" in words:
                place = words.index("-c") + 1
                tie = f"{inspect.getsource(die_with_parent)}\ndie_with_parent({os.getpid()})\n"
                words[place] = tie + words[place]
            return words

        with _starting:
            spawn.get_command_line = command_line
            try:
                super()._launch(process_obj)  # type: ignore[misc]
            finally:
                spawn.get_command_line = plain


class _Process(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: Any) -> _Popen:
        return _Popen(process_obj)


class _Context(SpawnContext):
    Process = _Process


def spawn_context() -> SpawnContext:
    """Return the way to start workers: anew, and tied to the life of this process.

    Forking a process with BLAS threads can hang it. A process of joblib's has a way of its own,
    which those that it spawns do not know by name.
    """
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        multiprocessing.set_start_method("spawn", force=True)
    return _Context()


@contextlib.contextmanager
def block_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Start processes that these signals do not reach: they are their parent's to handle."""
    resource_tracker.ensure_running()  # which would unblock them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
