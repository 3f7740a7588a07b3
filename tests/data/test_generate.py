"""Laws of `dpl.data.generate`: the same samples from any crew, and no process left behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from dpl.data import generate
from dpl.data.generate import Job, outcome, outcomes
from dpl.fem.materials import SaintVenantKirchhoff
from dpl.fem.modes import uniform

SEED = (5, 0)
ANSWER = ("force", "displacement", "young", "accepted", "residual", "iterations", "reason")


def content(one):
    """Return all of an outcome that may not depend on who solved it, as comparable values."""
    values = (getattr(one, name) for name in ANSWER)
    return [v.tobytes() if isinstance(v, np.ndarray) else v for v in values]


def by_index(found):
    return {one.job.number: content(one) for one in found}


def index_of(rng):
    return rng.bit_generator.seed_seq.spawn_key[-1]


def in_a_worker():
    return multiprocessing.parent_process() is not None


def dies_at_one(rng, count):
    """Draw as `uniform`; load 1 ends the worker that draws it."""
    if index_of(rng) == 1 and in_a_worker():
        os._exit(1)
    return uniform(rng, count)


def killed_once(rng, count, *, mark):
    """Draw as `uniform`; load 2 gets its first worker killed."""
    if index_of(rng) == 2 and in_a_worker() and not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return uniform(rng, count)


def raises(rng, count):
    """Draw nothing: every worker ends with a traceback."""
    raise RuntimeError("no load can be drawn")


def children():
    return {child.pid for child in multiprocessing.active_children()}


@pytest.fixture(scope="module")
def jobs():
    return [Job(SEED, index) for index in range(8)]


@pytest.fixture(scope="module")
def here(scene, jobs):
    """What this process finds."""
    return by_index(outcomes(scene, jobs, workers=0))


def test_loads_are_solved_in_the_order_of_the_jobs_without_workers(scene, jobs):
    assert [one.job for one in outcomes(scene, jobs[::-1], workers=0)] == jobs[::-1]


def test_a_sample_does_not_depend_on_the_order_of_the_jobs(scene, jobs, here):
    assert by_index(outcomes(scene, jobs[::-1], workers=0)) == here
    assert content(outcome(scene, jobs[5])) == here[5]


def test_a_sample_does_not_depend_on_the_scene_object(make_scene, jobs, here):
    assert content(outcome(make_scene(), jobs[3])) == here[3]


def test_a_killed_worker_is_replaced_and_every_crew_finds_the_same_bytes(
    make_scene, jobs, here, tmp_path
):
    before = children()
    mark = tmp_path / "killed"
    scene = make_scene(distribution=partial(killed_once, mark=str(mark)))
    found = list(outcomes(scene, jobs, workers=2))
    assert mark.exists()
    assert sorted(one.job.number for one in found) == list(range(8))
    assert by_index(found) == here
    assert children() <= before


def test_a_crew_closed_early_leaves_no_process_and_one_worker_finds_the_same_bytes(
    scene, jobs, here
):
    before = children()
    running = outcomes(scene, jobs, workers=1)
    first = [next(running), next(running)]
    crew = children() - before
    assert len(crew) == 1
    running.close()
    assert all(content(one) == here[one.job.number] for one in first)
    assert not crew & children()
    assert not any(Path(f"/proc/{pid}").exists() for pid in crew)


def test_a_load_that_kills_every_worker_is_given_up_with_a_reason(make_scene, here, monkeypatch):
    monkeypatch.setattr(generate, "TRIES", 2)
    scene = make_scene(distribution=dies_at_one)
    found = {
        one.job.number: one for one in outcomes(scene, [Job(SEED, 1), Job(SEED, 0)], workers=1)
    }
    assert content(found[0]) == here[0]
    lost = found[1]
    assert not lost.accepted
    assert "died 2 times" in lost.reason
    assert lost.load_factor == 0
    assert lost.force.tobytes() == here[1][0], "the load that could not be solved is kept"
    assert not children()


def test_workers_that_all_die_end_the_run(make_scene, monkeypatch, capfd):
    monkeypatch.setattr(generate, "HOPELESS", 1)
    scene = make_scene()
    scene.loads.modes  # noqa: B018 - found before the draws start to fail
    object.__setattr__(scene.loads, "distribution", raises)
    with pytest.raises(RuntimeError, match="workers died one after the other"):
        list(outcomes(scene, [Job(SEED, index) for index in range(4)], workers=1))
    assert "no load can be drawn" in capfd.readouterr().err
    assert not children()


def test_no_jobs_cost_no_process(scene):
    start = time.perf_counter()
    assert list(outcomes(scene, [], workers=2)) == []
    assert time.perf_counter() - start < 0.5


def test_an_outcome_is_judged_at_the_state_that_it_holds(scene, jobs):
    for job in jobs:
        one = outcome(scene, job)
        force, displacement = torch.from_numpy(one.force), torch.from_numpy(one.displacement)
        ratio = scene.problem.residual_ratio(displacement[None], force[None])
        assert one.accepted
        assert float(ratio) == pytest.approx(one.residual, rel=1e-6, abs=1e-14)
        assert one.residual < scene.solver.tol
        assert one.volume_ratio > 0
        assert one.load_factor == 1
        assert one.seconds > 0
        assert one.reason == ""


def test_a_load_without_an_answer_is_rejected_with_the_part_that_has_one(make_scene):
    scene = make_scene(law=SaintVenantKirchhoff, deflection=10.0, patch=(2.0, 2.0))
    found = [outcome(scene, Job(SEED, index)) for index in range(6)]
    lost = [one for one in found if not one.accepted]
    assert lost, "six loads of ten times L that SVK all bears: choose harder ones"
    for one in lost:
        assert one.reason
        assert 0 <= one.load_factor < 1
        displacement = torch.from_numpy(one.displacement)[None]
        part = one.load_factor * torch.from_numpy(one.force)[None]
        if one.load_factor:
            assert scene.problem.residual_ratio(displacement, part) < scene.solver.loose
            assert scene.problem.volume_ratio(displacement) > 0


def test_a_change_of_the_number_of_threads_between_loads_is_survived(tmp_path, environment):
    """PARDISO reads past its plan where threads are limited between analysis and factorisation."""
    pytest.importorskip("pypardiso")
    code = """
import torch
from threadpoolctl import threadpool_limits
from dpl.data.generate import Job, outcome
from dpl.fem.materials import NeoHookeanLn
from dpl.fem.mesh import Plane, box
from dpl.fem.modes import ModalLoads
from dpl.fem.newton import Newton
from dpl.fem.problem import Problem
from dpl.scene import Scene

torch.set_num_threads(2)
mesh = box([4.0, 1.0, 1.0], [17, 5, 5])
newton = Newton(Problem.build(mesh, NeoHookeanLn(0.3), fixed=Plane(0, "min")), linear="pardiso")
scene = Scene(newton.problem, ModalLoads(newton.rest, n_modes=3, deflection=0.01), newton)
outcome(scene, Job((0, 0), 0))
with threadpool_limits(1):
    assert outcome(scene, Job((0, 0), 1)).accepted
"""
    ended = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment(threads=2),
        capture_output=True,
    )
    assert ended.returncode == 0, ended.stderr.decode()[-500:] or f"signal {-ended.returncode}"
