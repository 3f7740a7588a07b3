"""The data set on disk: immutable safetensors shards and a manifest that names them.

    FOLDER/scene.json            fingerprint of the scene with its fields, seed, versions
    FOLDER/modes.safetensors     eigenvalues and eigenvectors that the loads are made of
    FOLDER/train-000000.safetensors, ...
    FOLDER/manifest.jsonl        a line a shard: name, SHA-256, loads tried, rejects with reasons
    FOLDER/manifest-1-of-4.jsonl the same of one writer of several
    FOLDER/journal.jsonl         a line a session: when, where, how long
    FOLDER/spool/                loads solved whose shard is not complete, a file each

Files are written beside their place, synced and renamed; a shard that no manifest names does not
exist. The manifest holds nothing that depends on a clock: interrupted and resumed, by one worker or
by eight, the same loads give the same bytes.
"""

import hashlib
import json
import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dpl.data import balance
from dpl.data.audit import flaw_of_modes, flaw_of_shard
from dpl.data.crew import Stop, outcomes
from dpl.data.durable import (
    DataSetError,
    append_line,
    own_file,
    read_lines,
    sole_writer,
    sync_folder,
    whole_file,
)
from dpl.data.manifest import STREAMS, is_number, kept_in, lines_of, place
from dpl.data.outcome import Job, Outcome
from dpl.data.shard import closed, opened, taken
from dpl.data.spool import Spool, sweep
from dpl.fem.modes import Modes
from dpl.scene import Sample, Scene
from dpl.version import __version__

