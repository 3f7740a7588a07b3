"""Test networks on the loads of other families: python scripts/transfer.py run=runs/families.

The folder has a folder for each family with the runs of its networks, FAMILY/NETWORK. All runs
have the same body. Test loads are those of the data sets of the runs.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from omegaconf import DictConfig

from benchmarks import CONF
from benchmarks.methods import load_runs
from benchmarks.samples import first
from benchmarks.study import picture, record
from dpl import Sample, Scene, config
from dpl.commands.cli import command
from dpl.evaluation.tables import share
from dpl.inference import default_hybrid
from dpl.inference.hybrid import Predict
from dpl.system.threads import one_thread
from dpl.training.metrics import errors_of


@dataclass(frozen=True)
class Transfer:
    """Errors of one network on the test loads of one family."""

    network: str  # name of the network
    trained_on: str  # family of its training loads
    tested_on: str  # family of the test loads
    count: int  # number of test loads
    # rel_L2_median, rel_L2_worst: relative L2 errors of the predictions [-]
    rel_L2_median: float
    rel_L2_worst: float
    SNR_min: float  # smallest signal-to-noise ratio [dB]
    converged: float  # part of the loads that the hybrid solves to the tolerance of the scene [%]
    hybrid_iterations: float  # mean number of its linear solves for these loads
    newton_iterations: float  # mean number of linear solves of Newton from rest


def differences(scenes: Mapping[str, Scene]) -> list[str]:
    """Return a line for each difference of scenes that have the same body, else none.

    Loads may differ.
    """
    (first, scene), *others = scenes.items()
    own = {key: value for key, value in scene.identity().items() if key != "loads"}
    return [
        f"{name} and {first}: {line}" for name, other in others for line in other.differences(own)
    ]


def newton_iterations(scene: Scene, test: Sample) -> float:
    """Return the mean number of linear solves of Newton's method from rest, on one thread."""
    with one_thread():
        *_, found = scene.newton.iterate(test.load)
    return float(found.iterations[found.converged].double().mean())


def measure(
    network: str,
    trained_on: str,
    predict: Predict,
    scene: Scene,
    tests: Mapping[str, Sample],
    newton: Mapping[str, float],
) -> Iterator[Transfer]:
    """Yield the row of a network for each set of test loads, computed on one thread."""
    hybrid = default_hybrid(predict, scene)
    for family, test in tests.items():
        with one_thread(), torch.inference_mode():
            found = torch.cat([predict(load) for load in test.load.unbatch()])
            *_, solved = hybrid.iterate(test.load)
        errors, done = errors_of(scene.problem, found, test), solved.converged
        yield Transfer(
            *(network, trained_on, family, len(done)),
            rel_L2_median=errors["rel_L2_median"],
            rel_L2_worst=errors["rel_L2_worst"],
            SNR_min=errors["SNR_min"],
            converged=100 * float(done.double().mean()),
            hybrid_iterations=float(solved.iterations[done].double().mean()),
            newton_iterations=newton[family],
        )


def draw(rows: Sequence[Transfer], path: Path) -> None:
    """Draw median errors as a matrix, trained on against tested on, for each network."""
    from matplotlib.colors import LogNorm

    networks, trained, tested = (
        list(dict.fromkeys(getattr(row, name) for row in rows))
        for name in ("network", "trained_on", "tested_on")
    )
    known = {(row.network, row.trained_on, row.tested_on): row.rel_L2_median for row in rows}
    finite = [error for error in known.values() if 0 < error < math.inf]
    norm = LogNorm(min(finite), max(finite))
    columns = min(len(networks), max(1, 10 // len(tested)))
    lines = math.ceil(len(networks) / columns)
    with picture(path, lines * (0.27 * len(trained) + 0.4) + 1.0) as figure:
        axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
        for ax, network in zip(axes.flat, networks, strict=False):
            errors = [[known.get((network, a, b), math.nan) for b in tested] for a in trained]
            ax.imshow(errors, norm=norm, cmap="RdYlGn_r", alpha=0.75, aspect="auto")
            for i, row in enumerate(errors):
                for j, error in enumerate(row):
                    label = "" if math.isnan(error) else share(error)
                    ax.text(j, i, label, ha="center", va="center", fontsize=7.5)
            ax.set_title(network)
            ax.set_xticks(range(len(tested)), tested, rotation=45, ha="right")
            ax.set_yticks(range(len(trained)), trained)
            ax.tick_params(length=0)
        for ax in axes.flat[len(networks) :]:
            ax.remove()
        figure.supxlabel("tested on", fontsize=8.5)
        figure.supylabel("trained on", fontsize=8.5)


KEYS = ((Sequence[str] | None, "families"), (str, "name"), (int, "count", 1, 10**6))


@command("transfer", conf=CONF, keys=KEYS)
def main(cfg: DictConfig) -> None:
    """Measure all networks of all families on the test loads of all families."""
    found = {path.parents[1].name for path in Path(cfg.run).glob("*/*/config.yaml")}
    if not found:
        raise config.ConfigError(
            f"run = {cfg.run} contains no runs; train some with run={cfg.run}/FAMILY/NETWORK"
        )
    families = cfg.families or sorted(found, key=lambda name: (name == "mixture", name))
    runs = {name: load_runs(Path(cfg.run) / name, cfg.networks) for name in families}
    scenes, tests = {}, {}
    for name, own in runs.items():
        first_run, surrogate = next(iter(own.values()))
        scenes[name] = surrogate.scene
        data = config.load_data(first_run, surrogate.scene)
        tests[name] = first(data.samples("test"), cfg.count)
    if lines := differences(scenes):
        raise config.ConfigError(f"run = {cfg.run}: the bodies of the families differ; {lines[0]}")
    newton = {name: newton_iterations(scenes[name], test) for name, test in tests.items()}

    def rows() -> Iterator[Transfer]:
        for family, own in runs.items():
            for network, (_, surrogate) in own.items():
                print(f"{family}/{network} ...", flush=True)
                predict, scene = surrogate.predict, surrogate.scene
                yield from measure(network, family, predict, scene, tests, newton)

    title = "networks on the loads of other families, 1 thread"
    record(rows(), Path(cfg.folder) / cfg.name, title, draw)
