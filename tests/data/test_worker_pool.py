"""Laws of the worker pool: samples do not depend on workers; faults are recorded."""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import forkserver
from pathlib import Path

import pytest
from set_files import fields_of as content

from dpl import Scene
from dpl.data.solving import worker_pool
from dpl.data.solving.solve import LoadKey
from dpl.data.solving.worker_pool import graceful_shutdown, solve_loads
from dpl.fem import ModalLoads

SEED = (5, 0)
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True, eq=False)
class Fragile(ModalLoads):
    """Loads of which some damage the worker that draws them.

    Attributes:
        harms: What they do, by number: die, hang, raise, or a file that they make to die once.
    """

    harms: dict = field(default_factory=dict)

    def points(self, seed, indices):
        harm = self.harms.get(indices[0])
        if harm and multiprocessing.parent_process() is not None:
            if harm == "hang":  # one call in C: no signal handler, no other thread
                ctypes.PyDLL(None).sleep(10**6)
            elif harm == "raise":
                raise RuntimeError("no load can be drawn")
            elif harm == "die":
                os._exit(1)
            elif not Path(harm).exists():
                Path(harm).touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return super().points(seed, indices)


def fragile(scene, harms):
    linear, modes = scene.solver.linear_solver, scene.loads.eigenmodes
    loads = Fragile(linear, n_modes=3, young=4500.0, harms=harms)
    loads.__dict__["eigenmodes"] = modes
    return Scene(scene.problem, loads, scene.solver)


def by_index(found):
    return {one.job.number: content(one) for one in found}


def children():
    return {child.pid for child in multiprocessing.active_children()}


@pytest.fixture(scope="module")
def jobs():
    return [LoadKey(SEED, index) for index in range(8)]


@pytest.fixture(scope="module")
def here(scene, jobs):
    """The solved loads of this process."""
    return by_index(solve_loads(scene, jobs, workers=0))


@pytest.fixture(autouse=True)
def _nothing_left():
    """Check that each test restores signal handlers and ends its child processes."""
    before = children(), [signal.getsignal(number) for number in SIGNALS]
    yield
    assert (children(), [signal.getsignal(number) for number in SIGNALS]) == before


# ------------------------------------------------------------------ results


def test_loads_are_solved_in_the_order_of_the_jobs_without_workers(scene, jobs, here):
    found = list(solve_loads(scene, jobs[::-1], workers=0))
    assert [one.job for one in found] == jobs[::-1]
    assert by_index(found) == here


def test_no_jobs_cost_no_process(scene, monkeypatch):
    monkeypatch.setattr(worker_pool, "workers_with", lambda module: None)  # nothing can be started
    assert list(solve_loads(scene, [], workers=2)) == []


def test_workers_that_are_killed_or_hang_are_replaced_and_the_bytes_do_not_depend_on_workers(
    scene, here, monkeypatch, tmp_path
):
    """The additional time for the first load of a worker is granted once."""
    monkeypatch.setattr(worker_pool, "STARTUP_GRACE", 1e6)
    mark = tmp_path / "killed"
    harmful = fragile(scene, {2: str(mark), 1: "hang"})
    solving = solve_loads(harmful, _jobs(2, 0, 1), workers=1, timeout=0.5)
    found = {one.job.number: one for one in solving}
    assert mark.exists()
    late = found.pop(1)
    assert by_index(found.values()) == {number: here[number] for number in (0, 2)}
    assert late.reason == "timed out after 0.5 s"
    assert late.seconds == 0.5
    assert not late.accepted
    assert late.force.tobytes() == here[1]["force"]


def test_a_pool_has_no_more_workers_than_loads_and_leaves_none_when_closed(scene, jobs, here):
    before = children()
    running = solve_loads(scene, jobs[:1], workers=64)
    first = next(running)
    members = children() - before
    assert len(members) == 1
    running.close()
    assert content(first) == here[first.job.number]
    assert not any(Path(f"/proc/{pid}").exists() for pid in members)


# ------------------------------------------------------------------ faults of workers


