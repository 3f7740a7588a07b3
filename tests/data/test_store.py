"""Laws of the data set on disk: the same bytes however it came about, nothing solved twice."""

import hashlib
import json
import multiprocessing
import os
import shutil
import subprocess
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save
from set_files import content, flaws, lines

from dpl import DataSetError
from dpl.data import DataSet, Store, dataset
from dpl.data.solving import worker_pool
from dpl.data.solving.solve import LoadKey, failed_load, solve_load
from dpl.data.storage import store as store_module
from dpl.data.storage.integrity import repair
from dpl.data.storage.manifest import shard_name
from dpl.data.storage.pending import PendingLoads
from dpl.data.storage.shard import to_dense, to_sparse
from dpl.fem import SaintVenantKirchhoff, rectangle
from dpl.system.files import append_jsonl

SIZES = {"train": 12, "val": 4, "test": 4}
WANTED = {split: range(size) for split, size in SIZES.items()}


@pytest.fixture
def fresh(scene, tmp_path):
    """The same data set before it is made."""
    return Store(tmp_path / "fresh", scene, 0)


@pytest.fixture
def solved(monkeypatch):
    """The list of solved loads, extended by each solve."""
    found = []

    def counted(scene, job):
        found.append((*job.seed, job.number))
        return solve_load(scene, job)

    monkeypatch.setattr("dpl.data.solving.worker_pool.solve_load", counted)
    return found


@pytest.fixture(scope="module")
def hard(make_scene):
    """Loads of ten times L on a law that does not bear them all."""
    return make_scene(law=SaintVenantKirchhoff, deflection=10.0, patch_radius=(2.0, 2.0))


def writer(store, shard=0, shards=1, workers=0):
    """Return a data set that writes to the files of a store."""
    return DataSet(
        store.scene, str(store.folder), store.seed, workers=workers, shard=shard, shards=shards
    )


def fill(store, missing=None, workers=0, **more):
    """Solve what is missing of the tiny data set; return how many loads that were."""
    if missing is None:
        missing = {split: store.missing(split, size) for split, size in SIZES.items()}
    return len(list(writer(store, workers=workers).solve(missing.items(), **more)))


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def rewrite(store, change, which=0):
    """Change the tensors of a shard and write down its new digest, as an intruder would."""
    manifest = store.folder / "manifest.jsonl"
    found = lines(store)
    path = store.folder / found[which]["file"]
    shard = load_file(path)
    changed = change(shard)
    path.write_bytes(changed if isinstance(changed, bytes) else save(changed or shard))
    found[which]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest.write_text("".join(json.dumps(line) + "\n" for line in found))
    return path.name


def mended(store):
    return [part.file for part, _ in repair(store)]


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


def test_the_data_set_carries_modes_fingerprint_seed_and_versions(data, scene):
    kept = data.store.modes()
    assert torch.equal(kept["values"], scene.loads.eigenmodes.values)
    assert torch.equal(kept["vectors"], scene.loads.eigenmodes.vectors)
    card = json.loads((data.store.folder / "scene.json").read_text())
    assert card["fingerprint"] == scene.fingerprint
    assert card["scene"] == json.loads(json.dumps(scene.identity()))
    assert card["seed"] == data.store.seed
    assert card["versions"]["torch"] == torch.__version__


def test_rejected_loads_are_recorded_with_reason_and_load_factor(hard, tmp_path):
    store = Store(tmp_path / "d", hard, 0)
    fill(store, {"train": range(6)})
    (line,) = lines(store)
    assert line["tried"] == len(line["amplitudes"]) == 6
    assert line["rejected"], "SVK bears six loads of ten times L: choose harder ones"
    assert line["accepted"] + len(line["rejected"]) == 6
    for one in line["rejected"]:
        assert one["reason"]
        assert 0 <= one["load_factor"] < 1
    rejected = {one["index"] for one in line["rejected"]}
    shard = load_file(store.folder / line["file"])
    assert set(shard["index"].tolist()) == set(range(6)) - rejected
    if line["accepted"]:
        assert len(store.load("train", 6).force) == line["accepted"]
    assert f"{line['accepted']} of 6 loads accepted" in store.summary()
    assert sum(part.tried for part in store.acceptance()) == 6
    assert sum(part.accepted for part in store.acceptance()) == line["accepted"]
    assert flaws(store) == {}