FORMAT = 2
MODES = "modes.safetensors"
HEADER = 100_000  # bytes of a shard besides its numbers, at most
SHARD = 64  # loads in one file
MACHINE = ("timed out", "its worker died")  # reasons that lie with the machine: `repair` retries


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

    @property
    def spool(self) -> Spool:
        """The loads that are solved and wait for their shard."""
        return Spool(self.folder / "spool", {name: self.stream(name) for name in STREAMS})

    # ------------------------------------------------------------------ reading

    def shards(self) -> list[dict[str, Any]]:
        """Return the lines of all manifests by first load; none if there is no data set yet.

        Raises:
            DataSetError: The folder holds something else.
        """
        card = self.folder / "scene.json"
        there = {path.name for path in self.folder.iterdir()} if self.folder.exists() else set()
        if card.name not in there:
            if not {name for name in there if name[0] != "."} <= {MODES}:
                raise DataSetError(
                    f"{self.folder} is not empty and no data set; choose another data.folder"
                )
            return []
        try:
            self._check(json.loads(own_file(card)))
        except DataSetError:
            raise
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            raise DataSetError(
                f"{card} is damaged ({error}); choose another data.folder or remove this one"
            ) from None
        lines = [line for path in self._manifests() for line in lines_of(path)]
        return sorted(lines, key=place)

    def _manifests(self) -> list[Path]:
        return sorted(self.folder.glob("manifest*.jsonl"))

    def _check(self, card: dict[str, Any]) -> None:
        if card.get("format") != FORMAT:
            raise DataSetError(
                f"{self.folder} has format {card.get('format')}, this dpl reads {FORMAT}; "
                "choose another data.folder"
            )
        if card["fingerprint"] != self.scene.fingerprint:
            ours = json.loads(json.dumps(self.scene.identity()))  # lists for tuples, as on disk
            differing = [k for k, v in ours.items() if card["scene"].get(k) != v]
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

    def missing(self, split: str, count: int, shard: int = 0, shards: int = 1) -> list[int]:
        """Return which of the first `count` loads of a split have not been tried.

        Args:
            split: train, val or test.
            count: So many loads are wanted.
            shard: Of these the ones that fall to this writer, of
            shards: so many, who take files in turn.
        """
        tried: set[int] = set()
        for line in self.shards():
            if line["split"] == split:
                tried.update(range(line["first"], line["first"] + line["tried"]))
        mine = (index for index in range(count) if index // SHARD % shards == shard)
        return [index for index in mine if index not in tried]

    def load(self, split: str, count: int) -> Sample:
        """Return the accepted ones of the first `count` loads of a split, in order.

        Raises:
            DataSetError: A shard is damaged, or there are no samples.
        """
        parts = []
        for line in self.shards():
            if line["split"] == split and line["first"] < count:
                parts.append(self._read(line))
        index = torch.cat([part["index"] for part in parts]) if parts else torch.zeros(0)
        keep = np.unique(index.numpy(), return_index=True)[1]  # two writers may have had one load
        keep = keep[index.numpy()[keep] < count]
        if not len(keep):
            raise DataSetError(f"{self.folder} holds no {split} samples")
        force, displacement, point, poisson = (
            torch.cat([part[name] for part in parts])[keep]
            for name in ("force", "displacement", "point", "poisson")
        )
        return Sample(force, displacement, self.scene.loads.young_at(point), poisson)

    def _read(self, line: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return what a shard holds, forces as fields (B, N, D).

        Raises:
            DataSetError: It is damaged.
        """
        try:
            return self._sound(line)
        except ValueError as error:
            raise DataSetError(
                f"{self.folder / line['file']} {error}; scripts/generate.py action=repair with the "
                "same scene solves its loads again"
            ) from None

    def _sound(self, line: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return what a shard holds.

        Raises:
            ValueError: It is damaged; the message goes on after its name.
        """
        path = self.folder / line["file"]
        if path.parent != self.folder or path.is_symlink() or not path.is_file():
            raise ValueError("is missing")
        shape = self.scene.problem.shape
        numbers = 3 * math.prod(shape) + self.scene.loads.dimension + 8  # of a load, at most
        if path.stat().st_size > HEADER + 8 * numbers * line["tried"]:
            raise ValueError("is damaged: it is larger than its loads")
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != line["sha256"]:
            raise ValueError("is damaged: its SHA-256 is not the manifest's")
        loads = self.scene.loads
        own = int(loads.poisson_range is not None)
        shard = opened(content, shape, loads.dimension, own)
        if shard["index"].tolist() != kept_in(line):
            raise ValueError("holds other loads than the manifest says")
        return shard

    def reader(self, split: str) -> Callable[[int], Outcome | None]:
        """Return what gives a split's loads one at a time, None for those not there at present."""
        lines = {
            index: line
            for line in self.shards()
            if line["split"] == split
            for index in range(line["first"], line["first"] + line["tried"])
        }
        spooled = self.spool.files()
        shard: dict[str, Tensor] = {}
        held: dict[str, Any] | None = None

        def read(index: int) -> Outcome | None:
            nonlocal shard, held
            if (line := lines.get(index)) is None:
                path = spooled.get(Job(self.stream(split), index))
                with suppress(FileNotFoundError):  # it is in a shard by now
                    return self.spool.get(path) if path else None
                return None
            if held is not line:
                shard, held = self._read(line), line
            return taken(shard, Job(self.stream(split), index), line)

        return read

    def digest(self, split: str, count: int) -> str:
        """Return the SHA-256 of a split's samples in order, however they came into their shards."""
        found = hashlib.sha256()
        for column in self.load(split, count)[:2]:
            found.update(column.contiguous().numpy().tobytes())
        return found.hexdigest()

    def modes(self) -> Modes:
        """Return the modes that the data set's loads are made of.

        Raises:
            DataSetError: They are damaged.
        """
        path = self.folder / MODES
        most = HEADER + 16 * sum(column.numel() for column in self.scene.loads.modes)
        try:
            found = load(own_file(path, most))
            return Modes(found["values"], found["vectors"])
        except (FileNotFoundError, KeyError, SafetensorError, ValueError) as error:
            raise DataSetError(
                f"{path} is damaged: {error}; scripts/generate.py action=repair makes it again"
            ) from None

    def acceptance(self) -> list[balance.Bin]:
        """Return how many loads of each amplitude were accepted, all splits together."""
        amplitudes: list[float] = []
        accepted: list[bool] = []
        for line in self.shards():
            rejected = {one["index"] for one in line["rejected"]}
            amplitudes += line["amplitudes"]
            accepted += [line["first"] + k not in rejected for k in range(line["tried"])]
        return balance.bins(amplitudes, accepted)

    def summary(self) -> str:
        """Return how many loads were tried and accepted, by split and by amplitude."""
        lines = [str(self.folder)]
        for split in STREAMS:
            shards = [line for line in self.shards() if line["split"] == split]
            tried, accepted = (sum(line[key] for line in shards) for key in ("tried", "accepted"))
            if tried:
                mean = sum(line["iterations"] for line in shards) / tried
                lines.append(
                    f"  {split}: {accepted} of {tried} loads accepted, {mean:.1f} Newton iterations"
                )
        lines += [f"  {row}" for row in balance.table(self.acceptance())]
        sessions = self._sessions()
        if loads := sum(one["loads"] for one in sessions):
            core = sum(one["core_seconds"] for one in sessions) / loads
            wall = sum(one["seconds"] for one in sessions)
            size = sum(path.lstat().st_size for path in self.folder.glob("*.safetensors")) / 1e6
            lines.append(
                f"  {core:.3f} s a load on one core, {wall:.0f} s of wall time in {len(sessions)} "
                f"sessions, {size:.0f} MB"
            )
        return "\n".join(lines)

    def _sessions(self) -> list[dict[str, Any]]:
        """Return the lines of the journal that say how long."""
        return [
            line
            for line in read_lines(self.folder / "journal.jsonl")
            if all(is_number(line.get(key)) for key in ("loads", "seconds", "core_seconds"))
        ]

    def seconds_a_load(self) -> float | None:
        """Return the wall time of a load in all sessions so far [s]; None before the first."""
        sessions = self._sessions()
        loads = sum(one["loads"] for one in sessions)
        return sum(one["seconds"] for one in sessions) / loads if loads else None

    # ------------------------------------------------------------------ writing

    def create(self) -> None:
        """Write down whose data set this is, if it is not there yet.

        Raises:
            DataSetError: The folder holds something else.
        """
        self.shards()
        if (self.folder / "scene.json").exists():
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        modes = self.scene.loads.modes
        _write(self.folder / MODES, save(modes._asdict()))
        card = {
            "format": FORMAT,
            "fingerprint": self.scene.fingerprint,
            "scene": self.scene.identity(),
            "seed": self.seed,
            "versions": {
                "dpl": __version__,
                "torch": torch.__version__,
                "numpy": np.__version__,
            },
        }
        _write(self.folder / "scene.json", json.dumps(card, indent=1).encode())

    def stream(self, split: str) -> tuple[int, int]:
        """Return the seed of a split's loads."""
        return self.seed, STREAMS[split]

    def fill(
        self,
        missing: Mapping[str, Sequence[int]],
        *,
        workers: int,
        timeout: float | None = None,
        stop: Stop | None = None,
        shard: int = 0,
        shards: int = 1,
    ) -> Generator[Outcome, None, None]:
        """Solve loads that are missing, by split; yield each as it is done.

        Each is kept in the spool as soon as it is solved; a shard is written when it is complete,
        in order. Loads that were spooled before an interruption are not solved again.

        Args:
            missing: Numbers of the loads, by split.
            workers: Processes that solve; 0: this one.
            timeout: Longest time for a load [s].
            stop: Asked whether to begin no more.
            shard: Which files to write, of
            shards: so many writers.

        Raises:
            DataSetError: The folder holds something else, or another process writes there.
        """
        self.create()
        with sole_writer(self.folder, shard, shards):
            manifest = "manifest.jsonl" if shards == 1 else f"manifest-{shard}-of-{shards}.jsonl"
            sweep(self.folder)
            spooled, tried = self.spool.files(), self._tried()
            for job in [*spooled]:
                if job in tried:  # killed between writing its shard and removing it
                    spooled.pop(job).unlink(missing_ok=True)
            wanted = {
                split: [i for i in indices if Job(self.stream(split), i) not in tried]
                for split, indices in missing.items()
            }
            files = [
                [Job(self.stream(split), index) for index in run]
                for split, indices in wanted.items()
                for run in _runs(indices)
            ]
            jobs = [job for file in files for job in file if job not in spooled]
            self._flush(files, spooled, manifest)
            for one in outcomes(self.scene, jobs, workers=workers, timeout=timeout, stop=stop):
                spooled[one.job] = self.spool.put(one)
                yield one
                self._flush(files, spooled, manifest)
            self._rewrite(self.folder / manifest, lines_of(self.folder / manifest))
            if shards == 1:
                self.spool.tidy()

    def _tried(self) -> set[Job]:
        """Return the loads that are in a shard, or rejected there."""
        return {
            Job(self.stream(line["split"]), index)
            for line in self.shards()
            for index in range(line["first"], line["first"] + line["tried"])
        }

    def _rewrite(self, manifest: Path, lines: Sequence[dict[str, Any]]) -> None:
        """Make a manifest of these lines, in order, if it is not that already."""
        text = "".join(json.dumps(line) + "\n" for line in sorted(lines, key=place)).encode()
        if manifest.exists() and manifest.read_bytes() != text:
            _write(manifest, text)

    def _split(self, job: Job) -> str:
        return {self.stream(name): name for name in STREAMS}[job.seed]

    def _flush(self, files: list[list[Job]], spooled: dict[Job, Path], manifest: str) -> None:
        """Write the first shards that are complete; take them off both lists."""
        while files and all(job in spooled for job in files[0]):
            jobs = files.pop(0)
            paths = [spooled.pop(job) for job in jobs]
            self._append([self.spool.get(path) for path in paths], manifest)
            for path in paths:
                path.unlink()

    def collect(self, split: str) -> None:
        """Write those spooled loads of a split that make whole shards.

        Raises:
            DataSetError: Another process writes there.
        """
        with sole_writer(self.folder):
            spooled = self.spool.files()
            mine = {job for job in spooled if job.seed == self.stream(split)}
            count = max((job.number for job in mine), default=-1) + 1
            runs = [run for run in _runs(self.missing(split, count)) if len(run) == SHARD]
            files = [[Job(self.stream(split), index) for index in run] for run in runs]
            whole = [file for file in files if mine.issuperset(file)]
            self._flush(whole, spooled, "manifest.jsonl")

    def _append(self, tried: Sequence[Outcome], manifest: str) -> None:
        """Write one shard, then its line of the manifest."""
        split, first = self._split(tried[0].job), tried[0].job.number
        kept = [one for one in tried if one.accepted]
        name = f"{split}-{first:06d}.safetensors"
        loads = self.scene.loads
        poisson = None if loads.poisson_range is None else loads.poisson_at
        content = closed(kept, self.scene.problem.shape, loads.dimension, poisson)
        _write(self.folder / name, content)
        line = {
            "file": name,
            "sha256": hashlib.sha256(content).hexdigest(),
            "split": split,
            "first": first,
            "tried": len(tried),
            "accepted": len(kept),
            "iterations": sum(one.iterations for one in tried),
            "amplitudes": [round(one.amplitude, 6) for one in tried],
            "rejected": [
                {"index": one.job.number, "reason": one.reason, "load_factor": one.load_factor}
                for one in tried
                if not one.accepted
            ],
        }
        append_line(self.folder / manifest, line)

    # ------------------------------------------------------------------ trust

    def verify(self) -> Iterator[tuple[dict[str, Any], str]]:
        """Yield each shard's line with what is wrong with it; empty if nothing is.

        A shard is sound if its bytes are those that were written, its loads those that the scene
        draws, and each displacement balances its load to the tolerance, evaluated again, with
        nothing inverted.

        Raises:
            DataSetError: There is none.
        """
        if not (self.folder / "scene.json").exists():
            raise DataSetError(f"{self.folder} holds no data set yet; generate it first")
        try:
            flaw = flaw_of_modes(self.scene, self.modes())
        except DataSetError as error:
            flaw = f"is damaged: {error}"
        yield {"file": MODES, "rejected": []}, flaw
        for line in self.shards():
            try:
                shard = self._sound(line)
                yield line, flaw_of_shard(self.scene, self.stream(line["split"]), shard)
            except ValueError as error:
                yield line, str(error)

    def repair(self) -> dict[str, dict[str, Any]]:
        """Forget damaged shards, and those with loads that the machine lost; return their lines.

        Their loads count as missing from then on. Files that no manifest names are removed.

        Raises:
            DataSetError: Another process writes there.
        """
        if not (self.folder / "scene.json").exists():
            return {}
        with sole_writer(self.folder):
            poor = {
                line["file"]: line
                for line, flaw in self.verify()
                if flaw or any(one["reason"].startswith(MACHINE) for one in line["rejected"])
            }
            if poor.pop(MODES, None):
                _write(self.folder / MODES, save(self.scene.loads.modes._asdict()))
            named = {MODES}
            for manifest in self._manifests():
                lines = [line for line in lines_of(manifest) if line["file"] not in poor]
                named |= {line["file"] for line in lines}
                self._rewrite(manifest, lines)
            for path in [*self.folder.glob("*.safetensors"), *self.folder.rglob(".*.part")]:
                if path.name not in named and (path.is_symlink() or not path.is_dir()):
                    path.unlink()
            for path in self.spool.files().values():
                if self.spool.get(path).reason.startswith(MACHINE):
                    path.unlink()
            sync_folder(self.folder)
        return poor


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


def _write(path: Path, content: bytes) -> None:
    try:
        with whole_file(path) as file:
            file.write(content)
    except IsADirectoryError:
        raise DataSetError(
            f"{path} is a folder where a file must be; remove it or choose another data.folder"
        ) from None
