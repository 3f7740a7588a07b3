"""Laws of the data set on disk: the same bytes however it came about, nothing solved twice."""

import json
import multiprocessing
import os
import sys
from pathlib import Path

import pytest
import torch
from set_files import content, flaws

from dpl import DataSetError
from dpl.data import DataSet, Store, dataset
from dpl.data.solving import worker_pool
from dpl.data.solving.solve import LoadKey, failed_load, solve_load
from dpl.data.storage import store as store_module
from dpl.data.storage.integrity import repair
from dpl.data.storage.shard import reasons
from dpl.system.files import append_jsonl

SIZES = {"train": 12, "val": 4, "test": 4}
CHANGES = {f"os.{name}" for name in ("mkdir", "rename", "remove", "rmdir", "truncate", "link")}
WANTED = {split: range(size) for split, size in SIZES.items()}


@pytest.fixture
def fresh(scene, tmp_path):
    """The same data set before it is made."""
    return Store(tmp_path / "fresh", scene, 0)


def writer(store, shard=0, shards=1, workers=0):
    """Return a data set that writes to the files of a store."""
    part = {"shard": shard, "shards": shards, "workers": workers}
    return DataSet(store.scene, str(store.folder), store.seed, **part)


def fill(store, missing=None, workers=0, **more):
    """Solve what is missing of the tiny data set; return how many loads that were."""
    if missing is None:
        missing = {split: store.missing(split, size) for split, size in SIZES.items()}
    return len(list(writer(store, workers=workers).solve(missing.items(), **more)))


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# ------------------------------------------------------------------ what is stored


def test_stored_samples_are_the_loads_of_their_stream_and_meet_the_tolerance(data, scene):
    for split, size in SIZES.items():
        sample = data.store.load(split, size)
        assert len(sample.force) == size
        assert sample.force.dtype == sample.displacement.dtype == torch.float64
        ratio = scene.problem.relative_residual(sample.displacement, sample.force)
        assert ratio.max() < scene.solver.tol
        assert scene.problem.volume_ratio(sample.displacement).min() > 0
        assert not sample.displacement[:, ~scene.problem.free].any()
        drawn = scene.loads.sample(data.store.stream(split), range(size))
        assert torch.equal(sample.force, drawn.force)
        assert torch.equal(sample.young, drawn.young)


def test_the_data_set_carries_fingerprint_seed_and_versions(data, scene):
    card = json.loads((data.store.folder / "scene.json").read_text())
    assert card["fingerprint"] == scene.fingerprint
    assert card["scene"] == json.loads(json.dumps(scene.identity()))
    assert card["seed"] == data.store.seed
    assert card["versions"]["torch"] == torch.__version__


def test_rejected_loads_are_recorded_with_reason_and_load_factor(hard, tmp_path):
    store = Store(tmp_path / "d", hard, 0)
    fill(store, {"train": range(6)})
    (shard,) = store.shards()
    assert shard.tried == list(range(6))
    rejected = ~shard.accepted
    assert rejected.any(), "SVK bears six loads of ten times L: choose harder ones"
    factors = shard.columns["load_factor"][rejected]
    assert ((factors >= 0) & (factors < 1)).all()
    assert len(list(filter(None, reasons(shard.columns)))) == int(rejected.sum())
    accepted = int(shard.accepted.sum())
    if accepted:
        assert len(store.load("train", 6).force) == accepted
    assert f"{accepted} of 6 loads accepted" in store.summary()
    assert f" rejected: {reasons(shard.columns)[0]}" in store.summary()
    assert sum(part.tried for part in store.acceptance()) == 6
    assert sum(part.accepted for part in store.acceptance()) == accepted
    assert flaws(store) == {}


def test_a_shard_may_hold_rejected_loads_only(scene, fresh, solves, monkeypatch):
    solves(lambda one: failed_load(scene, one.job, "never"))
    fill(fresh, {"train": range(3)})
    assert fresh.missing("train", 4) == [3]
    assert flaws(fresh) == {}
    assert reasons(fresh.shards()[0].columns) == 3 * ["never"]
    with pytest.raises(DataSetError, match="no train samples"):
        fresh.load("train", 3)
    monkeypatch.undo()
    fill(fresh, {"train": [3]})
    assert len(fresh.load("train", 4).force) == 1


def test_forces_that_every_load_holds_are_stored_and_verified(scene, make_scene, tmp_path):
    weight = torch.full(scene.problem.shape, 1e-7, dtype=torch.float64)
    weight[:, 1:] = 0.0
    store = Store(tmp_path / "d", make_scene(constant_force=weight), 0)
    fill(store, {"train": range(3)})
    plain = scene.loads.sample((0, 0), range(3)).force
    assert torch.allclose(store.load("train", 3).force, plain + weight, rtol=0, atol=1e-18)
    assert flaws(store) == {}