def test_a_shard_may_hold_rejected_loads_only(scene, fresh, monkeypatch):
    monkeypatch.setattr(
        "dpl.data.solving.worker_pool.solve_load",
        lambda scene, job: failed_load(scene, job, "never"),
    )
    fill(fresh, {"train": range(3)})
    assert fresh.missing("train", 4) == [3]
    assert flaws(fresh) == {}
    assert {one["reason"] for one in lines(fresh)[0]["rejected"]} == {"never"}
    with pytest.raises(DataSetError, match="no train samples"):
        fresh.load("train", 3)
    monkeypatch.undo()
    fill(fresh, {"train": [3]})
    assert len(fresh.load("train", 4).force) == 1


# ------------------------------------------------------------------ forces


@pytest.mark.parametrize("shape", [(7, 3), (5, 2)])
def test_forces_are_restored_from_their_sparse_form(shape):
    generator = torch.Generator().manual_seed(0)
    force = torch.randn(6, *shape, generator=generator, dtype=torch.float64)
    force[torch.rand(6, shape[0], generator=generator) < 0.6] = 0.0
    force[0, 2], force[0, 2, 1] = 0.0, 1e-300  # one component of a node is a node that carries
    force[3] = 0.0
    packed = to_sparse(force)
    assert torch.equal(to_dense(packed, shape), force)
    assert len(packed["nodal_force"]) == len(packed["node"]) == packed["n_loaded_nodes"].sum()
    assert packed["n_loaded_nodes"][3] == 0
    assert packed["node"].dtype == torch.int32
    assert packed["nodal_force"].abs().amax(dim=1).min() > 0, "nothing is stored of idle nodes"


def test_forces_that_every_load_holds_are_stored_and_verified(scene, make_scene, tmp_path):
    weight = torch.full(scene.problem.shape, 1e-7, dtype=torch.float64)
    weight[:, 1:] = 0.0
    store = Store(tmp_path / "d", make_scene(constant_force=weight), 0)
    fill(store, {"train": range(3)})
    plain = scene.loads.sample((0, 0), range(3)).force
    assert torch.allclose(store.load("train", 3).force, plain + weight, rtol=0, atol=1e-18)
    assert flaws(store) == {}


def test_samples_of_plane_bodies_are_stored(make_scene, tmp_path):
    mesh = rectangle([4.0, 1.0], [9, 3])
    store = Store(tmp_path / "d", make_scene(mesh=mesh, deflection=0.1), 0)
    fill(store, {"train": range(3)})
    assert store.load("train", 3).force.shape[1:] == store.scene.problem.shape == (27, 2)
    assert flaws(store) == {}


# ------------------------------------------------------------------ the same bytes


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_bytes_do_not_depend_on_the_number_of_workers(data, fresh, workers):
    fill(fresh, WANTED, workers=workers)
    assert content(fresh.folder) == content(data.store.folder)


def test_the_bytes_do_not_depend_on_the_order_in_which_loads_are_solved(data, fresh, monkeypatch):
    def backwards(scene, jobs, **more):
        return worker_pool.solve_loads(scene, list(jobs)[::-1], **more)

    monkeypatch.setattr(dataset, "solve_loads", backwards)
    fill(fresh, WANTED)
    assert content(fresh.folder) == content(data.store.folder)


def test_the_samples_do_not_depend_on_the_size_of_shards(data, fresh, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 5)
    fill(fresh, WANTED)
    assert max(line["tried"] for line in lines(fresh)) == 5
    for split, count in SIZES.items():
        assert fresh.digest(split, count) == data.store.digest(split, count)
    assert flaws(fresh) == {}


# ------------------------------------------------------------------ growing


