"""Laws of `verify` and `repair`: every flaw of a data set is found and repaired."""

import os
import shutil
from functools import partial

import pytest
import torch
from safetensors.torch import load_file
from set_files import content, falsify, flaws

from dpl.data import DataSet, DataSetError
from dpl.data.storage.integrity import repair

SIZES = {"train": 12, "val": 4, "test": 4}
FIRST = "train-000000.safetensors"


def wanted(store, **sizes):
    return DataSet(store.scene, str(store.folder), **{**SIZES, **sizes}, workers=0)


def harm_of(column, change, which=...):
    """Return a function that changes some values of a column."""

    def harm(columns):
        columns[column][which] = change(columns[column][which])

    return harm


def last(columns, column, factor):
    values = columns[column].view(-1)
    values[int(values.nonzero()[-1])] *= factor  # of the last load


HARMS = {
    "out of balance": harm_of("displacement", lambda u: u * (1.0 + 1e-5), (1, slice(20, 30))),
    "inverted": harm_of("displacement", lambda u: -30.0 * u, 0),
    "another load": harm_of("nodal_force", lambda f: 0.5 * f),
    "another order": harm_of("displacement", lambda u: u.flip(0)),
    "another point": harm_of("point", lambda _: 0.25, (..., -1)),
    "a load out of balance": partial(last, column="displacement", factor=1 + 1e-4),
    "a force": partial(last, column="nodal_force", factor=1 - 1e-4),
    "a point": partial(last, column="point", factor=1 + 1e-9),
}
WHY = {
    "another load": "holds loads that this scene does not draw",
    "a force": "holds loads that this scene does not draw",
    "another point": "holds other loads than its seed draws",
    "a point": "holds other loads than its seed draws",
    "a load out of balance": "holds a displacement that is not in equilibrium: load 11",
}


@pytest.mark.parametrize("harm", HARMS)
def test_verify_finds_wrong_numbers_under_a_right_digest(data, copy, harm):
    falsify(copy.folder / FIRST, HARMS[harm])
    found = flaws(copy)
    assert list(found) == [FIRST]
    assert found[FIRST].startswith(WHY.get(harm, "holds a displacement that is not in equilibrium"))
    wanted(copy).repair()
    assert content(copy.folder) == content(data.store.folder)


def test_verify_finds_a_displacement_with_det_F_of_zero(copy, monkeypatch):
    """Also if the displacement is in equilibrium."""
    body = type(copy.scene.problem)
    monkeypatch.setattr(body, "is_equilibrium", lambda *_: torch.tensor(True))
    assert flaws(copy) == {}
    genuine = body.evaluate

    def flat(self, u):
        internal, volume = genuine(self, u)
        return internal, 0 * volume

    monkeypatch.setattr(body, "evaluate", flat)
    assert flaws(copy)[FIRST] == "holds a displacement that is not in equilibrium: load 0"


LACKS = "lacks 1 of the loads that data.train = 13 requires; the first is load 12"


def test_verify_finds_missing_loads(copy):
    assert list(wanted(copy, train=3, val=0).verify()) == []
    assert list(wanted(copy, train=13).verify()) == [f"{copy.folder} {LACKS}"]
    train, test = wanted(copy, train=14, test=5).verify()
    assert "data.train = 14" in train
    assert "data.test = 5" in test


def test_verify_of_a_part_ignores_the_loads_of_other_parts(copy, monkeypatch):
    monkeypatch.setattr("dpl.data.storage.store.SHARD_SIZE", 12)
    found = [list(wanted(copy, train=24, shard=k, shards=2).verify()) for k in range(2)]
    assert found[0] == []
    assert [line.split()[1:3] for line in found[1]] == [["lacks", "12"]]


def test_repair_names_each_damaged_file_and_solves_only_its_loads(copy, data, capsys):
    path = copy.folder / "val-000000.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    (copy.folder / "test-000000.safetensors").unlink()
    first, *missing = wanted(copy).verify()
    assert first.startswith(f"{path} is damaged")
    assert [line.partition(" lacks ")[2].partition(";")[0] for line in missing] == [
        f"4 of the loads that data.{split} = 4 requires" for split in ("val", "test")
    ]
    capsys.readouterr()
    wanted(copy).repair()
    reported = capsys.readouterr().out
    assert f"{path} is damaged" in reported
    assert "; it is removed" in reported
    assert "4 loads of val are missing and are solved" in reported
    assert "8/8" in reported
    assert content(copy.folder) == content(data.store.folder)
    shutil.rmtree(copy.folder)
    wanted(copy).repair()
    assert content(copy.folder) == content(data.store.folder), "a missing set is made"


