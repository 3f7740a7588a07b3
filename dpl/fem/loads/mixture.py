"""Mixtures of load families."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.family import RandomLoads
from dpl.fem.loads.fit import best_fit
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import rounded
from dpl.system.checks import named_errors


@dataclass(frozen=True, eq=False)
class MixtureLoads(RandomLoads):
    """Loads of several families; each load belongs to one of them, which is drawn by weights.

    The numbers of a force are that of the family, then those of its force; the largest family
    decides how many.

    Attributes:
        families: Families by name: each a function of `linear` and the keywords `young` and
            `sampling` that returns a subclass of `RandomLoads`.
        weights: Relative frequency of each family; 1 where a name is left out.
    """

    families: Mapping[str, Callable[..., RandomLoads]]
    weights: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, weight in (self.weights or {}).items():
            if name not in self.families:
                known = ", ".join(self.families)
                raise ValueError(f"weights.{name}: there is no such family; there are {known}")
            if not 0 <= weight < math.inf:
                raise ValueError(f"weights.{name} = {weight} must be a number from 0")
        if not sum(self._weights) > 0:
            raise ValueError("families must contain one with a weight above 0")
        self.members  # noqa: B018  # raises if a family cannot be built

    @property
    def _weights(self) -> list[float]:
        """Weight of each family."""
        weights = self.weights or {}
        return [float(weights.get(name, 1.0)) for name in self.families]

    @cached_property
    def members(self) -> tuple[RandomLoads, ...]:
        """The families, without constant force."""
        members = []
        for name, family in self.families.items():
            with named_errors(f"families.{name}: "):
                one = family(linear=self.linear, young=self.young, sampling=self.sampling)
            if not isinstance(one, RandomLoads):
                raise TypeError(
                    f"families.{name} gives {type(one).__name__}; it must give a RandomLoads"
                )
            members.append(one)
        return tuple(members)

    @property
    def n_force(self) -> int:
        """1 + the largest number of random numbers of a family."""
        return 1 + max(member.n_force for member in self.members)

    def family_of(self, points: Tensor) -> Tensor:
        """Return the number of the family of points (B, d) of the unit cube, (B,)."""
        ends = torch.tensor(self._weights, dtype=torch.float64).cumsum(dim=0)
        # right: a family of weight 0 is never drawn
        return torch.searchsorted(ends / ends[-1], points[:, 0].double().contiguous(), right=True)

    def force_at(self, point: Array) -> Tensor:
        member = self.members[int(self.family_of(torch.from_numpy(point)[None]))]
        return member.force_at(point[1 : 1 + member.n_force])

    @cached_property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom on which a family can act, (N, D), boolean."""
        return torch.stack([member.loadable_dofs for member in self.members]).any(dim=0)

    @property
    def largest_force(self) -> float:
        """Largest of the largest forces of the families [-]."""
        sizes = []
        for name, member in zip(self.families, self.members, strict=True):
            with named_errors(f"families.{name}: "):
                sizes.append(member.largest_force)
        return max(sizes)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes (B,) and distances (B,) of the family that fits each force best.

        It is the one of the smallest distance, and of the smallest amplitude among those to which
        the force belongs. If it belongs to none, and a family cannot recognise its loads, the
        distance is NaN.
        """
        own = self.own_force(force)
        fits = zip(*(member.project(own) for member in self.members), strict=True)
        amplitude, distance = map(torch.stack, fits)  # (families, B)
        best, columns = best_fit(amplitude.numpy(), distance.numpy()), range(len(own))
        return amplitude[best, columns], distance[best, columns]

    def identity(self) -> dict[str, Any]:
        """Return the options with the identities of the families."""
        members = zip(self.families, self.members, strict=True)
        families = {name: member.identity() for name, member in members}
        weights = np.array(self._weights) / sum(self._weights)
        return super().identity() | {"families": families, "weights": rounded(weights)}

    def skipped_work(self) -> list[str]:
        """Return the notes of all families."""
        return [line for member in self.members for line in member.skipped_work()]
