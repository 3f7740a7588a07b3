"""Laws of manifests: valid lines are read, invalid ones are left out with a reason."""

import json

import pytest

from dpl.data.storage.manifest import (
    UPPER_LIMIT,
    accepted_loads,
    invalid_lines,
    is_number,
    read_manifest,
    shard_name,
    sort_key,
)

LINE = {
    "file": "val-000064.safetensors",
    "sha256": 64 * "0",
    "split": "val",
    "first": 64,
    "tried": 3,
    "accepted": 2,
    "iterations": 11,
    "amplitudes": [0.5, 0, 1],
    "rejected": [{"index": 65, "reason": "diverged", "load_factor": 0.25}],
}
REJECT = LINE["rejected"][0]


@pytest.fixture
def manifest(tmp_path):
    """Return a function that writes a manifest of some lines and returns its path."""

    def manifest(*lines):
        path = tmp_path / "manifest.jsonl"
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        return path

    return manifest


def test_a_missing_manifest_has_no_lines(tmp_path):
    assert read_manifest(tmp_path / "manifest.jsonl") == []
    assert invalid_lines(tmp_path / "manifest.jsonl") == []


POSSIBLE = [
    *({}, {"more": 1}, {"first": 63}, {"first": 65}, {"iterations": 0}, {"iterations": 2**53 - 1}),
    {"first": 2**53 - 1, "rejected": [REJECT | {"index": 2**53}]},
    *({"split": "train"}, {"split": "test"}),
    *({"amplitudes": [0, 0, 0]}, {"amplitudes": [1e14, 10**15 - 1, 0.0]}),
    {"tried": 0, "accepted": 0, "amplitudes": [], "rejected": []},
    {"accepted": 3, "rejected": []},
    {"accepted": 0, "rejected": [REJECT | {"index": k} for k in (64, 65, 66)]},
    {"rejected": [REJECT | {"load_factor": None}]},
]


@pytest.mark.parametrize("change", POSSIBLE, ids=str)
def test_a_valid_line_is_returned_unchanged(manifest, change):
    line = LINE | change
    line["file"] = shard_name(line["split"], line["first"])
    assert read_manifest(manifest(line)) == [line]
    assert invalid_lines(manifest(line)) == []


IMPOSSIBLE = {
    "has a file that is not a string": [{"file": None}, {"file": 3}],
    "has a sha256 that is not a string": [{"sha256": None}, {"sha256": []}],
    "has a split that is not a string": [{"split": 0}, {"split": None}],
    "names a split that does not exist": [{"split": ""}, {"split": "Train"}],
    "names a file that is not in the folder": [
        *({"file": ""}, {"file": "/a"}, {"file": "a b"}, {"file": "a\n"}, {"file": "a" * 201}),
    ],
    "has a number first out of range": [
        *({"first": -1}, {"first": 2**53}, {"first": True}, {"first": 64.0}, {"first": "64"}),
    ],
    "has a number tried out of range": [{"tried": -3}, {"tried": 3.0}, {"tried": None}],
    "has a number accepted out of range": [{"accepted": -2}, {"accepted": 2.0}],
    "has a number iterations out of range": [{"iterations": -1}, {"iterations": 2**53}],
    "names the file of another split or of another first load": [
        *({"split": "train"}, {"first": 63}, {"first": 0}, {"file": "a"}, {"file": "a" * 200}),
        {"file": "val-64.safetensors"},
    ],
    "has amplitudes or rejected loads that are not lists": [
        *({"amplitudes": {}}, {"amplitudes": "abc"}, {"rejected": {}}, {"rejected": None}),
    ],
    "has inconsistent numbers of loads": [
        *({"tried": 2}, {"tried": 4}, {"accepted": 1}, {"accepted": 3}, {"rejected": []}),
        *({"amplitudes": [1, 1]}, {"amplitudes": [1, 1, 1, 1]}),
    ],
    "has an amplitude out of range": [
        *({"amplitudes": [1, 1, value]} for value in (-1e-9, True, None, "1", 10**15, [1])),
        *({"amplitudes": [float(value), 1, 1]} for value in ("nan", "inf")),
    ],
    "has an invalid rejected load": [
        *({"rejected": [REJECT | {"index": value}]} for value in (63, 67, True, 65.0, None)),
        *({"rejected": [REJECT | {"reason": value}]} for value in (None, 3)),
        *({"rejected": [{k: v for k, v in REJECT.items() if k != name}]} for name in REJECT),
        *({"rejected": [value]} for value in (65, "text", None, [65])),
    ],
}
CASES = [(change, why) for why, changes in IMPOSSIBLE.items() for change in changes]


@pytest.mark.parametrize(("change", "why"), CASES, ids=str)
def test_an_invalid_line_is_left_out_with_its_number_and_the_reason(manifest, change, why):
    path = manifest(LINE, LINE | change)
    assert read_manifest(path) == [LINE]
    ((number, reported),) = invalid_lines(path)
    assert number == 2
    assert reported.startswith(why)


@pytest.mark.parametrize("name", LINE)
def test_a_line_with_a_missing_key_is_left_out_with_the_key(manifest, name):
    path = manifest({key: value for key, value in LINE.items() if key != name}, LINE)
    assert read_manifest(path) == [LINE]
    assert invalid_lines(path) == [(1, f"lacks {name}")]


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "null", "\0", "[" * 99_999])
def test_a_line_that_is_not_an_object_is_left_out(manifest, text):
    path = manifest(LINE)
    path.write_text(text + "\n" + path.read_text())
    assert read_manifest(path) == [LINE]
    assert invalid_lines(path) == [(1, "is not a JSON object")]


@pytest.mark.parametrize(
    ("value", "possible"),
    [
        *(
            (0, True),
            (0.0, True),
            (1e-300, True),
            (UPPER_LIMIT - 1, True),
            (UPPER_LIMIT, False),
            (-1, False),
        ),
        *((True, False), (False, False), (None, False), ("1", False), (10**30, False)),
        *((float("nan"), False), (float("inf"), False)),
    ],
)
def test_numbers_are_finite_and_not_negative(value, possible):
    assert is_number(value) is possible


def test_a_shard_holds_the_loads_that_were_tried_and_not_rejected():
    assert accepted_loads(LINE) == [64, 66]
    assert accepted_loads(LINE | {"rejected": []}) == [64, 65, 66]
    assert accepted_loads(LINE | {"tried": 0, "rejected": []}) == []


def test_lines_are_ordered_by_split_and_first_load():
    keys = [("train", 0), ("train", 64), ("val", 0), ("val", 128), ("test", 0)]
    found = [sort_key({"split": split, "first": first}) for split, first in keys]
    assert found == sorted(found) == [(0, 0), (0, 64), (1, 0), (1, 128), (2, 0)]
