"""A data set that is solved, killed, damaged and repaired in any order has the bytes of one run."""

import functools
import shutil
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from set_files import content

from dpl.data import DataSet, DataSetError, Store, dataset
from dpl.data.solving.solve import failed_load, solve_load
from dpl.data.storage import store as store_module
from dpl.data.storage.integrity import MACHINE_FAILURES

SIZES = {"train": 8, "val": 3, "test": 2}
COUNT = sum(SIZES.values())


class Killed(BaseException):
    """End of a process by SIGKILL."""


@contextmanager
def killed_after(operations):
    """Let no file be renamed or removed after a number of such operations."""
    left = operations

    def dying(original):
        def call(*arguments, **options):
            nonlocal left
            if left <= 0:
                raise Killed
            left -= 1
            return original(*arguments, **options)

        return call

    with pytest.MonkeyPatch.context() as patch, suppress(Killed):
        patch.setattr("dpl.system.files.os.replace", dying(shutil.move))
        patch.setattr(Path, "unlink", dying(Path.unlink))
        yield


class Life(RuleBasedStateMachine):
    """Sessions of writers of one data set, with their accidents.

    Attributes:
        whole: The same data set, made by one run.
        unlucky: Numbers of loads whose solves fail because of the machine.
        solved: Number of solves of each load.
        is_sound: Whether nothing has been damaged or failed since the last repair.
        lost_work: Whether solved loads may have been lost.
    """

    def __init__(self, whole, folder):
        super().__init__()
        self.whole, self.folder = whole, folder
        self.unlucky, self.solved = set(), Counter()
        self.is_sound, self.lost_work = True, False
        shutil.rmtree(folder, ignore_errors=True)
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr("dpl.data.solving.worker_pool.solve_load", self.solve_load)

    def solve_load(self, scene, job):
        self.solved[job] += 1
        if job.number in self.unlucky:
            return failed_load(scene, job, f"{MACHINE_FAILURES[job.number % 2]} 3 times")
        return solve_once(scene, job)

    def writer(self, **part):
        return DataSet(self.whole.scene, str(self.folder), **SIZES, workers=0, **part)

    def wanted(self):
        return {split: range(size) for split, size in SIZES.items()}.items()

    @rule(count=st.integers(0, COUNT))
    def a_session_ends_after_some_loads(self, count):
        running = self.writer().solve(self.wanted())
        for _ in range(count):
            next(running, None)
        running.close()

    @rule(operations=st.integers(0, 3 * COUNT))
    def a_session_is_killed(self, operations):
        self.lost_work = True
        with killed_after(operations):
            list(self.writer().solve(self.wanted()))

    @rule(turns=st.lists(st.integers(0, 1), max_size=COUNT))
    def two_writers_share_the_work(self, turns):
        writers = [self.writer(shard=shard, shards=2) for shard in range(2)]
        running = [one.solve(one.missing().items()) for one in writers]
        for turn in turns:
            next(running[turn], None)
        for one in running:
            one.close()

    @rule(number=st.integers(0, 7))
    def a_load_fails_because_of_the_machine(self, number):
        self.is_sound, self.lost_work = False, True
        self.unlucky = {number}
        list(self.writer().solve(self.wanted()))
        self.unlucky = set()

    @rule(
        which=st.integers(0, 99),
        how=st.sampled_from(["flip", "cut", "empty", "delete", "stray", "part"]),
        place=st.floats(0, 1, exclude_max=True),
    )
    def a_file_is_damaged(self, which, how, place):
        found = sorted(self.folder.glob("*.safetensors"))
        if not found:
            return
        self.is_sound, self.lost_work = False, True
        path = found[which % len(found)]
        harmed = bytearray(path.read_bytes())
        place = int(place * len(harmed))
        if how == "flip" and harmed:
            harmed[place] ^= 1 << which % 8
        elif how in ("cut", "empty"):
            del harmed[place if how == "cut" else 0 :]
        if how == "stray":
            (self.folder / f"train-{which:06d}00.safetensors").write_bytes(harmed)
        elif how == "part":
            path.with_name(f".{path.name}.99.part").write_bytes(harmed)
        elif how == "delete":
            path.unlink()
        else:
            path.write_bytes(harmed)

    @rule()
    def it_is_repaired(self):
        self.writer().repair()
        self.is_sound = True
        self.is_complete()

    @invariant()
    def what_is_read_was_written(self):
        store = Store(self.folder, self.whole.scene, 0)
        for split, size in SIZES.items():
            truth = self.whole.load(split, size)
            with suppress(DataSetError):  # none are there, or they are damaged
                found = store.load(split, size)
                for force, displacement in zip(found.force, found.displacement, strict=True):
                    row = (truth.force == force).flatten(1).all(dim=1).nonzero()
                    assert torch.equal(truth.displacement[int(row)], displacement)

    def is_complete(self):
        assert content(self.folder) == content(self.whole.folder)
        assert list(self.writer().verify()) == []
        assert not list(self.folder.rglob("*.part"))

    def teardown(self):
        try:
            if self.is_sound:
                self.writer().fill()
                self.is_complete()
            else:
                self.it_is_repaired()
            if not self.lost_work:
                assert set(self.solved.values()) == {1}, "no load is solved twice"
        finally:
            self.patch.undo()


@functools.cache
def solve_once(scene, job):
    return solve_load(scene, job)


def test_every_life_ends_with_the_bytes_of_one_run(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 3)
    monkeypatch.setattr(dataset, "PARTIAL_FILE_AGE", -1.0)
    whole = DataSet(scene, str(tmp_path / "whole"), **SIZES, workers=0).fill()
    options = settings(max_examples=12, stateful_step_count=8, deadline=None)
    run_state_machine_as_test(lambda: Life(whole, tmp_path / "d"), settings=options)
