"""Random numbers that are functions of their place in a stream, and the distributions made of them.

A distribution is its quantile function: it maps numbers uniform in [0, 1) to what is drawn, so that
every distribution goes with every way to fill the unit cube.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]
Quantile = Callable[[Array], Array]  # uniform in [0, 1) -> what is drawn, of the same shape


def independent(seed: int | Sequence[int], index: int, count: int) -> Array:
    """Return point `index` of a stream of independent points, (count,), uniform in [0, 1)."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,))).random(count)


def sobol(seed: int | Sequence[int], index: int, count: int) -> Array:
    """Return point `index` of a scrambled Sobol sequence, (count,), in [0, 1).

    It fills the cube more evenly than independent points; the stream decides how it is scrambled.

    Source: Sobol (1967); Owen (1998), J. Complexity 14; Joe, Kuo (2008).
    """
    from scipy.stats import qmc  # its import of half a second is not needed for other samplings

    rng = np.random.default_rng([seed] if isinstance(seed, int) else list(seed))
    sequence = qmc.Sobol(count, scramble=True, rng=rng)
    if index:
        sequence.fast_forward(index)
    return sequence.random(1)[0]


SAMPLINGS = {"independent": independent, "sobol": sobol}


def symmetric_uniform(t: Array) -> Array:
    """Return numbers uniform in [-1, 1]: the paper's modal loads."""
    return 2 * t - 1


def normal(t: Array) -> Array:
    """Return normal numbers, deviation 1/3, clipped to [-1, 1]: more small modal loads."""
    return np.clip(ndtri(t) / 3, -1.0, 1.0)


def uniform01(t: Array) -> Array:
    """Return numbers uniform in [0, 1)."""
    return t


def constant(t: Array) -> Array:
    """Return 1."""
    return np.ones_like(t)


def logarithmic(t: Array, low: float = 1e-2) -> Array:
    """Return numbers in [low, 1) of which every decade holds as many."""
    if not 0 < low < 1:
        raise ValueError(f"low = {low} must lie between 0 and 1")
    return low ** (1 - t)


def log_tail_mixture(t: Array, part: float = 0.25, low: float = 1e-3) -> Array:
    """Return 1, but for a part of the draws that is logarithmic in [low, 1): small loads."""
    if not 0 < part < 1:
        raise ValueError(f"part = {part} must lie between 0 and 1")
    return np.where(t < part, logarithmic(np.minimum(t / part, 1.0), low), 1.0)


def direction(t: Array) -> Array:
    """Return the unit vector (D,), uniform on the sphere, of numbers (D - 1,) in [0, 1)."""
    angle = 2 * np.pi * t[0]
    across = np.array([np.cos(angle), np.sin(angle)])
    if len(t) == 1:
        return across
    height = 2 * t[1] - 1  # uniform by Archimedes' theorem
    return np.append(np.sqrt(1 - height**2) * across, height)
