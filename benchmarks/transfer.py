"""Errors of networks that were trained on one family of loads and are tested on all of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.study import picture
from dpl import Sample, Scene
from dpl.evaluation.tables import share
from dpl.inference import default_hybrid
from dpl.inference.hybrid import Predict
from dpl.system.threads import one_thread
from dpl.training.metrics import median, relative_errors, signal_to_noise


@dataclass(frozen=True)
class Transfer:
    """Errors of one network on the test loads of one family.

    Attributes:
        network: Name of the network.
        trained_on: Family of its training loads.
        tested_on: Family of the test loads.
        count: Number of test loads.
        rel_L2_median, rel_L2_worst: Relative L2 errors of the predictions [-].
        SNR_min: Smallest signal-to-noise ratio [dB].
        converged: Part of the loads that the hybrid solves to the tolerance of the scene [%].
        hybrid_iterations: Mean number of its linear solves for these loads.
        newton_iterations: Mean number of linear solves of Newton from rest.
    """

    network: str
    trained_on: str
    tested_on: str
    count: int
    rel_L2_median: float
    rel_L2_worst: float
    SNR_min: float
    converged: float
    hybrid_iterations: float
    newton_iterations: float


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
    """Yield the row of a network for each set of test loads, computed on one thread.

    Args:
        network: Name of the network.
        trained_on: Name of its family.
        predict: Function from a load to displacements (B, N, D) [-].
        scene: Scene of the training.
        tests: Test loads with their solutions, by family.
        newton: `newton_iterations` of these loads, by family.
    """
    hybrid = default_hybrid(predict, scene)
    for family, test in tests.items():
        with one_thread(), torch.inference_mode():
            found = torch.cat([predict(load) for load in test.load.unbatch()])
            errors = relative_errors(found, test)
            *_, solved = hybrid.iterate(test.load)
        done = solved.converged
        yield Transfer(
            *(network, trained_on, family, len(errors)),
            rel_L2_median=float(median(errors)),
            rel_L2_worst=float(errors.max()),
            SNR_min=float(signal_to_noise(found, test).min()),
            converged=100 * float(done.double().mean()),
            hybrid_iterations=float(solved.iterations[done].double().mean()),
            newton_iterations=newton[family],
        )


def draw(rows: Sequence[Transfer], path: Path) -> None:
    """Draw median errors as a matrix, trained on against tested on, for each network.

    Args:
        rows: Rows of `measure` for all networks and families.
        path: Path of the picture.
    """
    from matplotlib.colors import LogNorm

    networks, trained, tested = (
        list(dict.fromkeys(getattr(row, name) for row in rows))
        for name in ("network", "trained_on", "tested_on")
    )
    known = {(row.network, row.trained_on, row.tested_on): row.rel_L2_median for row in rows}
    finite = [error for error in known.values() if 0 < error < math.inf]
    norm = LogNorm(min(finite), max(finite))
    size = (len(networks) * (0.62 * len(tested) + 0.3) + 1.6, 0.36 * len(trained) + 1.2)
    with picture(path, *size) as figure:
        axes = figure.subplots(1, len(networks), sharey=True, squeeze=False)[0]
        for ax, network in zip(axes, networks, strict=True):
            errors = [[known.get((network, a, b), math.nan) for b in tested] for a in trained]
            ax.imshow(errors, norm=norm, cmap="RdYlGn_r", alpha=0.75, aspect="auto")
            for i, row in enumerate(errors):
                for j, error in enumerate(row):
                    label = "" if math.isnan(error) else share(error)
                    ax.text(j, i, label, ha="center", va="center", fontsize=6.5)
            ax.set_title(network)
            ax.set_xticks(range(len(tested)), tested, rotation=45, ha="right")
            ax.set_yticks(range(len(trained)), trained)
            ax.tick_params(length=0)
            ax.set_xlabel("tested on")
        axes[0].set_ylabel("trained on")
