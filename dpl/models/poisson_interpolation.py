"""Poisson's ratio as an input of networks, where the law has a range of them."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dpl.fem import LinearSolver

EXACT = 1e-5  # aimed at between the nodes, relative error of a linear answer [-]
MOST = 16  # nodes, whatever the range


def normalise_poisson(poisson: Tensor | None, span: tuple[float, float], like: Tensor) -> Tensor:
    """Return where in a range Poisson's ratios lie, -1 at its low end, 1 at its high one, (B, 1).

    Args:
        poisson: Poisson's ratios, (B, 1) [-].
        span: The range.
        like: Gives type and device.

    Raises:
        ValueError: They are missing.
    """
    if poisson is None:
        raise ValueError("poisson is an input of this network: give Poisson's ratios, (B, 1)")
    low, high = span
    return ((2 * poisson - (low + high)) / (high - low)).to(like)


@dataclass(frozen=True, eq=False)
class PoissonInterpolation:
    """K(0)^-1 at a few Poisson's ratios, the polynomial between them for all of a range.

    K(0)^-1 is an analytic function of z = (1 + nu)/(1 - 2 nu), 3/2 of bulk over shear modulus, but
    for z <= 0. The variable w = (z - c)/(z + c), c = sqrt(z1 z2), maps a range [z1, z2] to [-a, a]
    and those z to |w| >= 1, so that polynomials in w through Chebyshev nodes converge like rho^-K,
    rho = (1 + sqrt(1 - a^2))/a. Where the law has one Poisson's ratio, that is the only node.

    Source: Trefethen (2019), Approximation Theory and Approximation Practice, theorem 8.2.

    Attributes:
        linear: The linear answer of the body.
    """

    linear: LinearSolver

    @cached_property
    def nodes(self) -> list[float]:
        """Poisson's ratios, (K,) [-]; none where the law has one."""
        if (span := self.linear.problem.material.poisson_range) is None:
            return []
        centre = self._centre
        a = float(_stretched(span[1], centre))
        count = math.ceil(-math.log(EXACT) / math.log(1 / self.rate))
        count = min(max(count, 3), MOST)
        w = [-a * math.cos((k + 0.5) * math.pi / count) for k in range(count)]
        z = [centre * (1 + one) / (1 - one) for one in w]
        return [(one - 1) / (1 + 2 * one) for one in z]

    @property
    def _centre(self) -> float:
        """Return c, see the class."""
        span = self.linear.problem.material.poisson_range or (0.0, 0.0)
        low, high = ((1 + nu) / (1 - 2 * nu) for nu in span)
        return math.sqrt(low * high)

    @property
    def rate(self) -> float:
        """1/rho: what a node more leaves of the error between nodes [-]."""
        span = self.linear.problem.material.poisson_range or (0.0, 0.0)
        a = float(_stretched(span[1], self._centre))
        return a / (1 + math.sqrt(1 - a * a))

    @property
    def count(self) -> int:
        """K, how many linear answers there are."""
        return max(1, len(self.nodes))

    @cached_property
    def members(self) -> list[LinearSolver]:
        """The linear answers, each with its factor when first asked."""
        problem = self.linear.problem
        if not self.nodes:
            return [self.linear]
        return [replace(self.linear, problem=problem.at(nu)) for nu in self.nodes]

    def weights(self, poisson: Tensor | None, like: Tensor) -> Tensor:
        """Return what each node contributes, (B, K), of the type of a tensor (B, ...).

        Raises:
            ValueError: There is a range and no Poisson's ratios, (B, 1).
        """
        if not self.nodes:
            return like.new_ones(len(like), 1)
        if poisson is None:
            raise ValueError("poisson is an input of this network: give Poisson's ratios, (B, 1)")
        known = torch.tensor(self.nodes, dtype=poisson.dtype, device=poisson.device)
        known, place = _stretched(known, self._centre), _stretched(poisson, self._centre)
        own = torch.eye(self.count, dtype=torch.bool, device=poisson.device)
        gaps = torch.where(own, 1.0, known[:, None] - known)
        ratios = torch.where(own, 1.0, (place - known)[:, None, :] / gaps)
        return ratios.prod(dim=2).to(like)

    def between(self, answers: Tensor, poisson: Tensor | None) -> Tensor:
        """Return what answers (B, K n), node by node, are at Poisson's ratios (B, 1), (B, n)."""
        if not self.nodes:
            return answers
        parts = answers.unflatten(1, (self.count, -1))
        return torch.einsum("bk,bkn->bn", self.weights(poisson, answers), parts)

    def __getstate__(self) -> dict[str, object]:
        """Pickle without the factors."""
        return {"linear": self.linear}


def _stretched(poisson: Any, centre: float) -> Any:
    """Return w of Poisson's ratios, see `PoissonInterpolation`."""
    z = (1 + poisson) / (1 - 2 * poisson)
    return (z - centre) / (z + centre)
