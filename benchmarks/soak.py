"""Run the soak test: python scripts/soak.py minutes=30.

Trains on a stream that worker processes solve, then evaluates the simulator of the trained run,
each for `minutes`. Writes the resources of both, every few seconds, and a figure. The exit status
is 1 if resources grow, the rate falls or processes are left over.
"""

import gc
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import lightning as L
import torch
from omegaconf import DictConfig

from benchmarks import CONF
from benchmarks.study import OTHER_COLOURS, picture, record
from dpl import config
from dpl.commands import cli
from dpl.inference import Simulator

SHARED = Path("/dev/shm")
STREAM = (0, 13)  # random stream of the loads
BATCH = 64  # loads that are drawn at once
MEMORY_GROWTH = 0.03  # largest relative growth of the memory in the second half
MIN_RATE = 0.8  # smallest final rate over the rate at mid-time
MEMORY_NOISE = 16.0  # growth that is ignored [MB]
FILE_GROWTH = 0.1  # largest relative growth of open files; batches open and close some


@dataclass(frozen=True)
class Usage:
    """Resources of a process and its descendants at one time."""

    workload: str  # name of the work
    seconds: float  # time since the start [s]
    steps: int  # answers or training steps so far
    memory: float  # proportional set size of all processes [MB]
    files: int  # open files, segments of shared memory included
    processes: int  # number of processes
    shm_segments: int  # named segments of shared memory, which outlive a killed process


def usage(workload: str, seconds: float, steps: int) -> Usage:
    """Return the resources of this process and its descendants (Linux)."""
    memory, files, found = 0, 0, process_tree()
    for number in found:
        home = Path(f"/proc/{number}")
        try:
            lines = (home / "smaps_rollup").read_text().splitlines()
            memory += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            files += len(os.listdir(home / "fd"))
        except OSError:  # the process has ended
            continue
    names = os.listdir(SHARED) if SHARED.is_dir() else []
    shm_segments = sum(any(f"_{number}_" in name for number in found) for name in names)
    return Usage(workload, seconds, steps, memory / 1024, files, len(found), shm_segments)


def process_tree() -> list[int]:
    """Return the process ids of this process and its living descendants.

    Python's resource tracker does not count: it lives as long as its parent.
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
    for number in found:  # the list grows
        found += [child for child, parent in parents.items() if parent == number]
    return found


def simulator(sim: Simulator, seconds: float, *, every: float = 5.0) -> Iterator[Usage]:
    """Evaluate a simulator without pause, in and beyond its range, and yield its resources.

    Network, tolerances, budgets, warm starts and invalid forces alternate. The loads repeat after
    `BATCH` times the number of calls.
    """
    calls, drawn = list(_calls(sim)), sim.scene.loads.sample(STREAM, range(BATCH))
    newtons = drawn.force * (drawn.young * sim.scene.force_unit).view(-1, 1, 1)
    start, next_record, steps = time.perf_counter(), 0.0, 0
    while (now := time.perf_counter() - start) < seconds:
        if now >= next_record:
            yield usage("simulator", now, steps)
            next_record = now + every
        calls[steps % len(calls)](newtons[steps % BATCH] * (2.0 if steps % 3 == 0 else 1.0))
        steps += 1
    yield usage("simulator", time.perf_counter() - start, steps)


def _calls(sim: Simulator) -> Iterator[Callable[[torch.Tensor], object]]:
    """Yield the kinds of calls; each gives Young's modulus."""
    loads = sim.scene.loads
    young = float(loads.moduli[1])
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


class UsageMonitor(L.Callback):
    """Record the resources of a training and end it after a given time.

    Attributes:
        rows: Records.
    """

    def __init__(self, seconds: float, *, every: float = 5.0) -> None:
        """Set the duration of the training and the time between records [s]."""
        self.rows: list[Usage] = []
        self._seconds, self._every = seconds, every
        self._start = self._next_record = 0.0

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, *args: object) -> None:
        """Record the resources at the chosen times."""
        now = time.perf_counter() - self._start
        if now >= self._next_record:
            self.rows.append(usage("online training", now, trainer.global_step))
            self._next_record = now + self._every
        trainer.should_stop |= now >= self._seconds


def regressions(rows: Sequence[Usage]) -> list[str]:
    """Return growth of resources and loss of speed in the second half, one line each.

    Buffers, caches and compiled kernels fill in the first half.
    """
    if len(rows) < 10:
        raise ValueError(f"{len(rows)} records must be 10 or more; increase minutes")
    fifth = len(rows) // 5
    middle, end = rows[-3 * fifth : -2 * fifth], rows[-fifth:]
    found = []
    before, after = (statistics.median(row.memory for row in part) for part in (middle, end))
    if after - before > max(MEMORY_GROWTH * before, MEMORY_NOISE):
        found.append(f"memory grew from {before:.0f} to {after:.0f} MB")
    slow, fast = _rate(rows[-fifth - 1 :]), _rate(rows[-3 * fifth - 1 : -fifth])
    if slow < MIN_RATE * fast:
        found.append(f"{fast:.1f} a second became {slow:.1f}")
    for name in ("files", "processes", "shm_segments"):
        before, after = (statistics.median(getattr(r, name) for r in p) for p in (middle, end))
        if after > (1 + FILE_GROWTH) * before or (name == "processes" and before != after):
            found.append(f"{name} were {before:g}, are {after:g}")
    return found


