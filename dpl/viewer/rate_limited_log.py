"""What goes wrong with requests of browsers: one line each, and at most one line a second."""

import contextlib
import inspect
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

PERIOD = 1.0  # shortest time between two lines [s]
LONGEST = 200  # characters of what is told


class RateLimitedHandler(logging.Handler):
    """A handler of log records that prints one line for a record, without a traceback.

    A browser decides how often a request fails, and often what the error says. So lines that come
    too soon after another are counted and not printed, and what is printed is cut and has no
    control characters.

    Attributes:
        logger: A logger that has this handler only.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with no line printed.

        Args:
            clock: Returns the time [s].
        """
        super().__init__(logging.ERROR)
        self.logger = logging.Logger("dpl.viewer", logging.ERROR)
        self.logger.addHandler(self)
        self._clock, self._counting = clock, threading.Lock()
        self._printed: float | None = None
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record in one line, or count it."""
        self.add(record.getMessage(), record.exc_info[1] if record.exc_info else None)

    def add(self, told: str, error: BaseException | None = None) -> None:
        """Print what went wrong in one line, or count it.

        Args:
            told: What failed.
            error: Why.
        """
        with self._counting:
            now = self._clock()
            if self._printed is not None and now - self._printed < PERIOD:
                self._left_out += 1
                return
            more = f" ({self._left_out} more were not printed)" if self._left_out else ""
            self._printed, self._left_out = now, 0
        why = "" if error is None else f": {type(error).__name__}: {error}"
        line = "".join(c if c.isprintable() else " " for c in f"{told}{why}")
        line = " ".join(line.split())[:LONGEST].encode("ascii", "backslashreplace").decode()
        print(f"warning: a request of a browser failed: {line}{more}", file=sys.stderr, flush=True)

    def caught(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Return a callback, a coroutine function or not, whose errors are told here."""
        if inspect.iscoroutinefunction(callback):

            async def awaited(event: Any) -> None:
                with self._telling():
                    await callback(event)

            return awaited

        def called(event: Any) -> None:
            with self._telling():
                callback(event)

        return called

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the page must go on, whatever one browser asked for
            self.add("a control", error)
