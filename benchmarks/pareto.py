"""Measure run time and error of all solvers: python scripts/pareto.py run=runs/beam_svk.

All iterates of the solvers and of the networks of a folder of runs, on the same loads.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig
from rich.progress import Progress

from benchmarks import CONF, methods
from benchmarks.study import label_decades, method_colours, picture, record
from dpl import config, inference
from dpl.commands.cli import command
from dpl.data import DataModule
from dpl.evaluation.timing import WARM_UP, percentiles
from dpl.fem import Solver, solve
from dpl.scene import Sample
from dpl.system.threads import available_cores, limited_threads
from dpl.training import TrainedSurrogate, relative_errors
from dpl.training.metrics import median

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORDS = {
    "": "prediction, or solution",
    "corrected": "one step in the modes",
    "hybrid": "hybrid: each iterate",
}
MARKERS = {"corrected": "D", "hybrid": "s"}  # of methods; "o" for others
LEAST = 1e-12  # errors below are drawn there [-]


@dataclass(frozen=True)
class Point:
    """One iterate of a solver, over all loads."""

    solver: str  # name of the solver
    iteration: int  # index of the iterate; a load with fewer iterates keeps its last one
    is_final: bool  # this is the last iterate of all loads
    threads: int  # threads of torch and BLAS
    device: str  # device of the other computations than the network's
    loads: int  # number of loads
    # median wall time up to this iterate, with its residual and min det F, one load at a time [ms]
    ms: float
    ms_p99: float  # 99th percentile of this time [ms]
    error: float  # median relative L2 error against the converged solution on the same mesh [-]
    max_error: float  # maximum of this error [-]
    residual: float  # median relative residual ||R|| / ||f|| [-]


def points(
    solvers: Mapping[str, Solver],
    batch: Sample,
    *,
    threads: int = 1,
    tick: Callable[[], None] = lambda: None,
) -> list[Point]:
    """Return run times and errors of all iterates of solvers, one load at a time.

    Each solver is warmed up, then solves all loads in a row; `tick` is called after each.
    """
    singles = batch.load.unbatch()
    found = []
    with limited_threads(threads), torch.inference_mode():
        for name, solver in solvers.items():
            for load in singles[:WARM_UP]:
                solve(solver, load)
            paths = []  # for each load the wall times up to each iterate [ms], and the iterates
            for load in singles:
                start = time.perf_counter()
                states = solver.iterate(load)
                paths.append([(1e3 * (time.perf_counter() - start), one) for one in states])
            count = max(map(len, paths))
            for k in range(count):
                iterates = [path[min(k, len(path) - 1)] for path in paths]
                times = torch.tensor([ms for ms, _ in iterates], dtype=torch.float64)
                displacement = torch.cat([state.displacement for _, state in iterates])
                error = relative_errors(displacement, batch)
                residual = torch.cat([state.residual for _, state in iterates])
                record = name, k, k == count - 1, threads, "cpu", len(singles)
                errors = float(median(error)), float(error.max()), float(median(residual))
                found.append(Point(*record, *percentiles(times), *errors))
            tick()
    return found


def draw(rows: Sequence[Point], path: Path) -> None:
    """Draw run time against error of the iterates of solvers, with the first number of threads.

    Each method has one colour: a dot for its prediction, a line through the iterates.
    """
    rows = [row for row in rows if row.threads == rows[0].threads]
    solvers = list(dict.fromkeys(row.solver for row in rows))
    # the method of a solver without its variant and tolerance
    families = {name: name.partition(", ")[0].partition(" to ")[0] for name in solvers}
    with picture(path, 4.4) as figure:
        ax = figure.subplots()
        for family, colour in method_colours(dict.fromkeys(families.values())).items():
            lines = [
                [row for row in rows if row.solver == name]
                for name in solvers
                if families[name] == family
            ]
            if family == "Newton":  # one line through the solutions to all tolerances
                lines = [sorted((line[-1] for line in lines), key=lambda row: row.ms)]
            for line in lines:
                _draw_line(ax, line, colour)
            ax.plot([], [], color=colour, lw=2.5, label=family)
        used = {name.partition(", ")[2] for name in solvers}
        for method, words in WORDS.items():
            if method in used:
                ax.plot([], [], color="0.5", ls="", marker=MARKERS.get(method, "o"), label=words)
        ax.set_xlabel("time of one load [ms], median")
        ax.set_ylabel("relative error, median of the loads")
        ax.set_ylim(top=10)
        label_decades(ax.xaxis)
        ax.grid(visible=True)
        figure.legend(loc="outside right upper")


def _draw_line(ax: "Axes", line: Sequence[Point], colour: str) -> None:
    """Draw the iterates of a solver, the last one larger."""
    shown = [row for row in line if row.error < 1]
    if not shown:
        return
    style = {"color": colour, "marker": MARKERS.get(shown[-1].solver.partition(", ")[2], "o")}
    x, y = [row.ms for row in shown], [max(row.error, LEAST) for row in shown]
    ax.loglog(x, y, lw=1.2, ms=3, **style)
    ax.loglog(x[-1:], y[-1:], ms=7, **style)


METHODS = (dict | None, "galerkin corrected")  # keys of `trained_methods`
KEYS = (METHODS,)


@command("pareto", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all solvers and the networks of a folder of runs; write rows and a figure."""
    solvers, batch = _solvers(cfg)
    rows: list[Point] = []
    for threads in cfg.threads:
        count = threads or available_cores()
        with Progress() as progress:
            bar = progress.add_task(f"solvers, {count} threads", total=len(solvers))
            rows += points(solvers, batch, threads=count, tick=partial(progress.advance, bar))
    title = Path(cfg.run).name
    record(rows, Path(cfg.folder) / f"pareto_{title}", title, draw, threads=rows[0].threads)


