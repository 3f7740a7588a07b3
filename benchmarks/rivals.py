"""Compare models with those of other packages on the same loads: python scripts/rivals.py.

Each method is fitted to the first 64, 256 and 1,024 loads of one data set and their images under
the symmetries of the body, by one thread, and each network of another package is trained for the
same time. Methods of other packages learn twice: the displacement from the force (`plain`), and the
nonlinear displacement from the linear solution, with the whitening and the gate of this package
(`linear`). Packages that are not installed are left out; requirements are in benchmarks/rivals.txt.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from benchmarks import CONF
from benchmarks.paper_tables import load_sets
from benchmarks.rival_methods import Learner, networks
from benchmarks.samples import first
from benchmarks.study import label_decades, method_colours, picture, read, record
from benchmarks.subcommands import run_script
from dpl import Sample, config
from dpl.commands.cli import command
from dpl.data.samples import Samples
from dpl.evaluation.timing import WARM_UP
from dpl.scene import Scene
from dpl.system.threads import one_thread
from dpl.training.metrics import errors_of
from dpl.training.predictors import OnLinearSolution, Predictor, Scaled

BASES: Mapping[str, type[Predictor]] = {"plain": Scaled, "linear": OnLinearSolution}
Fit = Callable[[], tuple[Predictor, float, float, int]]  # predictor, seconds, epochs and weights
OF_STUDY = ("counts", "models", "rivals", "bases", "seconds", "count", "folder", "run", "name")
KEYS = (
    (Sequence[int], "counts", 1, 10**6),
    (Sequence[str], "models"),
    (Sequence[str] | None, "rivals"),
    (Sequence[str], "bases"),
    (float, "seconds", 1e-3, 1e6),
)


@dataclass(frozen=True)
class Row:
    """Errors and costs of one method, fitted to one number of loads."""

    method: str  # its name, with its package
    base: str  # "plain", "linear" (it adds to the linear solution), or "own"
    loads: int  # number of loads of the fit
    median: float  # median relative L2 error of the test loads [-]
    worst: float  # largest relative L2 error [-]
    e_mean: float
    SNR_min: float
    small_median: float  # median error of loads of 0.01 to 0.1 of the range [-]
    small_worst: float
    twice_median: float  # median error of loads of 1 to 2 times the range [-]
    twice_worst: float
    ms: float  # median processor time of one prediction on one thread [ms]
    fit_seconds: float  # time of the fit [s]: processor time, of models of this package wall time
    epochs: float  # passes over samples and images, of a training by gradients
    weights: int  # numbers that a prediction reads, without those of the linear solution


def rivals(
    scene: Scene, parts: Sequence[Sample], cfg: DictConfig
) -> Iterator[tuple[str, str, Fit]]:
    """Yield name, base and fit of the methods of other packages; the second part is held out."""

    def fit(build: Callable[[], Learner], base: str) -> tuple[Predictor, float, float, int]:
        net = build()
        predictor = BASES[base](net, scene)
        start = time.process_time()
        with one_thread():
            net.learn_from(predictor, parts, cfg.seconds)
        return predictor, time.process_time() - start, net.epochs, net.weights

    for name, build in networks(scene.problem).items():
        if cfg.rivals is None or any(part in name for part in cfg.rivals):
            for base in cfg.bases:
                yield name, base, partial(fit, build, base)


def own(scene: Scene, loads: int, rows: int, cfg: DictConfig) -> Iterator[tuple[str, str, Fit]]:
    """Yield the same for models of this package, which its own command trains."""
    task = [one for one in HydraConfig.get().overrides.task if not one.startswith(OF_STUDY)]

    def fit(name: str) -> tuple[Predictor, float, float, int]:
        run = Path(cfg.folder) / "runs" / f"{cfg.name}-{name}-{loads}"
        limit = f"trainer.max_time={{seconds: {cfg.seconds:g}}}"
        if not (run / "evaluation.json").is_file():
            options = [f"model={name}", f"data.train={loads}", f"run={run}", limit]
            with one_thread():
                run_script("train", [*task, *options])
        trained, surrogate = config.load_run(run, scene=scene)
        sessions = [*map(json.loads, (run / "training.jsonl").read_text().splitlines())]
        seconds, steps = (sum(one[key] for one in sessions) for key in ("seconds", "steps"))
        count = sum(tensor.numel() for tensor in surrogate.net.state_dict().values())
        return surrogate.predictor, seconds, steps * trained.data.batch_size / rows, count

    for name in cfg.models:
        yield name, "own", partial(fit, name)


def measured(name: str, base: str, loads: int, fit: Fit, sets: Mapping[str, Sample]) -> Row:
    """Fit a method; return its errors for sets of loads, and the time of a prediction."""
    predictor, seconds, epochs, weights = fit()
    predictor.eval()
    found: dict[str, dict[str, float]] = {}
    times: list[float] = []
    with one_thread(), torch.inference_mode():
        for title, samples in sets.items():
            answers = []
            for load in samples.load.unbatch():
                start = time.process_time()
                answers.append(predictor(load))
                times.append(1e3 * (time.process_time() - start))
            found[title] = errors_of(predictor.problem, torch.cat(answers), samples)
    others = {
        f"{title}_{which}": found[title][f"rel_L2_{which}"]
        for title in ("small", "twice")
        for which in ("median", "worst")
    }
    test, ms = found["in range"], float(torch.tensor(times[WARM_UP:]).median())
    return Row(
        name, base, loads, test["rel_L2_median"], test["rel_L2_worst"], test["e_mean"],
        test["SNR_min"], **others, ms=ms, fit_seconds=seconds, epochs=epochs, weights=weights,
    )  # fmt: skip


def linear_solution(scene: Scene) -> tuple[Predictor, float, float, int]:
    """Return the linear solution alone as a fit: a network before its fit adds zeros."""
    return OnLinearSolution(Learner(), scene), 0.0, 0.0, 0


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw error against time of a prediction, and against the number of loads.

    The first panel has the number of loads that most methods have. Methods without the linear
    solution are hollow; networks of other packages are triangles, own models squares.
    """
    counts = [row.loads for row in rows if row.loads] or [0]
    common = max(set(counts), key=counts.count)
    colours = method_colours(dict.fromkeys(row.method for row in rows))
    with picture(path, 4.2) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for method, base in dict.fromkeys((row.method, row.base) for row in rows):
            some = [row for row in rows if (row.method, row.base) == (method, base)]
            some.sort(key=lambda row: row.loads)
            if not some[0].loads:
                right.axhline(some[0].median, color=colours[method], lw=0.8)
            marker = "s" if base == "own" else "^" if some[0].epochs else "o"
            style = {"color": colours[method], "marker": marker, "ms": 5, "lw": 0.8}
            style |= {"mfc": "white", "ls": "--"} if base == "plain" else {"label": method}
            few = [row for row in some if row.loads in (common, 0)]
            left.plot([row.ms for row in few], [row.median for row in few], **style)
            right.plot([row.loads or None for row in some], [row.median for row in some], **style)
        left.set(xscale="log", yscale="log", xlabel="time of a prediction [ms]")
        left.set_ylabel("median relative L2 error")
        left.set_title(f"{common} loads")
        right.set(xscale="log" if any(counts) else "linear", xlabel="loads of the fit")
        right.set_xticks(sorted(set(counts)), [f"{n:,}" for n in sorted(set(counts))])
        right.minorticks_off()
        label_decades(left.xaxis)
        for ax in (left, right):
            ax.grid(visible=True)
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)


