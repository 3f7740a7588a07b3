"""Pool of supervised worker processes that solve loads.

- A worker that dies is replaced, and its load is tried again.
- A worker that exceeds the time limit is replaced, and its load is recorded as failed.
- After the first SIGINT or SIGTERM the solves in progress are finished; the second one aborts them.
- No worker outlives this process, except until the end of its imports.
"""

import atexit
import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator
from itertools import islice
from multiprocessing import connection
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from dpl.data.solving.solve import LoadKey, SolvedLoad, failed_load, solve_load
from dpl.scene import Scene
from dpl.system.processes import die_with_parent, workers_with

MAX_RETRIES = 3  # tries of a load whose worker dies
MAX_CONSECUTIVE_CRASHES = 12  # without a solved load in between; the loads are not the cause
STARTUP_GRACE = 120.0  # additional time for the first load of a worker: imports, compilation [s]
RETRY_DELAY = 8  # loads that are solved before a load whose worker died is tried again


@contextlib.contextmanager
def graceful_shutdown() -> Iterator[list[int]]:
    """Yield the list of the signals received: empty, and therefore false, until the first one.

    A SIGINT or SIGTERM raises KeyboardInterrupt or SystemExit at the end of the context. A second
    one raises it at once. In a thread other than the main one, signals have their usual effect.
    """
    received: list[int] = []

    def leave() -> None:
        if received[0] == signal.SIGTERM:
            sys.exit(128 + signal.SIGTERM)
        raise KeyboardInterrupt

    def handle(number: int, _: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            for each in previous:  # the termination of the workers must not be interrupted
                signal.signal(each, signal.SIG_IGN)
            leave()
        # not print, which is not reentrant and may be what the signal has interrupted
        os.write(2, b"\nFinishing the solves in progress. Press Ctrl-C again to abort.\n")

    previous: dict[int, Any] = {}
    try:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                previous[number] = signal.signal(number, handle)
        yield received
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)
    if received:
        leave()


def solve_loads(
    scene: Scene,
    jobs: Iterable[LoadKey],
    *,
    workers: int,
    timeout: float | None = None,
    stop: object = None,
) -> Generator[SolvedLoad, None, None]:
    """Yield solved loads in the order in which they are finished.

    Args:
        scene: Scene of the loads.
        jobs: Identifiers of the loads; read a few loads ahead.
        workers: Number of processes, one core each; 0: solve in this process, without time limit.
        timeout: Time limit for a load [s]; the first load of a worker has more. None: no limit.
        stop: Once its truth value is True, no further load is started.

    Raises:
        RuntimeError: Workers die repeatedly.
    """
    jobs = iter(jobs)
    if workers == 0:
        while not stop and (job := next(jobs, None)):
            yield solve_load(scene, job)
        return
    limit = math.inf if timeout is None else timeout
    todo = deque(islice(jobs, max(workers, RETRY_DELAY)))
    with _worker_pool(scene, min(workers, len(todo))) as pool:
        crashes: Counter[LoadKey] = Counter()
        consecutive = 0
        while True:
            for worker in pool:
                if worker.job is None and todo and not stop:
                    worker.submit(todo.popleft(), limit)
                    todo.extend(islice(jobs, 1))
            if not any(worker.job for worker in pool):
                break
            solved, crashed, late = _wait(pool)
            yield from solved
            for job in late:
                yield failed_load(scene, job, f"timed out after {limit:g} s", seconds=limit)
            consecutive = 0 if solved else consecutive + len(crashed)
            if consecutive >= MAX_CONSECUTIVE_CRASHES:
                raise RuntimeError(f"{consecutive} workers died in a row; see the errors above")
            for job in crashed:
                crashes[job] += 1
                if crashes[job] < MAX_RETRIES:
                    todo.insert(RETRY_DELAY, job)
                else:
                    yield failed_load(scene, job, f"its worker died {MAX_RETRIES} times")


class _Worker:
    """A worker process; its `job` is the load that it solves until `deadline` [s], None if idle."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._start()

    def _start(self) -> None:
        context = workers_with(__name__)
        self.pipe, far_end = context.Pipe()
        process = context.Process(target=_work, args=(far_end,), daemon=True)
        process.start()
        far_end.close()
        self.process = process
        self.job: LoadKey | None = None
        self.deadline = math.inf
        # The scene is more than a pipe holds: sent at the start, it would have to be read before
        # the next process can start, and the imports of the workers would follow one another.
        self._unsent, self._grace = [self._scene], STARTUP_GRACE

    def submit(self, job: LoadKey, limit: float) -> None:
        """Start to solve a load."""
        self.job, self.deadline = job, time.monotonic() + limit + self._grace
        messages, self._unsent, self._grace = [*self._unsent, job], [], 0.0
        with contextlib.suppress(BrokenPipeError):  # `_wait` detects that it died while idle
            for message in messages:
                self.pipe.send(message)

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def replace(self) -> LoadKey:
        """Replace the process; return its load."""
        job = self.job
        assert job is not None
        self.kill()
        self._start()
        return job


@contextlib.contextmanager
def _worker_pool(scene: Scene, size: int) -> Iterator[list[_Worker]]:
    """Yield worker processes, which end with the context and with this process."""
    workers: list[_Worker] = []

    def kill_all() -> None:
        for worker in workers:
            worker.process.kill()
        while workers:
            workers.pop().kill()

    atexit.register(kill_all)  # runs before multiprocessing's, which joins the workers
    try:
        for _ in range(size):
            workers.append(_Worker(scene))
        yield workers
    finally:
        kill_all()
        atexit.unregister(kill_all)


def _wait(workers: list[_Worker]) -> tuple[list[SolvedLoad], list[LoadKey], list[LoadKey]]:
    """Wait for an event; return solved loads, loads of dead workers, and timed-out loads."""
    solved, crashed = [], []
    busy = {worker.pipe: worker for worker in workers if worker.job}
    left = min(worker.deadline for worker in busy.values()) - time.monotonic()
    for pipe in connection.wait(list(busy), None if math.isinf(left) else max(0.0, left)):
        worker = busy[pipe]  # type: ignore[index]
        try:
            solved.append(worker.pipe.recv())
            worker.job = None
        except (EOFError, ConnectionResetError):
            crashed.append(worker.replace())
    now = time.monotonic()
    late = [worker.replace() for worker in workers if worker.job and worker.deadline < now]
    return solved, crashed, late


def _work(pipe: Connection) -> None:
    """Receive a scene; solve the loads that follow until the pipe closes or the parent ends."""
    die_with_parent()
    for number in (signal.SIGINT, signal.SIGTERM):  # libraries may have unblocked them
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        scene = pipe.recv()
        while True:
            pipe.send(solve_load(scene, pipe.recv()))
