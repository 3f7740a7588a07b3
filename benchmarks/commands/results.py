"""Compare all methods on one experiment: python scripts/results.py name=beam_svk.

name=all does so for every experiment that has finished runs, and writes the table of losses,
Newton from predictions, and the numbers of the paper beside all of them. scripts/paper.py trains
the runs.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from benchmarks.commands import CONF
from benchmarks.commands.pareto import METHODS, trained_methods
from dpl import config
from dpl.commands.cli import command

if TYPE_CHECKING:
    from dpl import Sample, Scene
    from dpl.inference.hybrid import Predict

KEYS = (
    METHODS,
    (bool, "keep single"),
    (str, "runs"),
    (Sequence[str], "convergence"),
    (float, "deflection", 1e-6, 10),
)
ALL = "all"  # name for all experiments


@command("results", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure every run of one or of all experiments; write rows, machines and figures."""
    from benchmarks import all_results

    if cfg.name != ALL:
        measure(cfg)
        return

    for line in all_results.run(cfg, measure):
        print(f"left out: {line}")
    print(f"written to {cfg.folder}")


def measure(cfg: DictConfig) -> None:
    """Measure every run of an experiment; write rows, machine and figure."""
    from benchmarks import learning_curves, methods, paper_tables
    from benchmarks.study import record

    runs = config.load_runs(cfg.run, cfg.networks)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(first, scene)
    if cfg.single:
        _single(cfg, scene, data.samples("test"), {n: s.predict for n, (_, s) in runs.items()})
        return
    compared = {"linear": methods.linear(scene)}
    for (name, variant), method in trained_methods(cfg, runs, data).items():
        compared[name + (paper_tables.CORRECTED if variant else "")] = method
    sets = paper_tables.load_sets(scene, data.samples("test"), cfg.count)
    rows, errors = paper_tables.paper(cfg.name), {}
    a_load = data.store.seconds_per_load()
    minutes = None if a_load is None else a_load * sum(data.sizes.values()) / 60
    for row, error in paper_tables.measure(
        compared, sets, scene.newton, generation_minutes=minutes
    ):
        rows.append(row)
        errors[row.method, row.loads] = error
    stem = Path(cfg.folder) / cfg.name
    if cfg.keep:
        rows = paper_tables.with_kept_rows(rows, stem.with_suffix(".csv"))
    title = f"{cfg.name}, one load at a time, 1 thread"
    record(rows, stem, title, lambda _, path: paper_tables.draw(errors, path))
    learning_curves.save([Path(cfg.run) / name for name in runs], Path(f"{stem}_curves"))


def _single(
    cfg: DictConfig, scene: "Scene", test: "Sample", predictions: "dict[str, Predict]"
) -> None:
    """Measure and draw one large test load."""
    from benchmarks import single_loads
    from benchmarks.study import record

    load = single_loads.choose(test, cfg.deflection)
    measured, displacements = single_loads.measure(predictions, test, load)
    rows = [*single_loads.paper(cfg.name), *measured]
    stem, draw = Path(cfg.folder) / f"{cfg.name}_single", partial(single_loads.draw, scene, test)
    record(rows, stem, f"{cfg.name}, test load {load}", partial(draw, displacements))