def test_growing_solves_only_the_new_loads_and_gives_the_same_samples(data, fresh, solved):
    fill(fresh, {"train": range(5)})
    before = fresh.load("train", 5)
    files = content(fresh.folder)
    solved.clear()
    fill(fresh, {"train": fresh.missing("train", 12)})
    assert solved == [(0, 0, index) for index in range(5, 12)]
    assert same([column[:5] for column in fresh.load("train", 12)], before)
    assert fresh.missing("train", 12) == []
    assert fresh.digest("train", 12) == data.store.digest("train", 12)
    assert all(
        content(fresh.folder)[name] == was for name, was in files.items() if "manifest" not in name
    )
    assert [(line["first"], line["tried"]) for line in lines(fresh)] == [(0, 5), (5, 7)]


def test_shards_begin_at_multiples_of_their_size(fresh, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD_SIZE", 4)
    for count in (6, 11):
        fill(fresh, {"train": fresh.missing("train", count)})
    assert [(line["first"], line["tried"]) for line in lines(fresh)] == [
        (0, 4), (4, 2), (6, 2), (8, 3)
    ]  # fmt: skip


def test_a_load_that_two_writers_have_solved_is_read_once(data, copy):
    """Parts of different divisions were copied into one folder."""
    (copy.folder / "manifest-0-of-2.jsonl").write_bytes(
        (copy.folder / "manifest.jsonl").read_bytes()
    )
    for split, size in SIZES.items():
        assert same(copy.load(split, size), data.store.load(split, size))


# ------------------------------------------------------------------ parts


def test_a_second_writer_of_the_whole_or_of_the_same_part_is_refused(fresh):
    running = writer(fresh, 0, 2).solve([("train", range(12))])
    next(running)
    for part in ((), (0, 2), (1, 3)):
        with pytest.raises(DataSetError, match=f"process {os.getpid()} on "):
            next(writer(fresh, *part).solve([("train", range(12))]))
    with pytest.raises(DataSetError, match=f"process {os.getpid()} on "):
        repair(fresh)
    running.close()
    assert fill(fresh) == 19


def test_a_pending_file_that_another_process_removes_is_ignored(data, fresh):
    writer(fresh).create()
    pending = fresh.folder / "pending"
    pending.mkdir()
    gone = pending / "train-000099.load"
    gone.symlink_to(pending / "nothing")  # listed, and then not there
    assert fresh.pending.files() == {}
    gone.unlink()


# ------------------------------------------------------------------ interruption


def test_an_error_in_writing_ends_the_workers(fresh, monkeypatch):
    """A traceback references the frames of the pool, which must be closed all the same."""
    before = multiprocessing.active_children()

    def keep(self, one):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(PendingLoads, "write", keep)
    with pytest.raises(OSError, match="No space left") as held:
        fill(fresh, WANTED, workers=1)
    try:
        assert held.value.__traceback__ is not None
        assert multiprocessing.active_children() == before
    finally:
        del held


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
    with pytest.raises(DataSetError, match="no data set"):
        fill(store, WANTED)
    repair(store)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    "harm",
    [
        *("", "{", "[]", "null", "\0\0\0"),
        '{"format": 99}',
        '{"format": 3, "fingerprint": 3}',
    ],
)
def test_a_damaged_scene_file_is_refused_by_name(copy, harm):
    (copy.folder / "scene.json").write_text(harm)
    with pytest.raises(DataSetError, match=r"scene\.json|format|another scene"):
        copy.shards()


def test_values_of_another_scene_are_compared_by_key(copy):
    """1 equals 1.0 even if the fingerprint differs."""
    card, found = json.loads((copy.folder / "scene.json").read_text()), copy.shards()
    card["fingerprint"], card["scene"]["degree"] = "0f" * 32, 1.0
    (copy.folder / "scene.json").write_text(json.dumps(card))
    assert copy.shards() == found
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


