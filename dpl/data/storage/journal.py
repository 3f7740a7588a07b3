"""Journal of a data set: one line per session that solved loads."""

import os
import platform
import socket
import time
from pathlib import Path
from typing import Any

from dpl.data.storage.manifest import is_number
from dpl.system.files import append_jsonl, read_jsonl
from dpl.version import __version__

NAME = "journal.jsonl"


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


def read_sessions(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a journal that give numbers of loads and durations."""
    return [
        line
        for line in read_jsonl(folder / NAME)
        if all(is_number(line.get(key)) for key in ("loads", "seconds", "core_seconds"))
    ]
