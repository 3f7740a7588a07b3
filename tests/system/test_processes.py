"""Laws of worker processes: a worker ends with its parent at any moment."""

import os
import signal
import subprocess
import sys
import textwrap
from contextlib import suppress

import pytest

LONG = 120  # limit for an event; reached only if a process is left behind [s]

# Parent and worker hold the standard output, which therefore closes when both have ended. A worker
# imports the main module before it calls its task.
PROGRAM = textwrap.dedent(
    """
    import multiprocessing
    import os
    import signal
    import threading

    from dpl.system.processes import die_with_parent, workers_with

    if __name__ == "__mp_main__" and {dies_first}:
        multiprocessing.parent_process().join()

    def task():
        die_with_parent()
        print("at work", flush=True)
        threading.Event().wait()

    if __name__ == "__main__":
        workers_with("json").Process(target=task, daemon=True).start()
        if {dies_first}:
            os.kill(os.getpid(), signal.SIGKILL)
        threading.Event().wait()
    """
)


@pytest.fixture
def launched(tmp_path, environment):
    """Return a function that starts a program in its own process group, which is killed."""
    started = []

    def launched(text):
        path = tmp_path / "program.py"
        path.write_text(text)
        process = subprocess.Popen(
            [sys.executable, str(path)],
            cwd=tmp_path,
            env=environment(),
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        return process

    yield launched
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.mark.timeout(3 * LONG)
@pytest.mark.parametrize("dies_first", [False, True], ids=["at work", "importing"])
def test_a_worker_ends_with_its_parent(launched, dies_first):
    parent = launched(PROGRAM.format(dies_first=dies_first))
    if not dies_first:
        assert parent.stdout.readline() == "at work\n"
        parent.kill()
    out, _ = parent.communicate(timeout=LONG)  # which waits for the worker's output to end
    assert parent.returncode == -signal.SIGKILL
    assert out == ""
