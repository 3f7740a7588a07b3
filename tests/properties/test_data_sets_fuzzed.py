"""Laws of damaged data sets: the written samples are read, or an error names a remedy."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import reduce
from operator import getitem
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from bounds import bounded
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save

from dpl import DataSetError
from dpl.data import DataModule, DataSet, Store
from dpl.data.solving.solve import LoadKey, solve_load
from dpl.data.storage import store as store_module
from dpl.data.storage.integrity import repair, verify
from dpl.data.storage.shard import digest

SIZES = {"train": 12, "val": 4, "test": 4}
ALONE = (10, 11)  # loads of training whose files are not merged
SHARDS = ["train-000000", "train-000004", "train-000008", "val-000000", "test-000000"]
SHARDS += [f"train-{number:06d}" for number in ALONE]
FILES = ["scene.json", "journal.jsonl", *(f"{name}.safetensors" for name in SHARDS)]
REMEDIES = ("action=repair", "data.folder", "data.seed", "remove", "generate")


@pytest.fixture(scope="module")
def sound(scene, tmp_path_factory):
    """A data set of five shards and two loads alone, and its samples."""
    folder = tmp_path_factory.mktemp("sound") / "set"
    store = Store(folder, scene, 0)
    wanted = {**{split: range(size) for split, size in SIZES.items()}, "train": range(10)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "SHARD_SIZE", 4)
        list(DataSet(scene, str(folder), workers=0).solve(wanted.items()))
    for number in ALONE:
        store.write(solve_load(scene, LoadKey((0, 0), number)))
    session = {"loads": 18, "seconds": 1.0, "core_seconds": 1.0}
    (folder / "journal.jsonl").write_text(json.dumps(session) + "\n")
    assert sorted(FILES) == sorted(
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
    )
    whole = shutil.copytree(folder, folder.with_name("whole"))
    return SimpleNamespace(folder=folder, samples=samples(scene, whole))


@contextmanager
def copied(folder: Path) -> Iterator[Path]:
    """Yield a copy that may be damaged; its sibling folder `outside` must not be read."""
    copy = folder.with_name("copy") / "set"
    shutil.copytree(folder, copy)
    outside = copy.parent / "outside"
    shutil.copytree(folder, outside)
    try:
        yield copy
    finally:
        shutil.rmtree(copy.parent)


def opened(scene, folder: Path) -> DataModule:
    return DataModule(scene, folder=str(folder), **SIZES, batch_size=4, workers=0)


def samples(scene, folder: Path) -> dict:
    """Return all samples; missing loads are solved as in every command."""
    data = opened(scene, folder)
    data.skipped_work()
    data.prepare_data()
    assert data.store.summary()
    return {split: data.samples(split) for split in SIZES}


def same(found: dict, written: dict) -> bool:
    return all(
        torch.equal(a, b)
        for split in SIZES
        for a, b in zip(found[split], written[split], strict=True)
    )


@contextmanager
def reported(folder: Path) -> Iterator[None]:
    """Check that an error is one line with a file of the folder and a remedy."""
    try:
        yield
    except DataSetError as error:
        line = str(error)
        assert "\n" not in line
        assert str(folder) in line, line
        assert any(remedy in line for remedy in REMEDIES), line


def law(scene, folder: Path, written: dict, *, trusts_digests: bool = True) -> None:
    """Look at a damaged data set in every way there is; then repair it."""
    store = Store(folder, scene, 0)
    flaws = None
    with bounded():
        with reported(folder):
            flaws = [flaw for _, flaw in verify(store) if flaw]
        with reported(folder):
            found = samples(scene, folder)
            assert same(found, written) or (not trusts_digests and flaws)
        with reported(folder):
            repair(store)
            found = samples(scene, folder)
            assert same(found, written)
            assert not [flaw for _, flaw in verify(store) if flaw]


# ------------------------------------------------------------------ bytes

BYTES = st.binary(min_size=1, max_size=12)
WAYS = ["flip", "flip", "cut", "remove", "repeat", "insert", "zero", "empty", "delete", "swap"]
WAYS += ["folder", "pipe", "loop", "outside", "endless", "huge", "deep"]


@st.composite
def blows(draw):
    """Return a damage: name of a file and parameters."""
    name = draw(st.sampled_from(FILES))
    how = draw(st.sampled_from(WAYS))
    place = draw(st.floats(0, 1)), draw(st.floats(0, 0.3))
    return name, how, place, draw(st.sampled_from(FILES)), draw(BYTES), draw(st.integers(0, 7))


def strike(folder: Path, blow) -> None:
    name, how, (start, length), other, inserted, bit = blow
    path = folder / name
    if not path.is_file() or path.stat().st_size > 10**9:  # struck before
        return
    content = bytearray(path.read_bytes())
    a = min(int(start * len(content)), max(0, len(content) - 1))
    b = min(a + 1 + int(length * len(content)), len(content))
    if how == "flip" and content:
        content[a] ^= 1 << bit
    elif how == "cut":
        del content[a:]
    elif how == "remove":
        del content[a:b]
    elif how == "repeat":
        content[b:b] = content[a:b]
    elif how == "insert":
        content[a:a] = inserted
    elif how == "zero":
        content[a:b] = bytes(b - a)
    elif how == "empty":
        content.clear()
    elif how == "deep":
        content = bytearray(b"[" * 200_000)
    elif how == "swap" and (folder / other).is_file():
        held = (folder / other).read_bytes()
        (folder / other).write_bytes(content)
        content = bytearray(held)
    if how in ("delete", "folder", "pipe", "loop", "outside", "endless"):
        path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "pipe":
        os.mkfifo(path)
    elif how == "loop":
        path.symlink_to(path.name)
    elif how == "outside":
        path.symlink_to(folder.parent / "outside" / name)
    elif how == "endless":
        path.symlink_to("/dev/zero")
    elif how == "huge":
        os.truncate(path, 2**40)
    elif how != "delete":
        path.write_bytes(content)


@given(st.lists(blows(), min_size=1, max_size=2))
def test_damaged_files_give_the_written_samples_or_an_error(scene, sound, damage):
    with copied(sound.folder) as folder:
        for blow in damage:
            strike(folder, blow)
        law(scene, folder, sound.samples)


# ------------------------------------------------------------------ what the text files say

VALUES = [
    *(None, True, False, -1, 0, 1, 3, 4, 5, 8, 64, 10**6, 10**12, 10**30, -(10**30), 0.5, 1e300),
    *(float("nan"), float("inf"), "", "train", "val", "no such thing", "3", [], [None], {}),
    *([0, 1, 2, 3], [{"index": 1}], [{"index": 1, "reason": "x", "load_factor": 0.5}], [[[]]]),
    *("../outside/train-000000.safetensors", "/dev/zero", "/etc/passwd", ".", "..", "modes"),
    *("scene.json", "val-000000.safetensors", "train-000004.safetensors", "a\nb", "\0", "x" * 9999),
]
ABSENT = object()


def entries(node, path=()) -> Iterator[tuple]:
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from entries(value, (*path, key))


@given(st.data())
def test_a_text_file_with_arbitrary_values_gives_the_samples_or_an_error(scene, sound, data):
    name = data.draw(st.sampled_from(["scene.json", "journal.jsonl"]))
    with copied(sound.folder) as folder:
        text = (folder / name).read_text()
        texts = [text] if name == "scene.json" else text.splitlines()
        lines = list(map(json.loads, texts))
        for _ in range(data.draw(st.integers(1, 2))):
            path = data.draw(st.sampled_from(list(entries(lines))))
            value = data.draw(st.sampled_from([*VALUES, ABSENT, "twice"]))
            node = reduce(getitem, path[:-1], lines)
            if value is ABSENT:
                del node[path[-1]]
            elif value == "twice" and isinstance(node, list):
                node.append(node[path[-1]])
            else:
                node[path[-1]] = deepcopy(value)
            if not lines:
                break
        (folder / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
        law(scene, folder, sound.samples)


# ------------------------------------------------------------------ shards whose digests are right


def digest_of(name, columns):
    with suppress(TypeError):  # a type that NumPy does not have
        return digest(name, columns)
    return ""


def cast(kind):
    return lambda column, k: column.to(kind)


def filled(value):
    def change(column, k):
        flat = column.clone().flatten()
        if flat.numel():
            flat[k % flat.numel()] = value if column.is_floating_point() else int(value)
        return flat.view(column.shape)

    return change


CHANGES = {
    **{str(kind): cast(kind) for kind in (torch.float32, torch.float16, torch.int64, torch.int32)},
    **{str(kind): cast(kind) for kind in (torch.uint8, torch.bool, torch.bfloat16, torch.float64)},
    **{str(value): filled(value) for value in (-1, 0, 1, 44, 45, 2**31 - 1, 0.25, -1e-3)},
    "flat": lambda column, k: column.flatten(),
    "deeper": lambda column, k: column[None],
    "fewer": lambda column, k: column[:-1],
    "none": lambda column, k: column[:0],
    "twice": lambda column, k: torch.cat([column, column]),
    "turned": lambda column, k: column.flip(0),
    "rolled": lambda column, k: column.roll(1),
    "larger": lambda column, k: 2 * column,
    "opposite": lambda column, k: -column,
}
ENDLESS = {str(value): filled(value) for value in map(float, ("nan", "inf", "-inf", "1e300"))}
HEADERS = [
    (2**63).to_bytes(8, "little"),
    (2**31).to_bytes(8, "little") + b"{}",
    *(
        len(text).to_bytes(8, "little") + text
        for text in (
            b'{"index":{"dtype":"I64","shape":[1000000000000],"data_offsets":[0,8000000000000]}}',
            b'{"index":{"dtype":"I64","shape":[4294967296,4294967296],"data_offsets":[0,0]}}',
            b'{"index":{"dtype":"F99","shape":[1],"data_offsets":[0,8]}}' + bytes(8),
            b'{"index":[]}',
            b"[" * 100_000,
            b"{}",
        )
    ),
]


@given(st.data())
def test_a_shard_with_wrong_numbers_and_a_right_digest_is_refused_or_found(scene, sound, data):
    name = data.draw(st.sampled_from([*SHARDS, "modes"])) + ".safetensors"
    with copied(sound.folder) as folder:
        path = folder / name
        columns = load(path.read_bytes())
        which = data.draw(st.sampled_from(sorted(columns)))
        how = data.draw(st.sampled_from([*CHANGES, *ENDLESS, "gone", "more", "header"]))
        k = data.draw(st.integers(0, 10_000))
        if how == "gone":
            del columns[which]
        elif how == "more":
            columns["parameters"] = torch.zeros(4, 1, dtype=torch.float64)
        elif how != "header":
            if how in ENDLESS and not columns[which].is_floating_point():
                which = "values" if name.startswith("modes") else "displacement"
            columns[which] = (CHANGES | ENDLESS)[how](columns[which], k).contiguous()
        if how == "header":
            path.write_bytes(HEADERS[k % len(HEADERS)])
        else:
            path.write_bytes(save(columns, {"sha256": digest_of(path.name, columns)}))
        law(scene, folder, sound.samples, trusts_digests=False)
