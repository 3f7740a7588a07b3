"""The data set on disk: immutable safetensors shards and a manifest that names them.

    FOLDER/scene.json            fingerprint of the scene with its fields, seed, versions
    FOLDER/modes.safetensors     eigenvalues and eigenvectors that the loads are made of
    FOLDER/train-000000.safetensors, ...
    FOLDER/manifest.jsonl        a line a shard: name, SHA-256, loads tried, rejects with reasons

Files are written beside their place, synced and renamed; a shard that the manifest does not name
does not exist. So an interrupted run loses the shard it was filling and nothing else.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

import dpl
from dpl.data.generate import Job, Outcome, outcomes
from dpl.fem.modes import Modes
from dpl.scene import Sample, Scene

FORMAT = 1
SHARD = 64  # loads in one file
STREAMS = {"train": 0, "val": 1, "test": 2}  # disjoint streams of one seed


class DataSetError(ValueError):
    """A data set that cannot be used, and what to do about it."""


def store_of(scene: Scene, folder: str | None, seed: int) -> "Store":
    """Return the data set in a folder; left out, one named after the scene and the seed."""
    return Store(Path(folder or f"datasets/{scene.fingerprint[:12]}-seed{seed}"), scene, seed)


def generate(
    scene: Scene,
    *,
    folder: str | None = None,
    seed: int = 0,
    train: int = 1000,
    val: int = 100,
    test: int = 100,
    workers: int = 2,
) -> "Store":
    """Return a data set with so many loads tried; what is missing is solved under a progress bar.

    Args:
        scene: What is simulated.
        folder: Where the data set is; named after the scene's fingerprint if left out.
        seed: Names the loads.
        train: Loads to train on.
        val: Loads to validate on.
        test: Loads to test on.
        workers: Processes that solve; 0: this one.

    Raises:
        ValueError: A number is out of range.
        DataSetError: The folder holds something else.
    """
    sizes = {"train": train, "val": val, "test": test}
    for name, number in {"seed": seed, **sizes, "workers": workers}.items():
        if number < 0:
            raise ValueError(f"{name} = {number} must be 0 or more")
    store = store_of(scene, folder, seed)
    missing = {split: store.missing(split, size) for split, size in sizes.items()}
    if not any(missing.values()):
        return store
    columns = (
        TextColumn("solving {task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[news]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as progress:
        bar = progress.add_task("loads", total=sum(map(len, missing.values())), news="")
        accepted, start = 0, time.perf_counter()
        for count, one in enumerate(store.fill(missing, workers=workers), 1):
            accepted += one.accepted
            rate = count / (time.perf_counter() - start)
            news = f"{accepted} accepted, {count - accepted} rejected, {rate:.1f}/s"
            progress.update(bar, advance=1, news=news)
    return store


@dataclass(frozen=True)
class Store:
    """A data set of one scene and one seed.

    Attributes:
        folder: Where it is, or will be.
        scene: What it must be a data set of.
        seed: Names its loads.
    """

    folder: Path
    scene: Scene
    seed: int

    def open(self) -> list[dict[str, Any]]:
        """Return the manifest, after creating the data set or checking that it is the scene's.

        Raises:
            DataSetError: The folder holds something else.
        """
        card = self.folder / "scene.json"
        if not card.exists():
            there = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
            if there - {"modes.safetensors"}:  # which is written first
                raise DataSetError(
                    f"{self.folder} is not empty and no data set; choose another data.folder"
                )
            self.folder.mkdir(parents=True, exist_ok=True)
            modes = self.scene.loads.modes
            _write(
                self.folder / "modes.safetensors",
                _packed(values=modes.values, vectors=modes.vectors),
            )
            _write(card, json.dumps(self._card(), indent=1).encode())
        self._check(json.loads(card.read_text()))
        manifest = self.folder / "manifest.jsonl"
        shards = []
        for line in manifest.read_text().splitlines() if manifest.exists() else ():
            with suppress(json.JSONDecodeError):  # torn by a crash: its shard does not count
                shards.append(json.loads(line))
        return shards

    def _card(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "fingerprint": self.scene.fingerprint,
            "scene": self.scene.identity(),
            "seed": self.seed,
            "versions": {
                "dpl": dpl.__version__,
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
        }

    def _check(self, card: dict[str, Any]) -> None:
        if card.get("format") != FORMAT:
            raise DataSetError(
                f"{self.folder} has format {card.get('format')}, this dpl reads {FORMAT}"
            )
        if card["fingerprint"] != self.scene.fingerprint:
            differing = [k for k, v in self.scene.identity().items() if card["scene"].get(k) != v]
            raise DataSetError(
                f"{self.folder} is a data set of another scene: its fingerprint is "
                f"{card['fingerprint'][:12]}, this scene's is {self.scene.fingerprint[:12]} "
                f"({', '.join(differing)} differ); choose another data.folder or restore the scene"
            )
        if card["seed"] != self.seed:
            raise DataSetError(
                f"{self.folder} was drawn with seed {card['seed']}, not {self.seed}; "
                "choose another data.folder or data.seed"
            )

    def missing(self, split: str, count: int) -> list[int]:
        """Return which of the first `count` loads of a split have not been tried."""
        tried: set[int] = set()
        for line in self.open() if self.folder.exists() else ():
            if line["split"] == split:
                tried.update(range(line["first"], line["first"] + line["tried"]))
        return [index for index in range(count) if index not in tried]

    def fill(self, missing: Mapping[str, Sequence[int]], *, workers: int) -> Iterator[Outcome]:
        """Solve loads that are missing, by split; yield each as it is done.

        Raises:
            DataSetError: The folder holds something else.
        """
        self.open()
        shards = [
            [Job(self.stream(split), index) for index in run]
            for split, indices in missing.items()
            for run in _runs(indices)
        ]
        waiting: dict[Job, Outcome] = {}
        jobs = [job for shard in shards for job in shard]
        for one in outcomes(self.scene, jobs, workers=workers):
            waiting[one.job] = one
            yield one
            while shards and all(job in waiting for job in shards[0]):
                self._append([waiting.pop(job) for job in shards.pop(0)])

    def stream(self, split: str) -> tuple[int, int]:
        """Return the seed of a split's loads."""
        return self.seed, STREAMS[split]

    def _append(self, tried: Sequence[Outcome]) -> None:
        """Write one shard, then its line of the manifest."""
        split = {self.stream(name): name for name in STREAMS}[tried[0].job.seed]
        kept = [one for one in tried if one.accepted]
        name = f"{split}-{tried[0].job.number:06d}.safetensors"
        shape = (0, *self.scene.problem.shape)
        content = _packed(
            index=torch.tensor([one.job.number for one in kept], dtype=torch.int64),
            force=torch.from_numpy(
                np.stack([one.force for one in kept]) if kept else np.zeros(shape)
            ),
            displacement=torch.from_numpy(
                np.stack([one.displacement for one in kept]) if kept else np.zeros(shape)
            ),
            young=torch.tensor([one.young for one in kept], dtype=torch.float64),
        )
        _write(self.folder / name, content)
        line = {
            "file": name,
            "sha256": hashlib.sha256(content).hexdigest(),
            "split": split,
            "first": tried[0].job.number,
            "tried": len(tried),
            "accepted": len(kept),
            "rejected": [
                {"index": one.job.number, "reason": one.reason, "load_factor": one.load_factor}
                for one in tried
                if not one.accepted
            ],
            "iterations": sum(one.iterations for one in tried),
            "seconds": round(sum(one.seconds for one in tried), 3),
        }
        with (self.folder / "manifest.jsonl").open("a+") as manifest:
            manifest.seek(0)
            torn = not manifest.read().endswith("\n") and manifest.tell() > 0
            manifest.write("\n" * torn + json.dumps(line) + "\n")
            manifest.flush()
            os.fsync(manifest.fileno())

    def load(self, split: str, count: int) -> Sample:
        """Return the accepted ones of the first `count` loads of a split, in order.

        Raises:
            DataSetError: A shard is damaged, or there are no samples.
        """
        parts: list[tuple[Tensor, Sample]] = []
        for line in sorted(self.open(), key=lambda line: line["first"]):
            if line["split"] != split or line["first"] >= count:
                continue
            path = self.folder / line["file"]
            if (
                not path.is_file()
                or hashlib.sha256(path.read_bytes()).hexdigest() != line["sha256"]
            ):
                raise DataSetError(
                    f"{path} is damaged or missing; remove its line from manifest.jsonl"
                )
            with safe_open(path, framework="pt") as shard:
                sample = Sample(*(shard.get_tensor(name) for name in Sample._fields))
                parts.append((shard.get_tensor("index"), sample))
        if not parts or not sum(len(index) for index, _ in parts):
            raise DataSetError(f"{self.folder} holds no {split} samples")
        chosen = torch.cat([index for index, _ in parts]) < count
        columns = zip(*(sample for _, sample in parts), strict=True)
        return Sample(*(torch.cat(column)[chosen] for column in columns))

    def summary(self) -> str:
        """Return how many loads were tried and accepted, a line a split."""
        lines = [str(self.folder)]
        for split in STREAMS:
            shards = [line for line in self.open() if line["split"] == split]
            tried, accepted = (sum(line[key] for line in shards) for key in ("tried", "accepted"))
            seconds = sum(line["seconds"] for line in shards)
            if tried:
                mean = sum(line["iterations"] for line in shards) / tried
                lines.append(
                    f"  {split}: {accepted} of {tried} loads accepted, {mean:.1f} Newton "
                    f"iterations and {seconds / tried:.3f} s each on one core"
                )
        return "\n".join(lines)

    def modes(self) -> Modes:
        """Return the modes that the data set's loads are made of."""
        with safe_open(self.folder / "modes.safetensors", framework="pt") as file:
            return Modes(file.get_tensor("values"), file.get_tensor("vectors"))


def _runs(indices: Sequence[int]) -> Iterator[list[int]]:
    """Yield runs of consecutive indices, none across a multiple of SHARD."""
    run: list[int] = []
    for index in indices:
        if run and (index != run[-1] + 1 or index % SHARD == 0):
            yield run
            run = []
        run.append(index)
    if run:
        yield run


def _packed(**tensors: Tensor) -> bytes:
    return save({name: tensor.contiguous() for name, tensor in tensors.items()})


def _write(path: Path, content: bytes) -> None:
    with whole_file(path) as file:
        file.write(content)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file to write that will be there whole or not at all, also after a crash."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
