"""Worker processes that end when their parent process ends."""

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
    """End this process as soon as its parent process, of this number, has ended.

    The kernel does it (`prctl`). The end of the parent's thread that started this process counts.
    """
    # imports are local, because `_Popen` passes only the source of this function
    import ctypes
    import os
    import signal

    set_death_signal = 1  # PR_SET_PDEATHSIG
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the lines above
        os._exit(1)


class _Popen(popen_spawn_posix.Popen):
    """Starts a process whose command line calls `die_with_parent`, before imports of seconds."""

    def _launch(self, process_obj: Any) -> None:
        plain = spawn.get_command_line

        def command_line(**fields: Any) -> list[str]:
            words = plain(**fields)
            call = f"{inspect.getsource(die_with_parent)}\ndie_with_parent({os.getpid()})\n"
            words[words.index("-c") + 1] = call + words[words.index("-c") + 1]
            return words

        with _starting:
            spawn.get_command_line = command_line
            try:
                super()._launch(process_obj)  # type: ignore[misc]
            finally:
                spawn.get_command_line = plain


class _Process(SpawnProcess):
    _Popen = _Popen


class _Context(SpawnContext):
    Process = _Process


def spawn_context() -> SpawnContext:
    """Return a multiprocessing context that spawns workers which end with this process.

    Workers are not forked, because forking a process with BLAS threads can hang it.
    """
    # processes of joblib have a start method that their own workers do not know
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        multiprocessing.set_start_method("spawn", force=True)
    return _Context()


@contextlib.contextmanager
def block_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals in the processes that are started in this context; the parent handles them."""
    resource_tracker.ensure_running()  # its start would unblock them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
