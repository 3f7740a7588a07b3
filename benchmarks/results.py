"""Compare all methods on one experiment: python scripts/results.py name=beam_svk.

name=all does so for every experiment that has finished runs, and writes the table of losses and
Newton from predictions; scripts/paper.py trains the runs. name=figures measures nothing and draws
the figures of all CSV files in `folder` again.
"""

import importlib
import json
import math
import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import torch
from omegaconf import DictConfig, OmegaConf

import benchmarks
from benchmarks import CONF, learning_curves, methods, paper_tables
from benchmarks.methods import training_minutes
from benchmarks.pareto import METHODS, trained_methods
from benchmarks.study import Draw, read, record
from benchmarks.subcommands import run_script
from dpl import config
from dpl.commands.cli import command
from dpl.evaluation.tables import PREDICTION
from dpl.training.metrics import median

EXPERIMENTS = ("beam_svk", "propeller_nh", "beam_nh_loss", "beam_young", "beam_young_wide")
OF_CONVERGENCE = "beam_svk"  # experiment whose networks start Newton's method in experiment 4
LOSS_METRICS = ("e_mean", "e_max", "SNR_min", "rel_L2_median", "rel_L2_worst", "residual")
HYBRID = "paper's hybrid"  # begins the name of its row in an evaluation


@dataclass(frozen=True)
class LossRow:
    """Medians over the runs of a loss with different seeds."""

    runs: str  # common name of the runs, network and loss
    seeds: int  # number of runs
    # e_mean, e_max, SNR_min, rel_L2_median, rel_L2_worst, residual: See `dpl.training.metrics`; of
    # the test loads
    e_mean: float
    e_max: float
    SNR_min: float
    rel_L2_median: float
    rel_L2_worst: float
    residual: float
    hybrid_iterations: float  # mean iterations of the paper's hybrid from the predictions
    training_minutes: float  # wall time of a training [min]


def loss_numbers(folder: Path) -> list[float]:
    """Return the numbers of a run in the order of `LossRow`; NaN where one is unknown."""
    rows = {row["solver"]: row for row in json.loads((folder / "evaluation.json").read_text())}
    errors = rows[PREDICTION]["errors"]
    hybrids = [row["iterations"] for name, row in rows.items() if name.startswith(HYBRID)]
    minutes = training_minutes(folder)
    return [
        *(float(errors.get(name, math.nan)) for name in LOSS_METRICS),
        float(hybrids[0]) if hybrids else math.nan,
        math.nan if minutes is None else minutes,
    ]


def loss_rows(runs: Mapping[str, Sequence[float]]) -> list[LossRow]:
    """Return a row for each group of runs whose names differ only in the seed at their end."""
    groups: dict[str, list[Sequence[float]]] = {}
    for name, values in runs.items():
        stem, _, seed = name.rpartition("-")
        groups.setdefault(stem if stem and seed.isdigit() else name, []).append(values)
    return [
        LossRow(name, len(members), *median(torch.tensor(members, dtype=torch.float64)).tolist())
        for name, members in groups.items()
    ]


def finished_runs(folder: Path) -> list[str]:
    """Return the names of the runs in a folder whose evaluation is complete."""
    return sorted(path.parent.name for path in folder.glob("*/evaluation.json"))


def measure_all(cfg: DictConfig) -> list[str]:
    """Write the tables of all experiments; return a line for each part that is left out."""
    root, folder, left_out = Path(cfg.runs), Path(cfg.folder), []
    for name in EXPERIMENTS:
        names = finished_runs(root / name)
        if not names:
            left_out.append(f"{name}: no finished run below {root / name}")
            continue
        print(f"\n{name}: {', '.join(names)}", flush=True)
        own = {"name": name, "run": str(root / name), "networks": names}
        try:
            measure(OmegaConf.merge(cfg, own))
        except (config.ConfigError, ValueError) as error:
            left_out.append(f"{name}: {error}")
    runs = root / "losses"
    if names := finished_runs(runs):
        rows = loss_rows({name: loss_numbers(runs / name) for name in names})
        record(rows, folder / "losses", "losses: medians over seeds")
    else:
        left_out.append(f"losses: no finished run below {runs}")
    runs = root / OF_CONVERGENCE
    if names := finished_runs(runs):
        options = [f"run={runs}", f"networks=[{','.join(names)}]", f"folder={folder}"]
        print(f"\nconvergence: {', '.join(names)}", flush=True)
        if status := run_script("convergence", [*options, *cfg.convergence]):
            left_out.append(f"convergence: ended with status {status}")
    else:
        left_out.append(f"convergence (experiment 4): no finished run below {runs}")
    return left_out


def figures() -> list[tuple[type, Draw[Any]]]:
    """Return the classes of rows that a module of this folder draws, each with its `draw`."""
    names = [one.name for one in pkgutil.iter_modules(benchmarks.__path__, "benchmarks.")]
    draws = [getattr(importlib.import_module(name), "draw", None) for name in names]
    return [(get_args(get_type_hints(draw)["rows"])[0], draw) for draw in draws if draw]


def redraw(folder: Path) -> list[Path]:
    """Draw all figures of a folder again from its rows, whose columns tell their class."""
    drawn = []
    for path in sorted(folder.glob("*.csv")):
        for kind, draw in figures():
            try:
                rows: list[Any] = read(kind, path)
            except ValueError:  # the columns are those of another class
                continue
            drawn.append(path.with_suffix(".png"))
            draw(rows, drawn[-1])
    return drawn


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
    if cfg.name == FIGURES:
        print(*redraw(Path(cfg.folder)), sep="\n")
    elif cfg.name == ALL:
        for line in measure_all(cfg):
            print(f"left out: {line}")
        print(f"written to {cfg.folder}")
    else:
        measure(cfg)


def measure(cfg: DictConfig) -> None:
    """Measure every run of an experiment; write rows, machine and figure."""
    runs = methods.load_runs(cfg.run, cfg.networks)
    first, surrogate = next(iter(runs.values()))
    scene = surrogate.scene
    data = config.load_data(first, scene)
    stem = Path(cfg.folder) / (f"{cfg.name}_single" if cfg.single else cfg.name)
    if cfg.single:
        networks = {name: methods.Method(one.predict) for name, (_, one) in runs.items()}
        sets = paper_tables.one_load(data.samples("test"), cfg.deflection)
        found = paper_tables.paper(cfg.name, single=True)
        found += paper_tables.measure(networks, sets, scene.newton)
        record(found, stem, f"{cfg.name}, one load", paper_tables.draw)
        return
    compared = {"linear": methods.linear(scene)}
    for (name, variant), method in trained_methods(cfg, runs, data).items():
        compared[name + (paper_tables.CORRECTED if variant else "")] = method
    sets = paper_tables.load_sets(scene, data.samples("test"), cfg.count)
    rows = paper_tables.paper(cfg.name)
    a_load = data.store.seconds_per_load()
    minutes = None if a_load is None else a_load * sum(data.sizes.values()) / 60
    rows += paper_tables.measure(compared, sets, scene.newton, generation_minutes=minutes)
    if cfg.keep:
        rows = paper_tables.with_kept_rows(rows, stem.with_suffix(".csv"))
    title = f"{cfg.name}, one load at a time, 1 thread"
    record(rows, stem, title, paper_tables.draw)
    learning_curves.save([Path(cfg.run) / name for name in runs], Path(f"{stem}_curves"))
