"""Scripts of this checkout as processes that are interrupted and ended with this one."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

SCRIPTS = Path(__file__).parents[1] / "scripts"
ENDING = (signal.SIGTERM, signal.SIGHUP)  # end the process; SIGINT lets it finish its step


class Interrupted(KeyboardInterrupt):
    """This process was interrupted while a script ran; the script has ended."""


def run_script(name: str, arguments: Sequence[str]) -> int:
    """Run a script and return its exit status.

    The script is in a session of its own, so that Ctrl-C reaches it once, through this process.
    """
    path = os.pathsep.join(filter(None, [str(SCRIPTS.parent), os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        [sys.executable, str(SCRIPTS / f"{name}.py"), *arguments],
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )
    with _forwarded(process) as received:
        status = process.wait()
    if received:
        raise Interrupted(f"signal {received[0]}")
    return status


@contextmanager
def _forwarded(process: "subprocess.Popen[bytes]") -> Iterator[list[int]]:
    """Pass signals on to a process; the list contains those that were received."""
    received: list[int] = []

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(number)
        process.send_signal(number)

    before = {number: signal.signal(number, forward) for number in (signal.SIGINT, *ENDING)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
