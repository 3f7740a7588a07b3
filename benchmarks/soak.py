"""Soak: hours of work at full speed, in which nothing may grow, slow down or be left behind."""

import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import lightning as L
import torch

from dpl import Scene
from dpl.inference import Simulator

SHARED = Path("/dev/shm")
STREAM = (0, 13)  # of the simulator's loads
BATCH = 64  # loads that are drawn at once
FLAT = 0.03  # part of the memory that its second half may gain
STEADY = 0.8  # part of its rate that the end must have
SOME = 16.0  # memory that counts as none [MB]
FEW = 0.1  # part of the open files that come and go with batches


@dataclass(frozen=True)
class Vitals:
    """What a process and its descendants hold at one time.

    Attributes:
        what: They do.
        seconds: Since the start [s].
        done: Answers or steps so far.
        memory: Of all of them, shared pages once (PSS) [MB].
        files: Open files, segments of shared memory among them.
        processes: This one included.
        shared: Segments of shared memory with names, which outlive a process that is killed.
    """

    what: str
    seconds: float
    done: int
    memory: float
    files: int
    processes: int
    shared: int


def vitals(what: str, seconds: float, done: int) -> Vitals:
    """Return what this process and its descendants hold now (Linux)."""
    memory, files, found = 0, 0, family()
    for number in found:
        home = Path(f"/proc/{number}")
        try:
            lines = (home / "smaps_rollup").read_text().splitlines()
            memory += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            files += len(os.listdir(home / "fd"))
        except OSError:  # it has just ended
            continue
    names = os.listdir(SHARED) if SHARED.is_dir() else []
    shared = sum(any(f"_{number}_" in name for number in found) for name in names)
    return Vitals(what, seconds, done, memory / 1024, files, len(found), shared)


def family() -> list[int]:
    """Return the numbers of this process and its living descendants.

    Left out is Python's resource tracker, of which a process that has had others keeps one.
    """
    parents: dict[int, int] = {}
    for home in Path("/proc").glob("[0-9]*"):
        try:
            state, parent = (home / "stat").read_text().rpartition(")")[2].split()[:2]
            tracker = b"resource_tracker" in (home / "cmdline").read_bytes()
        except OSError:
            continue
        if state != "Z" and not tracker:
            parents[int(home.name)] = int(parent)
    found = [os.getpid()]
    for number in found:  # which grows
        found += [child for child, parent in parents.items() if parent == number]
    return found


def simulator(sim: Simulator, seconds: float, *, every: float = 5.0) -> Iterator[Vitals]:
    """Ask for answers as fast as they come, in and beyond the range, and yield what that holds.

    Network, tolerances, budgets, warm starts and refusals take turns. The loads repeat after
    `BATCH` times the turns.

    Args:
        sim: The simulator.
        seconds: For so long.
        every: Time between two looks [s].
    """
    turns = list(_turns(sim))
    newtons = _loads(sim.scene)
    yield from _watched("simulator", lambda k: turns[k % len(turns)](newtons(k)), seconds, every)


def _loads(scene: Scene) -> Callable[[int], torch.Tensor]:
    """Return the k-th force, (N, D) [N], every third one to twice the range."""
    drawn = scene.loads.sample(STREAM, range(BATCH))
    force = drawn.force * (drawn.young * scene.force_unit).view(-1, 1, 1)
    return lambda k: force[k % BATCH] * (2.0 if k % 3 == 0 else 1.0)


def _turns(sim: Simulator) -> Iterator[Callable[[torch.Tensor], object]]:
    """Yield the ways to ask; with a modulus where the scene has a range of them."""
    loads = sim.scene.loads
    young = float(loads.young if isinstance(loads.young, int | float) else max(loads.young))
    yield partial(sim, young=young)
    for tol in (1e-3, 1e-6):
        yield partial(sim, young=young, tol=tol)
    yield partial(sim, young=young, budget_ms=5.0)
    yield partial(sim, young=young, tol=1e-3, warm=True)

    def single(force: torch.Tensor) -> None:
        sim(force.numpy().astype("float32"), young=young)

    yield single

    def refused(force: torch.Tensor) -> None:
        try:
            sim(force * float("nan"), young=young)
        except ValueError:
            return
        raise AssertionError("a force that is not finite was answered")

    yield refused


