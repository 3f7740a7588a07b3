"""Measure run time and error of all solvers: python scripts/pareto.py run=runs/beam_svk."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig
from rich.progress import Progress

import dpl
from benchmarks.commands import CONF
from dpl import config, fem, inference, training
from dpl.commands.cli import command

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.methods import Method
    from benchmarks.pareto import Point

METHODS = (dict | None, "galerkin corrected")  # keys of `trained_methods`
KEYS = (METHODS,)


@command("pareto", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all solvers and the networks of a folder of runs; write rows and a figure."""
    from benchmarks import pareto
    from benchmarks.study import record
    from dpl.system.threads import available_cores

    solvers, batch = _solvers(cfg)
    rows: list[Point] = []
    for threads in cfg.threads:
        count = threads or available_cores()
        with Progress() as progress:
            bar = progress.add_task(f"solvers, {count} threads", total=len(solvers))
            tick = partial(progress.advance, bar)
            rows += pareto.points(solvers, batch, threads=count, tick=tick)
    title = Path(cfg.run).name
    stem = Path(cfg.folder) / f"pareto_{title}"
    record(rows, stem, title, pareto.draw, threads=rows[0].threads)


def _solvers(cfg: DictConfig) -> tuple[dict[str, "fem.Solver"], "dpl.Sample"]:
    """Return all solvers including the networks of the runs, and the test loads."""
    runs = config.load_runs(cfg.run, trust=cfg.trust)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(first, scene)
    robust = scene.newton
    solvers: dict[str, fem.Solver] = {"linear": scene.linear}
    solvers |= {f"Newton to {tol:g}": replace(robust, tol=tol) for tol in (1e-3, 1e-6, 1e-8)}
    for (name, variant), method in trained_methods(cfg, runs, data).items():
        title = f"{name}, {variant}" if variant else name
        solvers[title] = dpl.Direct(method.predict, scene.problem)
    for name, (_, surrogate) in runs.items():
        solvers[f"{name}, hybrid"] = inference.default_hybrid(surrogate.predict, scene)
    return solvers, data.samples("test")


def trained_methods(
    cfg: DictConfig,
    runs: "Mapping[str, tuple[DictConfig, training.TrainedSurrogate]]",
    data: "dpl.DataModule",
) -> dict[tuple[str, str], "Method"]:
    """Return POD-Galerkin, the networks and the corrected networks, by name and variant.

    The variant is "corrected" or empty. Reduced models are made from the training samples, or from
    the validation samples of a run that has none on disk.
    """
    from benchmarks import methods

    found: dict[tuple[str, str], Method] = {}
    if cfg.galerkin:
        found["POD-Galerkin", ""] = _made(cfg, "galerkin", data.scene, data.snapshots())
    for name, (trained, surrogate) in runs.items():
        loads = config.training_loads(trained)
        plain = methods.network(surrogate, Path(cfg.run) / name, loads)
        found[name, ""] = plain
        if cfg.corrected and {"correction", "vectors"} & set(dir(surrogate.net)):
            samples = data.snapshots()
            found[name, "corrected"] = _made(cfg, "corrected", surrogate, plain, samples)
    return found


def _made(cfg: DictConfig, key: str, *parts: object) -> "Method":
    """Return the method of a key; raise a `ConfigError` with the remedy if it cannot be made."""
    make = config.instantiate(cfg, key)
    try:
        made: Method = make(*parts)
    except ValueError as error:
        raise config.ConfigError(f"{key}: {error}; {key}=null leaves it out") from error
    return made
