"""Items of a generator that a thread advances, such as solved loads."""

import queue
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from typing import Generic, TypeVar

PATIENCE = 1.0  # time after which the end of the solves in progress is announced [s]

T = TypeVar("T")


class StopFlag(threading.Event):
    """Event that is its own truth value."""

    def __bool__(self) -> bool:
        return self.is_set()


class Background(Generic[T]):
    """Items of a generator that a thread advances; without a thread `get` advances it.

    Attributes:
        ended: True once `get` has found no further item.
    """

    def __init__(
        self, start: Callable[[StopFlag], Generator[T, None, None]], *, thread: bool, ahead: int = 0
    ) -> None:
        """Start the thread, if there is one.

        `start` returns the generator, which ends soon after its argument is true. At most `ahead`
        items wait for `get`; 0: no limit.
        """
        self.ended, self._stop = False, StopFlag()
        self._items = start(self._stop)
        self._queue: queue.Queue[T | BaseException | None] = queue.Queue(ahead)
        self._thread = (
            threading.Thread(target=self._run, name="background", daemon=True) if thread else None
        )
        if self._thread is not None:
            self._thread.start()

    def _run(self) -> None:
        end: BaseException | None = None
        try:
            with closing(self._items) as items:
                while (item := next(items, None)) is not None and self._put(item):
                    pass
        except BaseException as error:  # raised again in the thread that waits
            end = error
        self._put(end)

    def _put(self, item: T | BaseException | None) -> bool:
        """Wait for a place in the queue; return False if there is none after `close`."""
        while True:
            with suppress(queue.Full):
                self._queue.put(item, timeout=0.1)
                return True
            if self._stop:
                return False

    def get(self, timeout: float | None = None) -> T | None:
        """Return the next item; None at the end or if there is none within a time [s]."""
        if self.ended:
            return None
        item: T | BaseException | None
        if self._thread is None:
            item = next(self._items, None)
        else:
            try:
                item = self._queue.get(timeout=timeout)
            except queue.Empty:
                return None
        self.ended = item is None or isinstance(item, BaseException)
        if isinstance(item, BaseException):
            raise item
        return item

    def close(self) -> None:
        """End the generator; announce it if that takes long."""
        self._stop.set()
        if self._thread is None:
            self._items.close()
            return
        self._thread.join(PATIENCE)
        if self._thread.is_alive():
            print("Finishing the solves in progress. Press Ctrl-C again to abort.", file=sys.stderr)
        self._thread.join()
