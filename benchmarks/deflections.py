"""Largest nodal displacement of the bodies of the paper under each test load."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.study import picture
from dpl import Scene
from dpl.data.solving.solve import LoadKey
from dpl.data.solving.worker_pool import solve_loads
from dpl.data.storage.store import STREAMS

BINS = 20


@dataclass(frozen=True)
class Deflection:
    """Deflection of a body under a test load."""

    body: str  # name of the body
    load: int  # number of the load in the test stream
    deflection: float  # largest nodal displacement over L, the longest side of the body [-]


def deflections(scenes: Mapping[str, Scene], count: int, workers: int) -> list[Deflection]:
    """Return the deflection of each test load that a data set of seed 0 accepts."""
    rows = []
    for name, scene in scenes.items():
        jobs = [LoadKey((0, STREAMS["test"]), k) for k in range(count)]
        for found in solve_loads(scene, jobs, workers=workers):
            if found.accepted:
                largest = float(np.linalg.norm(found.displacement, axis=1).max())
                rows.append(Deflection(name, found.job.number, largest))
    order = list(scenes)
    return sorted(rows, key=lambda row: (order.index(row.body), row.load))


def by_body(rows: Sequence[Deflection]) -> dict[str, list[float]]:
    """Return the deflections [-] of each body."""
    names = dict.fromkeys(row.body for row in rows)
    return {name: [row.deflection for row in rows if row.body == name] for name in names}


def draw(rows: Sequence[Deflection], path: Path) -> None:
    """Draw a histogram of the deflections of each body, with the median."""
    bodies = by_body(rows)
    with picture(path, 2.7) as figure:
        axes = figure.subplots(1, len(bodies), squeeze=False)[0]
        for ax, (name, values) in zip(axes, bodies.items(), strict=True):
            top, middle = max(values), median(values)
            ax.hist(values, bins=BINS, range=(0, top), color="0.6", edgecolor="white", lw=0.5)
            ax.axvline(middle, color="black", lw=1, label=f"median {middle:.3f} L")
            ax.set_title(f"{name}: {len(values)} test loads, largest {top:.3f} L", loc="left")
            ax.set_xlabel("largest nodal displacement / L [-]")
            ax.set_xlim(0, 1.05 * top)
            ax.yaxis.get_major_locator().set_params(integer=True)
            ax.legend(loc="upper right")
        axes[0].set_ylabel("loads")
