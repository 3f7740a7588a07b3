"""Follower loads: pressures, tension of muscle and cables, whose forces follow the deformation.

Their nodal forces depend on the displacement and are a part of the internal force of a body.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self
from weakref import WeakKeyDictionary

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.identity import plain
from dpl.fem.materials.material import Material
from dpl.fem.mesh.regions import Origin
from dpl.fem.ranges import ParameterRange, is_range
from dpl.fem.units import Units
from dpl.system.checks import named_errors

Stress = float | Sequence[float] | Mapping[str, float | str]  # number or range
ASYMMETRIC = 1e-10  # part of the largest entry above which a skew part is no rounding [-]


class FollowerLoad:
    """Specification of a follower load: a stress on a part of a body, or the tension of a cable.

    Attributes:
        value: The stress [Pa] or tension [N]; or a range [low, high] or {low, high, distribution}.
        name: Name of the parameter of a range; `default_name` if left out.
    """

    default_name: ClassVar[str]
    direction_hint: ClassVar[str]  # says why `value` is no vector
    unit: ClassVar[str] = "Pa"  # of `value`
    value: Stress
    name: str | None

    def stress(self, units: Units) -> tuple[float, ParameterRange | None]:
        """Return the value over E, and None; NaN and its range [Pa or N] if loads decide it."""
        value, ends = self.value, None
        if is_range(value):
            try:
                ends = ParameterRange.of("value", value)
            except ValueError as error:
                raise ValueError(f"{error}; {self.direction_hint}") from error
            value = ends[0]
        if isinstance(value, bool) or not (isinstance(value, int | float) and math.isfinite(value)):
            raise ValueError(f"value = {value} must be a finite number or a range [{self.unit}]")
        stress = float(units.stress(np.array(value, dtype=np.float64), f"value = {self.value}"))
        return (math.nan if ends else stress), ends

    def on(
        self, basis: skfem.Basis, units: Units, material: Material, origin: Origin = 0.0
    ) -> "LoadedPart":
        """Return the loaded part of a body, whose law is that after `Material.on`.

        The coordinates of the scalar basis are those from `origin` (D,), divided by L.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class LoadedPart:
    """Facets, cells or segments under a follower load: forces, work and stiffness of a unit value.

    Attributes:
        nodes: Nodes of each facet, cell or segment, (S, A).
    """

    kind: ClassVar[str]  # name in messages
    extent: ClassVar[str]  # of a number of facets, cells or segments, in words
    nodes: Tensor

    def to(self, device: torch.device | str) -> Self:
        """Return the part with its tensors on a device."""
        return type(self)(*(getattr(self, field.name).to(device) for field in fields(self)))

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without cached properties."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def key(self) -> str:
        """Name in the identity of a scene."""
        raise NotImplementedError

    @property
    def unit(self) -> str:
        """SI unit of the value."""
        return "Pa"

    @property
    def scale(self) -> float:
        """Dimensionless value of the value E [SI units]."""
        return 1.0

    @property
    def directions(self) -> Tensor | None:
        """Directions that belong to the identity of the load; None for a pressure."""
        return None

    @property
    def links(self) -> Tensor:
        """Pairs of nodes in `stiffness` that belong to no common cell, (K, 2)."""
        return self.nodes.new_zeros(0, 2)

    def force(self, displacement: Tensor) -> Tensor:
        """Return the part of the internal force, minus the nodal forces, (B, N, D) [-]."""
        raise NotImplementedError

    def work(self, displacement: Tensor) -> Tensor:
        """Return the work of `force` on the straight way from u = 0 to u, (B,) [-].

        It is the potential of `force` if there is one, see `Problem.has_potential`.
        """
        raise NotImplementedError

    def stiffness(self, displacement: Tensor) -> list[Tensor]:
        """Return entries of A = d force / du, (B, M) [-]: those of the symmetric and the skew part.

        There is no skew part if A is symmetric for any supports.
        """
        raise NotImplementedError

    def places(self, pattern: Pattern) -> NDArray[Any]:
        """Return the positions of the entries on a pattern, (M,); nnz for those not stored.

        By default they are those of all pairs of degrees of freedom (a, i) of a facet or segment.
        """
        numbers = pattern.number[self.nodes.cpu().numpy()].reshape(len(self.nodes), -1)
        return pattern.positions(numbers[:, :, None], numbers[:, None, :]).ravel()

    def places_on(self, pattern: Pattern) -> Tensor:
        """Return `places`, computed once for each pattern."""
        if pattern not in self._places:
            self._places[pattern] = torch.from_numpy(self.places(pattern).astype(np.int64))
        return self._places[pattern]

    @cached_property
    def _places(self) -> WeakKeyDictionary[Pattern, Tensor]:
        return WeakKeyDictionary()

    def describe(self) -> str:
        """Return the part in words."""
        return f"{self.kind} {self.extent.format(len(self.nodes))}"

    def _sum_at_nodes(self, forces: Tensor, displacement: Tensor) -> Tensor:
        """Return the sums (B, N, D) of forces of facets or cells at their nodes (B, S, A, D)."""
        total = torch.zeros_like(displacement)
        return total.index_add(1, self.nodes.flatten(), forces.flatten(1, 2))


