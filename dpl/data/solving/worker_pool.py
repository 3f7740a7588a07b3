"""Pool of supervised worker processes that solve loads.

- A worker that dies is replaced, and its load is tried again.
- A worker that exceeds the time limit is replaced, and its load is recorded as failed.
- After the first SIGINT or SIGTERM the solves in progress are finished; the second one aborts them.
- No worker outlives this process.
"""

import atexit
import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import FrameType
from typing import Any

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.scene import Scene
from dpl.system.processes import block_signals, spawn_context

MAX_RETRIES = 3  # tries of a load whose worker dies
MAX_CONSECUTIVE_CRASHES = 12  # without a solved load in between; the loads are not the cause
STARTUP_GRACE = 120.0  # additional time for the first load of a worker: imports, compilation [s]
RETRY_DELAY = 8  # loads that are solved before a load whose worker died is tried again


class GracefulShutdown:
    """Context manager that turns the first SIGINT or SIGTERM into a flag, which is its truth value.

    The second one raises KeyboardInterrupt, or SystemExit if the first one was a SIGTERM.
    """

    def __init__(self) -> None:
        """Start without a request."""
        self._requested = 0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "GracefulShutdown":
        """Install the signal handlers, which is possible in the main thread only."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            for each in self._previous:  # the termination of the workers must not be interrupted
                signal.signal(each, signal.SIG_IGN)
            self.exit()
        self._requested = number
        # not print, which is not reentrant and may be what the signal has interrupted
        os.write(2, b"\nFinishing the solves in progress. Press Ctrl-C again to abort.\n")

    def __bool__(self) -> bool:
        """Return True after the first signal."""
        return self._requested != 0

    def exit(self) -> None:
        """Raise KeyboardInterrupt or SystemExit after a signal; do nothing without one."""
        if self._requested == signal.SIGTERM:
            sys.exit(128 + signal.SIGTERM)
        if self._requested:
            raise KeyboardInterrupt


def solve_loads(
    scene: Scene,
    jobs: Iterable[LoadKey],
    *,
    workers: int,
    timeout: float | None = None,
    stop: GracefulShutdown | None = None,
) -> Iterator[SolvedLoad]:
    """Yield solved loads in the order in which they are finished.

    Args:
        scene: Scene of the loads.
        jobs: Identifiers of the loads.
        workers: Number of processes, one core each; 0: solve in this process, without time limit.
        timeout: Time limit for a load [s]; the first load of a worker has more. None: no limit.
        stop: Once it is true, no further load is started.

    Raises:
        RuntimeError: Workers die repeatedly.
    """
    todo, stop = list(jobs)[::-1], GracefulShutdown() if stop is None else stop
    if workers == 0:
        while todo and not stop:
            yield solve_load(scene, todo.pop())
        return
    with WorkerPool(scene, min(workers, len(todo)), timeout) as pool:
        crashes: Counter[LoadKey] = Counter()
        consecutive = 0
        while pool.busy or (todo and not stop):
            while todo and pool.idle and not stop:
                pool.submit(todo.pop())
            if not pool.busy:  # the stop was requested after the condition of the outer loop
                break
            solved, crashed, late = pool.wait()
            yield from solved
            for job in late:
                reason = f"timed out after {timeout:g} s"
                yield failed_load(scene, job, reason, seconds=timeout or 0.0)
            consecutive = 0 if solved else consecutive + len(crashed)
            if consecutive >= MAX_CONSECUTIVE_CRASHES:
                raise RuntimeError(f"{consecutive} workers died in a row; see the errors above")
            for job in crashed:
                crashes[job] += 1
                if crashes[job] < MAX_RETRIES:
                    todo.insert(max(0, len(todo) - RETRY_DELAY), job)
                else:
                    yield failed_load(scene, job, f"its worker died {MAX_RETRIES} times")


@dataclass(eq=False)
class _Worker:
    """A worker process.

    Attributes:
        process: The process.
        pipe: Connection to it.
        job: Load that it solves; None: it is idle.
        deadline: Time at which the load counts as timed out [s].
        warm: True after its first load.
    """

    process: BaseProcess
    pipe: Connection
    job: LoadKey | None = None
    deadline: float = math.inf
    warm: bool = False

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


class WorkerPool:
    """Worker processes with a pipe each; a context manager that ends them all."""

    def __init__(self, scene: Scene, size: int, timeout: float | None) -> None:
        self._context = spawn_context()
        self._scene = scene
        self._size = size
        self._timeout = math.inf if timeout is None else timeout
        self._workers: list[_Worker] = []

    def __enter__(self) -> "WorkerPool":
        atexit.register(self._kill_all)  # runs before multiprocessing's, which joins the workers
        for _ in range(self._size):
            self._spawn()
        return self

    def __exit__(self, *_: object) -> None:
        self._kill_all()
        atexit.unregister(self._kill_all)

    def _kill_all(self) -> None:
        for worker in self._workers:
            worker.process.kill()
        while self._workers:
            self._workers.pop().kill()

    def _spawn(self) -> None:
        pipe, far_end = self._context.Pipe()
        process = self._context.Process(target=_work, args=(far_end, self._scene), daemon=True)
        with block_signals(signal.SIGINT, signal.SIGTERM):
            process.start()
        far_end.close()
        self._workers.append(_Worker(process, pipe))

    @property
    def idle(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.job is None]

    @property
    def busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.job is not None]

    def submit(self, job: LoadKey) -> None:
        """Send a load to an idle worker."""
        worker = self.idle[-1]
        worker.job = job
        grace = 0.0 if worker.warm else STARTUP_GRACE
        worker.deadline = time.monotonic() + self._timeout + grace
        with contextlib.suppress(BrokenPipeError):  # `wait` detects that it died while idle
            worker.pipe.send(job)

    def wait(self) -> tuple[list[SolvedLoad], list[LoadKey], list[LoadKey]]:
        """Wait for an event; return solved loads, loads of dead workers, and timed-out loads."""
        solved, crashed = [], []
        busy = {worker.pipe: worker for worker in self.busy}
        left = min(worker.deadline for worker in busy.values()) - time.monotonic()
        for pipe in connection.wait(list(busy), None if math.isinf(left) else max(0.0, left)):
            worker = busy[pipe]  # type: ignore[index]
            try:
                solved.append(worker.pipe.recv())
            except (EOFError, ConnectionResetError):
                crashed.append(self._replace(worker))
                continue
            worker.job, worker.warm = None, True
        now = time.monotonic()
        late = [self._replace(worker) for worker in self.busy if worker.deadline < now]
        return solved, crashed, late

    def _replace(self, worker: _Worker) -> LoadKey:
        """Replace a worker; return its load."""
        assert worker.job is not None
        self._workers.remove(worker)
        worker.kill()
        self._spawn()
        return worker.job


def _work(pipe: Connection, scene: Scene) -> None:
    """Solve the loads that are received until the pipe closes."""
    for number in (signal.SIGINT, signal.SIGTERM):  # libraries may have unblocked them
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            pipe.send(solve_load(scene, pipe.recv()))
