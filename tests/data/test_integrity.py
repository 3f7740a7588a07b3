"""Laws of `verify` and `repair`: every flaw of a data set is found and repaired."""

import hashlib
import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save
from set_files import content, flaws, lines

from dpl.data import DataSet
from dpl.data.storage.integrity import check_modes, repair

SIZES = {"train": 12, "val": 4, "test": 4}


def wanted(store, **sizes):
    return DataSet(store.scene, str(store.folder), **{**SIZES, **sizes}, workers=0)


def write(store, found):
    text = "".join(line if isinstance(line, str) else json.dumps(line) + "\n" for line in found)
    (store.folder / "manifest.jsonl").write_text(text)


# ------------------------------------------------------------------ flaws


@pytest.mark.parametrize(("split", "size"), [("train", 12), ("val", 4)])
def test_verify_finds_a_shard_whose_line_is_lost(copy, data, split, size, capsys):
    write(copy, [line for line in lines(copy) if line["split"] != split])
    assert list(wanted(copy).verify()) == [
        f"{copy.folder}/{split}-000000.safetensors is named by no manifest",
        f"{copy.folder} lacks {size} of the loads that data.{split} = {size} requires; "
        "the first is load 0",
    ]
    capsys.readouterr()
    wanted(copy, **{split: 2}).repair()  # also the loads that are not wanted
    reported = capsys.readouterr().out
    assert "is named by no manifest; it is removed, and its" in reported
    assert f"{size} loads of {split} are missing and are solved" in reported
    assert content(copy.folder) == content(data.store.folder)
    assert list(wanted(copy).verify()) == []


@pytest.mark.parametrize(
    ("lost", "reported"),
    [
        (
            {"train": 13},
            ["lacks 1 of the loads that data.train = 13 requires; the first is load 12"],
        ),
        ({"val": 9}, ["lacks 5 of the loads that data.val = 9 requires; the first is load 4"]),
        ({"train": 14, "test": 5}, ["data.train = 14", "data.test = 5"]),
        ({"train": 3, "val": 0}, []),
    ],
)
def test_verify_finds_missing_loads(copy, lost, reported):
    found = list(wanted(copy, **lost).verify())
    assert len(found) == len(reported)
    assert all(words in line for words, line in zip(reported, found, strict=True))


def test_verify_of_a_part_ignores_the_loads_of_other_parts(copy, monkeypatch):
    monkeypatch.setattr("dpl.data.storage.store.SHARD_SIZE", 12)
    found = [list(wanted(copy, train=24, shard=k, shards=2).verify()) for k in range(2)]
    assert found[0] == []
    assert [line.split()[1:3] for line in found[1]] == [["lacks", "12"]]


TORN = {
    "torn": (lambda line: json.dumps(line)[:40] + "\n", "is not a JSON object"),
    "no object": (lambda line: "[1, 2]\n", "is not a JSON object"),
    "empty": (lambda line: "\n", "is not a JSON object"),
    "lacking": (lambda line: {"file": line["file"]}, "lacks accepted, amplitudes"),
    "elsewhere": (lambda line: line | {"file": "/dev/zero"}, "not in the folder of the data set"),
}


@pytest.mark.parametrize(("harm", "why"), TORN.values(), ids=TORN)
def test_verify_finds_an_invalid_line_with_its_number(copy, data, harm, why):
    found, which = lines(copy), 2
    name = found[which]["file"]
    found[which] = harm(found[which])
    write(copy, found)
    reported = flaws(copy)
    assert sorted(reported) == sorted(["manifest.jsonl", name])
    assert reported["manifest.jsonl"].startswith(
        f"has 1 lines that describe no shard; the first is line {which + 1}, which "
    )
    assert why in reported["manifest.jsonl"]
    assert reported[name] == "is named by no manifest"
    done = {part.file: words for part, words in repair(copy)}
    assert done["manifest.jsonl"].endswith("; these lines are removed")
    wanted(copy).repair()
    assert content(copy.folder) == content(data.store.folder)


def test_invalid_lines_are_counted_for_each_manifest(copy):
    with (copy.folder / "manifest.jsonl").open("a") as file:
        file.write("{\n{}\n")
    (copy.folder / "manifest-1-of-2.jsonl").write_text("torn")
    reported = flaws(copy)
    assert reported["manifest.jsonl"].startswith("has 2 lines")
    assert "the first is line 4" in reported["manifest.jsonl"]
    assert reported["manifest-1-of-2.jsonl"].startswith("has 1 lines")
    repair(copy)
    assert flaws(copy) == {}


