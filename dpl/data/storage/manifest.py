"""What the manifest of a data set says of its shards, and whether that can be."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dpl.system.files import parsed_lines

STREAMS = {"train": 0, "val": 1, "test": 2}  # disjoint streams of one seed
LINE = {  # what a line of the manifest has
    *("file", "sha256", "split", "first", "tried", "accepted"),
    *("iterations", "amplitudes", "rejected"),
}
NAME = re.compile(r"[\w.-][\w./-]{0,199}")  # of a shard
MOST = 1e15  # that a number of a manifest or a journal can be


def lines_of(manifest: Path) -> list[dict[str, Any]]:
    """Return the lines of a manifest that describe a shard.

    The other lines are left out, so that their loads are solved again; see `torn_lines`.
    """
    return [line for line in parsed_lines(manifest) if line is not None and not _flaw_of(line)]


def torn_lines(manifest: Path) -> list[tuple[int, str]]:
    """Return the number (from 1) of each line that `lines_of` leaves out, and the reason."""
    flaws = (
        "is not a JSON object" if line is None else _flaw_of(line)
        for line in parsed_lines(manifest)
    )
    return [(number, flaw) for number, flaw in enumerate(flaws, 1) if flaw]


def _flaw_of(line: Mapping[str, Any]) -> str:
    """Return why a line cannot describe a shard; empty if it can."""
    if absent := LINE - line.keys():
        return f"lacks {', '.join(sorted(absent))}"
    for key in ("file", "sha256", "split"):
        if not isinstance(line[key], str):
            return f"has a {key} that is not text"
    if line["split"] not in STREAMS:
        return "names a split that does not exist"
    if not NAME.fullmatch(line["file"]):
        return "names a file that is not in the folder of the data set"
    for key in ("first", "tried", "accepted", "iterations"):
        if not (type(line[key]) is int and 0 <= line[key] < 2**53):
            return f"has a number {key} that cannot be"
    if "/" not in line["file"] and line["file"] != shard_name(line["split"], line["first"]):
        return "names the file of another split or of another first load"
    return _flaw_of_loads(line)


def _flaw_of_loads(line: Mapping[str, Any]) -> str:
    """Return why the loads that a line lists cannot be those of a shard; empty if they can."""
    amplitudes, rejected = line["amplitudes"], line["rejected"]
    if not isinstance(amplitudes, list) or not isinstance(rejected, list):
        return "has amplitudes or rejected loads that are not lists"
    if not len(amplitudes) == line["tried"] == line["accepted"] + len(rejected):
        return "has numbers of loads that disagree"
    if not all(map(is_number, amplitudes)):
        return "has an amplitude that cannot be"
    numbers = range(line["first"], line["first"] + line["tried"])
    possible = all(
        isinstance(one, dict)
        and type(one.get("index")) is int
        and one["index"] in numbers
        and isinstance(one.get("reason"), str)
        and "load_factor" in one
        for one in rejected
    )
    return "" if possible else "has a rejected load that cannot be"


def shard_name(split: str, first: int) -> str:
    """Return the name of the file of a shard.

    Args:
        split: Split of its loads.
        first: Number of its first load.
    """
    return f"{split}-{first:06d}.safetensors"


def is_number(value: Any) -> bool:
    """Return whether a value is a number that a manifest or a journal may hold."""
    return type(value) in (int, float) and 0 <= value < MOST


def kept_in(line: Mapping[str, Any]) -> list[int]:
    """Return the loads that a shard must hold."""
    rejected = {one["index"] for one in line["rejected"]}
    numbers = range(line["first"], line["first"] + line["tried"])
    return [number for number in numbers if number not in rejected]


def place(line: Mapping[str, Any]) -> tuple[int, int]:
    """Return where a line of the manifest belongs."""
    return STREAMS[line["split"]], line["first"]
