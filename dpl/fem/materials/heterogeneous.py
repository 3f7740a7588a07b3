"""Bodies of several laws: each region of cells has its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self, cast

import numpy as np
import skfem
import torch
from torch import Tensor

from dpl.fem.identity import plain
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.material import Material, Response
from dpl.fem.mesh.regions import Origin, Region, Tag, cells_in

OTHER = "other"  # region of the cells that belong to no other region


@dataclass(frozen=True, eq=False)
class Heterogeneous(Material):
    """Laws of the regions of a body, which are its parts.

    Cells with isotropic laws of one class are evaluated together.

    Attributes:
        laws: Law of each region, by name.
        regions: The regions, by name. A name that is not there is a tag of cells of the mesh, or
            `other`, the cells of no other region.
        layout: Cells of the laws; None before `on`.
    """

    laws: Mapping[str, Material]
    regions: Mapping[str, Region]
    layout: "Layout | None" = None

    def __post_init__(self) -> None:
        if not self.laws:
            raise ValueError("material: there is no law; give at least one region a law")
        if len({law.finite for law in self.laws.values()}) > 1:
            raise ValueError(
                "material: LinearElastic is a law of small strains; give it to all regions or none"
            )
        if unknown := sorted(set(self.regions) - set(self.laws)):
            raise ValueError(f"regions: {unknown[0]} has no law; add material.{unknown[0]}")

    @property
    def finite(self) -> bool:  # type: ignore[override]
        return all(law.finite for law in self.laws.values())

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        count = basis.mesh.nelements
        index = np.full(count, -1)
        names = list(self.laws)
        for k, name in enumerate(names):
            if name == OTHER and name not in self.regions:
                continue
            region = self.regions.get(name) or Tag(name)
            try:
                cells = cells_in(region, basis.mesh, length, origin)
            except ValueError as error:
                remedy = "" if name in self.regions else f"; define regions.{name}"
                raise ValueError(f"material.{name}: {error}{remedy}") from error
            if (twice := cells[index[cells] >= 0]).size:
                both = f"{names[index[twice[0]]]} and {name}"
                raise ValueError(f"regions: {twice.size} cells belong to both {both}")
            index[cells] = k
        free, takes_rest = np.flatnonzero(index < 0), OTHER in names and OTHER not in self.regions
        if free.size and not takes_rest:
            remedy = f"remove regions.{OTHER}" if OTHER in names else f"add material.{OTHER}"
            raise ValueError(f"regions: {free.size} of {count} cells belong to no region; {remedy}")
        if takes_rest and not free.size:
            raise ValueError(f"material.{OTHER}: all cells belong to other regions; remove it")
        if takes_rest:
            index[free] = names.index(OTHER)
        return super().on(basis, length, origin)._with_layout(torch.from_numpy(index))

    def of_cells(self, cells: Tensor) -> Self:
        return super().of_cells(cells)._with_layout(self._layout.law_of_cell[cells])

    def _with_layout(self, law_of_cell: Tensor) -> Self:
        """Return the laws with the number of the law of each cell, (E,)."""
        numbers: dict[Any, list[int]] = {}
        for k, law in enumerate(self.laws.values()):
            if (law_of_cell == k).any():
                key: Any = k
                if isinstance(law, InvariantBasedMaterial):
                    key = type(law), law.unit, *(getattr(law, name) is None for name in law.ranged)
                numbers.setdefault(key, []).append(k)
        groups = [
            (own, torch.isin(law_of_cell, torch.tensor(own)).nonzero()[:, 0])
            for own in numbers.values()
        ]
        order = torch.cat([cells for _, cells in groups]).argsort()
        return replace(self, layout=Layout(law_of_cell, groups, order))

    @property
    def _layout(self) -> "Layout":
        if self.layout is None:
            raise ValueError("the cells of the regions are not known; use Problem.build")
        return self.layout

    def groups(self, count: int) -> list[tuple[Material, Tensor]]:
        return self._groups

    @cached_property
    def _groups(self) -> list[tuple[Material, Tensor]]:
        """Laws that are evaluated together and their cells, in ascending order."""
        laws, index = list(self.laws.values()), self._layout.law_of_cell
        return [
            (merge_laws([laws[k] for k in numbers], numbers, index, cells), cells)
            for numbers, cells in self._layout.groups
        ]

    @property
    def parts(self) -> Mapping[str, Material]:
        return self.laws

    def with_parts(self, parts: Mapping[str, Any]) -> Self:
        return replace(self, laws=parts)

    def identity(self) -> dict[str, Any]:
        """Return laws and cells as plain data; the definition of the regions does not count."""
        laws = {name: law.identity() for name, law in self.laws.items()}
        return {"name": type(self).__name__, "laws": laws, "cells": plain(self._layout.law_of_cell)}

    @property
    def young_at_rest(self) -> float:
        """Young's modulus at rest of the softest law."""
        return min(law.young_at_rest for law in self.laws.values())

    def describe(self) -> str:
        return "; ".join(f"{name}: {law.describe()}" for name, law in self.laws.items())

    @property
    def is_known(self) -> bool:
        return all(law.is_known for law in self.laws.values())

    @property
    def has_response(self) -> bool:
        return all(law.has_response for law in self.laws.values())

    def energy(self, H: Tensor) -> Tensor:
        return self._of_all_cells("energy", H)

    def volumetric_energy(self, j: Tensor) -> Tensor:
        return self._of_all_cells("volumetric_energy", j)

    def pressure(self, j: Tensor) -> Tensor:
        return self._of_all_cells("pressure", j)

    def stress(self, H: Tensor) -> Tensor:
        return self._of_all_cells("stress", H)

    def tangent(self, H: Tensor) -> Tensor:
        return self._of_all_cells("tangent", H)

    @property
    def has_residual_stress(self) -> bool:
        return any(law.has_residual_stress for law in self.laws.values())

    def residual_stress(self, H: Tensor) -> Tensor:
        return self._of_all_cells("residual_stress", H)

    def rest_stress(self, H: Tensor) -> Tensor:
        return self._of_all_cells("rest_stress", H)

    def response(self, E: Tensor) -> Response:
        parts = [law.response(E[:, cells]) for law, cells in self._groups]
        order = self._layout.order
        joined = (torch.cat(one, dim=1)[:, order] for one in zip(*parts, strict=True))
        return Response(*joined)

    def _of_all_cells(self, quantity: str, strain: Tensor) -> Tensor:
        """Return a quantity of the law of each cell, a method of strains (B, E, Q, ...)."""
        if len(self._groups) == 1:
            return getattr(self._groups[0][0], quantity)(strain)
        parts = [getattr(law, quantity)(strain[:, cells]) for law, cells in self._groups]
        return torch.cat(parts, dim=1)[:, self._layout.order]

    @property
    def largest_poisson_ratio(self) -> float:
        return max(law.largest_poisson_ratio for law in self.laws.values())

    @property
    def mu(self) -> Tensor:
        return self._modulus("mu")

    @property
    def lam(self) -> Tensor:
        return self._modulus("lam")

    @property
    def point_bulk(self) -> Tensor:
        return self._modulus("point_bulk")

    def _modulus(self, name: str) -> Tensor:
        """Return a modulus of the law of each cell, (E, 1) or (B, E, 1) [-]."""
        values = [getattr(law, name) for law in self.laws.values()]
        return values_of_cells(values, self._layout.law_of_cell)