@pytest.mark.skipif(os.system("unshare -rm true 2>/dev/null") != 0, reason="needs unshare")
def test_a_read_only_folder_can_only_be_read(copy, environment):
    """The folder is mounted read-only, since root may write everywhere."""
    code = (
        "import sys; from dpl.system.files import read_jsonl; from pathlib import Path; "
        "folder = Path(sys.argv[1]); "
        "assert len(read_jsonl(folder / 'manifest.jsonl')) == 3; "
        "from dpl.data.storage.store import Store; from dpl.data import DataSet; "
        "from types import SimpleNamespace as N; import json; "
        "card = json.loads((folder / 'scene.json').read_text()); "
        "scene = N(fingerprint=card['fingerprint'], identity=lambda: card['scene'], "
        "problem=N(shape=(45, 3)), loads=N(n_random=7, parameter_ranges={}, "
        "young_at=lambda point: point[:, -1], parameters_at=None)); "
        "store = Store(folder, scene, 0); "
        "assert len(store.load('train', 12).force) == 12; "
        "assert store.missing('train', 13) == [12]; DataSet(scene, sys.argv[1]).create(); "
        "store.summary(); "
        "print('read')\ntry:\n    (folder / 'x').touch()\nexcept OSError:\n    print('only')"
    )
    mount = 'mount --bind $0 $0 && mount -o remount,bind,ro $0 && exec $1 -c "$2" $0'
    ended = subprocess.run(
        ["unshare", "-rm", "bash", "-c", mount, str(copy.folder), os.sys.executable, code],
        env=environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert ended.stdout.split() == ["read", "only"], ended.stderr[-1000:]


# ------------------------------------------------------------------ damage


@pytest.mark.parametrize("harm", ["a flipped bit", "a cut end", "no file"])
def test_a_damaged_shard_is_refused_by_name(copy, harm):
    path = copy.folder / lines(copy)[0]["file"]
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content if harm == "a flipped bit" else content[:-8])
    if harm == "no file":
        path.unlink()
    with pytest.raises(DataSetError, match=f"{path.name}.*action=repair"):
        copy.load(lines(copy)[0]["split"], 4)
    assert list(flaws(copy)) == [path.name]


def out_of_balance(shard):
    shard["displacement"][1, 20:30] *= 1.0 + 1e-5


def inverted(shard):
    shard["displacement"][0] *= -30.0


def not_a_number(shard):
    shard["displacement"][0, 20] = float("nan")


def another_load(shard):
    shard["nodal_force"] *= 0.5


def another_order(shard):
    shard["displacement"] = shard["displacement"].flip(0).contiguous()


def another_name(shard):
    shard["index"] += 100


def another_point(shard):
    shard["point"][:, -1] = 0.25


@pytest.mark.parametrize(
    "change",
    [
        *(out_of_balance, inverted, not_a_number, another_load, another_order, another_name),
        another_point,
    ],
)
def test_verify_finds_damaged_shards_whose_digest_is_right(data, copy, change):
    before = content(data.store.folder)
    name = rewrite(copy, change)
    assert list(flaws(copy)) == [name]
    assert mended(copy) == [name]
    fill(copy)
    after = content(copy.folder)
    assert sorted(after.pop("manifest.jsonl").splitlines()) == sorted(
        before.pop("manifest.jsonl").splitlines()
    )
    assert after == before


@pytest.mark.parametrize("harm", [{"split": "vrain"}, {"file": "/dev/zero"}, {"tried": 10**12}])
def test_an_invalid_line_of_the_manifest_is_solved_again(copy, data, harm):
    found = lines(copy)
    assert found[0]["split"] == "train"
    found[0] |= harm
    (copy.folder / "manifest.jsonl").write_text("".join(json.dumps(one) + "\n" for one in found))
    assert copy.missing("train", 12) == list(range(12))
    assert copy.summary()
    repair(copy)
    fill(copy)
    assert content(copy.folder) == content(data.store.folder)


