"""Laws of data sets: missing loads, generation, interruption, messages, verify and repair."""

import json
import os
import signal

import pytest
from set_files import content

from dpl.data import DataSet, Store
from dpl.data.solving.solve import failed_load

SIZES = {"train": 6, "val": 2, "test": 2}


@pytest.fixture
def wanted(scene, tmp_path):
    """Return a function that builds data sets of ten loads in one folder."""

    def wanted(**other):
        return DataSet(scene, str(tmp_path / "d"), **{**SIZES, "workers": 0, **other})

    return wanted


@pytest.fixture
def interrupted(monkeypatch):
    """Return a function that sends signals to this process after a number of solved loads."""

    def interrupted(after, *signals):
        count = 0
        real = Store.write

        def keep(self, one):
            nonlocal count
            count += 1
            real(self, one)
            if count == after:
                for number in signals:
                    os.kill(os.getpid(), number)

        monkeypatch.setattr(Store, "write", keep)

    return interrupted


def sessions(store):
    return [json.loads(line) for line in (store.folder / "journal.jsonl").read_text().splitlines()]


# ------------------------------------------------------------------ what is wanted


def test_the_folder_is_named_after_scene_and_seed_if_left_out(scene, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    made = DataSet(scene, seed=7, train=1, val=0, test=0, workers=0).fill()
    (folder,) = (tmp_path / "datasets").iterdir()
    assert folder.name == f"{scene.fingerprint[:12]}-seed7"
    assert made.folder.resolve() == folder


def test_the_plan_counts_existing_loads_and_writes_nothing(wanted, scene, tmp_path):
    (line,) = wanted().skipped_work()
    assert scene.fingerprint[:12] in line
    assert not wanted(train=0, val=0, test=0).fill().folder.exists()
    assert wanted().store.summary().splitlines() == [str(wanted().store.folder)]
    assert not list(tmp_path.iterdir())
    wanted(train=4, test=0).fill()
    assert "6 of 10 loads not solved again: they are there" in wanted().skipped_work()
    assert (
        "6 of 10 loads not solved again: they are there" in wanted(shard=1, shards=2).skipped_work()
    )


# ------------------------------------------------------------------ filling it


def test_the_journal_has_a_line_for_each_session_that_solved_something(wanted, capsys):
    store = wanted(val=0, test=0).fill()
    wanted(val=0, test=0).fill()
    wanted().fill()
    first, second = sessions(store)
    assert (first["loads"], second["loads"]) == (6, 4)
    for one in (first, second):
        assert one["process"] == os.getpid()
        assert one["workers"] == 0
        assert one["seconds"] > 0
        assert one["core_seconds"] > 0
        assert {"started", "machine", "python", "dpl"} <= set(one)


def test_progress_and_summary_tell_splits_amplitudes_and_time(wanted, capsys):
    reported = wanted().fill().summary().splitlines()
    out = capsys.readouterr().out
    assert "10/10" in out
    assert "10 accepted, 0 rejected" in out
    assert "/s" in out
    assert reported[0].endswith("/d")
    assert "train: 6 of 6 loads accepted" in reported[1]
    assert "val: 2 of 2 loads accepted" in reported[2]
    assert "test: 2 of 2 loads accepted" in reported[3]
    assert "iterations" in reported[1]
    assert any("amplitude up to" in line for line in reported)
    assert "s per load on one core" in reported[-1]
    assert "MB" in reported[-1]


# ------------------------------------------------------------------ interruption


@pytest.mark.parametrize(
    ("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_after_one_signal_the_solve_in_progress_is_finished(wanted, interrupted, number, raised):
    interrupted(3, number)
    with pytest.raises(raised) as end:
        wanted().fill()
    if raised is SystemExit:
        assert end.value.code == 143
    store = wanted().store
    assert len(store.tried("train")) == 3
    assert sessions(store)[0]["loads"] == 3


def test_a_set_interrupted_by_two_signals_has_the_bytes_of_an_uninterrupted_one(
    wanted, scene, tmp_path, interrupted, solved
):
    after = 5
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    at_once = DataSet(scene, str(tmp_path / "at once"), **SIZES, workers=0).fill()
    solved.clear()
    interrupted(after, signal.SIGINT, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        wanted().fill()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert len(solved) == after
    wanted().fill()
    assert len(set(solved)) == len(solved) == 10, "no load is solved twice"
    assert content(wanted().store.folder) == content(at_once.folder)
    assert sum(one["loads"] for one in sessions(wanted().store)) in (9, 10)


# ------------------------------------------------------------------ warnings


def test_an_unbiased_set_and_six_rejected_loads_give_no_warning(wanted, hard, tmp_path, capsys):
    wanted(train=20).fill()
    assert capsys.readouterr().err == ""
    DataSet(hard, str(tmp_path / "hard"), train=6, val=0, test=0, workers=0).fill()
    assert "biased" not in capsys.readouterr().err, "six loads say nothing"


def test_a_biased_set_gives_a_warning_of_one_line(scene, wanted, solves, capsys):
    solves(lambda one: failed_load(scene, one.job, "no") if one.amplitude > 0.1 else one)
    store = wanted(train=80).fill()
    err = capsys.readouterr().err
    poor = [part for part in store.acceptance() if part.biased]
    assert poor, "no range of ten large loads: want more"
    assert err.startswith("warning: the data set is biased: only ")
    assert err.count("\n") == 1
    assert all(part.accepted == part.tried for part in store.acceptance() if part.high < 0.1)


# ------------------------------------------------------------------ the command


def test_the_command_verifies_and_repairs_a_set(script, tiny, tmp_path):
    sizes = [*tiny, "data.train=4", "data.val=1", "data.test=1", "data.workers=0", "data.folder=d"]
    assert script("generate", *sizes, cwd=tmp_path).status == 0
    before = content(tmp_path / "d")
    again = script("generate", *sizes, cwd=tmp_path)
    assert "train: 4 of 4 loads accepted" in again.out
    assert "solving" not in again.out
    sound = script("generate", *sizes, "action=verify", cwd=tmp_path)
    assert sound.status == 0
    assert "0 flaws found" in sound.out
    assert "train: 4 of 4 loads accepted" in sound.out
    path = tmp_path / "d/test-000000.safetensors"
    harmed = bytearray(path.read_bytes())
    harmed[-3] ^= 8
    path.write_bytes(harmed)
    found = script("generate", *sizes, "action=verify", cwd=tmp_path)
    assert found.status == 1
    assert "d/test-000000.safetensors is damaged" in found.out
    assert "1 flaws found" in found.out
    repaired = script("generate", *sizes, "action=repair", cwd=tmp_path)
    assert repaired.status == 0
    assert "1/1" in repaired.out
    assert content(tmp_path / "d") == before
    assert script("generate", *sizes, "action=verify", cwd=tmp_path).status == 0


INVALID = {
    "action=look": "action = 'look' must be one of generate, verify, repair",
    "shard=1": "shard = 1",
    "data.timeout=0": "timeout = 0",
    "data.seed=1": "was drawn with seed 0, not 1",
    "material.poisson=0.31": "another scene",
    "data.folder=typo action=verify": "typo holds no data set yet; generate it first",
}


def test_invalid_options_end_with_one_line_and_status_2(script, tiny, scene_of, tmp_path):
    scene = scene_of(*tiny)
    DataSet(scene, str(tmp_path / "d"), train=1, val=0, test=0, workers=0).fill()
    for override, reported in INVALID.items():
        ended = script("generate", *tiny, "data.folder=d", *override.split(), cwd=tmp_path)
        assert ended.status == 2, override
        assert ended.err.startswith("error: ")
        assert reported in ended.err
        assert ended.err.count("\n") == 1
