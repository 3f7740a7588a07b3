"""Learning curves of runs: validation errors after each epoch that was validated."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.paper_tables import PLAIN
from benchmarks.study import method_colours, picture
from dpl.evaluation.tables import write

ERROR = "val/rel_L2_median"
CSV_LOG = Path("csv", "metrics.csv")  # see conf/logger/csv.yaml


@dataclass(frozen=True)
class Validation:
    """Error of a run after an epoch.

    Attributes:
        method: Name of the run.
        epoch: Number of epochs that were trained.
        rel_L2_median: Median relative L2 error of the validation loads [-].
    """

    method: str
    epoch: int
    rel_L2_median: float


def curve(folder: Path) -> list[Validation]:
    """Return the validations of a run from its logs; empty without logs or validations.

    A resumed run has several logs. Of an epoch that was validated twice, the last value counts.

    Args:
        folder: Folder of the run, with logs of TensorBoard or of `logger=csv`.
    """
    found = dict(_from_csv(folder / CSV_LOG))
    for path in sorted(folder.glob("events.out.tfevents.*")):
        found |= _from_events(path)
    return [Validation(folder.name, epoch, found[epoch]) for epoch in sorted(found)]


def _from_csv(path: Path) -> dict[int, float]:
    if not path.is_file():
        return {}
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row.get(ERROR)]
    return {int(row["epoch"]) + 1: float(row[ERROR]) for row in rows}


def _from_events(path: Path) -> dict[int, float]:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = EventAccumulator(str(path)).Reload()
    if not {"epoch", ERROR} <= set(log.Tags()["scalars"]):
        return {}
    epochs = {event.step: round(event.value) + 1 for event in log.Scalars("epoch")}
    return {epochs[event.step]: event.value for event in log.Scalars(ERROR)}


def save(runs: Sequence[Path], stem: Path) -> bool:
    """Write the learning curves of runs as CSV and PNG; return False if no run has one.

    Args:
        runs: Folders of the runs.
        stem: Path of the files without extension.
    """
    curves = {folder.name: line for folder in runs if len(line := curve(folder)) > 1}
    if curves:
        write([point for line in curves.values() for point in line], stem.with_suffix(".csv"))
        draw(curves, stem.with_suffix(".png"))
    return bool(curves)


def draw(curves: Mapping[str, Sequence[Validation]], path: Path) -> None:
    """Draw validation errors over epochs on logarithmic scales, a labelled line for each run.

    Networks on the linear solution have the colour of the network without it and a solid line; the
    lines of networks without it are dashed.

    Args:
        curves: Validations by name of the run, two or more each.
        path: Path of the picture.
    """
    families = {name: name.partition("_")[0] for name in curves}
    colours = method_colours(families.values())
    with picture(path, 5.6, 3.4) as figure:
        ax = figure.subplots()
        for name, line in curves.items():
            epochs, errors = zip(
                *((point.epoch, point.rel_L2_median) for point in line), strict=True
            )
            colour, dashes = colours[families[name]], "--" if PLAIN in name else "-"
            ax.plot(epochs, errors, marker="o", ms=3, lw=1.2, color=colour, ls=dashes)
            ax.annotate(
                name, (epochs[-1], errors[-1]), xytext=(5, 0), textcoords="offset points",
                va="center", fontsize=7.5, color=colour,
            )  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel="epochs", ylabel="median relative L2 error")
        ax.grid(visible=True)
