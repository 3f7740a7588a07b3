"""Follower loads: stresses of the surroundings or of muscle, whose forces follow the deformation.

Their nodal forces depend on the displacement and are a part of the internal force of a body.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

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

Stress = float | Sequence[float] | Mapping[str, float | str]  # number or range
CONSTANT = -1  # `FollowerTerm.column` of a load that is one number

Places = Sequence[tuple[Tensor, Tensor]]


class FollowerLoad:
    """Specification of a follower load: a stress on a part of a body.

    Attributes:
        value: The stress [Pa]; or a range [low, high] or {low, high, distribution}, of which each
            load has its own, see `Problem.parameter_ranges`. On a problem with E = 1 Pa, the
            default of `Problem.build`, this is the stress over E.
        name: Name of the parameter of a range; `default_name` if left out.
    """

    default_name: ClassVar[str]
    direction_hint: ClassVar[str]  # says why `value` is no vector
    value: Stress
    name: str | None

    @property
    def parameter(self) -> str:
        """Name of the parameter of a range."""
        return self.name or self.default_name

    @property
    def range(self) -> ParameterRange | None:
        """Range of the stress [Pa]; None if it is one number.

        Raises:
            ValueError: `value` is neither a finite number nor a range.
        """
        if is_range(self.value):
            try:
                return ParameterRange.of("value", self.value)
            except ValueError as error:
                raise ValueError(f"{error}; {self.direction_hint}") from error
        value = self.value
        if (
            not isinstance(value, int | float)
            or isinstance(value, bool)
            or not math.isfinite(value)
        ):
            raise ValueError(f"value = {value} must be a finite number or a range [Pa]")
        return None

    def dimensionless(self, units: Units) -> float:
        """Return the stress over E [-]; NaN for a range, until a load says which.

        Raises:
            ValueError: `value` is neither a finite number nor a range, or the loads have a range
                of moduli.
        """
        ends = self.range
        one = ends[0] if ends else self.value
        stress = float(units.stress(np.array(one, dtype=np.float64), f"value = {self.value}"))
        return math.nan if ends else stress

    def check(self, mesh: skfem.Mesh, units: Units) -> None:
        """Check value and region on a mesh [m]; raise the errors of `on`."""
        raise NotImplementedError

    def on(
        self,
        basis: skfem.Basis,
        units: Units,
        material: Material,
        origin: Origin = 0.0,
        column: int = CONSTANT,
    ) -> "FollowerTerm":
        """Return the nodal forces on a body.

        Args:
            basis: Scalar basis of the body, its coordinates divided by L.
            units: L and E.
            material: Law of the body, after `Material.on`.
            origin: Origin of the coordinates, (D,) [-].
            column: See `FollowerTerm.column`.

        Raises:
            ValueError: The load does not fit the body, or `value` is invalid, see `dimensionless`.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class FollowerTerm:
    """Nodal forces of all follower loads of one kind on a body, evaluated in batches.

    Attributes:
        nodes: Nodes of each loaded facet or cell, (S, A).
        value: Stress over E on each facet or cell, (S,) [-], or (B, S) for each member of a batch.
        column: Number of the load with a range that acts on each facet or cell, (S,); `CONSTANT`
            where the load is one number.
    """

    kind: ClassVar[str]  # name in messages
    key: ClassVar[str]  # name in the identity of a scene
    independent: ClassVar[tuple[str, ...]]  # cached properties that do not depend on `value`
    nodes: Tensor
    value: Tensor
    column: Tensor

    @classmethod
    def join(cls, terms: Sequence[Self]) -> Self:
        """Return the sum of several terms as one."""
        return cls(*(torch.cat([getattr(t, f.name) for t in terms]) for f in fields(cls)))

    def to(self, device: torch.device | str) -> Self:
        """Return the term with its tensors on a device."""
        return type(self)(*(getattr(self, field.name).to(device) for field in fields(self)))

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without cached properties."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def identity(self) -> list[Any]:
        """Return facets or cells and stresses as plain data, arrays as their SHA-256."""
        loaded = [plain(self.nodes.sort(dim=1).values), plain(self.value.nan_to_num())]
        return [*loaded, plain(self.column)] if self.n_ranges else loaded

    @property
    def n_ranges(self) -> int:
        """1 plus the largest `column`: number of ranges up to the last of this term."""
        return int(self.column.max()) + 1

    def scaled(self, factor: float) -> Self:
        """Return the term of `factor` times its stresses."""
        return self._with_value(factor * self.value)

    def with_values(self, values: Tensor) -> Self:
        """Return the term with stresses over E in place of the ranges, (1, P) or (B, P) [-]."""
        own = values[:, self.column.clamp(min=0)]
        value = torch.where(self.column == CONSTANT, self.value, own)
        return self._with_value(value[0] if len(value) == 1 else value)

    @property
    def generic(self) -> Self:
        """The term with a different stress in place of each range; itself without ranges."""
        values = torch.arange(1.0, self.n_ranges + 1).to(self.value)
        return self.with_values(values[None]) if self.n_ranges else self

    def _with_value(self, value: Tensor) -> Self:
        twin = replace(self, value=value)
        twin.__dict__.update({name: getattr(self, name) for name in self.independent})
        return twin

    def force(self, displacement: Tensor) -> Tensor:
        """Return the part of the internal force, minus the nodal forces, (B, N, D) [-]."""
        raise NotImplementedError

    def work(self, displacement: Tensor) -> Tensor:
        """Return the work of `force` on the straight way from u = 0 to u, (B,) [-].

        It is the potential of `force` if there is one, see `has_potential`.
        """
        raise NotImplementedError

    def stiffness(self, displacement: Tensor) -> Tensor:
        """Return entries of the symmetric part of d force / du, (B, M) [-]."""
        raise NotImplementedError

    def places(self, pattern: Pattern) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the numbers of entries of `stiffness` and their positions in K, (P,) each.

        A position is among the nnz stored values of K; nnz for entries that K does not store.
        """
        raise NotImplementedError

    def has_potential(self, free: Tensor, prescribed: Tensor) -> bool:
        """Return True if d force / du is symmetric on the free degrees of freedom.

        Args:
            free: Mask of the free degrees of freedom, (N, D).
            prescribed: Displacement of the others, (N, D) [-].
        """
        return True

    def asymmetry(self, displacement: Tensor) -> Callable[[Tensor], Tensor] | None:
        """Return the function v -> (A - A^T) v / 2 of A = d force / du at (1, N, D) [-].

        It maps fields (1, N, D) to fields; None if A is symmetric for any supports.
        """
        return None

    def describe(self) -> str:
        """Return the term in words."""
        raise NotImplementedError

    def _sum_at_nodes(self, forces: Tensor, displacement: Tensor) -> Tensor:
        """Return the sums (B, N, D) of forces of facets or cells at their nodes (B, S, A, D)."""
        total = torch.zeros_like(displacement)
        return total.index_add(1, self.nodes.flatten(), forces.flatten(1, 2))


@dataclass(frozen=True, eq=False)
class FollowerLoads:
    """All follower loads of a body; False in a condition if there are none.

    Attributes:
        terms: One for each kind of load.
        ranges: Smallest and largest stress [Pa] of each load that differs between samples, by name.
    """

    terms: tuple[FollowerTerm, ...] = ()
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
        """Return loads on a body; arguments as in `FollowerLoad.on`.

        Raises:
            ValueError: A load does not fit the body, or two ranges have one name.
        """
        ranges: dict[str, ParameterRange] = {}
        terms: dict[type[FollowerTerm], list[FollowerTerm]] = {}
        for load in loads:
            name = load.parameter
            try:
                ends = load.range
                if ends and name in (*ranges, *material.parameter_ranges):
                    raise ValueError(f"two ranges have the name {name}; set another")
                column = len(ranges) if ends else CONSTANT
                term = load.on(basis, units, material, origin, column)
            except ValueError as error:
                raise ValueError(f"follower_loads.{name}: {error}") from error
            if ends:
                ranges[name] = ends
            terms.setdefault(type(term), []).append(term)
        return cls(tuple(kind.join(own) for kind, own in terms.items()), ranges)

    def __bool__(self) -> bool:
        """Return True if there is a load."""
        return bool(self.terms)

    @property
    def kinds(self) -> str:
        """Kinds of the loads in words."""
        return " and ".join(term.kind for term in self.terms)

    @property
    def n_members(self) -> int:
        """B, the number of members of a batch that have their own stresses; else 1."""
        return max((len(torch.atleast_2d(term.value)) for term in self.terms), default=1)

    def to(self, device: torch.device | str) -> Self:
        """Return the loads with their tensors on a device."""
        return replace(self, terms=tuple(term.to(device) for term in self.terms))

    def identity(self) -> dict[str, Any]:
        """Return everything that decides their forces as plain data; {} without loads.

        The key of the ranges of all kinds is `pressure_ranges`.
        """
        terms = {term.key: term.identity() for term in self.terms}
        return terms | ({"pressure_ranges": self.ranges} if self.ranges else {})

    def scaled(self, factor: float) -> Self:
        """Return the loads times a factor, without ranges."""
        return type(self)(tuple(term.scaled(factor) for term in self.terms))

    def with_values(self, values: Tensor) -> Self:
        """Return the loads with stresses over E in place of the ranges, (1, P) or (B, P) [-]."""
        return type(self)(tuple(term.with_values(values) for term in self.terms))

    def force(self, displacement: Tensor) -> Tensor:
        """Return the part of the internal force, minus the nodal forces, (B, N, D) [-]."""
        return sum((t.force(displacement) for t in self.terms), torch.zeros_like(displacement))

    def work(self, displacement: Tensor) -> Tensor:
        """Return the work of `force` on the straight way from u = 0 to u, (B,) [-]."""
        nothing = displacement.new_zeros(len(displacement))
        return sum((t.work(displacement) for t in self.terms), nothing)

    def has_potential(self, free: Tensor, prescribed: Tensor) -> bool:
        """Return True if `work` is a potential of `force`, see `FollowerTerm.has_potential`."""
        return all(term.generic.has_potential(free, prescribed) for term in self.terms)

    def asymmetry(self, displacement: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the sum of `FollowerTerm.asymmetry` at (1, N, D) [-]."""
        found = [term.asymmetry(displacement) for term in self.terms]
        products = [product for product in found if product is not None]
        return lambda v: sum((product(v) for product in products), torch.zeros_like(v))

    def places(self, pattern: Pattern, device: torch.device) -> Places:
        """Return `FollowerTerm.places` of each term, without entries that are not stored."""
        places = []
        for term in self.terms:
            source, target = map(torch.from_numpy, term.places(pattern))
            stored = target < len(pattern.indices)
            places.append((source[stored].to(device), target[stored].to(device)))
        return places

    def add_stiffness(self, tangent: Tensor, displacement: Tensor, places: Places) -> Tensor:
        """Return a tangent (B, nnz) plus the symmetric part of d force / du at `places`."""
        for term, (source, target) in zip(self.terms, places, strict=True):
            values = term.stiffness(displacement)[:, source]
            tangent = tangent.scatter_add(1, target.expand(len(tangent), -1), values)
        return tangent


NO_LOADS = FollowerLoads()
