"""Solves loads on many cores: worker processes, supervised.

A worker that dies is replaced and its load tried again; one that hangs is replaced and its load
recorded; Ctrl-C lets loads at work be finished, a second one does not; and whatever becomes of this
process, no worker outlives it.
"""

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.scene import Scene
from dpl.system.processes import block_signals, spawn_context

MAX_RETRIES = 3  # of a load whose worker died, before it is given up
MAX_CONSECUTIVE_CRASHES = 12  # deaths in a row after which the fault is not in the loads
STARTUP_GRACE = 120.0  # more time for a worker's first load: imports, compilation [s]


class GracefulShutdown:
    """Whether somebody wants to stop: a context that takes Ctrl-C and SIGTERM.

    Asked once, it is true. Asked twice, it raises at once where the program is: KeyboardInterrupt,
    or SystemExit after a SIGTERM.
    """

    def __init__(self) -> None:
        """Begin with nobody asking."""
        self._asked = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "GracefulShutdown":
        """Take the signals; threads other than the main one cannot."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back."""
        for number, before in self._before.items():
            signal.signal(number, before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            for each in self._before:  # nothing may interrupt what ends the workers
                signal.signal(each, signal.SIG_IGN)
            self.exit()
        self._asked = number
        # not print: it may be what the signal has interrupted
        os.write(2, b"\nstopping when the loads at work are done; once more to stop at once\n")

    def __bool__(self) -> bool:
        """Return whether somebody has asked."""
        return self._asked != 0

    def exit(self) -> None:
        """Raise what ends a program that was asked to stop; do nothing if nobody has asked."""
        if self._asked == signal.SIGTERM:
            sys.exit(128 + signal.SIGTERM)
        if self._asked:
            raise KeyboardInterrupt


def solve_loads(
    scene: Scene,
    jobs: Iterable[LoadKey],
    *,
    workers: int,
    timeout: float | None = None,
    stop: GracefulShutdown | None = None,
) -> Iterator[SolvedLoad]:
    """Yield loads solved, in the order in which they are finished.

    Args:
        scene: What is simulated.
        jobs: Which loads.
        workers: Processes, one core each; 0 solves in this one, where none can be timed out.
        timeout: Longest time for one load [s], a worker's first one has more; None: no limit.
        stop: Asked before each load whether to begin no more.

    Raises:
        RuntimeError: Workers die one after the other.
    """
    todo, stop = list(jobs)[::-1], GracefulShutdown() if stop is None else stop
    if workers == 0:
        while todo and not stop:
            yield solve_load(scene, todo.pop())
        return
    with WorkerPool(scene, min(workers, len(todo)), timeout) as crew:
        deaths: dict[LoadKey, int] = {}
        in_a_row = 0
        while crew.busy or (todo and not stop):
            while todo and crew.idle and not stop:
                crew.submit(todo.pop())
            if not crew.busy:  # asked to stop between the two looks
                break
            done, dead, hung = crew.wait()
            yield from done
            for job in hung:
                yield failed_load(
                    scene, job, f"timed out after {timeout:g} s", seconds=timeout or 0.0
                )
            in_a_row = 0 if done else in_a_row + len(dead)
            if in_a_row >= MAX_CONSECUTIVE_CRASHES:
                raise RuntimeError(f"{in_a_row} workers died one after the other; see above why")
            for job in dead:
                deaths[job] = deaths.get(job, 0) + 1
                if deaths[job] < MAX_RETRIES:
                    todo.insert(max(0, len(todo) - 8), job)  # after others: is it the load?
                else:
                    yield failed_load(scene, job, f"its worker died {MAX_RETRIES} times")


class WorkerPool:
    """Worker processes, each with a pipe; a context that leaves none of them behind."""

    def __init__(self, scene: Scene, size: int, timeout: float | None) -> None:
        self._context = spawn_context()
        self._scene, self._size, self._timeout = scene, size, timeout
        self._members: dict[Connection, BaseProcess] = {}
        self._deadlines: dict[Connection, float] = {}
        self._fresh: set[Connection] = set()
        self.idle: list[Connection] = []
        self.busy: dict[Connection, LoadKey] = {}

    def __enter__(self) -> "WorkerPool":
        atexit.register(self._end)  # before multiprocessing's, which would wait for workers
        for _ in range(self._size):
            self._spawn()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        atexit.unregister(self._end)

    def _end(self) -> None:
        for process in self._members.values():
            process.kill()
        for pipe, process in self._members.items():
            process.join()
            pipe.close()
        self._members.clear()

    def _spawn(self) -> None:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, self._scene), daemon=True)
        with block_signals(signal.SIGINT, signal.SIGTERM):
            process.start()
        theirs.close()
        self._members[ours] = process
        self._fresh.add(ours)
        self.idle.append(ours)

    def _replace(self, pipe: Connection) -> LoadKey:
        """Put a new worker in the place of one; return its load."""
        process = self._members.pop(pipe)
        process.kill()
        process.join()
        pipe.close()
        self._spawn()
        return self.busy.pop(pipe)

    def submit(self, job: LoadKey) -> None:
        """Hand a load to an idle worker."""
        pipe = self.idle.pop()
        self.busy[pipe] = job
        if self._timeout is not None:
            grace = STARTUP_GRACE if pipe in self._fresh else 0.0
            self._deadlines[pipe] = time.monotonic() + self._timeout + grace
        with contextlib.suppress(BrokenPipeError):  # it died idle: `wait` will see
            pipe.send(job)

    def wait(self) -> tuple[list[SolvedLoad], list[LoadKey], list[LoadKey]]:
        """Return what was finished, the loads whose workers died, and those whose workers hang."""
        done, dead = [], []
        patience = None
        if self._timeout is not None:
            first = min(self._deadlines[pipe] for pipe in self.busy)
            patience = max(0.0, first - time.monotonic())
        for pipe in connection.wait(list(self.busy), patience):
            assert isinstance(pipe, Connection)
            try:
                done.append(pipe.recv())
            except (EOFError, ConnectionResetError):
                dead.append(self._replace(pipe))
                continue
            del self.busy[pipe]
            self._fresh.discard(pipe)
            self.idle.append(pipe)
        now = time.monotonic()
        late = [pipe for pipe in self.busy if self._deadlines.get(pipe, now) < now]
        return done, dead, [self._replace(pipe) for pipe in late]


def _work(pipe: Connection, scene: Scene) -> None:
    """Solve what comes through the pipe until it closes."""
    for number in (signal.SIGINT, signal.SIGTERM):  # whatever has unblocked them here
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            pipe.send(solve_load(scene, pipe.recv()))