# ------------------------------------------------------------------ the same bytes


def test_the_bytes_do_not_depend_on_the_order_in_which_loads_are_solved(data, fresh, monkeypatch):
    def backwards(scene, jobs, **more):
        return worker_pool.solve_loads(scene, list(jobs)[::-1], **more)

    monkeypatch.setattr(dataset, "solve_loads", backwards)
    fill(fresh, WANTED)
    assert content(fresh.folder) == content(data.store.folder)


def test_the_samples_do_not_depend_on_the_size_of_shards(data, fresh, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 5)
    fill(fresh, WANTED)
    assert max(len(shard.tried) for shard in fresh.shards()) == 5
    for split, count in SIZES.items():
        assert same(fresh.load(split, count), data.store.load(split, count))
    assert flaws(fresh) == {}


# ------------------------------------------------------------------ growing


def test_loads_are_samples_before_their_files_are_merged(fresh, monkeypatch):
    monkeypatch.setattr(store_module.Store, "merge", lambda *_: None)
    fill(fresh, {"train": [0, 1, 2, 3, 4, 5, 7]})
    assert len(list(fresh.folder.glob("train-*"))) == 7
    assert fresh.scattered() == [("train", 0)]
    expected = fresh.scene.loads.sample((0, 0), [4, 5, 7]).force
    assert torch.equal(fresh.load("train", 8, first=4).force, expected)
    assert fresh.tried("train") == {0, 1, 2, 3, 4, 5, 7}
    assert fresh.missing("train", 8) == [6]
    monkeypatch.undo()
    assert fill(fresh, {"train": [6]}) == 1
    assert [shard.tried for shard in fresh.shards()] == [list(range(8))]


@pytest.mark.parametrize("reads", ["shards", "load"])
def test_a_reader_waits_for_a_writer_that_merges_files(data, fresh, monkeypatch, reads):
    merge = Store.merge
    monkeypatch.setattr(Store, "merge", lambda *_: None)
    fill(fresh, WANTED)
    method = "describe" if reads == "shards" else "read"
    genuine, merged = getattr(Store, method), []

    def after_the_merge(self, path):
        if path.name == "train-000003.safetensors" and not merged:
            merged.append(path)
            for block in self.scattered():
                merge(self, *block)
        return genuine(self, path)

    monkeypatch.setattr(Store, method, after_the_merge)
    assert same(fresh.load("train", 12), data.store.load("train", 12))
    assert merged


def test_a_load_in_two_files_is_read_once_and_merged(data, copy):
    """A writer was killed after it had merged files and before it removed them."""
    copy.write(solve_load(copy.scene, LoadKey(copy.stream("train"), 7)))
    assert same(copy.load("train", 12), data.store.load("train", 12))
    fill(copy)
    assert content(copy.folder) == content(data.store.folder)


# ------------------------------------------------------------------ parts


def test_a_second_writer_of_the_whole_or_of_the_same_part_is_refused(fresh):
    running = writer(fresh, 0, 2).solve([("train", range(12))])
    next(running)
    for part in ((), (0, 2), (1, 3)):
        with pytest.raises(DataSetError, match=f"process {os.getpid()} on {os.uname().nodename}"):
            next(writer(fresh, *part).solve([("train", range(12))]))
    with pytest.raises(DataSetError, match=f"process {os.getpid()} on "):
        repair(fresh)
    running.close()
    assert fill(fresh) == 19


# ------------------------------------------------------------------ interruption


def test_an_error_in_writing_ends_the_workers(fresh, monkeypatch):
    """A traceback references the frames of the pool, which must be closed all the same."""
    before = multiprocessing.active_children()

    def keep(self, one):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "write", keep)
    with pytest.raises(OSError, match="No space left") as held:
        fill(fresh, WANTED, workers=1)
    assert held.value.__traceback__ is not None
    assert multiprocessing.active_children() == before


# ------------------------------------------------------------------ refusals


def test_a_data_set_of_another_scene_is_refused_naming_both_fingerprints(copy, make_scene):
    other = Store(copy.folder, make_scene(poisson=0.31), 0)
    uses = lambda: fill(other, WANTED), other.shards, lambda: repair(other), writer(other).create
    for use in uses:
        with pytest.raises(DataSetError) as refusal:
            use()
        assert copy.scene.fingerprint[:12] in str(refusal.value)
        assert other.scene.fingerprint[:12] in str(refusal.value)
        assert "law" in str(refusal.value)


