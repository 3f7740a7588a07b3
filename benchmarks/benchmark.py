"""Measure run times of the mechanics and of public codes: python scripts/benchmark.py.

Long cases on demand: cases=[large] (run alone, it reports its memory), cases=[robustness],
cases=[generation], cases=[sizes]; errors of other meshes: cases=[discretisation]; displacements of
the test loads: cases=[deflections] count=100; latency of a trained run:
cases=[latency] run=runs/mine; loads on small areas: cases=[local] run=runs/mine count=250.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from benchmarks import CONF, peers
from benchmarks import deflections as reached
from benchmarks import discretisation as meshes
from benchmarks import sizes as beams
from benchmarks.study import record
from dpl import Scene, config
from dpl.commands.cli import command
from dpl.data.solving.solve import equilibrium
from dpl.evaluation.tables import machine
from dpl.fem import (
    Load,
    NeoHookeanLn,
    SaintVenantKirchhoff,
    Solution,
    installed_backends,
    solve,
    symmetries,
)
from dpl.fem.linear import BACKENDS
from dpl.inference import Simulator
from dpl.system.threads import one_thread

CASES = (
    *("scenes", "pieces", "propeller", "large", "robustness", "generation"),
    *("discretisation", "sizes", "deflections", "latency", "local"),
)


KEYS = (
    (Sequence[str], "linear"),
    (Sequence[str] | None, "cases bodies"),
    (dict, "reference_codes"),
    (int, "workers", 0, 1024),
    (Sequence[int], "cells_across", 1, 1000),
)


@command("benchmark", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Time the chosen cases, print tables and write the rows to a folder.

    Each case is a function of the configuration that records the rows of one study or several.
    """
    cases = CASES if cfg.cases is None else cfg.cases
    if unknown := [case for case in cases if case not in CASES]:
        raise config.ConfigError(f"cases = {unknown[0]!r} must be one of {', '.join(CASES)}")
    if unknown := [name for name in cfg.linear if name not in ("auto", *BACKENDS)]:
        known = ", ".join(("auto", *BACKENDS))
        raise config.ConfigError(f"linear: {unknown[0]!r} is none of {known}")
    if not installed(cfg):
        raise config.ConfigError(
            f"linear = {list(cfg.linear)} must name one that is installed: auto"
        )
    print(f"{machine()}, 1 thread, medians of {cfg.repeats}")
    for case in cases:
        with one_thread():
            globals()[case](cfg)


def installed(cfg: DictConfig) -> list[str]:
    """Return the linear backends of the configuration that are installed."""
    return [name for name in cfg.linear if name == "auto" or name in installed_backends()]


def scenes(cfg: DictConfig) -> None:
    """Record the times on the scenes of `benchmarks.peers`, by dpl and by public codes."""
    record(_scene_times(cfg), Path(cfg.folder) / "scenes", "clamped beam, by code and scene")


def _scene_times(cfg: DictConfig) -> Iterator[peers.Time]:
    measured = [partial(peers.beams, name, cfg.repeats) for name in installed(cfg)]
    programs = Path(peers.__file__).parent / "programs"
    for name, python in cfg.reference_codes.items():
        if python:
            program = programs / f"{name}_beam.py"
            measured.append(partial(peers.time_reference_code, python, program, cfg.repeats))
    for measure in measured:
        with config.error_in("reference_codes", OSError):
            rows = measure()
        for scene, row in rows.items():
            yield replace(row, case=f"{row.case}, {scene}")
    for name, seconds in peers.PUBLISHED.items():
        for scene, taken in zip(peers.CASES, seconds, strict=True):
            yield peers.Time(f"published: {name}, {scene}", taken, note="on a Zen 5 core")


def pieces(cfg: DictConfig) -> None:
    """Record the times of the parts of an iteration on the beam."""
    rows = peers.pieces(3 * cfg.repeats)
    record(rows, Path(cfg.folder) / "pieces", "beam of 12,000 degrees of freedom")


def propeller(cfg: DictConfig) -> None:
    """Record the time of a random load on the propeller."""
    names = [name for name in installed(cfg) if name != "band"]
    rows = (peers.propellers(name, 4 * cfg.repeats) for name in names)
    record(rows, Path(cfg.folder) / "propeller", "propeller of 12,075 degrees of freedom, one load")


def large(cfg: DictConfig) -> None:
    """Record the time of an iteration on 100,548 degrees of freedom with the first backend."""
    rows = [peers.large(installed(cfg)[0])]
    record(rows, Path(cfg.folder) / "large", "beam of 100,548 degrees of freedom")


def robustness(cfg: DictConfig) -> None:
    """Record the numbers of random loads solved in one step and with load steps."""
    builders: dict[str, Callable[[], Scene]] = {
        "beam, NH-ln": partial(peers.beam_scene, NeoHookeanLn(0.3)),
        "beam, SVK": partial(peers.beam_scene, SaintVenantKirchhoff(0.3)),
        "propeller, NH-ln": peers.propeller_scene,
        "beam, fibres": peers.fibre_scene,
        "beam, stiff core": peers.inclusion_scene,
    }
    if unknown := sorted(set(cfg.bodies or ()) - set(builders)):
        raise config.ConfigError(f"bodies: {unknown[0]} must be one of {list(builders)}")
    chosen = {name: builders[name] for name in cfg.bodies or builders}
    rows = peers.robustness(chosen, cfg.count, cfg.workers)
    record(rows, Path(cfg.folder) / "robustness", "random loads")


