"""Learning curves of runs: validation errors after each epoch that was validated."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.paper_tables import PLAIN
from benchmarks.study import label_decades, method_colours, picture, record

ERROR = "val/rel_L2_median"
MARKS = "osD^v"  # of the runs of a method


@dataclass(frozen=True)
class Validation:
    """Error of a run after an epoch."""

    method: str  # name of the run
    epoch: int  # number of epochs that were trained
    rel_L2_median: float  # median relative L2 error of the validation loads [-]


def curve(folder: Path) -> list[Validation]:
    """Return the validations of a run from its logs; empty without logs or validations.

    A resumed run has several logs. Of an epoch that was validated twice, the last value counts.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found: dict[int, float] = {}
    for path in sorted(folder.glob("events.out.tfevents.*")):
        log = EventAccumulator(str(path)).Reload()
        if {"epoch", ERROR} <= set(log.Tags()["scalars"]):
            epochs = {event.step: round(event.value) + 1 for event in log.Scalars("epoch")}
            found |= {epochs[event.step]: event.value for event in log.Scalars(ERROR)}
    return [Validation(folder.name, epoch, found[epoch]) for epoch in sorted(found)]


def save(runs: Sequence[Path], stem: Path) -> bool:
    """Write the learning curves of runs as CSV and PNG; return False if no run has one."""
    curves = [line for folder in runs if len(line := curve(folder)) > 1]
    return bool(record([point for line in curves for point in line], stem, None, draw))


def draw(rows: Sequence[Validation], path: Path) -> None:
    """Draw validation errors over epochs, a line for each run; dashed without the linear base."""
    last = {row.method: row.rel_L2_median for row in rows}
    colours = method_colours(sorted(last, key=lambda name: -last[name]))
    with picture(path) as figure:
        ax = figure.subplots()
        for k, (name, colour) in enumerate(colours.items()):
            line = [(row.epoch, row.rel_L2_median) for row in rows if row.method == name]
            mark = MARKS[list(colours.values())[:k].count(colour) % len(MARKS)]  # of this colour
            style = {"marker": mark, "ms": 3.5, "lw": 1.2, "color": colour, "label": name}
            ax.loglog(*zip(*line, strict=True), ls="--" if PLAIN in name else "-", **style)
        ax.set(xlabel="epochs", ylabel="median relative L2 error")
        label_decades(ax.xaxis)
        ax.grid(visible=True)
        ax.legend()