def test_a_body_of_another_size_shares_the_set_with_its_own_moduli(copy, make_scene, solved):
    twin = make_scene(size=(1.0, 0.25, 0.25), young=[1e9, 2e11])
    shared = Store(copy.folder, twin, 0)
    assert fill(shared) == 0
    assert solved == []
    assert flaws(shared) == {}
    for split, size in SIZES.items():
        mine, theirs = shared.load(split, size), copy.load(split, size)
        assert same(mine[:2], theirs[:2])
        assert torch.equal(theirs.young, torch.full((size,), 4500.0, dtype=torch.float64))
        drawn = twin.loads.sample(shared.stream(split), range(size)).young
        assert torch.equal(mine.young, drawn)
        assert mine.young.min() >= 1e9
        assert mine.young.max() <= 2e11
        assert len(mine.young.unique()) == size


def test_a_folder_that_is_no_data_set_is_refused_and_not_changed(scene, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    store = Store(tmp_path, scene, 0)
    for use in (lambda: fill(store, WANTED), lambda: repair(store)):
        with pytest.raises(DataSetError, match="no data set"):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    "harm",
    ["", "{", "[]", "null", "\0\0\0", '{"format": 99}', '{"format": 5, "fingerprint": 3}'],
)
def test_a_damaged_scene_file_is_refused_by_name(copy, harm):
    (copy.folder / "scene.json").write_text(harm)
    with pytest.raises(DataSetError, match=r"scene\.json|format|another scene"):
        copy.shards()


def test_values_of_another_scene_are_compared_by_key(copy):
    """1 equals 1.0 even if the fingerprint differs."""
    card = json.loads((copy.folder / "scene.json").read_text())
    card["fingerprint"], card["scene"]["degree"] = "0f" * 32, 1.0
    (copy.folder / "scene.json").write_text(json.dumps(card))
    assert len(copy.shards()) == 3
    card["scene"]["loads"]["deflection"] = 0.3
    (copy.folder / "scene.json").write_text(json.dumps(card))
    with pytest.raises(DataSetError, match=r"\(loads\.deflection: 0\.3 there, 0\.4 here\)"):
        copy.shards()


def test_a_folder_of_another_seed_and_a_file_are_refused_by_their_key(copy, tmp_path):
    with pytest.raises(DataSetError, match=r"seed 0, not 1.*data\.seed"):
        fill(Store(copy.folder, copy.scene, 1), WANTED)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", Path("/dev/null")):
        with pytest.raises(DataSetError, match=r"^data\.folder = .* must be a folder"):
            Store(path, copy.scene, 0).shards()


def test_a_complete_data_set_is_only_read(copy):
    """So that it can lie in a folder that is mounted read-only."""
    written = []

    def audit(event, arguments):
        place = str(arguments[0]) if arguments and isinstance(arguments[0], str | Path) else ""
        writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if watched and place.startswith(watched) and (writes or event in CHANGES):
            written.append((event, place))

    watched = str(copy.folder)
    sys.addaudithook(audit)  # which cannot be removed
    try:
        (copy.folder / "x").touch()
        assert [Path(place).name for _, place in written] == ["x"], "a change is seen"
        (copy.folder / "x").unlink()
        written.clear()
        assert len(copy.load("train", 12).force) == 12
        assert copy.missing("train", 13) == [12]
        assert copy.summary()
        complete = DataSet(copy.scene, str(copy.folder), **SIZES, workers=0)
        complete.create()
        complete.fill()
        assert written == []
    finally:
        watched = ""


def test_invalid_lines_of_the_journal_are_ignored(copy):
    reported, a_load = copy.summary(), copy.seconds_per_load()
    with (copy.folder / "journal.jsonl").open("a") as file:
        for line in ("{}", '{"loads": "many"}', "[" * 99_999, '{"loads": NaN}'):
            file.write(line + "\n")
    assert (copy.summary(), copy.seconds_per_load()) == (reported, a_load)


# ------------------------------------------------------------------ reports


def test_the_summary_states_mean_iterations_and_size(copy):
    (shard,) = copy.shards("train")
    mean = int(shard.columns["iterations"].sum()) / len(shard.tried)
    assert f"{mean:.1f} iterations" in copy.summary()
    with (copy.folder / "large.safetensors").open("wb") as file:
        file.truncate(30_000_000)  # sparse
    assert "sessions, 30 MB" in copy.summary()


def test_the_time_per_load_is_the_mean_over_all_sessions(copy):
    (copy.folder / "journal.jsonl").unlink()
    assert copy.seconds_per_load() is None
    for line in (
        {"loads": 10, "seconds": 4.0, "core_seconds": 8.0},
        {"loads": 30, "seconds": 4.0, "core_seconds": 24.0},
        {"loads": 30, "seconds": "long"},
    ):
        append_jsonl(copy.folder / "journal.jsonl", line)
    assert copy.seconds_per_load() == pytest.approx(8.0 / 40)
    assert "0.800 s per load on one core, 8 s of wall time in 2 sessions" in copy.summary()