@pytest.mark.parametrize("tries", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_load_that_kills_every_worker_is_given_up_with_a_reason(scene, here, monkeypatch, tries):
    monkeypatch.setattr(worker_pool, "MAX_RETRIES", tries)
    (one,) = solve_loads(fragile(scene, {1: "die"}), _jobs(1), workers=1)
    assert one.reason == f"its worker died {tries} times"
    assert not one.accepted
    assert one.load_factor == 0
    assert one.force.tobytes() == here[1]["force"], "the load that could not be solved is kept"


def test_workers_that_exceed_the_time_limit_while_starting_are_replaced(scene, monkeypatch):
    monkeypatch.setattr(worker_pool, "STARTUP_GRACE", 0.0)
    found = list(solve_loads(scene, _jobs(0, 1, 2), workers=2, timeout=1e-4))
    assert [one.reason for one in found] == 3 * ["timed out after 0.0001 s"]


def test_workers_that_all_die_end_the_run(scene, monkeypatch, capfd):
    monkeypatch.setattr(worker_pool, "MAX_CONSECUTIVE_CRASHES", 1)
    forkserver._forkserver._stop()  # the next server has the streams of this test
    victim = fragile(scene, {0: "raise"})
    with pytest.raises(RuntimeError, match="1 workers died in a row"):
        list(solve_loads(victim, _jobs(0), workers=1))
    assert "no load can be drawn" in capfd.readouterr().err


def _jobs(*numbers):
    return [LoadKey(SEED, number) for number in numbers]


# ------------------------------------------------------------------ signals


@pytest.mark.parametrize("second", [None, *SIGNALS])
@pytest.mark.parametrize(
    ("first", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_signal_ends_the_context_at_its_end_and_a_second_one_at_once(
    capfd, first, second, raised
):
    seen = []

    def run():
        with graceful_shutdown() as stop:
            seen.append(bool(stop))
            os.kill(os.getpid(), first)
            seen.append(bool(stop))
            if second is not None:
                os.kill(os.getpid(), second)
            seen.append("end")

    with pytest.raises(raised) as end:
        run()
    assert seen == [False, True, "end"][: 3 if second is None else 2]
    assert "again to abort" in capfd.readouterr().err
    if raised is SystemExit:
        assert end.value.code == 143


def test_signal_handlers_are_restored_after_an_error():
    before = [signal.getsignal(number) for number in SIGNALS]
    with suppress(RuntimeError), graceful_shutdown():
        assert [signal.getsignal(number) for number in SIGNALS] != before
        raise RuntimeError
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_another_thread_leaves_signal_handlers_unchanged():
    def enter():
        before = signal.getsignal(signal.SIGINT)
        with graceful_shutdown() as stop:
            return signal.getsignal(signal.SIGINT) is before, bool(stop)

    with ThreadPoolExecutor() as threads:
        assert threads.submit(enter).result() == (True, False)


def test_after_a_signal_no_load_is_started_in_this_process(scene, jobs, here):
    with suppress(SystemExit), graceful_shutdown() as stop:
        running = solve_loads(scene, jobs, workers=0, stop=stop)
        found = [next(running), next(running)]
        os.kill(os.getpid(), signal.SIGTERM)
        found += running
    assert by_index(found) == {0: here[0], 1: here[1]}


def test_after_a_signal_only_the_solves_in_progress_are_finished(scene, jobs, here):
    with suppress(KeyboardInterrupt), graceful_shutdown() as stop:
        running = solve_loads(scene, jobs, workers=2, stop=stop)
        found = [next(running)]
        os.kill(os.getpid(), signal.SIGINT)
        found += running
    assert 2 <= len(found) <= 3, "two were at work, the first one's worker may have had a third"
    assert by_index(found) == {number: here[number] for number in by_index(found)}


def test_a_stop_is_checked_before_the_first_load_is_sent_to_a_worker(scene, jobs):
    assert list(solve_loads(scene, jobs, workers=1, stop=True)) == []


# ------------------------------------------------------------------ the end of the program

ENDING = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import test_worker_pool
from dpl.data.solving.worker_pool import solve_loads
from dpl.data.solving.solve import LoadKey
from dpl.fem.materials.neo_hookean import NeoHookeanLn
from dpl.fem import Plane, box
from dpl.fem.loads.modal import ModalLoads
from dpl.fem.solvers.newton import Newton
from dpl.fem.problem import Problem
from dpl.scene import Scene

if __name__ == "__main__":
    problem = Problem.build(
        box([100.0, 25.0, 25.0], [5, 3, 3]), NeoHookeanLn(0.3), fixed=Plane(0, "min")
    )
    newton = Newton(problem, linear="superlu")
    scene = Scene(problem, ModalLoads(newton.linear_solver, n_modes=3), newton)
    running = solve_loads(scene, [LoadKey((5, 0), k) for k in range(100000)], workers=1)
    print(next(running).accepted, flush=True)
    test_worker_pool.kept = running  # as long as the program
"""


@pytest.mark.slow
def test_a_program_with_a_running_pool_ends(tmp_path, environment):
    path = tmp_path / "ending.py"
    path.write_text(ENDING)
    process = subprocess.Popen(
        [sys.executable, str(path), str(Path(__file__).parent)],
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        assert process.stdout.readline() == b"True\n"
        assert process.wait(timeout=240) == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