@dataclass(frozen=True, eq=False)
class FollowerLoads:
    """All follower loads of a body; False in a condition if there are none.

    Forces, work and stiffness are linear in the values.

    Attributes:
        parts: One for each load.
        values: Stress over E, or tension over E L^(D - 1), of each load, (1, P) [-], or (B, P) for
            each member of a batch; NaN for a range.
        ranges: Smallest and largest stress [Pa] or tension [N] of each load that differs between
            samples, by name.
    """

    parts: tuple[LoadedPart, ...] = ()
    values: Tensor = field(default_factory=lambda: torch.zeros(1, 0, dtype=torch.float64))
    ranges: Mapping[str, ParameterRange] = field(default_factory=dict)

    @classmethod
    def build(
        cls,
        loads: Sequence[FollowerLoad],
        basis: skfem.Basis,
        units: Units,
        material: Material,
        origin: Origin,
    ) -> Self:
        """Return loads on a body; arguments as in `FollowerLoad.on`."""
        ranges: dict[str, ParameterRange] = {}
        values, parts = [], []
        for load in loads:
            name = load.name or load.default_name
            with named_errors(f"follower_loads.{name}: "):
                stress, ends = load.stress(units)
                if ends and name in (*ranges, *material.parameter_ranges):
                    raise ValueError(f"two ranges have the name {name}; set another")
                parts.append(load.on(basis, units, material, origin))
                values.append(stress * parts[-1].scale)
            if ends:
                ranges[name] = ends
        return cls(tuple(parts), torch.tensor([values], dtype=torch.float64), ranges)

    def __bool__(self) -> bool:
        """Return True if there is a load."""
        return bool(self.parts)

    @property
    def kinds(self) -> str:
        """Kinds of the loads in words."""
        return " and ".join(dict.fromkeys(part.kind for part in self.parts))

    @property
    def units(self) -> dict[str, str]:
        """Unit of each range, by name."""
        return dict(zip(self.ranges, (part.unit for part in self._ranged_parts), strict=True))

    @property
    def links(self) -> Tensor:
        """Pairs of nodes that the loads join beyond the cells, (K, 2)."""
        return torch.cat([torch.zeros(0, 2, dtype=torch.int64), *(p.links for p in self.parts)])

    def to(self, device: torch.device | str) -> Self:
        """Return the loads with their tensors on a device."""
        parts = tuple(part.to(device) for part in self.parts)
        return replace(self, parts=parts, values=self.values.to(device))

    def identity(self) -> dict[str, Any]:
        """Return everything that decides their forces as plain data; {} without loads.

        Facets or cells, stresses and numbers of the ranges are listed by kind. The key of the
        ranges of all kinds is `pressure_ranges`.
        """
        columns = torch.where(self._ranged, self._ranged.cumsum(0) - 1, -1)
        found: dict[str, Any] = {}
        for key in dict.fromkeys(part.key for part in self.parts):
            own = [k for k, part in enumerate(self.parts) if part.key == key]
            sizes = torch.tensor([len(self.parts[k].nodes) for k in own])
            nodes = torch.cat([self.parts[k].nodes for k in own]).sort(dim=1).values
            stresses = self.values[0].nan_to_num()[own].repeat_interleave(sizes)
            numbers = columns[own].repeat_interleave(sizes)
            directions = [d for k in own if (d := self.parts[k].directions) is not None]
            found[key] = [plain(nodes), plain(stresses)]
            found[key] += [plain(numbers)] if (numbers >= 0).any() else []
            found[key] += [plain(torch.cat(directions))] if directions else []
        return found | ({"pressure_ranges": self.ranges} if self.ranges else {})

    @property
    def _ranged(self) -> Tensor:
        """Mask of the loads with a range, (P,)."""
        return self.values[0].isnan()

    @property
    def _ranged_parts(self) -> list[LoadedPart]:
        """Parts of the loads with a range."""
        pairs = zip(self.parts, self._ranged.tolist(), strict=True)
        return [part for part, is_ranged in pairs if is_ranged]

    def with_values(self, values: Tensor) -> Self:
        """Return the loads with values over E [SI units] in place of the ranges, (1 or B, R)."""
        every, numbers = self.values.expand(len(values), -1), self._ranged.nonzero()[:, 0]
        values = values * values.new_tensor([part.scale for part in self._ranged_parts])
        return type(self)(self.parts, every.index_copy(1, numbers, values))

    @property
    def constant(self) -> Self:
        """The loads with 0 in place of each range."""
        return type(self)(self.parts, self.values.nan_to_num())

    @property
    def generic(self) -> Self:
        """The loads with a different stress in place of each range."""
        count = int(self._ranged.sum())
        return self.with_values(torch.arange(1.0, count + 1)[None].to(self.values))

    def force(self, displacement: Tensor) -> Tensor:
        """Return the part of the internal force, minus the nodal forces, (B, N, D) [-]."""
        forces = (part.force(displacement) for part in self.parts)
        return self._weighted(forces, torch.zeros_like(displacement))

    def work(self, displacement: Tensor) -> Tensor:
        """Return the work of `force` on the straight way from u = 0 to u, (B,) [-]."""
        works = (part.work(displacement) for part in self.parts)
        return self._weighted(works, displacement.new_zeros(len(displacement)))

    def unit_forces(self, displacement: Tensor) -> Tensor:
        """Return `force` at (1, N, D) of each range for the value E [SI units], (R, N, D) [-]."""
        forces = [part.scale * part.force(displacement) for part in self._ranged_parts]
        return torch.cat(forces) if forces else displacement[:0]

    def _weighted(self, terms: Iterable[Tensor], total: Tensor) -> Tensor:
        """Return a total plus the terms of all loads for a unit value, times their values."""
        for value, term in zip(self.values.unbind(1), terms, strict=True):
            total = total + value.reshape(-1, *(1,) * (term.ndim - 1)) * term
        return total

    def pattern_on(self, pattern: Pattern) -> tuple[Pattern, NDArray[np.int64]]:
        """Return the part of a pattern that `stiffness` fills, see `Pattern.of_entries`."""
        used = torch.cat([part.places_on(pattern) for part in self.parts]).unique().numpy()
        return pattern.of_entries(used[used < len(pattern.indices)])

    def stiffness(self, displacement: Tensor, pattern: Pattern) -> tuple[Tensor, Tensor | None]:
        """Return the symmetric and the skew part of d force / du on the pattern, (B, nnz) each.

        The skew part is None where it is zero to rounding: then the matrix is symmetric.
        """
        count, largest = len(pattern.indices), 0.0
        total = displacement.new_zeros(2, len(displacement), count + 1)
        for value, part in zip(self.values.detach().unbind(1), self.parts, strict=True):
            places = part.places_on(pattern).to(displacement.device)
            for sums, entries in zip(total, part.stiffness(displacement), strict=False):
                scaled = (value[:, None] * entries.detach()).expand(len(sums), -1)
                sums.scatter_add_(1, places.expand(len(sums), -1), scaled)
                largest = max(largest, float(scaled.abs().max()))
        symmetric, skew = total[..., :count]
        is_symmetric = bool((skew.abs() <= ASYMMETRIC * largest).all())
        return symmetric, None if is_symmetric else skew


NO_LOADS = FollowerLoads()