@pytest.mark.parametrize(
    ("name", "harm"),
    [
        *(("scene.json", harm) for harm in ("a link", "huge", "a folder")),
        *(("manifest.jsonl", harm) for harm in ("a loop", "a pipe", "huge")),
        *(("modes.safetensors", harm) for harm in ("a folder", "a link", "huge")),
        *(("shard", harm) for harm in ("a pipe", "a loop", "huge", "a link")),
    ],
)
def test_irregular_files_are_refused_by_name_and_not_read(copy, tmp_path, name, harm):
    name = lines(copy)[0]["file"] if name == "shard" else name
    path = copy.folder / name
    if harm == "huge":
        os.truncate(path, 2**40)
    else:
        path.rename(tmp_path / "outside")
    if harm in ("a link", "a loop"):
        path.symlink_to(tmp_path / "outside" if harm == "a link" else path.name)
    elif harm == "a folder":
        path.mkdir()
    elif harm == "a pipe":
        os.mkfifo(path)
    read = copy.modes if name == "modes.safetensors" else partial(copy.load, "train", 12)
    with pytest.raises(DataSetError, match=name) as refusal:
        read()
    assert "\n" not in str(refusal.value)


def test_modes_of_another_precision_are_found(copy):
    path = copy.folder / "modes.safetensors"
    path.write_bytes(save({name: column.float() for name, column in load_file(path).items()}))
    assert list(flaws(copy)) == ["modes.safetensors"]


@pytest.mark.parametrize("line", ["{}", '{"loads": "many"}', "[" * 99_999, '{"loads": NaN}'])
def test_an_invalid_line_of_the_journal_is_ignored(copy, line):
    reported, a_load = copy.summary(), copy.seconds_per_load()
    with (copy.folder / "journal.jsonl").open("a") as file:
        file.write(line + "\n")
    assert (copy.summary(), copy.seconds_per_load()) == (reported, a_load)


def test_a_shard_under_the_name_of_another_is_refused(copy):
    (first, *_) = (line for line in lines(copy) if line["split"] == "train")
    name = shard_name("train", 6400)
    (copy.folder / name).write_bytes((copy.folder / first["file"]).read_bytes())
    line = first | {"first": 6400, "file": name, "rejected": [], "accepted": first["tried"]}
    with (copy.folder / "manifest.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")
    assert len(copy.load("train", 12).force) == 12
    with pytest.raises(DataSetError, match=r"holds other loads than its line of the manifest"):
        copy.load("train", 6401)


def test_a_load_under_the_name_of_another_is_solved_again(fresh, data, scene):
    writer(fresh).create()
    paths = [fresh.pending.write(solve_load(scene, LoadKey((0, 0), number))) for number in (0, 1)]
    paths[1].write_bytes(paths[0].read_bytes())
    (paths[0].parent / "train-one.load").write_bytes(b"mine")
    (paths[0].parent / "rain-000001.load").write_bytes(b"mine")
    assert [job.number for job in fresh.pending.files()] == [0]
    assert fill(fresh) == 19
    assert fresh.digest("train", 12) == data.store.digest("train", 12)


def test_a_file_outside_the_folder_is_not_read(copy):
    found = lines(copy)
    shutil.copy(copy.folder / found[0]["file"], copy.folder.parent / "outside.safetensors")
    found[0]["file"] = "../outside.safetensors"
    (copy.folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in found))
    with pytest.raises(
        DataSetError, match=r"outside\.safetensors is not in the folder of the data set"
    ):
        copy.load(found[0]["split"], 4)
    assert list(flaws(copy)) == [
        "../outside.safetensors",
        found[0]["split"] + "-000000.safetensors",
    ]


def test_repair_removes_files_that_no_manifest_names(copy):
    before = content(copy.folder)
    stray = copy.folder / "train-000012.safetensors"
    stray.write_bytes(b"half a shard")
    part = copy.folder / ".val-000004.safetensors.99.part"
    part.write_bytes(b"half a shard")
    (copy.folder / "notes.txt").write_text("mine")
    assert copy.missing("train", 20) == list(range(12, 20))
    assert len(copy.load("train", 20).force) == 12
    repair(copy)
    assert not stray.exists()
    assert not part.exists()
    assert (copy.folder / "notes.txt").exists()
    assert content(copy.folder) == before


# ------------------------------------------------------------------ reports


def test_the_summary_states_mean_iterations_and_size(copy):
    shards = [line for line in copy.shards() if line["split"] == "train"]
    mean = sum(line["iterations"] for line in shards) / sum(line["tried"] for line in shards)
    assert f"{mean:.1f} Newton iterations" in copy.summary()
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
