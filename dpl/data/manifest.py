"""What the manifest of a data set says of its shards, and whether that can be."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dpl.data.durable import read_lines

STREAMS = {"train": 0, "val": 1, "test": 2}  # disjoint streams of one seed
LINE = {  # what a line of the manifest has
    *("file", "sha256", "split", "first", "tried", "accepted"),
    *("iterations", "amplitudes", "rejected"),
}
NAME = re.compile(r"[\w.-][\w./-]{0,199}")  # of a shard
MOST = 1e15  # that a number of a manifest or a journal can be


def lines_of(manifest: Path) -> list[dict[str, Any]]:
    """Return the lines of a manifest; one that lacks something counts as torn.

    So does one that says what cannot be: its loads are solved again.
    """
    return [line for line in read_lines(manifest) if line.keys() >= LINE and _is_possible(line)]


def _is_possible(line: Mapping[str, Any]) -> bool:
    """Return whether the values of a line are of their kinds and agree with each other."""
    texts, counts = ("file", "sha256", "split"), ("first", "tried", "accepted", "iterations")
    if not all(isinstance(line[key], str) for key in texts) or line["split"] not in STREAMS:
        return False
    if not all(type(line[key]) is int and 0 <= line[key] < 2**53 for key in counts):
        return False
    if not NAME.fullmatch(line["file"]):
        return False
    amplitudes, rejected = line["amplitudes"], line["rejected"]
    if not isinstance(amplitudes, list) or not isinstance(rejected, list):
        return False
    if not len(amplitudes) == line["tried"] == line["accepted"] + len(rejected):
        return False
    numbers = range(line["first"], line["first"] + line["tried"])
    return all(map(is_number, amplitudes)) and all(
        isinstance(one, dict)
        and type(one.get("index")) is int
        and one["index"] in numbers
        and isinstance(one.get("reason"), str)
        and "load_factor" in one
        for one in rejected
    )


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
