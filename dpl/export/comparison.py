"""Comparison of an ONNX graph with its surrogate: largest differences."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.evaluation import Latency, latency
from dpl.export.onnx_graph import Array, OnnxSession
from dpl.export.quantities import Quantities
from dpl.fem import Load
from dpl.scene import Scene
from dpl.training import TrainedSurrogate

CHECK_STREAM = (0, 11)  # random stream of the loads of the comparison
IN_RANGE = "in range"
AMPLITUDES = {"small": 1e-3, "tiny": 1e-9, "large": 3.0}  # factors on loads in the training range
REPEATS = 3  # calls with each load whose times are measured
N_OUTSIDE = 4  # loads of each kind outside the training range


@dataclass(frozen=True)
class OutputDifference:
    """Differences between graph and surrogate for loads of one kind."""

    kind: str
    n_loads: int
    max_error: float  # largest relative difference of displacements, ||a - b|| / ||b|| [-]
    max_number_error: float  # largest relative difference of the other outputs [-]


def sample_check_loads(scene: Scene, count: int) -> tuple[list[str], dict[str, Tensor]]:
    """Return kinds (B entries) and inputs of the graph (B of each) of loads for the comparison.

    They are `count` loads in the training range, scaled and zero loads, forces on single nodes, and
    white noise.
    """
    loads, random = scene.loads, torch.Generator().manual_seed(11)
    some = loads.sample(CHECK_STREAM, range(N_OUTSIDE))
    zero, nodes = torch.zeros_like(some.force), loads.loadable_dofs.any(dim=1).nonzero()[:, 0]
    nodal = zero.clone()
    for force in nodal:
        node = nodes[int(torch.randint(len(nodes), (1,), generator=random))]
        force[node] = torch.randn(force.shape[1], generator=random, dtype=torch.float64)
    noise = torch.randn(zero.shape, generator=random, dtype=torch.float64)
    size = 0.1 * loads.largest_force
    nodal, noise = (f * size / f.flatten(1).norm(dim=1)[:, None, None] for f in (nodal, noise))
    forces = {kind: factor * some.force for kind, factor in AMPLITUDES.items()}
    forces |= {"zero": zero, "on a node": nodal, "noise": noise}
    parts = {IN_RANGE: loads.sample(CHECK_STREAM, range(count))}
    parts |= {kind: some._replace(force=force) for kind, force in forces.items()}
    kinds = [kind for kind, load in parts.items() for _ in load.force]
    return kinds, scene.si_inputs(Load(*map(torch.cat, zip(*parts.values(), strict=True))))


def compare_outputs(
    surrogate: TrainedSurrogate, session: OnnxSession, kinds: list[str], inputs: dict[str, Tensor]
) -> list[OutputDifference]:
    """Return the differences between an ONNX file and its surrogate for each kind of load.

    All loads are evaluated at once, then the first three, then each load alone, to detect a graph
    with a fixed batch size. Finite displacements with inverted elements are compared in range only:
    far out of range they amplify rounding errors.
    """
    module, rows = Quantities(surrogate, session.outputs[1:]), list[OutputDifference]()
    largest, scene = np.zeros((2, len(kinds))), surrogate.scene
    with torch.inference_mode():
        volume = scene.problem.volume_ratio(surrogate(**inputs) / scene.length).numpy()
    is_chaotic = (volume <= 0) & np.array([kind != IN_RANGE for kind in kinds])
    for part in (slice(0, len(kinds)), slice(0, 3), *(slice(k, k + 1) for k in range(len(kinds)))):
        some = {name: column[part] for name, column in inputs.items()}
        with torch.inference_mode():
            expected = [one.numpy() for one in module(**some)]
        pairs = zip(session(**some).values(), expected, strict=True)
        first, *others = (relative_differences(*pair) for pair in pairs)
        first = np.where(is_chaotic[part] & np.isfinite(first), 0.0, first)
        both = first, np.max([0 * first, *others], axis=0)
        largest[:, part] = np.maximum(largest[:, part], both)
    for kind in dict.fromkeys(kinds):
        own = largest[:, [one == kind for one in kinds]]
        rows.append(OutputDifference(kind, own.shape[1], *own.max(axis=1).tolist()))
    return rows


def latencies(surrogate: TrainedSurrogate, session: OnnxSession, count: int) -> dict[str, Latency]:
    """Return the latencies of an ONNX file and of its surrogate for `count` loads in range."""
    load = surrogate.scene.loads.sample(CHECK_STREAM, range(count))
    inputs: list[dict[str, Any]] = [surrogate.scene.si_inputs(one) for one in load.unbatch()]
    return {
        "onnxruntime": latency(lambda one: session(**one), inputs, repeats=REPEATS),
        "torch": latency(lambda one: surrogate(**one), inputs, repeats=REPEATS),
    }


def relative_differences(found: Array, expected: Array) -> Array:
    """Return ||a - b|| / ||b|| of fields (B, ...), (B,) [-]; 0 where both are equal."""
    with np.errstate(divide="ignore", invalid="ignore"):
        difference = np.where(found == expected, 0.0, found - expected)  # both may be infinite
        both = (x.reshape(len(x), -1) for x in (difference, expected))
        difference, size = (np.linalg.norm(x, axis=1) for x in both)
        ratio = np.where(difference == 0, 0.0, difference / size)
    return np.where(np.isfinite(ratio), ratio, np.inf)