class Layout(NamedTuple):
    """Cells of the laws of a heterogeneous body.

    Attributes:
        law_of_cell: Number of the law of each cell, (E,).
        groups: For each group of laws of one class their numbers and their cells, both ascending.
        order: Position of each cell in the cells of the groups, (E,).
    """

    law_of_cell: Tensor
    groups: list[tuple[list[int], Tensor]]
    order: Tensor


def one_law(material: Material) -> Material:
    """Return the law of a heterogeneous body whose laws are of one class, else the material."""
    if isinstance(material, Heterogeneous) and len(material._groups) == 1:
        return material._groups[0][0]
    return material


def values_of_cells(values: Sequence[Tensor], index: Tensor) -> Tensor:
    """Return for each cell the value (E, 1) or (B, E, 1) of the law whose number is its index."""
    full = torch.broadcast_tensors(*values, torch.empty(len(index), 1))[:-1]
    return torch.stack(full, dim=-3)[..., index, torch.arange(len(index)), :]


def merge_laws(
    laws: Sequence[Material], numbers: Sequence[int], law_of_cell: Tensor, cells: Tensor
) -> Material:
    """Return laws of one class as one law of their cells (C,), whose constants are fields."""
    laws = [law.of_cells(cells) for law in laws]
    if len(laws) == 1:
        return laws[0]
    ranges = {name: ends for law in laws for name, ends in law.parameter_ranges.items()}
    constants: dict[str, Any] = dict(ranges)  # such a law has no moduli yet
    index = torch.searchsorted(torch.tensor(numbers), law_of_cell[cells])
    for name in set(laws[0].ranged) - set(ranges):
        if getattr(laws[0], name) is None:
            continue
        own = [law.given(name) for law in laws]
        if not all(value.ndim == 0 and value == own[0] for value in own):
            constants[name] = values_of_cells(own, index)
    return replace(cast("Any", laws[0]), **constants)
