"""Layers on sets of vectors, such as the images of a load under the symmetries of a body."""

from typing import cast

import torch
from torch import Tensor, nn


def bent(hidden: Tensor) -> Tensor:
    """Return gelu(hidden), by tanh: twice as fast as by the error function."""
    return nn.functional.gelu(hidden, approximate="tanh")


class SetLinear(nn.Module):
    """A linear layer on a set: every member h becomes A h + B times the mean member, and a bias.

    It commutes with whatever permutes the members. A set of one takes A alone.

    Source: Zaheer et al. (2017), Deep sets, NeurIPS, lemma 3.
    """

    def __init__(self, channels: int, *, alone: bool = False) -> None:
        """Build it.

        Args:
            channels: Of a member.
            alone: Sets have one member.
        """
        super().__init__()
        self.alone = alone
        self.mix = nn.Linear(channels if alone else 2 * channels, channels)  # A, and B beside it

    def forward(self, members: Tensor) -> Tensor:
        """Return (B, G, C) of (B, G, C)."""
        if not self.alone:
            mean = members.mean(dim=1, keepdim=True)
            members = torch.cat([members, mean.expand_as(members)], dim=2)
        return cast(Tensor, self.mix(members))


class Block(nn.Module):
    """h + B gelu(A h): a residual block of two layers on a set."""

    def __init__(self, channels: int, *, alone: bool = False) -> None:
        """Build it, close to the identity; see `SetLinear`."""
        super().__init__()
        self.inner = SetLinear(channels, alone=alone)
        self.outer = SetLinear(channels, alone=alone)
        with torch.no_grad():
            self.outer.mix.weight.mul_(0.1)
            self.outer.mix.bias.zero_()

    def forward(self, members: Tensor) -> Tensor:
        """Return (B, G, C) of (B, G, C)."""
        return cast(Tensor, members + self.outer(bent(self.inner(members))))