def generation(cfg: DictConfig) -> None:
    """Record the cost of a sample on one core for each method."""
    scenes = {
        "paper's beam, NH-ln": peers.beam_scene(NeoHookeanLn(0.3)),
        "paper's propeller, NH-ln": peers.propeller_scene(),
    }
    rows = (
        replace(row, method=f"{name}: {row.method}")
        for name, scene in scenes.items()
        for row in costs(scene, cfg.samples)
    )
    record(rows, Path(cfg.folder) / "generation", f"a sample on one core, {cfg.samples} loads")


@dataclass(frozen=True)
class Cost:
    """Cost of one method on the same loads, one at a time, on one core."""

    method: str  # name of the method
    seconds: float  # median time of a sample [s]
    rate: float  # number of samples over the sum of their times [1/s]
    # iterations, factorisations: mean numbers per sample
    iterations: float
    factorisations: float
    accepted: int  # number of accepted samples


def costs(scene: Scene, loads: int) -> list[Cost]:
    """Return the cost of a sample of each method; the methods alternate on each load."""
    newton = scene.newton
    solvers: dict[str, Callable[[Load], Solution]] = {
        "a factor for every tangent": partial(solve, replace(newton, factor_reuse_tol=0.0)),
        "factors reused": partial(solve, newton),
        "the generator": partial(equilibrium, scene),
    }
    found: dict[str, list[tuple[Any, ...]]] = {method: [] for method in solvers}
    for k in range(-1, loads):  # the first one is not timed
        load = scene.loads.sample((1, 0), [max(k, 0)])
        for method, solver in solvers.items():
            start = time.perf_counter()
            answer = solver(load)
            seconds = time.perf_counter() - start
            count = int(answer.iterations), int(answer.factorisations), bool(answer.stable)
            if k >= 0:
                found[method].append((seconds, *count))
    rows = []
    for method, numbers in found.items():
        taken, iterations, factors, accepted = zip(*numbers, strict=True)
        rate, (a, b) = len(numbers) / sum(taken), map(statistics.mean, (iterations, factors))
        rows.append(Cost(method, statistics.median(taken), rate, a, b, sum(accepted)))
    return [*rows, _images(scene, rows[-1])]


def _images(scene: Scene, solved: Cost) -> Cost:
    """Return the cost of a sample if the symmetric images of each solution count too."""
    group = symmetries(scene.problem)
    field = torch.zeros(2, *scene.problem.shape, dtype=torch.float64)
    start = time.perf_counter()
    for symmetry in group[1:]:
        symmetry.image(field)
    imaging = time.perf_counter() - start
    count = len(group)
    return Cost(
        f"the generator, {count} symmetries",
        (solved.seconds + imaging) / count,
        count / (1 / solved.rate + imaging),
        solved.iterations / count,
        solved.factorisations / count,
        solved.accepted,
    )


def discretisation(cfg: DictConfig) -> None:
    """Record the errors of coarser, finer and quadratic meshes of the beam and of the propeller."""
    for name, law in (("beam_svk", SaintVenantKirchhoff(0.3)), ("propeller_nh", NeoHookeanLn(0.3))):
        family = meshes.FAMILIES[name.partition("_")[0]]
        rows = meshes.discretisations(family, law, repeats=cfg.repeats)
        record(rows, Path(cfg.folder) / f"discretisation_{name}", f"{name}: Newton to 1e-6")


def sizes(cfg: DictConfig) -> None:
    """Record the costs of solvers and networks on beams of growing size."""
    parts = beams.sizes(cfg.cells_across, loads=cfg.repeats)
    rows = (row for part in parts for row in part)
    record(rows, Path(cfg.folder) / "sizes", "beams of growing size", beams.draw)


def deflections(cfg: DictConfig) -> None:
    """Record the deflections of the paper's beam and propeller under test loads."""
    scenes = {
        "beam_svk": peers.beam_scene(SaintVenantKirchhoff(0.3)),
        "propeller_nh": peers.propeller_scene(),
    }
    rows = reached.deflections(scenes, cfg.count, cfg.workers)
    rows = record(rows, Path(cfg.folder) / "deflections", None, reached.draw)
    for name, values in reached.by_body(rows).items():
        least, middle, most = min(values), statistics.median(values), max(values)
        print(
            f"{name}: largest nodal displacements of {len(values)} loads {least:.2g} to "
            f"{most:.2g} L, median {middle:.2g} L"
        )


def latency(cfg: DictConfig) -> None:
    """Record the wall times of a trained run."""
    from benchmarks.latency import call_times

    simulator = Simulator(config.load_run(_run(cfg, "latency"))[1])
    load = simulator.scene.loads.sample((0, 2), range(cfg.samples))
    calls = call_times(simulator, load, repeats=cfg.repeats)
    record(calls, Path(cfg.folder) / "latency", "one load, one thread [ms]")


def local(cfg: DictConfig) -> None:
    """Record the errors of a trained run of `unrolled` for loads on small areas."""
    from benchmarks import local_loads
    from dpl.models import Unrolled

    surrogate = config.load_run(_run(cfg, "local"))[1]
    if not isinstance(surrogate.net, Unrolled):
        raise config.ConfigError(f"run = {cfg.run} must be a run of model=unrolled")
    stem = Path(cfg.folder) / f"local_loads_{Path(cfg.run).name}"
    record(local_loads.measure(surrogate, cfg.count), stem, "errors for loads on small areas")


def _run(cfg: DictConfig, case: str) -> str:
    """Return the folder of the run that a case needs."""
    if cfg.run is None:
        raise config.ConfigError(f"run = null must name the trained run for cases=[{case}]")
    return str(cfg.run)
