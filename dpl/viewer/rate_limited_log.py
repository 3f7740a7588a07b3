"""Log of failed browser requests: one line per failure, at most one line per second."""

import contextlib
import inspect
import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

MIN_INTERVAL = 1.0  # shortest time between two lines [s]
MAX_CHARACTERS = 200  # longest message


class RateLimitedHandler(logging.Handler):
    """Handler of log records that prints one line per record, without a traceback.

    A browser decides how often requests fail and can influence the text of errors. Lines within
    `MIN_INTERVAL` of the last one are counted and not printed. Lines are shortened and contain no
    control characters.

    Attributes:
        logger: A logger with this handler only.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Create the handler and its logger; `clock` returns the time [s]."""
        super().__init__(logging.ERROR)
        self.logger = logging.Logger("dpl.viewer", logging.ERROR)
        self.logger.addHandler(self)
        self._clock = clock
        self._count_lock = threading.Lock()
        self._last_line = -math.inf
        self._n_omitted = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Print or count a record."""
        self.report(record.getMessage(), record.exc_info[1] if record.exc_info else None)

    def report(self, message: str, error: BaseException | None = None) -> None:
        """Print a failure and its exception in one line, or count it if the last is too recent."""
        with self._count_lock:
            now = self._clock()
            if now - self._last_line < MIN_INTERVAL:
                self._n_omitted += 1
                return
            omitted = f" ({self._n_omitted} more were not printed)" if self._n_omitted else ""
            self._last_line, self._n_omitted = now, 0
        cause = "" if error is None else f": {type(error).__name__}: {error}"
        line = "".join(c if c.isprintable() else " " for c in f"{message}{cause}")
        line = " ".join(line.split())[:MAX_CHARACTERS].encode("ascii", "backslashreplace").decode()
        print(f"warning: browser request failed: {line}{omitted}", file=sys.stderr, flush=True)

    def catch_errors(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Return a callback, or a coroutine function, whose exceptions are reported here."""
        if not inspect.iscoroutinefunction(callback):
            return self._report_errors()(callback)

        async def call(event: Any) -> None:
            with self._report_errors():
                await callback(event)

        return call

    @contextlib.contextmanager
    def _report_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # no request of a browser may stop the server
            self.report("control", error)
