"""K(0)^-1 for all parameters of a range from its inverses for a few of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.solvers.stiffness_terms import StiffnessTerms

Array = NDArray[np.float64]

SPRINGS = 10.0 ** np.linspace(-3, 3, 25)  # stiffness of springs over that of the body that count
SAMPLES = 65  # eigenvalues at which weights are fitted
MAX_ERROR = 1e-4  # of a solution, relative [-]
MAX_NODES = 16


@dataclass(frozen=True)
class StiffnessInterpolation:
    """Weights w with K(0)^-1 = sum_k w_k K_k^-1, K_k = K(0) for a few parameters.

    K(0) = a_1 A + a_2 B with factors a of the law, see `StiffnessTerms`, and A and B are diagonal
    in a common basis. K(0)^-1 has the diagonal 1 / (a_1 + a_2 b), and bounds of b are known for
    every body: for the terms mu and lambda of an isotropic law 0 <= b <= 1.5. The weights
    interpolate this function at all b: they are exact at the nodes, and their error is known for
    every load. Springs add a term C to K(0), whose diagonal is not known; the weights then fit
    1 / (a_1 + a_2 b + c) for all c. With one term there is one node.

    Attributes:
        nodes: Factors of the nodes, (K, T).
        eigenvalues: Smallest and largest b.
        springs: True if the body has springs.
    """

    nodes: tuple[tuple[float, ...], ...]
    eigenvalues: tuple[float, float] = (0.0, 0.0)
    springs: bool = False

    @classmethod
    def of_terms(cls, terms: StiffnessTerms) -> "StiffnessInterpolation":
        """Return the interpolation for all parameters of a body.

        Raises:
            ValueError: K(0) has more than two terms.
        """
        if len(terms) > 2:
            raise ValueError(f"there are {len(terms)} terms; this is known for two")
        if len(terms) == 1:
            return cls(((1.0,),))
        springs = terms.problem.springs is not None
        return cls.of(terms.sampled_factors.numpy(), terms.eigenvalues, springs=springs)

    @classmethod
    def of(
        cls, factors: Array, eigenvalues: tuple[float, float], *, springs: bool = False
    ) -> "StiffnessInterpolation":
        """Return the interpolation of factors between samples (S, 2) with the fewest nodes.

        Its relative error is at most `MAX_ERROR`, or the number of nodes is `MAX_NODES`.
        """
        for count in range(1, MAX_NODES + 1):
            found = cls(_nodes(factors, eigenvalues, count), eigenvalues, springs)
            if found.error(factors) <= MAX_ERROR:
                break
        return found

    def weights(self, factors: Tensor) -> Tensor:
        """Return the weights, (B, K), of factors (B, T)."""
        if len(self.nodes[0]) == 1:
            return 1 / factors
        matrix, scale = (torch.from_numpy(part).to(factors) for part in self._fit)
        b, c = (torch.from_numpy(part).to(factors) for part in self._spectrum)
        rows = scale / (factors[:, :1] + factors[:, 1:] * b + c)
        return rows @ matrix.T

    def error(self, factors: Array) -> float:
        """Return the largest relative error of a component of a solution [-] for factors (S, 2)."""
        exact = self._diagonals(factors)
        weights = (self._fit[1] * exact) @ self._fit[0].T
        return float(np.abs(weights @ self._diagonals(np.array(self.nodes)) / exact - 1).max())

    def _diagonals(self, factors: Array) -> Array:
        """Return diagonals of K(0)^-1, (S, J), for factors (S, 2)."""
        b, c = self._spectrum
        return np.asarray(1 / (factors[:, :1] + factors[:, 1:] * b + c))

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues b of the second term relative to the first and c of springs, (J,) each."""
        low, high = self.eigenvalues
        b = low + (high - low) * (1 - np.cos(np.linspace(0, np.pi, SAMPLES))) / 2
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


def _nodes(
    factors: Array, eigenvalues: tuple[float, float], count: int
) -> tuple[tuple[float, ...], ...]:
    """Return Chebyshev nodes in the logarithm of the condition number, ascending.

    It is that of a_1 + a_2 b between the smallest and the largest b. The smallest a_1 + a_2 b is
    interpolated between the samples.
    """
    low, high = eigenvalues
    softest = factors[:, 0] + factors[:, 1] * low
    condition = np.log((factors[:, 0] + factors[:, 1] * high) / softest)
    order = np.argsort(condition)
    first, last = condition[order[[0, -1]]]
    angles = (2 * np.arange(count)[::-1] + 1) * np.pi / (2 * count)
    at = (first + last) / 2 + (last - first) / 2 * np.cos(angles)
    ratio = np.exp(at)
    direction = np.stack([high - ratio * low, ratio - 1], axis=1) / (high - low)
    scale = np.interp(at, condition[order], softest[order])
    return tuple(map(tuple, (scale[:, None] * direction).tolist()))
