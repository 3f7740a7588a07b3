"""Laws of worker processes: a worker ends with its parent at any moment."""

import os
import signal
import subprocess
import sys
import textwrap
from contextlib import suppress

import pytest

from dpl.system.processes import spawn_context

LONG = 120  # limit for an event; reached only if a process is left behind [s]

# Parent and worker hold the standard output, which therefore closes when both have ended. A worker
# first imports the main module, where it waits without end.
PROGRAM = textwrap.dedent(
    """
    import os
    import signal
    import threading

    if __name__ == "__mp_main__":
        print("importing", flush=True)
        threading.Event().wait()

    def task():
        print("at work", flush=True)

    if __name__ == "__main__":
        from dpl.system.processes import spawn_context
        worker = spawn_context().Process(target=task, daemon=True)
        worker.start()
        {then}
    """
)
MOMENTS = {
    "at once": "os.kill(os.getpid(), signal.SIGKILL)",
    "while it imports": "print('started', flush=True); threading.Event().wait()",
}


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
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_worker_that_is_still_importing_ends_with_its_parent(launched, moment):
    parent = launched(PROGRAM.format(then=MOMENTS[moment]))
    if moment == "while it imports":
        lines = {parent.stdout.readline() for _ in range(2)}
        assert lines == {"started\n", "importing\n"}
        parent.kill()
    out, _ = parent.communicate(timeout=LONG)  # which waits for the worker's output to end
    assert parent.returncode == -signal.SIGKILL
    assert "at work" not in out


def test_a_worker_returns_its_exit_status_and_leaves_other_starts_unchanged():
    from multiprocessing import spawn

    before = spawn.get_command_line
    context = spawn_context()
    workers = [context.Process(target=sys.exit, args=(status,)) for status in (0, 3)]
    for worker in workers:
        worker.start()
    assert {worker.pid for worker in workers}.isdisjoint({os.getpid()})
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0, 3]
    assert spawn.get_command_line is before
    assert context.get_start_method() == "spawn"
