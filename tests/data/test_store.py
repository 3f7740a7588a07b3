"""Laws of the data set on disk: nothing solved twice, nothing used that is not the scene's."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file

from dpl.data import store as store_module
from dpl.data.generate import outcome
from dpl.data.store import DataSetError, Store, generate, whole_file
from dpl.fem.materials import SaintVenantKirchhoff

SIZES = {"train": 12, "val": 4, "test": 4}


@pytest.fixture
def copy(data, tmp_path):
    """The tiny data set in a folder that may be harmed."""
    folder = tmp_path / "copy"
    shutil.copytree(data.store.folder, folder)
    return Store(folder, data.scene, data.store.seed)


@pytest.fixture
def solved(monkeypatch):
    """The loads that are solved, as they are."""
    found = []

    def counted(scene, job):
        found.append((*job.seed, job.number))
        return outcome(scene, job)

    monkeypatch.setattr("dpl.data.generate.outcome", counted)
    return found


def lines(store):
    return [json.loads(line) for line in (store.folder / "manifest.jsonl").read_text().splitlines()]


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_stored_samples_meet_the_tolerance_and_invert_nothing(data, scene):
    for split, size in SIZES.items():
        sample = data.store.load(split, size)
        assert len(sample.force) == size
        assert sample.force.dtype == sample.displacement.dtype == torch.float64
        ratio = scene.problem.residual_ratio(sample.displacement, sample.force)
        assert ratio.max() < scene.solver.tol
        assert scene.problem.volume_ratio(sample.displacement).min() > 0
        assert not sample.displacement[:, ~scene.problem.free].any()


def test_stored_samples_are_the_loads_of_their_stream_in_order(data, scene):
    for split, size in SIZES.items():
        drawn = scene.loads.sample(data.store.stream(split), range(size))
        assert torch.equal(data.store.load(split, size).force, drawn.force)
        assert torch.equal(data.store.load(split, size).young, drawn.young)


def test_train_val_and_test_share_no_load(data):
    forces = torch.cat([data.store.load(split, size).force for split, size in SIZES.items()])
    distance = torch.cdist(forces.flatten(1), forces.flatten(1))
    distance.fill_diagonal_(1.0)
    assert distance.min() > 1e-9


def test_the_first_samples_do_not_depend_on_how_many_there_are(data):
    assert same(data.store.load("train", 5), [c[:5] for c in data.store.load("train", 12)])


def test_the_modes_are_kept_with_the_data(data, scene):
    kept = data.store.modes()
    assert torch.equal(kept.values, scene.loads.modes.values)
    assert torch.equal(kept.vectors, scene.loads.modes.vectors)


def test_the_data_set_carries_fingerprint_seed_and_versions(data, scene):
    card = json.loads((data.store.folder / "scene.json").read_text())
    assert card["fingerprint"] == scene.fingerprint
    assert card["scene"] == json.loads(json.dumps(scene.identity()))
    assert card["seed"] == data.store.seed
    assert card["versions"]["torch"] == torch.__version__


def test_the_folder_is_named_after_scene_and_seed_if_left_out(scene, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    made = generate(scene, seed=7, train=1, val=0, test=0, workers=0)
    (folder,) = (tmp_path / "datasets").iterdir()
    assert folder.name == f"{scene.fingerprint[:12]}-seed7"
    assert made.folder.resolve() == folder


def test_a_matching_data_set_is_reused_and_nothing_is_solved(copy, solved):
    generate(copy.scene, folder=str(copy.folder), **SIZES, workers=0)
    assert solved == []


def test_growing_a_data_set_solves_only_the_new_loads(copy, solved):
    before = copy.load("train", 12)
    generate(copy.scene, folder=str(copy.folder), **{**SIZES, "train": 20}, workers=0)
    assert solved == [(0, 0, index) for index in range(12, 20)]
    assert same([c[:12] for c in copy.load("train", 20)], before)
    assert copy.missing("train", 20) == []


def test_an_interrupted_run_keeps_its_shards_and_solves_only_what_is_missing(
    scene, data, tmp_path, monkeypatch, solved
):
    monkeypatch.setattr(store_module, "SHARD", 4)
    store = Store(tmp_path / "grown", scene, 0)
    running = store.fill({"train": range(12)}, workers=0)
    for _ in range(7):  # the second shard of four is not full
        next(running)
    running.close()
    assert store.missing("train", 12) == list(range(4, 12))
    solved.clear()
    generate(scene, folder=str(store.folder), **{**SIZES, "val": 0, "test": 0}, workers=0)
    assert solved == [(0, 0, index) for index in range(4, 12)]
    assert same(store.load("train", 12), data.store.load("train", 12))


def test_shards_hold_at_most_so_many_loads(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "SHARD", 4)
    store = generate(scene, folder=str(tmp_path / "d"), train=10, val=0, test=0, workers=0)
    assert [(line["first"], line["tried"]) for line in lines(store)] == [(0, 4), (4, 4), (8, 2)]


def test_a_data_set_of_another_scene_is_refused_naming_both_fingerprints(copy, make_scene):
    other = make_scene(poisson=0.31)
    with pytest.raises(DataSetError) as refusal:
        generate(other, folder=str(copy.folder), **SIZES, workers=0)
    assert copy.scene.fingerprint[:12] in str(refusal.value)
    assert other.fingerprint[:12] in str(refusal.value)
    assert "law" in str(refusal.value)


def test_the_data_set_of_another_size_and_stiffness_is_the_same(copy, make_scene, solved):
    twin = make_scene(size=(1.0, 0.25, 0.25), young=2e11)
    generate(twin, folder=str(copy.folder), **SIZES, workers=0)
    assert solved == []


def test_a_data_set_of_another_seed_is_refused(copy):
    with pytest.raises(DataSetError, match=r"seed 0, not 1.*data\.seed"):
        generate(copy.scene, folder=str(copy.folder), seed=1, **SIZES, workers=0)


def test_a_folder_that_is_no_data_set_is_refused_and_left_as_it_is(scene, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(DataSetError, match="no data set"):
        generate(scene, folder=str(tmp_path), **SIZES, workers=0)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_an_unknown_format_is_refused(copy):
    card = copy.folder / "scene.json"
    card.write_text(json.dumps({**json.loads(card.read_text()), "format": 99}))
    with pytest.raises(DataSetError, match="format 99"):
        copy.open()


@pytest.mark.parametrize("harm", ["a flipped bit", "a cut end", "no file"])
def test_a_damaged_shard_is_detected_and_named(copy, harm):
    path = copy.folder / lines(copy)[0]["file"]
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content if harm == "a flipped bit" else content[:-8])
    if harm == "no file":
        path.unlink()
    with pytest.raises(DataSetError, match=path.name):
        copy.load(lines(copy)[0]["split"], 4)


def test_what_a_refusal_says_to_do_repairs_a_damaged_shard(copy, data, solved):
    manifest = copy.folder / "manifest.jsonl"
    damaged, *sound = manifest.read_text().splitlines()
    (copy.folder / json.loads(damaged)["file"]).write_bytes(b"nothing")
    manifest.write_text("".join(line + "\n" for line in sound))
    generate(copy.scene, folder=str(copy.folder), **SIZES, workers=0)
    assert len(solved) == json.loads(damaged)["tried"]
    split = json.loads(damaged)["split"]
    assert same(copy.load(split, SIZES[split]), data.store.load(split, SIZES[split]))


def test_a_torn_last_line_of_the_manifest_is_solved_again(copy, data, solved):
    manifest = copy.folder / "manifest.jsonl"
    whole = manifest.read_text().splitlines()
    manifest.write_text("\n".join(whole[:-1]) + "\n" + whole[-1][:50])
    torn = json.loads(whole[-1])
    assert len(copy.missing(torn["split"], SIZES[torn["split"]])) == torn["tried"]
    generate(copy.scene, folder=str(copy.folder), **SIZES, workers=0)
    assert len(solved) == torn["tried"]
    for split, size in SIZES.items():
        assert same(copy.load(split, size), data.store.load(split, size))


def test_a_line_torn_inside_its_reject_list_is_solved_again(make_scene, tmp_path):
    scene = make_scene(law=SaintVenantKirchhoff, deflection=10.0, patch=(2.0, 2.0))
    store = generate(scene, folder=str(tmp_path / "d"), train=6, val=0, test=0, workers=0)
    manifest = store.folder / "manifest.jsonl"
    line = manifest.read_text()
    manifest.write_text(line[: line.index("}") + 1])  # ends like a whole line
    assert store.missing("train", 6) == list(range(6))


def test_a_file_that_was_not_finished_does_not_exist(copy):
    (copy.folder / "train-000012.safetensors").write_bytes(b"half a shard")
    assert copy.missing("train", 20) == list(range(12, 20))
    assert len(copy.load("train", 20).force) == 12


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")

    def write_and_fail():
        with whole_file(path) as file:
            file.write(b"new")
            raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        write_and_fail()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    with whole_file(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"


def test_rejected_loads_are_recorded_with_reason_and_load_factor(make_scene, tmp_path):
    scene = make_scene(law=SaintVenantKirchhoff, deflection=10.0, patch=(2.0, 2.0))
    store = generate(scene, folder=str(tmp_path / "d"), train=6, val=0, test=0, workers=0)
    (line,) = lines(store)
    assert line["tried"] == 6
    assert line["rejected"], "SVK bears six loads of ten times L: choose harder ones"
    assert line["accepted"] + len(line["rejected"]) == 6
    for one in line["rejected"]:
        assert one["reason"]
        assert 0 <= one["load_factor"] < 1
    lost = {one["index"] for one in line["rejected"]}
    shard = load_file(store.folder / line["file"])
    assert set(shard["index"].tolist()) == set(range(6)) - lost
    if line["accepted"]:
        assert len(store.load("train", 6).force) == line["accepted"]
    else:
        with pytest.raises(DataSetError, match="no train samples"):
            store.load("train", 6)
    assert f"{line['accepted']} of 6 loads accepted" in store.summary()


def test_an_empty_split_is_refused(copy):
    with pytest.raises(DataSetError, match="no test samples"):
        copy.load("test", 0)


@pytest.mark.parametrize("name", ["seed", "train", "val", "test", "workers"])
def test_negative_numbers_are_refused_by_name(scene, tmp_path, name):
    with pytest.raises(ValueError, match=f"{name} = -1"):
        generate(scene, folder=str(tmp_path / "d"), **{"workers": 0, name: -1})
    assert not list(tmp_path.iterdir())


def test_progress_shows_accepted_rejected_and_samples_a_second(scene, tmp_path, capsys):
    generate(scene, folder=str(tmp_path / "d"), train=2, val=1, test=0, workers=0)
    out = capsys.readouterr().out
    assert "3/3" in out
    assert "3 accepted, 0 rejected" in out
    assert "/s" in out


def test_nothing_is_written_where_nothing_is_wanted(scene, tmp_path):
    store = generate(scene, folder=str(tmp_path / "d"), train=0, val=0, test=0, workers=0)
    assert not store.folder.exists()
