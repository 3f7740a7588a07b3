"""Laws of scripts/generate.py with killed processes, signals, full disks and second writers.

The tests start real processes for the tiny scene. Its loads are drawn by `Slow`, which pauses in
workers and draws the same loads for every pause. Tests wait for events (a line, a file, the end of
a process); no result depends on a duration.
"""

import ctypes
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from set_files import content

from dpl.data.storage.shard import read_shard
from dpl.fem import ModalLoads

HERE = Path(__file__)
LONG = 240.0  # limit for an event; reached only if a test fails [s]
pytestmark = pytest.mark.timeout(1800)
SCRIPT = HERE.parents[2] / "scripts" / "generate.py"


@dataclass(frozen=True, eq=False)
class Slow(ModalLoads):
    """Loads that take time in workers; each worker creates a file `begun-...` when it starts.

    Attributes:
        pause: Duration [s]; below 0: infinite, in one call that no signal handler interrupts.
        gate: File whose creation they wait for; none if empty.
    """

    pause: float = 0.0
    gate: str = ""

    def points(self, seed, indices):
        if multiprocessing.parent_process() is not None:
            Path(f"begun-{os.getpid()}").touch()
            if self.pause < 0:
                ctypes.PyDLL(None).sleep(10**6)
            while self.gate and not Path(self.gate).exists():
                time.sleep(0.01)
            time.sleep(self.pause)
        return super().points(seed, indices)

    def identity(self):
        """Return the options that determine the loads: not pause and gate."""
        return {k: v for k, v in super().identity().items() if k not in ("pause", "gate")}


@pytest.fixture
def slow(monkeypatch, tiny):
    """Return a function that returns the overrides of a data set of slow loads in folder `d`."""
    monkeypatch.setenv("PYTHONPATH", str(HERE.parent))

    def slow(pause=0.0, train=40, val=5, test=5, workers=2, folder="d", gate=""):
        sizes = [f"data.train={train}", f"data.val={val}", f"data.test={test}"]
        loads = [f"loads._target_={HERE.stem}.Slow", f"+loads.pause={pause}"]
        loads += [f"+loads.gate={gate}"] if gate else []
        return [*tiny, *sizes, *loads, f"data.workers={workers}", f"data.folder={folder}"]

    return slow


@pytest.fixture
def limited(environment):
    """Return a function that runs the generator in a shell; it returns status, out, err."""

    def limited(before, *arguments, cwd):
        words = " ".join(f"'{word}'" for word in (sys.executable, SCRIPT, *arguments))
        ended = subprocess.run(
            ["bash", "-c", before.replace("GENERATE", words)],
            cwd=cwd,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=3 * LONG,
        )
        return ended.returncode, ended.stdout, ended.stderr

    return limited


def finish(process):
    out, err = process.communicate(timeout=LONG)
    return process.returncode, out, err


def waited_for(condition):
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.01)
    return False


def gone(members, group):
    """Wait until no process of a group is left; return whether none is."""
    return waited_for(lambda: not members(group))


def read_until_confirmed(process):
    """Read the errors of a process until it confirms the first signal; return them."""
    said = ""
    while line := process.stderr.readline():
        said += line
        if "again to abort" in line:
            return said
    raise AssertionError(said)


def done(folder):
    """Return the number of loads that have been tried."""
    found = 0
    for path in folder.glob("*-*.safetensors"):
        with suppress(FileNotFoundError):  # it has just been merged
            found += len(read_shard(path)["tried"])
    return found


def leftovers(folder):
    return [path.name for path in folder.rglob("*") if path.name.endswith(".part")]


def made(script, overrides, cwd):
    """Make a data set in this process, where all modules are imported, without workers."""
    ended = script("generate", *overrides, "data.workers=0", cwd=cwd)
    assert ended.status == 0, ended.err[-2000:]
    return ended


def begun(folder):
    return len(list(folder.glob("begun-*")))


# ------------------------------------------------------------------ workers end with the parent


@pytest.mark.slow
def test_workers_in_a_solve_end_with_a_killed_parent(start, members, workers_of, slow, tmp_path):
    process = start("generate", *slow(pause=-1, workers=1), cwd=tmp_path)
    assert waited_for(lambda: begun(tmp_path) == 1)
    assert len(workers_of(process.pid)) == 1
    process.kill()
    process.wait()
    assert gone(members, process.pid)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_twenty_killed_runs_and_a_resume_make_the_bytes_of_one_run(
    start, members, workers_of, script, slow, tmp_path
):
    sizes = {"train": 260, "val": 20, "test": 20}
    made(script, slow(**sizes, folder="once"), tmp_path)
    rng = random.Random(0)
    folder = tmp_path / "d"

    def killed(cycle):
        """Kill a run; return True if it had solved loads."""
        before, more = done(folder), rng.randint(1, 6)
        process = start("generate", *slow(pause=0.08, **sizes), cwd=tmp_path)
        if cycle % 4:  # most of them amid work, the others as soon as there are workers
            waited_for(lambda: done(folder) >= before + more or process.poll() == 0)
        else:
            waited_for(lambda: workers_of(process.pid) or process.poll() == 0)
        amid = process.poll() is None and done(folder) != before
        process.kill()
        process.wait()
        assert gone(members, process.pid), f"orphans of kill {cycle}"
        return amid

    amid = sum(killed(cycle) for cycle in range(20))
    assert amid >= 10, "the set was complete too early"
    status, _, err = finish(start("generate", *slow(**sizes), cwd=tmp_path))
    assert status == 0, err[-2000:]
    assert content(folder) == content(tmp_path / "once")
    for path in folder.rglob("*.part"):  # may be too young to be removed
        os.utime(path, (0, 0))
    grown = {**sizes, "test": 21}
    made(script, slow(**grown), tmp_path)
    assert leftovers(folder) == []