@command("rivals", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Fit and measure all methods."""
    scene = config.build_scene(cfg)
    data = config.load_data(cfg, scene)
    train, held, test = (data.samples(split) for split in ("train", "val", "test"))
    sets = load_sets(scene, test, cfg.count)
    stem = Path(cfg.folder) / cfg.name
    stem.parent.mkdir(parents=True, exist_ok=True)
    table = stem.with_name(f"{cfg.name}.csv")
    earlier = read(Row, table) if table.is_file() else []
    known = {(row.method, row.base, row.loads): row for row in earlier}

    def fits() -> Iterator[tuple[str, str, int, Fit]]:
        yield "linear solution", "linear", 0, partial(linear_solution, scene)
        for loads in cfg.counts:
            every = Samples(first(train, loads), data.group)
            some = every.__getitems__(list(range(len(every))))
            for method in rivals(scene, (some, held), cfg):
                yield *method[:2], loads, method[2]
            for method in own(scene, loads, len(every), cfg):
                yield *method[:2], loads, method[2]

    def rows() -> Iterator[Row]:
        yield from known.values()
        for name, base, loads, fit in fits():
            if (name, base, loads) not in known:
                yield measured(name, base, loads, fit, sets)

    record(rows(), stem, "models of other packages on the same loads", draw)
