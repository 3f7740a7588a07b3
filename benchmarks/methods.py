"""Methods of a comparison: linear, POD-Galerkin, networks of a folder of runs, corrected ones."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from torch import Tensor

from benchmarks.pod_galerkin import PODGalerkin
from dpl import config
from dpl.config.plain import read_config
from dpl.config.run_folder import OF_SCENE
from dpl.fem import Load, SubspaceNewton
from dpl.inference.hybrid import Predict
from dpl.scene import Sample, Scene
from dpl.training import TrainedSurrogate

CELL_STATES = 256  # states at which the cells of hyper-reduction are chosen


@dataclass(frozen=True)
class Method:
    """A method that predicts displacements, and the cost of its training."""

    predict: Predict  # function from a load to displacements (B, N, D) [-]
    samples: int | None = None  # number of training samples; None without training
    training_minutes: float | None = None  # wall time of the training [min]; None without training
    parameters: int | None = None  # number of trained parameters; None without training


def linear(scene: Scene) -> Method:
    """Return the linear solution K(0)^-1 f."""

    def predict(load: Load) -> Tensor:
        members = load.unbatch()
        return torch.stack(
            [scene.linear.with_parameters(one.parameters).solve(one.force[0]) for one in members]
        )

    return Method(predict)


def pod_galerkin(scene: Scene, train: Sample, *, rank: int, tolerance: float) -> Method:
    """Return the hyper-reduced POD-Galerkin model with the linear solution as offset.

    It has `rank` modes of the nonlinear part of displacements; see `cubature` for the tolerance.
    """
    start = time.perf_counter()
    solver = PODGalerkin.fit(
        scene.problem, train.displacement, rank, tolerance=tolerance, lift=scene.linear
    )
    minutes = (time.perf_counter() - start) / 60

    def predict(load: Load) -> Tensor:
        return torch.stack([solver.reduced(force).displacement for force in load.force])

    return Method(predict, len(train.force), minutes)


def network(surrogate: TrainedSurrogate, folder: Path, samples: int | None) -> Method:
    """Return the network of the run in a folder."""
    count = sum(p.numel() for p in surrogate.net.parameters())
    return Method(surrogate.predict, samples, training_minutes(folder), count)


def corrected(
    surrogate: TrainedSurrogate,
    method: Method,
    train: Sample,
    *,
    rank: int,
    tolerance: float,
    steps: int,
) -> Method:
    """Return a network whose predictions are corrected by Newton iterations in its modes.

    The model `HasCorrection`, or it has `vectors`: then `rank` of them are the modes, and see
    `cubature` for the tolerance. `method` is that of the network alone.
    """
    start = time.perf_counter()
    if (solver := surrogate.predictor.correction()) is None:
        net, states = cast(Any, surrogate.net), train.displacement[:CELL_STATES]
        solver = SubspaceNewton.within(
            surrogate.scene.problem, net.vectors[..., :rank], states, tolerance=tolerance
        )
    minutes = (method.training_minutes or 0.0) + (time.perf_counter() - start) / 60

    def predict(load: Load) -> Tensor:
        pairs = zip(load.unbatch(), surrogate.predict(load), strict=True)
        ends = [list(solver.states(one, guess=u[None], max_iter=steps))[-1] for one, u in pairs]
        return torch.cat([state.displacement for state in ends])

    return Method(predict, method.samples, minutes, method.parameters)


def training_minutes(folder: Path) -> float | None:
    """Return the wall time of all training sessions of a run [min]; None if not recorded."""
    path = folder / "training.jsonl"
    if not path.is_file():
        return None
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return sum(float(line["seconds"]) for line in lines) / 60


def load_runs(
    folder: str | Path, names: Sequence[str] | None = None, *, trust: bool = False
) -> dict[str, tuple[DictConfig, TrainedSurrogate]]:
    """Return the configurations and surrogates of named runs in a folder, or of all.

    Runs whose configurations have the same keys of the scene share one scene. Raises ConfigError if
    there are none, or if one cannot be used or belongs to another scene.
    """
    if names is None:
        names = sorted(path.parent.name for path in Path(folder).glob("*/config.yaml"))
    if not names:
        raise config.ConfigError(
            f"run = {folder} contains no runs; train some with run={folder}/NAME"
        )
    runs: dict[str, tuple[DictConfig, TrainedSurrogate]] = {}
    scenes: dict[str, Scene] = {}  # by their part of the configuration
    for name in names:
        path, _ = config.files_of_run(Path(folder) / name)
        part = {key: node for key, node in read_config(path).items() if key in OF_SCENE}
        known = scenes.get(key := json.dumps(part))
        runs[name] = config.load_run(Path(folder) / name, trust=trust, scene=known)
        own = scenes.setdefault(key, runs[name][1].scene)
        first = next(iter(scenes.values()))
        if own.fingerprint != first.fingerprint:
            differences = "; ".join(first.differences(own.identity()))
            raise config.ConfigError(
                f"run = {folder}: {name} is of another scene than {names[0]}: {differences}"
            )
    return runs
