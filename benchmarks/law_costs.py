"""Time of tangent and residual of bodies of several laws and of laws with fibres."""

import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.discretisation import BEAM
from dpl.fem import (
    ConstantFibres,
    FibreReinforced,
    HolzapfelOgdenFibres,
    Material,
    NeoHookeanIsoK4,
    NeoHookeanLn,
    Plane,
    Problem,
    box,
)

NODES = (40, 10, 10)  # along each side of the beam of 12,000 degrees of freedom
STIFF = NeoHookeanLn(0.3, young=100.0)
FIBRES = FibreReinforced(
    NeoHookeanLn(0.3), HolzapfelOgdenFibres(1.0, 1.0, 0.5, 1.0, 0.5, 1.0), ConstantFibres([1, 0, 0])
)
# name -> law, or laws of the cells with x below and above half of the length
BODIES: dict[str, Material | Mapping[str, Material]] = {
    "one isotropic law": NeoHookeanLn(0.3),
    "two regions, one law": {"left": NeoHookeanLn(0.3), "other": STIFF},
    "two regions, two laws": {"left": NeoHookeanLn(0.3), "other": NeoHookeanIsoK4(0.3)},
    "isotropic law with fibres": FIBRES,
    "two regions, one with fibres": {"left": NeoHookeanLn(0.3), "other": FIBRES},
}


@dataclass(frozen=True)
class LawCost:
    """Time of tangent and residual by the compiled loops on one thread.

    Attributes:
        body: Laws of the body.
        dofs: Degrees of freedom, fixed ones included.
        ms: Median wall time [ms].
        ratio: Median of the times over those of one isotropic law, measured alternately [-].
    """

    body: str
    dofs: int
    ms: float
    ratio: float


def law_costs(nodes: Sequence[int] = NODES, *, repeats: int = 5) -> Iterator[LawCost]:
    """Yield the time of each body under one small random displacement.

    Args:
        nodes: Numbers of nodes along the three sides of the beam.
        repeats: Number of timed repetitions after one that is not timed.
    """
    mesh = box(BEAM, list(nodes))
    problems = {
        name: Problem.build(
            mesh,
            laws,
            regions={"left": _left_half} if isinstance(laws, Mapping) else None,
            fixed=Plane(0, "min"),
        )
        for name, laws in BODIES.items()
    }
    first = next(iter(problems.values()))
    random = torch.Generator().manual_seed(0)
    u = 1e-4 * torch.randn(1, *first.shape, generator=random, dtype=torch.float64)
    seconds: dict[str, list[float]] = {name: [] for name in problems}
    for _ in range(1 + repeats):
        for name, problem in problems.items():
            begin = time.perf_counter()
            problem.linearise(u)
            seconds[name].append(time.perf_counter() - begin)
    reference = np.array(seconds[next(iter(problems))][1:])
    for name, values in seconds.items():
        middle = statistics.median(values[1:])
        ratio = float(np.median(np.array(values[1:]) / reference))
        yield LawCost(name, problems[name].free.numel(), 1e3 * middle, ratio)


def _left_half(points: np.ndarray) -> np.ndarray:
    return np.asarray(points[:, 0] < BEAM[0] / 2)


@dataclass(frozen=True)
class EnergyAlone(Material):
    """A law that is the energy of another law and nothing else: derivatives are automatic."""

    law: Material

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density, see `Material.energy`."""
        return self.law.energy(H)


def energy_alone_costs(
    nodes: Sequence[int] = NODES, *, repeats: int = 5
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return processor times of residual and of both [s] by two forms of one law.

    Each pair holds the median by compiled loops and by the energy alone, on one thread, measured
    alternately after one evaluation that is not timed.

    Args:
        nodes: Numbers of nodes along the three sides of the beam.
        repeats: Number of timed repetitions.
    """
    law, mesh = NeoHookeanLn(0.3), box(BEAM, list(nodes))
    bodies = [Problem.build(mesh, one, fixed=Plane(0, "min")) for one in (law, EnergyAlone(law))]
    random = torch.Generator().manual_seed(0)
    u = 1e-4 * torch.randn(1, *bodies[0].shape, generator=random, dtype=torch.float64)
    rows = []
    for _ in range(1 + repeats):
        for call in ("evaluate", "linearise"):
            for body in bodies:
                begin = time.process_time()
                getattr(body, call)(u)
                rows.append(time.process_time() - begin)
    residual, both, *_ = np.median(np.reshape(rows, (-1, 2, 2))[1:], axis=0).tolist()
    return tuple(residual), tuple(both)
