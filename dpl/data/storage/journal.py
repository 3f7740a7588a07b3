"""Journal of a data set: one line per session that solved loads."""

import os
import platform
import socket
import time
from pathlib import Path
from typing import Any

from dpl.system.files import append_jsonl, read_jsonl
from dpl.version import __version__

NAME = "journal.jsonl"
UPPER_LIMIT = 1e15  # of a number in a journal


class Session:
    """Counts the loads of one run of the generator."""

    def __init__(self, workers: int) -> None:
        """Start the clock of a run with this many workers."""
        self.workers = workers
        self.loads = self.accepted = 0
        self.core_seconds = 0.0
        self._date = time.strftime("%Y-%m-%d %H:%M:%S")
        self._start = time.perf_counter()

    def count(self, accepted: bool, seconds: float) -> str:
        """Count a load; return the text of the progress bar."""
        self.loads += 1
        self.accepted += accepted
        self.core_seconds += seconds
        rate = self.loads / (time.perf_counter() - self._start)
        return f"{self.accepted} accepted, {self.loads - self.accepted} rejected, {rate:.1f}/s"

    def append_to_journal(self, folder: Path) -> None:
        """Append a line to the journal of a data set, if loads were solved and the set exists."""
        if self.loads and folder.is_dir():
            line = {
                "started": self._date,
                "machine": socket.gethostname(),
                "process": os.getpid(),
                "python": platform.python_version(),
                "dpl": __version__,
                "workers": self.workers,
                "loads": self.loads,
                "seconds": round(time.perf_counter() - self._start, 3),
                "core_seconds": round(self.core_seconds, 3),
            }
            append_jsonl(folder / NAME, line)


def totals(folder: Path) -> tuple[int, float, float, float]:
    """Return the numbers of sessions and of loads, wall time and core time of a journal [s].

    Lines that do not give these numbers are left out.
    """
    keys = "loads", "seconds", "core_seconds"
    rows: list[list[Any]] = [[line.get(key) for key in keys] for line in read_jsonl(folder / NAME)]
    valid = [row for row in rows if all(map(is_number, row))]
    loads, wall, core = (sum(row[k] for row in valid) for k in range(len(keys)))
    return len(valid), loads, wall, core


def is_number(value: Any) -> bool:
    """Return True for a number that a journal may hold."""
    return type(value) in (int, float) and 0 <= value < UPPER_LIMIT
