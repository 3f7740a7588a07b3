"""Parameters of the law as inputs of networks, and interpolation of K(0)^-1 over its range."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dpl.fem import LinearSolver

INTERPOLATION_TOL = 1e-5  # target relative error of linear solutions between nodes [-]
MAX_NODES = 16


def normalise_parameters(
    parameters: Tensor | None, ranges: Mapping[str, tuple[float, float]], like: Tensor
) -> Tensor:
    """Return parameters of the law mapped linearly from their ranges to [-1, 1], (B, P).

    Args:
        parameters: Parameters of the law, (B, P).
        ranges: Range of each, by name.
        like: Tensor of the dtype and device to return.

    Raises:
        ValueError: `parameters` is None.
    """
    if parameters is None:
        raise ValueError(f"parameters are an input of this network; give {list(ranges)}, (B, P)")
    low, high = parameters.new_tensor(list(ranges.values())).T
    return ((2 * parameters - (low + high)) / (high - low)).to(like)


@dataclass(frozen=True, eq=False)
class PoissonInterpolation:
    """Polynomial interpolation of K(0)^-1 between a few Poisson's ratios.

    K(0)^-1 is an analytic function of z = (1 + nu)/(1 - 2 nu), 3/2 of bulk over shear modulus, but
    for z <= 0. The variable w = (z - c)/(z + c), c = sqrt(z1 z2), maps a range [z1, z2] to [-a, a]
    and those z to |w| >= 1, so that polynomials in w through Chebyshev nodes converge like rho^-K,
    rho = (1 + sqrt(1 - a^2))/a. A law with a single Poisson's ratio has one node.

    Source: Trefethen (2019), Approximation Theory and Approximation Practice, theorem 8.2.

    Attributes:
        linear: Solver with K(0).
    """

    linear: LinearSolver

    def __post_init__(self) -> None:
        """Check the law.

        Raises:
            ValueError: The law has a range of another constant.
        """
        if others := set(self.linear.problem.material.parameter_ranges) - {"poisson"}:
            raise ValueError(
                f"material.{min(others)} is a range, and K(0)^-1 is interpolated over Poisson's "
                f"ratio only; set material.{min(others)} to a number or choose another model"
            )

    @cached_property
    def nodes(self) -> list[float]:
        """Poisson's ratios of the nodes, (K,) [-]; empty if the law has a single one."""
        if not self.linear.problem.material.parameter_ranges:
            return []
        centre, span = self._centre, self._span
        a = float(_mapped(span[1], centre))
        count = math.ceil(-math.log(INTERPOLATION_TOL) / math.log(1 / self.rate))
        count = min(max(count, 3), MAX_NODES)
        w = [-a * math.cos((k + 0.5) * math.pi / count) for k in range(count)]
        z = [centre * (1 + one) / (1 - one) for one in w]
        return [(one - 1) / (1 + 2 * one) for one in z]

    @property
    def _span(self) -> tuple[float, float]:
        return self.linear.problem.material.parameter_ranges.get("poisson", (0.0, 0.0))

    @property
    def _centre(self) -> float:
        """The constant c of the class."""
        low, high = ((1 + nu) / (1 - 2 * nu) for nu in self._span)
        return math.sqrt(low * high)

    @property
    def rate(self) -> float:
        """1/rho, the factor by which another node reduces the error [-]."""
        a = float(_mapped(self._span[1], self._centre))
        return a / (1 + math.sqrt(1 - a * a))

    @property
    def count(self) -> int:
        """Number of nodes, K."""
        return max(1, len(self.nodes))

    @cached_property
    def solvers(self) -> list[LinearSolver]:
        """Solvers at the nodes; each factorises K(0) on first use."""
        if not self.nodes:
            return [self.linear]
        bodies = [self.linear.problem.with_parameters(torch.tensor([[nu]])) for nu in self.nodes]
        return [replace(self.linear, problem=body) for body in bodies]

    def weights(self, poisson: Tensor | None, like: Tensor) -> Tensor:
        """Return the Lagrange weights of the nodes, (B, K).

        Args:
            poisson: Poisson's ratios, (B, 1) [-]; may be None if the law has a single one.
            like: Tensor (B, ...) of the dtype and device to return.

        Raises:
            ValueError: `poisson` is None although the law has a range.
        """
        if not self.nodes:
            return like.new_ones(len(like), 1)
        if poisson is None:
            raise ValueError("poisson is an input of this network; give Poisson's ratios, (B, 1)")
        known = torch.tensor(self.nodes, dtype=poisson.dtype, device=poisson.device)
        known, place = _mapped(known, self._centre), _mapped(poisson, self._centre)
        own = torch.eye(self.count, dtype=torch.bool, device=poisson.device)
        gaps = torch.where(own, 1.0, known[:, None] - known)
        ratios = torch.where(own, 1.0, (place - known)[:, None, :] / gaps)
        return ratios.prod(dim=2).to(like)

    def interpolate(self, values: Tensor, poisson: Tensor | None) -> Tensor:
        """Return values at Poisson's ratios (B, 1), (B, n), from values at the nodes (B, K n)."""
        if not self.nodes:
            return values
        parts = values.unflatten(1, (self.count, -1))
        return torch.einsum("bk,bkn->bn", self.weights(poisson, values), parts)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factors."""
        return {"linear": self.linear}


def _mapped(poisson: Any, centre: float) -> Any:
    """Return the variable w of `PoissonInterpolation`."""
    z = (1 + poisson) / (1 - 2 * poisson)
    return (z - centre) / (z + centre)
