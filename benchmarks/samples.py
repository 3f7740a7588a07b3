"""Solved loads of a scene."""

from torch import Tensor

from dpl import Sample, Scene
from dpl.fem import Load, Status, solve


def solved(scene: Scene, load: Load) -> Sample:
    """Return loads with their solutions; loads without a stable solution are left out."""
    found = solve(scene.solver, load)
    sound = found.status == int(Status.CONVERGED)
    columns = load.force, found.displacement, load.young, load.parameters
    return Sample(*(column[sound] for column in columns))


def first(samples: Sample, count: int) -> Sample:
    """Return the first samples."""
    return Sample(*(column[:count] for column in samples))


def scaled(scene: Scene, stream: int, factors: Tensor) -> Load:
    """Return loads of a random stream times factors (B,)."""
    drawn = scene.loads.sample((0, stream), range(len(factors)))
    return drawn._replace(force=factors[:, None, None] * drawn.force)
