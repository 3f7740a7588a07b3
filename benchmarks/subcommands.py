"""Scripts of this checkout as processes that are interrupted and ended with this one."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

SCRIPTS = Path(__file__).parents[1] / "scripts"


def run_script(name: str, arguments: Sequence[str]) -> int:
    """Run a script and return its exit status.

    The script is in a session of its own, so that Ctrl-C reaches it once, through this process,
    which waits until it has finished its step. SIGTERM and SIGHUP act as Ctrl-C.
    """
    path = os.pathsep.join(filter(None, [str(SCRIPTS.parent), os.environ.get("PYTHONPATH")]))
    ending = (signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.default_int_handler) for number in ending}
    process = subprocess.Popen(
        [sys.executable, str(SCRIPTS / f"{name}.py"), *arguments],
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.send_signal(signal.SIGINT)
        process.wait()
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