@pytest.mark.parametrize("name", ["../outside.safetensors", "sub/outside.safetensors", "sub/../x"])
def test_verify_finds_a_line_that_names_a_file_outside_and_repair_leaves_the_file(copy, data, name):
    found = lines(copy)
    genuine = copy.folder / found[0]["file"]
    (copy.folder / "sub").mkdir()
    outside = copy.folder / name
    genuine.rename(outside)
    found[0]["file"] = name
    write(copy, found)
    assert flaws(copy) == {name: "is not in the folder of the data set and is not read"}
    wanted(copy).repair()
    assert outside.exists()
    assert content(copy.folder)[genuine.name] == genuine.read_bytes()
    assert copy.digest("train", 12) == data.store.digest("train", 12)
    assert list(wanted(copy).verify()) == []


@pytest.mark.parametrize("harm", ["a copy", "no shard", "a link", "larger than any shard"])
def test_a_shard_that_no_manifest_names_is_found_and_removed(copy, data, harm):
    stray = copy.folder / "train-000064.safetensors"
    if harm == "a copy":
        shutil.copy(copy.folder / "train-000000.safetensors", stray)
    elif harm == "a link":
        stray.symlink_to(copy.folder / "train-000000.safetensors")
    else:
        stray.write_bytes(b"nothing" if harm == "no shard" else bytes(copy.max_shard_size(64) + 1))
    assert flaws(copy) == {stray.name: "is named by no manifest"}
    ((part, reported),) = repair(copy)
    assert (part.file, list(part.loads)) == (stray.name, []), "none of its loads is of its name"
    assert reported == "is named by no manifest; it is removed"
    assert content(copy.folder) == content(data.store.folder)


def test_an_empty_folder_with_the_name_of_a_shard_is_removed_and_a_full_one_left_alone(copy):
    empty, full = (copy.folder / f"train-{first:06d}.safetensors" for first in (64, 128))
    empty.mkdir()
    full.mkdir()
    (full / "mine").touch()
    wanted(copy).repair()
    assert not empty.exists()
    assert (full / "mine").is_file()


def flip_lowest_bit(path, column):
    """Flip the lowest bit of the mantissa of the last number of a column that is not 0."""
    whole = bytearray(path.read_bytes())
    length = int.from_bytes(whole[:8], "little")
    first, last = json.loads(whole[8 : 8 + length])[column]["data_offsets"]
    places = range(8 + length + first, 8 + length + last, 8)
    place = next(k for k in reversed(places) if any(whole[k : k + 8]))
    whole[place] ^= 1
    path.write_bytes(whole)


@pytest.mark.parametrize("column", ["displacement", "nodal_force", "iterations"])
def test_verify_finds_a_flipped_bit_that_only_the_digest_detects(copy, column):
    """Equilibrium, loads and shapes stay within their tolerances."""
    path = copy.folder / "train-000000.safetensors"
    before = load_file(path)[column].clone()
    flip_lowest_bit(path, column)
    after = load_file(path)[column]
    assert (before != after).sum() == 1
    if after.is_floating_point():
        assert torch.allclose(before, after, rtol=1e-15, atol=0)
    assert flaws(copy) == {path.name: "is damaged: its SHA-256 differs from the manifest's"}
    with pytest.raises(ValueError, match="SHA-256"):
        copy.load("train", 12)
    found = lines(copy)
    found[0]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    write(copy, found)
    assert flaws(copy) == {}, "no other check can tell"


# ------------------------------------------------------------------ tolerances


def harmed(store, change):
    """Change the columns and the digest of the first shard; return its flaw."""
    found = lines(store)
    path = store.folder / found[0]["file"]
    shard = load_file(path)
    change(shard)
    path.write_bytes(save(shard))
    found[0]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    write(store, found)
    return flaws(store).get(path.name, "")


@pytest.mark.parametrize(
    ("column", "error", "flaw"),
    [
        ("point", 1e-9, "holds other loads than its seed draws"),
        ("nodal_force", -1e-4, "holds loads that this scene does not draw"),
        ("displacement", 1e-4, "holds a displacement that is not in equilibrium: load 11"),
    ],
)
def test_verify_finds_a_small_error_in_a_number_of_one_load(copy, column, error, flaw):
    def change(shard):
        values = shard[column].view(-1)
        place = int(values.nonzero()[-1])  # of the last load
        values[place] *= 1 + error

    assert harmed(copy, change) == flaw


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
    assert (
        flaws(copy)["train-000000.safetensors"]
        == "holds a displacement that is not in equilibrium: load 0"
    )


@pytest.mark.parametrize("which", ["values", "vectors"])
def test_modes_are_compared_to_six_digits_with_their_signs(scene, which):
    modes = scene.loads.arrays()
    assert check_modes(scene, modes) == ""
    for factor, equal in ((1 + 1e-9, True), (1 + 1e-4, False), (-1.0, False)):
        found = check_modes(scene, {**modes, which: modes[which] * factor})
        assert found == ("" if equal else "holds other modes than this scene has")
    fewer = {name: array[:-1] for name, array in modes.items()}
    assert check_modes(scene, fewer) == "holds other modes than this scene has"