def _rate(rows: Sequence[Usage]) -> float:
    """Return the rate between the first and the last row [1/s]."""
    return (rows[-1].steps - rows[0].steps) / (rows[-1].seconds - rows[0].seconds)


def leftovers(before: Usage, after: Usage) -> list[str]:
    """Return leftover processes and segments of shared memory, one line each."""
    counts = {
        name: getattr(after, name) - getattr(before, name) for name in ("processes", "shm_segments")
    }
    return [f"{count} {name} more than before" for name, count in counts.items() if count > 0]


def summary(rows: Sequence[Usage]) -> str:
    """Return duration, rate and resources of a workload as one line."""
    memory = [row.memory for row in rows[len(rows) // 2 :]]
    last = rows[-1]
    return (
        f"{last.workload}: {last.steps:,} in {last.seconds / 60:.1f} min, "
        f"{_rate(rows):.1f} a second; "
        f"second half {min(memory):.0f} to {max(memory):.0f} MB, {last.files} files, "
        f"{last.processes} processes"
    )


def draw(rows: Sequence[Usage], path: Path) -> None:
    """Draw memory, rate, open files and processes against time, one line per workload."""
    workloads = list(dict.fromkeys(row.workload for row in rows))
    with picture(path, 3.0) as figure:
        axes = figure.subplots(1, 3, sharex=True)
        memory, rate, counts = axes
        for colour, workload in zip(("0.25", OTHER_COLOURS[2]), workloads, strict=False):
            own = [row for row in rows if row.workload == workload]
            minutes = [row.seconds / 60 for row in own]
            memory.plot(minutes, [row.memory for row in own], color=colour, label=workload)
            span = max(1, len(own) // 40)
            rates = [_rate(own[k - span : k + 1]) for k in range(span, len(own))]
            rate.plot(minutes[span:], rates, color=colour)
            counts.plot(minutes, [row.files for row in own], color=colour)
            counts.plot(minutes, [row.processes for row in own], color=colour, linestyle="--")
        labels = "memory [MB]", "answers or steps a second", "open files (-), processes (- -)"
        for ax, label in zip(axes, labels, strict=True):
            ax.set(xlabel="time [min]", title=label)
            ax.set_ylim(bottom=0)
            ax.grid(visible=True)
        figure.legend(loc="outside lower center", ncols=2)


KEYS = ((float, "minutes", 1e-2, 1e6), (Sequence[Literal["training", "simulator"]], "workloads"))
RECORDS = 360  # of each workload


@cli.command("soak", conf=CONF, keys=KEYS, preload=["dpl.data.solving.worker_pool"])
def main(cfg: DictConfig) -> None:
    """Train, simulate and record the resources of both."""
    if not cfg.workloads:
        raise config.ConfigError("workloads = [] must contain training, simulator or both")
    folder, seconds = Path(cfg.folder), 60.0 * cfg.minutes
    rows: list[Usage] = []
    wrong: list[str] = []

    def report(work: list[Usage]) -> None:
        rows.extend(work)
        wrong.extend(f"{work[-1].workload}: {line}" for line in regressions(work))
        record(rows, folder / "soak", None, draw)
        print(summary(work))

    if "training" in cfg.workloads:
        before = usage("before", 0.0, 0)
        report(_train(cfg, seconds))
        gc.collect()  # frees the last batches in shared memory
        time.sleep(2.0)  # workers end
        wrong += [
            f"after the training: {line}" for line in leftovers(before, usage("after", 0.0, 0))
        ]
    if "simulator" in cfg.workloads:
        _, surrogate = config.load_run(folder, trust=True)
        records = []
        for row in simulator(Simulator(surrogate), seconds, every=seconds / RECORDS):
            records.append(row)
            said = f"{row.seconds / 60:.1f} min: {row.steps:,} answers ..."
            print(said, end="\r", file=sys.stderr)
        report(records)
    print("\n".join(wrong) or "no growth, no loss of speed, nothing left over")
    if wrong:
        sys.exit(1)


def _train(cfg: DictConfig, seconds: float) -> list[Usage]:
    """Train for a time [s] and return the records."""
    scene = config.build_scene(cfg)
    data = config.instantiate(cfg, "data", scene=scene)
    surrogate = config.build_surrogate(cfg, scene)
    trainer = config.build_trainer(cfg)
    cli.check_trainer(trainer, cfg)
    monitor = UsageMonitor(seconds, every=seconds / RECORDS)
    trainer.callbacks.append(monitor)
    config.save_config(cfg, Path(cfg.folder), without=[name for _, name, *_ in KEYS])
    try:
        trainer.fit(surrogate, datamodule=data)
    finally:
        data.teardown("fit")
    return monitor.rows
