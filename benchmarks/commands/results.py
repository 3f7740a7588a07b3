"""Compare all methods on one experiment: python scripts/results.py name=beam_svk.

name=all does so for every experiment that has finished runs, and writes the table of losses and
Newton from predictions; scripts/paper.py trains the runs. name=figures measures nothing and draws
the figures of all CSV files in `folder` again.
"""

from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from benchmarks.commands import CONF
from benchmarks.commands.pareto import METHODS, trained_methods
from dpl import config
from dpl.commands.cli import command

KEYS = (
    METHODS,
    (bool, "keep single"),
    (str, "runs"),
    (Sequence[str], "convergence"),
    (float, "deflection", 1e-6, 10),
)
ALL, FIGURES = "all", "figures"  # names for all experiments, and for all figures


@command("results", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure every run of one or of all experiments; write rows, machines and figures."""
    from benchmarks import all_results

    if cfg.name == FIGURES:
        print(*all_results.redraw(Path(cfg.folder)), sep="\n")
    elif cfg.name == ALL:
        for line in all_results.run(cfg, measure):
            print(f"left out: {line}")
        print(f"written to {cfg.folder}")
    else:
        measure(cfg)


def measure(cfg: DictConfig) -> None:
    """Measure every run of an experiment; write rows, machine and figure."""
    from benchmarks import learning_curves, methods, paper_tables, single_loads
    from benchmarks.study import record

    runs = config.load_runs(cfg.run, cfg.networks)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(first, scene)
    if cfg.single:
        test, predictions = data.samples("test"), {n: s.predict for n, (_, s) in runs.items()}
        load = single_loads.choose(test, cfg.deflection)
        found = [*single_loads.paper(cfg.name), *single_loads.measure(predictions, test, load)]
        stem = Path(cfg.folder) / f"{cfg.name}_single"
        record(found, stem, f"{cfg.name}, test load {load}", single_loads.draw)
        return
    compared = {"linear": methods.linear(scene)}
    for (name, variant), method in trained_methods(cfg, runs, data).items():
        compared[name + (paper_tables.CORRECTED if variant else "")] = method
    sets = paper_tables.load_sets(scene, data.samples("test"), cfg.count)
    rows = paper_tables.paper(cfg.name)
    a_load = data.store.seconds_per_load()
    minutes = None if a_load is None else a_load * sum(data.sizes.values()) / 60
    rows += paper_tables.measure(compared, sets, scene.newton, generation_minutes=minutes)
    stem = Path(cfg.folder) / cfg.name
    if cfg.keep:
        rows = paper_tables.with_kept_rows(rows, stem.with_suffix(".csv"))
    title = f"{cfg.name}, one load at a time, 1 thread"
    record(rows, stem, title, paper_tables.draw)
    learning_curves.save([Path(cfg.run) / name for name in runs], Path(f"{stem}_curves"))
