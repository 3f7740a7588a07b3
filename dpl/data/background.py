"""Solving of loads in the background of a training."""

import sys
import threading
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing

from rich import progress

from dpl.data.dataset import DataSet
from dpl.data.solving.solve import SolvedLoad
from dpl.data.storage.journal import Session
from dpl.data.storage.store import STREAMS

REFRESH = 0.5  # time between two updates of the progress bar [s]
PATIENCE = 1.0  # time after which the end of the solves in progress is announced [s]


class StopFlag(threading.Event):
    """Event that is its own truth value."""

    def __bool__(self) -> bool:
        return self.is_set()


class BackgroundSolver:
    """Solves loads of a data set while this process works.

    A thread supervises the worker processes and writes the solved loads. Without workers there is
    no thread, and `wait` solves the loads.
    """

    def __init__(self, dataset: DataSet, loads: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Start to solve.

        Args:
            dataset: The data set.
            loads: Splits with numbers of loads, in the order of the solves; read when they are due.
        """
        self._dataset, self._loads = dataset, loads
        streams = {split: dataset.store.stream(split) for split in STREAMS}
        self._splits = {stream: split for split, stream in streams.items()}
        self._tried = {split: dataset.store.tried(split) for split in STREAMS}
        self._first = dict.fromkeys(STREAMS, 0)  # all loads before these have been tried
        self._changed = threading.Condition()
        self._stop = StopFlag()
        self._ended = False
        self._error: BaseException | None = None
        self._solving = self._solve()
        self._thread = threading.Thread(target=self._run, name="solver", daemon=True)
        if dataset.workers:
            self._thread.start()

    def _solve(self) -> Generator[SolvedLoad, None, None]:
        session = Session(workers=self._dataset.workers)
        try:
            with closing(self._dataset.solve(self._loads, self._stop)) as solving:
                for solved in solving:
                    session.count(solved.accepted, solved.seconds)
                    yield solved
        finally:
            session.append_to_journal(self._dataset.store.folder)

    def _run(self) -> None:
        """Solve all loads."""
        try:
            while self._advance():
                pass
        except BaseException as error:  # raised again in the thread that waits
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _advance(self) -> bool:
        """Solve a load; return False if there was none left."""
        solved = next(self._solving, None)
        if solved is None:
            self._ended = True
            return False
        with self._changed:
            self._tried[self._splits[solved.job.seed]].add(solved.job.number)
            self._changed.notify_all()
        return True

    def count(self, split: str) -> int:
        """Return the number of loads of a split before the first one that has not been tried."""
        while self._first[split] in self._tried[split]:
            self._first[split] += 1
        return self._first[split]

    def wait(
        self, sizes: Mapping[str, int], *, until: float | None = None, show: bool = False
    ) -> None:
        """Wait until the first loads of each split have been tried, or there is no load left.

        Args:
            sizes: Number of loads, by split.
            until: Time of `time.monotonic` at which the wait ends [s]; None: no limit.
            show: Show a progress bar.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
            RuntimeError: Workers die repeatedly.
        """
        wanted = sum(sizes.values())
        with progress.Progress(
            progress.TextColumn("solving loads"),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeRemainingColumn(),
            disable=not show,
        ) as bars:
            bar = bars.add_task("", total=wanted)
            while (done := self._done(sizes)) < wanted and not self._ended:
                bars.update(bar, completed=done)
                if until is not None and time.monotonic() >= until:
                    break
                self._wait_for_more(sizes, done, until)
            bars.update(bar, completed=done)
        if self._error is not None:
            raise self._error

    def _done(self, sizes: Mapping[str, int]) -> int:
        return sum(min(self.count(split), size) for split, size in sizes.items())

    def _wait_for_more(self, sizes: Mapping[str, int], done: int, until: float | None) -> None:
        """Wait until more than `done` loads have been tried; without workers, solve one."""
        if not self._dataset.workers:
            self._advance()
            return
        limit = REFRESH if until is None else min(REFRESH, max(0.0, until - time.monotonic()))
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._done(sizes) > done, limit)

    def close(self) -> None:
        """Finish the solves in progress, start no other and end the workers."""
        self._stop.set()
        if not self._dataset.workers:
            while self._advance():  # writes the last shard
                pass
            return
        join(self._thread)


def join(thread: threading.Thread) -> None:
    """Wait for the end of a thread that supervises workers; announce solves that take long."""
    thread.join(PATIENCE)
    if thread.is_alive():
        print("Finishing the solves in progress. Press Ctrl-C again to abort.", file=sys.stderr)
    thread.join()