def _solvers(cfg: DictConfig) -> tuple[dict[str, Solver], Sample]:
    """Return all solvers including the networks of the runs, and the test loads."""
    runs = methods.load_runs(cfg.run, trust=cfg.trust)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(first, scene)
    solvers: dict[str, Solver] = {"linear": scene.linear}
    solvers |= {f"Newton to {tol:g}": replace(scene.newton, tol=tol) for tol in (1e-3, 1e-6, 1e-8)}
    for (name, variant), method in trained_methods(cfg, runs, data).items():
        title = f"{name}, {variant}" if variant else name
        solvers[title] = inference.Direct(method.predict, scene.problem)
    for name, (_, surrogate) in runs.items():
        solvers[f"{name}, hybrid"] = inference.default_hybrid(surrogate.predict, scene)
    return solvers, data.samples("test")


def trained_methods(
    cfg: DictConfig, runs: Mapping[str, tuple[DictConfig, TrainedSurrogate]], data: DataModule
) -> dict[tuple[str, str], methods.Method]:
    """Return POD-Galerkin, the networks and the corrected networks, by name and variant.

    The variant is "corrected" or empty. Reduced models are made from the training samples, or from
    the validation samples of a run that has none on disk.
    """
    found: dict[tuple[str, str], methods.Method] = {}
    if cfg.galerkin:
        found["POD-Galerkin", ""] = _made(cfg, "galerkin", data.scene, data.snapshots())
    for name, (trained, surrogate) in runs.items():
        train = trained.data.train  # no number for a stream
        loads = train if isinstance(train, int) else None
        plain = methods.network(surrogate, Path(cfg.run) / name, loads)
        found[name, ""] = plain
        if cfg.corrected and {"correction", "vectors"} & set(dir(surrogate.net)):
            samples = data.snapshots()
            found[name, "corrected"] = _made(cfg, "corrected", surrogate, plain, samples)
    return found


def _made(cfg: DictConfig, key: str, *parts: object) -> methods.Method:
    """Return the method of a key; raise a `ConfigError` with the remedy if it cannot be made."""
    make = config.instantiate(cfg, key)
    try:
        made: methods.Method = make(*parts)
    except ValueError as error:
        raise config.ConfigError(f"{key}: {error}; {key}=null leaves it out") from error
    return made