# ------------------------------------------------------------------ signals


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "group", "status"), [(signal.SIGINT, True, 130), (signal.SIGTERM, False, 143)]
)
def test_after_one_signal_the_solves_in_progress_are_finished_and_kept(
    start, members, script, slow, tmp_path, number, group, status
):
    made(script, slow(folder="once"), tmp_path)
    process = start("generate", *slow(gate="go"), cwd=tmp_path)
    assert waited_for(lambda: begun(tmp_path) == 2)
    (os.killpg if group else os.kill)(process.pid, number)
    said = read_until_confirmed(process)
    assert done(tmp_path / "d") == 0, "the solves in progress continue"
    (tmp_path / "go").touch()
    ended, _, err = finish(process)
    assert ended == status, err[-2000:]
    assert gone(members, process.pid)
    assert "Traceback" not in said + err
    assert done(tmp_path / "d") == 2
    resumed = made(script, slow(), tmp_path)
    assert "48/48" in resumed.out
    assert content(tmp_path / "d") == content(tmp_path / "once")


def test_a_second_signal_aborts_the_solves_in_progress(start, members, workers_of, slow, tmp_path):
    process = start("generate", *slow(pause=-1, workers=1), cwd=tmp_path)
    assert waited_for(lambda: begun(tmp_path) == 1)
    os.killpg(process.pid, signal.SIGINT)
    said = read_until_confirmed(process)
    assert process.poll() is None, "the solves in progress continue"
    assert len(workers_of(process.pid)) == 1
    os.killpg(process.pid, signal.SIGINT)
    status, _, err = finish(process)  # the solves in progress would never end
    assert status == 130, err[-2000:]
    assert gone(members, process.pid)
    assert err.strip().endswith("interrupted")
    assert (said + err).count("again to abort") == 1


@pytest.mark.slow
def test_an_interrupt_during_the_start_of_workers_prints_no_traceback(
    start, members, workers_of, slow, tmp_path
):
    """A terminal also sends Ctrl-C to workers, possibly before they set their handlers."""
    process = start("generate", *slow(pause=0.2, train=20), cwd=tmp_path)
    assert waited_for(lambda: len(workers_of(process.pid)) == 2)
    os.killpg(process.pid, signal.SIGINT)
    status, _, err = finish(process)
    assert status == 130, err[-2000:]
    assert "Traceback" not in err


# ------------------------------------------------------------------ several writers


@pytest.mark.slow
def test_two_parts_made_in_parallel_have_the_bytes_of_a_set_made_at_once(
    start, script, slow, tmp_path
):
    sizes = {"train": 200, "val": 70, "test": 10}
    made(script, slow(**sizes, folder="once"), tmp_path)
    parts = [
        start("generate", *slow(**sizes, workers=1), f"shard={k}", "shards=2", cwd=tmp_path)
        for k in range(2)
    ]
    for process in parts:
        status, _, err = finish(process)
        assert status == 0, err[-2000:]
    assert content(tmp_path / "d") == content(tmp_path / "once")
    sound = script("generate", *slow(**sizes), "action=verify", cwd=tmp_path)
    assert sound.status == 0
    assert "0 flaws found" in sound.out


# ------------------------------------------------------------------ a full disk


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "blocks"), [(0, 4), (2, 16)])
def test_a_limit_of_the_file_size_ends_with_one_line_and_a_resume_makes_the_same_bytes(
    limited, script, slow, tmp_path, workers, blocks
):
    """With either limit no file of 40 loads fits."""
    for folder in ("once", "d"):
        made(script, slow(train=3, val=0, test=0, folder=folder), tmp_path)
    made(script, slow(folder="once"), tmp_path)
    before = content(tmp_path / "d")
    status, _, err = limited(f"ulimit -f {blocks}; GENERATE", *slow(workers=workers), cwd=tmp_path)
    assert status == 2, err[-2000:]
    assert err.startswith("error: File too large")
    assert err.count("\n") == 1
    assert {**content(tmp_path / "d"), **before} == content(tmp_path / "d")
    assert leftovers(tmp_path / "d") == []
    made(script, slow(), tmp_path)
    assert content(tmp_path / "d") == content(tmp_path / "once")
