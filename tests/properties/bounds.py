"""Limits of time and memory of one input, and of the number of inputs."""

import resource
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import settings

LIMIT = 200.0  # on a busy machine, below that of a test [s]
MEMORY = 1.0  # [GB]


class Late(BaseException):
    """An input took too long."""


def at_most(part: float) -> settings:
    """Return the settings of a test with `part` as many inputs as the others."""
    return settings(max_examples=max(1, round(settings.default.max_examples * part)))


@contextmanager
def bounded(seconds: float = LIMIT, memory: float = MEMORY) -> Iterator[None]:
    """Hold what is done to a time [s] and to a memory [GB].

    Three times that memory cannot be had at all, so that the machine is safe.
    """

    def late(*_: object) -> None:
        raise Late(f"more than {seconds:g} s")

    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before, handler = _peak(), signal.signal(signal.SIGALRM, late)
    left, begin = signal.setitimer(signal.ITIMER_REAL, seconds)[0], time.monotonic()
    resource.setrlimit(resource.RLIMIT_AS, (size + int(3e9 * memory), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, handler)
        rest = max(1e-3, left - (time.monotonic() - begin)) if left else 0.0
        signal.setitimer(signal.ITIMER_REAL, rest)
    assert _peak() - before < memory, f"{_peak() - before:.1f} GB more"


def _peak() -> float:
    """Return the largest memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
