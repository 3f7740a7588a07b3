"""Poisson's ratio as an input of networks, where the law has a range of them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.newton import Linear

EXACT = 1e-8  # aimed at between the nodes of `Rests`, relative error of a linear answer [-]


def placed(poisson: Tensor | None, span: tuple[float, float], like: Tensor) -> Tensor:
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
class Rests:
    """K(0)^-1 at a few Poisson's ratios, the polynomial between them for all of a range.

    K(0)^-1 is analytic in Poisson's ratio but at -1 and 0.5 and beyond, so that polynomials through
    Chebyshev nodes converge geometrically, the slower the nearer the range comes to those. Where
    the law has one, that is the only node, and nothing is between.

    Source: Trefethen (2019), Approximation Theory and Approximation Practice, theorem 8.2.

    Attributes:
        linear: The linear answer of the body.
    """

    linear: Linear

    @cached_property
    def nodes(self) -> list[float]:
        """Poisson's ratios, (K,) [-]; none where the law has one."""
        if (span := self.linear.problem.material.poisson_range) is None:
            return []
        middle, half = (span[0] + span[1]) / 2, (span[1] - span[0]) / 2
        nearest = min(0.5 - middle, middle + 1.0) / half
        rate = nearest + np.sqrt(nearest**2 - 1)
        count = int(np.clip(np.ceil(-np.log(EXACT) / np.log(rate)), 3, 12))
        return [float(middle - half * np.cos((k + 0.5) * np.pi / count)) for k in range(count)]

    @property
    def count(self) -> int:
        """K, how many linear answers there are."""
        return max(1, len(self.nodes))

    @cached_property
    def members(self) -> list[Linear]:
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
        own = torch.eye(self.count, dtype=torch.bool, device=poisson.device)
        gaps = torch.where(own, 1.0, known[:, None] - known)
        ratios = torch.where(own, 1.0, (poisson - known)[:, None, :] / gaps)
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
