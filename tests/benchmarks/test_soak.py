"""A soak sees what grows, slows down and is left behind, and what does none of it."""

import subprocess
import sys
from dataclasses import replace

import pytest

from benchmarks import soak
from dpl.inference import Simulator
from dpl.models import FCNN
from dpl.training import MSE, Surrogate

EVEN = [soak.Vitals("work", 5.0 * k, 100 * k, 500.0, 20, 3, 4) for k in range(50)]


def test_work_that_goes_on_as_it_began_has_no_flaws():
    assert soak.flaws(EVEN) == []
    filling = [replace(row, memory=100 + 40.0 * min(k, 20)) for k, row in enumerate(EVEN)]
    assert soak.flaws(filling) == [], "the first half is for caches to fill"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda k, row: replace(row, memory=500 + 2.0 * k), "memory grew from 549 to 589 MB"),
        (lambda k, row: replace(row, done=round(1000 * k**0.3)), "a second became"),
        (lambda k, row: replace(row, files=20 + k // 5), "files were 24.5, are 28.5"),
        (lambda k, row: replace(row, processes=3 - k // 40), "processes were 3, are 2"),
        (lambda k, row: replace(row, shared=4 + k), "shared were"),
    ],
    ids=["memory", "rate", "files", "processes", "shared memory"],
)
def test_what_grows_or_slows_down_is_named(change, told):
    found = soak.flaws([change(k, row) for k, row in enumerate(EVEN)])
    assert any(told in line for line in found), found


def test_too_few_looks_are_refused():
    with pytest.raises(ValueError, match="let it take longer"):
        soak.flaws(EVEN[:9])


def test_processes_files_and_memory_of_children_count():
    before = soak.vitals("before", 0.0, 0)
    holding = "x = bytearray(200_000_000); f = open('/dev/null'); print(flush=True); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", holding], **pipes) as child:
        child.stdout.readline()
        during = soak.vitals("during", 0.0, 0)
        child.communicate(b"\n")
    after = soak.vitals("after", 0.0, 0)
    assert during.processes == before.processes + 1
    assert during.memory > before.memory + 190
    assert during.files > before.files + 3
    assert soak.left(before, during) == ["1 processes more than before"]
    assert soak.left(before, after) == []


def test_a_simulator_is_asked_in_every_way(scene, tmp_path):
    sim = Simulator(Surrogate(FCNN(scene, width=8), MSE(), scene))
    rows = list(soak.simulator(sim, 1.5, every=0.05))
    assert rows[-1].done > 7, "each way was asked"
    assert [row.seconds for row in rows] == sorted(row.seconds for row in rows)
    soak.draw(rows, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 10_000
    assert soak.told(rows).startswith("simulator: ")


@pytest.mark.slow
def test_a_short_soak_leaves_its_rows_and_figure(script, tiny, tmp_path):
    options = ["data.val=4", "data.test=4", "data.batch_size=8", "model.width=16", "minutes=0.5"]
    ended = script("soak", *tiny, *options, "run=r", cwd=tmp_path)
    assert ended.status in (0, 1), ended.err
    assert {"soak.csv", "soak.png", "machine.json"} <= {p.name for p in (tmp_path / "r").iterdir()}
    assert "online training: " in ended.out
    assert "more than before" not in ended.out
