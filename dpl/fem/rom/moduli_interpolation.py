"""K(0)^-1 for all moduli of a range from its inverses for a few of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]

LARGEST_EIGENVALUE = 1.5  # of the volumetric relative to the shear stiffness: tr(e)^2 / (2 e:e)
SPRINGS = 10.0 ** np.linspace(-3, 3, 25)  # stiffness of springs over shear stiffness that count
SAMPLES = 65  # eigenvalues at which weights are fitted
MAX_ERROR = 1e-4  # of a solution, relative [-]
MAX_NODES = 12


@dataclass(frozen=True)
class ModuliInterpolation:
    """Weights w with K(0)^-1 = sum_k w_k K_k^-1, K_k = K(0) with Poisson's ratio k.

    K(0) = mu A + lambda B, and A and B are diagonal in a common basis, so that K(0)^-1 has the
    diagonal 1 / (mu + lambda b) with 0 <= b <= 1.5 for every body: the square of the trace of a
    strain is at most three times its square. The weights interpolate this function at all b: they
    are exact at the nodes, and their error is known for every body and load. Springs add a term C
    to K(0), whose diagonal is not known; the weights then fit 1 / (mu + lambda b + c) for all c.

    Attributes:
        nodes: Poisson's ratios, ascending, (K,).
        springs: True if the body has springs.
    """

    nodes: tuple[float, ...]
    springs: bool = False

    @classmethod
    def of(cls, low: float, high: float, *, springs: bool = False) -> "ModuliInterpolation":
        """Return the interpolation of a range of Poisson's ratios with the fewest nodes.

        Its relative error is at most `MAX_ERROR`, or the number of nodes is `MAX_NODES`.
        """
        if high - low < 1e-9:
            return cls((low,), springs)
        for count in range(2, MAX_NODES + 1):
            found = cls(_nodes(low, high, count), springs)
            if found.error(np.linspace(low, high, 101)) <= MAX_ERROR:
                break
        return found

    def weights(self, mu: Tensor, lam: Tensor) -> Tensor:
        """Return the weights, (B, K), of moduli (B,)."""
        matrix, scale = (torch.from_numpy(part).to(mu) for part in self._fit)
        b, c = (torch.from_numpy(part).to(mu) for part in self._spectrum)
        rows = scale / (mu[:, None] + lam[:, None] * b + c)
        return rows @ matrix.T

    def error(self, poisson: Array) -> float:
        """Return the largest relative error of a component of a solution [-] for some ratios."""
        exact = self._diagonals(poisson)
        weights = (self._fit[1] * exact) @ self._fit[0].T
        return float(np.abs(weights @ self._diagonals(np.array(self.nodes)) / exact - 1).max())

    def _diagonals(self, poisson: Array) -> Array:
        """Return diagonals of K(0)^-1, (P, J), for Poisson's ratios (P,)."""
        mu = 1 / (2 * (1 + poisson))
        lam = poisson / ((1 + poisson) * (1 - 2 * poisson))
        b, c = self._spectrum
        return np.asarray(1 / (mu[:, None] + lam[:, None] * b + c))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues b of the volumetric stiffness and c of springs, (J,) each."""
        b = LARGEST_EIGENVALUE * (1 - np.cos(np.linspace(0, np.pi, SAMPLES))) / 2
        c = np.array([0.0, *(SPRINGS if self.springs else ())])
        both = np.meshgrid(b, c)
        return both[0].ravel(), both[1].ravel()

    @cached_property
    def _fit(self) -> tuple[Array, Array]:
        """Matrix (K, J) from scaled diagonals (J,) to weights, and the scale, (J,).

        The scale is between that of absolute and that of relative errors.
        """
        diagonals = self._diagonals(np.array(self.nodes))
        scale = diagonals.mean(axis=0) ** -0.5
        return np.linalg.pinv((scale * diagonals).T, rcond=1e-10), scale


def _nodes(low: float, high: float, count: int) -> tuple[float, ...]:
    """Return Chebyshev nodes in log(2/3 + lambda / mu), ascending."""
    ends = np.array([low, high])
    first, last = np.log(2 * ends / (1 - 2 * ends) + 2 / 3)
    angles = (2 * np.arange(count)[::-1] + 1) * np.pi / (2 * count)
    ratio = np.exp((first + last) / 2 + (last - first) / 2 * np.cos(angles)) - 2 / 3
    return tuple((ratio / (2 * (1 + ratio))).tolist())