def _watched(
    what: str, step: Callable[[int], object], seconds: float, every: float
) -> Iterator[Vitals]:
    start, following = time.perf_counter(), 0.0
    done = 0
    while (now := time.perf_counter() - start) < seconds:
        if now >= following:
            yield vitals(what, now, done)
            following = now + every
        step(done)
        done += 1
    yield vitals(what, time.perf_counter() - start, done)


class Pulse(L.Callback):
    """Looks at a training every few seconds and ends it in time.

    Attributes:
        rows: What it has seen.
    """

    def __init__(self, seconds: float, *, every: float = 5.0) -> None:
        """Choose how long the training lasts and how often to look [s]."""
        self.rows: list[Vitals] = []
        self._seconds, self._every = seconds, every
        self._start = self._following = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, *args: object) -> None:
        """Look, if it is time to."""
        now = time.perf_counter() - self._start
        if now >= self._following:
            self.rows.append(vitals("online training", now, trainer.global_step))
            self._following = now + self._every
        trainer.should_stop |= now >= self._seconds


def flaws(rows: Sequence[Vitals]) -> list[str]:
    """Return what has grown, slowed down or been lost in the second half, a line each.

    The first half is for buffers, caches and compiled kernels to fill.

    Raises:
        ValueError: There are fewer than ten rows.
    """
    if len(rows) < 10:
        raise ValueError(f"{len(rows)} looks tell nothing; let it take longer")
    fifth = len(rows) // 5
    middle, end = rows[-3 * fifth : -2 * fifth], rows[-fifth:]
    found = []
    before, after = (statistics.median(row.memory for row in part) for part in (middle, end))
    if after - before > max(FLAT * before, SOME):
        found.append(f"memory grew from {before:.0f} to {after:.0f} MB")
    slow, fast = _rate(rows[-fifth - 1 :]), _rate(rows[-3 * fifth - 1 : -fifth])
    if slow < STEADY * fast:
        found.append(f"{fast:.1f} a second became {slow:.1f}")
    for name in ("files", "processes", "shared"):
        before, after = (statistics.median(getattr(r, name) for r in p) for p in (middle, end))
        if after > (1 + FEW) * before or (name == "processes" and before != after):
            found.append(f"{name} were {before:g}, are {after:g}")
    return found


def _rate(rows: Sequence[Vitals]) -> float:
    """Return what was done a second between the first and the last row [1/s]."""
    return (rows[-1].done - rows[0].done) / (rows[-1].seconds - rows[0].seconds)


def left(before: Vitals, after: Vitals) -> list[str]:
    """Return which processes and named segments a work has left behind, a line each."""
    counts = {
        name: getattr(after, name) - getattr(before, name) for name in ("processes", "shared")
    }
    return [f"{count} {name} more than before" for name, count in counts.items() if count > 0]


def told(rows: Sequence[Vitals]) -> str:
    """Return a work in a line: how long, how much, how fast, in how much memory."""
    memory = [row.memory for row in rows[len(rows) // 2 :]]
    last = rows[-1]
    return (
        f"{last.what}: {last.done:,} in {last.seconds / 60:.1f} min, {_rate(rows):.1f} a second; "
        f"second half {min(memory):.0f} to {max(memory):.0f} MB, {last.files} files, "
        f"{last.processes} processes"
    )


def draw(rows: Sequence[Vitals], path: Path) -> None:
    """Draw memory, rate, and open files and processes against time, a line for each work."""
    from benchmarks.verification.drawing import panel, picture
    from dpl.visualization import COLOURS

    works = list(dict.fromkeys(row.what for row in rows))
    with picture(path, 3.4) as figure:
        memory = panel(figure, 1, "time [min]", "memory [MB]", "(a)", columns=3)
        rate = panel(figure, 2, "time [min]", "answers or steps a second", "(b)", columns=3)
        held = panel(figure, 3, "time [min]", "open files; processes", "(c)", columns=3)
        for colour, what in zip(COLOURS, works, strict=False):
            own = [row for row in rows if row.what == what]
            minutes = [row.seconds / 60 for row in own]
            memory.plot(minutes, [row.memory for row in own], color=colour, label=what)
            span = max(1, len(own) // 40)
            rates = [_rate(own[k - span : k + 1]) for k in range(span, len(own))]
            rate.plot(minutes[span:], rates, color=colour)
            held.plot(minutes, [row.files for row in own], color=colour)
            held.plot(minutes, [row.processes for row in own], color=colour, linestyle="--")
        for ax in (memory, rate, held):
            ax.set_ylim(bottom=0)
        figure.legend(*memory.get_legend_handles_labels(), loc="outside lower center", ncols=2)