def test_repair_also_solves_damaged_loads_beyond_the_sizes_wanted(copy, data):
    falsify(copy.folder / "val-000000.safetensors", harm_of("displacement", lambda u: 2 * u))
    wanted(copy, val=2).repair()
    assert content(copy.folder) == content(data.store.folder)


@pytest.mark.parametrize("harm", ["a copy", "no shard", "a link", "larger than any shard"])
def test_a_file_that_is_no_shard_of_its_name_is_found_and_removed(copy, data, harm):
    stray = copy.folder / "train-000064.safetensors"
    if harm == "a copy":
        shutil.copy(copy.folder / FIRST, stray)
    elif harm == "a link":
        stray.symlink_to(copy.folder / FIRST)
    else:
        stray.write_bytes(b"nothing" if harm == "no shard" else bytes(copy.max_shard_size(64) + 1))
    (copy.folder / ".val-000004.safetensors.99.part").write_bytes(b"half a shard")
    for name in ("notes.txt", "mine.safetensors"):
        (copy.folder / name).write_text("mine")
    assert copy.missing("train", 70) == list(range(12, 70))
    assert len(copy.load("train", 70).force) == 12
    assert list(flaws(copy)) == [stray.name]
    ((path, reported),) = repair(copy)
    assert path == stray
    assert reported.endswith("; it is removed")
    for name in ("notes.txt", "mine.safetensors"):
        assert (copy.folder / name).read_text() == "mine"
        (copy.folder / name).unlink()
    assert not list(copy.folder.glob(".*.part"))
    assert content(copy.folder) == content(data.store.folder)


def test_an_empty_folder_with_the_name_of_a_shard_is_removed_and_a_full_one_left_alone(copy):
    empty, full = (copy.folder / f"train-{first:06d}.safetensors" for first in (64, 128))
    empty.mkdir()
    full.mkdir()
    (full / "mine").touch()
    wanted(copy).repair()
    assert not empty.exists()
    assert (full / "mine").is_file()


@pytest.mark.parametrize("column", ["displacement", "nodal_force", "iterations"])
def test_a_flipped_bit_that_only_the_digest_detects_is_found(copy, column):
    """Equilibrium, loads and shapes stay within their tolerances."""
    path = copy.folder / FIRST
    columns = load_file(path)
    values = columns[column].clone().view(torch.int64).view(-1)
    values[int(values.nonzero()[-1])] ^= 1
    after = values.view(columns[column].dtype).view_as(columns[column])
    if after.is_floating_point():
        assert torch.allclose(columns[column], after, rtol=1e-15, atol=0)
    content = path.read_bytes()
    before, changed = (c.numpy().tobytes() for c in (columns[column], after))
    assert content.count(before) == 1
    path.write_bytes(content.replace(before, changed))
    why = "is damaged: the SHA-256 of its name and its columns is wrong"
    assert flaws(copy) == {path.name: why}
    with pytest.raises(DataSetError, match=f"{FIRST} {why}; .*action=repair"):
        copy.load("train", 12)
    falsify(path, lambda columns: None)
    assert flaws(copy) == {}, "no other check can tell"


@pytest.mark.parametrize(
    ("name", "harm"),
    [
        *(("scene.json", harm) for harm in ("a link", "huge", "a folder")),
        *((FIRST, harm) for harm in ("a pipe", "a loop", "huge", "a link", "a folder")),
    ],
)
def test_irregular_files_are_not_read(copy, tmp_path, name, harm):
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
    if name == FIRST:
        assert copy.missing("train", 12) == list(range(12))
        assert "regular" in flaws(copy)[name] or "larger" in flaws(copy)[name]
        return
    with pytest.raises(DataSetError, match=name) as refusal:
        copy.load("train", 12)
    assert "\n" not in str(refusal.value)
