"""Manifest of a data set: a line of JSON for each shard, checked when it is read."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dpl.data.solving.solve import SolvedLoad
from dpl.system.files import parsed_lines, write_file

STREAMS = {"train": 0, "val": 1, "test": 2}  # disjoint streams of one seed
STRINGS, INTEGERS = ("file", "sha256", "split"), ("first", "tried", "accepted", "iterations")
NAME = re.compile(r"[\w.-][\w./-]{0,199}")  # of a shard
UPPER_LIMIT = 1e15  # of a number in a manifest or a journal


def entry_of_load(split: str, solved: SolvedLoad) -> dict[str, Any]:
    """Return the line of a manifest for a shard of one load, without `file` and `sha256`."""
    number, accepted = solved.job.number, solved.accepted
    reject = {"index": number, "reason": solved.reason, "load_factor": solved.load_factor}
    return {
        "split": split,
        "first": number,
        "tried": 1,
        "accepted": int(accepted),
        "iterations": solved.iterations,
        "amplitudes": [round(solved.amplitude, 6)],
        "rejected": [] if accepted else [reject],
    }


def merge_entries(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the entry of a shard from those of its loads, in ascending order."""
    merged = {"split": entries[0]["split"], "first": entries[0]["first"]}
    for key in ("tried", "accepted", "iterations"):
        merged[key] = sum(entry[key] for entry in entries)
    for key in ("amplitudes", "rejected"):
        merged[key] = [value for entry in entries for value in entry[key]]
    return merged


def read_manifest(manifest: Path) -> list[dict[str, Any]]:
    """Return the valid lines of a manifest; the loads of the others are solved again."""
    return [line for line in parsed_lines(manifest) if line and not _flaw_of(line)]


def invalid_lines(manifest: Path) -> list[tuple[int, str]]:
    """Return the number (from 1) of each line that `read_manifest` leaves out, and the reason."""
    flaws = map(_flaw_of, parsed_lines(manifest))
    return [(number, flaw) for number, flaw in enumerate(flaws, 1) if flaw]


def _flaw_of(line: Mapping[str, Any] | None) -> str:
    """Return the reason why a line describes no shard; empty if it is valid."""
    if line is None:
        return "is not a JSON object"
    if absent := {*STRINGS, *INTEGERS, "amplitudes", "rejected"} - line.keys():
        return f"lacks {', '.join(sorted(absent))}"
    for key in STRINGS:
        if not isinstance(line[key], str):
            return f"has a {key} that is not a string"
    if line["split"] not in STREAMS:
        return "names a split that does not exist"
    if not NAME.fullmatch(line["file"]):
        return "names a file that is not in the folder of the data set"
    for key in INTEGERS:
        if not (type(line[key]) is int and 0 <= line[key] < 2**53):
            return f"has a number {key} out of range"
    if "/" not in line["file"] and line["file"] != shard_name(line["split"], line["first"]):
        return "names the file of another split or of another first load"
    return _flaw_of_loads(line)


def _flaw_of_loads(line: Mapping[str, Any]) -> str:
    """Return the reason why the loads of a line are invalid; empty if they are valid."""
    amplitudes, rejected = line["amplitudes"], line["rejected"]
    if not isinstance(amplitudes, list) or not isinstance(rejected, list):
        return "has amplitudes or rejected loads that are not lists"
    if not len(amplitudes) == line["tried"] == line["accepted"] + len(rejected):
        return "has inconsistent numbers of loads"
    if not all(map(is_number, amplitudes)):
        return "has an amplitude out of range"
    valid = all(
        isinstance(one, dict)
        and type(one.get("index")) is int
        and one["index"] in tried_loads(line)
        and isinstance(one.get("reason"), str)
        and "load_factor" in one
        for one in rejected
    )
    return "" if valid else "has an invalid rejected load"


def shard_name(split: str, first: int) -> str:
    """Return the name of the file of a shard, from split and number of its first load."""
    return f"{split}-{first:06d}.safetensors"


def is_number(value: Any) -> bool:
    """Return True for a number that a manifest or a journal may hold."""
    return type(value) in (int, float) and 0 <= value < UPPER_LIMIT


def tried_loads(line: Mapping[str, Any]) -> range:
    """Return the numbers of the loads of a line, accepted or rejected."""
    return range(line["first"], line["first"] + line["tried"])


def accepted_loads(line: Mapping[str, Any]) -> list[int]:
    """Return the numbers of the loads whose solutions the shard of a line holds."""
    rejected = {one["index"] for one in line["rejected"]}
    return [number for number in tried_loads(line) if number not in rejected]


def sort_key(line: Mapping[str, Any]) -> tuple[int, int]:
    """Return the position of a line in the manifest: by split, then by first load."""
    return STREAMS[line["split"]], line["first"]


def rewrite(manifest: Path, lines: Sequence[dict[str, Any]]) -> None:
    """Write these lines, sorted, to a manifest that exists and differs."""
    text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=sort_key)).encode()
    if manifest.exists() and manifest.read_bytes() != text:
        write_file(manifest, text)
