"""Draws loads and solves them, in parallel."""

import contextlib
import signal
import time
from collections.abc import Iterable, Iterator
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpl.fem.solution import Load, Status, one_thread, solve
from dpl.scene import Scene

TRIES = 3  # of a load whose worker died, before it is given up
HOPELESS = 12  # deaths in a row after which the fault is not in the loads


class Job(NamedTuple):
    """A load to solve: which one of which stream."""

    seed: tuple[int, int]
    number: int


class Outcome(NamedTuple):
    """One load, solved or not; arrays and numbers only, to cross between processes.

    Attributes:
        job: Which load it is.
        force, displacement: (N, D) [-]; the displacement is an answer only if `accepted`.
        young: [Pa].
        accepted: Whether `displacement` meets the tolerance and inverts nothing.
        residual: ||R_free|| / ||f|| [-].
        volume_ratio: min det F [-].
        load_factor: Part of the load for which an equilibrium was found [-].
        iterations: Newton iterations.
        seconds: Wall time of the solve.
        reason: Why it is rejected; empty if accepted.
    """

    job: Job
    force: NDArray[np.float64]
    displacement: NDArray[np.float64]
    young: float
    accepted: bool
    residual: float
    volume_ratio: float
    load_factor: float
    iterations: int
    seconds: float
    reason: str


def outcome(scene: Scene, job: Job) -> Outcome:
    """Return a load, solved."""
    load = scene.loads.sample(job.seed, [job.number])
    start = time.perf_counter()
    with one_thread():
        solution = solve(scene.solver, Load(load.force, load.young))
    accepted = bool(solution.stable)
    return Outcome(
        job=job,
        force=load.force[0].numpy(),
        displacement=solution.displacement[0].numpy(),
        young=float(load.young),
        accepted=accepted,
        residual=float(solution.residual),
        volume_ratio=float(solution.volume_ratio),
        load_factor=float(solution.load_factor),
        iterations=int(solution.iterations),
        seconds=time.perf_counter() - start,
        reason="" if accepted else str(Status(int(solution.status))),
    )


def outcomes(scene: Scene, jobs: Iterable[Job], *, workers: int) -> Iterator[Outcome]:
    """Yield loads solved, in the order in which they are finished.

    Each worker is a process of its own on one core. One that dies is replaced, its load tried
    again, and given up after three deaths; none outlives this generator.

    Args:
        scene: What is simulated.
        jobs: Which loads.
        workers: Processes; 0 solves in this one.

    Raises:
        RuntimeError: Workers die one after the other.
    """
    todo = list(jobs)[::-1]
    if workers == 0:
        while todo:
            yield outcome(scene, todo.pop())
        return
    with _Crew(scene, min(workers, len(todo))) as crew:
        deaths: dict[Job, int] = {}
        in_a_row = 0
        while todo or crew.busy:
            while todo and crew.idle:
                crew.give(todo.pop())
            done, dead = crew.wait()
            yield from done
            in_a_row = 0 if done else in_a_row + len(dead)
            if in_a_row >= HOPELESS:
                raise RuntimeError(f"{in_a_row} workers died one after the other; see above why")
            for job in dead:
                deaths[job] = deaths.get(job, 0) + 1
                if deaths[job] < TRIES:
                    todo.append(job)
                else:
                    yield _lost(scene, job)


def _lost(scene: Scene, job: Job) -> Outcome:
    """Return a load that killed its workers."""
    load = scene.loads.sample(job.seed, [job.number])
    force = load.force[0].numpy()
    return Outcome(
        job, force, 0 * force, float(load.young), False, np.nan, np.nan, 0.0, 0, 0.0,
        f"its worker died {TRIES} times",
    )  # fmt: skip


class _Crew:
    """Worker processes, each with a pipe; a context that leaves none of them behind."""

    def __init__(self, scene: Scene, size: int) -> None:
        self._context = get_context("spawn")  # forking a process with BLAS threads can hang it
        self._scene, self._size = scene, size
        self._members: dict[Connection, BaseProcess] = {}
        self.idle: list[Connection] = []
        self.busy: dict[Connection, Job] = {}

    def __enter__(self) -> "_Crew":
        for _ in range(self._size):
            self._hire()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._members.values():
            process.terminate()
        for pipe, process in self._members.items():
            process.join()
            pipe.close()

    def _hire(self) -> None:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, self._scene), daemon=True)
        process.start()
        theirs.close()
        self._members[ours] = process
        self.idle.append(ours)

    def give(self, job: Job) -> None:
        """Hand a load to an idle worker."""
        pipe = self.idle.pop()
        self.busy[pipe] = job
        with contextlib.suppress(BrokenPipeError):  # it died idle: `wait` will see
            pipe.send(job)

    def wait(self) -> tuple[list[Outcome], list[Job]]:
        """Return what was finished, and the loads whose workers died, once there is any."""
        done, dead = [], []
        for pipe in connection.wait(list(self.busy)):
            assert isinstance(pipe, Connection)
            job = self.busy.pop(pipe)
            try:
                done.append(pipe.recv())
                self.idle.append(pipe)
            except (EOFError, ConnectionResetError):
                self._members.pop(pipe).join()
                pipe.close()
                dead.append(job)
                self._hire()
        return done, dead


def _work(pipe: Connection, scene: Scene) -> None:
    """Solve what comes through the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            pipe.send(outcome(scene, pipe.recv()))
