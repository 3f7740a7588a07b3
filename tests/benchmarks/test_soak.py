"""Laws of the soak test: growth, loss of speed and leftovers are reported."""

import subprocess
import sys
from dataclasses import replace

import pytest

from benchmarks import soak

EVEN = [soak.Usage("work", 5.0 * k, 100 * k, 500.0, 20, 3, 4) for k in range(50)]


def test_steady_work_has_no_regressions():
    assert soak.regressions(EVEN) == []
    filling = [replace(row, memory=100 + 40.0 * min(k, 20)) for k, row in enumerate(EVEN)]
    assert soak.regressions(filling) == [], "caches fill in the first half"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k, row: replace(row, memory=500 + 2.0 * k), "memory grew from 549 to 589 MB"),
        (lambda k, row: replace(row, steps=round(1000 * k**0.3)), "a second became"),
        (lambda k, row: replace(row, files=20 + k // 5), "files were 24.5, are 28.5"),
        (lambda k, row: replace(row, processes=3 - k // 40), "processes were 3, are 2"),
        (lambda k, row: replace(row, shm_segments=4 + k), "shm_segments were"),
    ],
    ids=["memory", "rate", "files", "processes", "shared memory"],
)
def test_growth_and_loss_of_speed_are_reported(change, message):
    found = soak.regressions([change(k, row) for k, row in enumerate(EVEN)])
    assert any(message in line for line in found), found


def test_processes_files_and_memory_of_children_count():
    before = soak.usage("before", 0.0, 0)
    holding = "x = bytearray(200_000_000); f = open('/dev/null'); print(flush=True); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", holding], **pipes) as child:
        child.stdout.readline()
        during = soak.usage("during", 0.0, 0)
        child.communicate(b"\n")
    after = soak.usage("after", 0.0, 0)
    assert during.processes == before.processes + 1
    assert during.memory > before.memory + 190
    assert during.files > before.files + 3
    assert soak.leftovers(before, during) == ["1 processes more than before"]
    assert soak.leftovers(before, after) == []


@pytest.mark.slow
def test_a_short_soak_leaves_its_rows_and_figure(script, tiny, tmp_path):
    options = ["data.val=4", "data.test=4", "data.batch_size=8", "model.width=16", "minutes=0.5"]
    ended = script("soak", *tiny, *options, "run=r", cwd=tmp_path)
    assert ended.status in (0, 1), ended.err
    assert {"soak.csv", "soak.png", "soak.json"} <= {p.name for p in (tmp_path / "r").iterdir()}
    assert "online training: " in ended.out
    assert "more than before" not in ended.out
