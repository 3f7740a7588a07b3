"""Constants of laws: numbers, ranges, or fields with a value for each cell."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.mesh.regions import Origin
from dpl.fem.options import check_options
from dpl.fem.ranges import ParameterRange, is_range
from dpl.system.checks import named_errors


@dataclass(frozen=True, eq=False)
class CellField:
    """Constant of a law with a value in each cell.

    Attributes:
        values: Function of the centres of the cells (E, D) [m] that returns the values (E,), the
            values in the order of the cells of the mesh, or the name of such cell data in `file`.
        file: File with this cell data; its cells are those of the mesh.
    """

    values: Callable[[NDArray[np.float64]], NDArray[np.float64]] | Sequence[float] | str
    file: str | Path | None = None

    def __post_init__(self) -> None:
        if isinstance(self.values, str) != (self.file is not None):
            raise ValueError(
                "values must be the name of cell data if there is a file, and a function or an "
                "array if not"
            )

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        """Return the values, (E, 1); arguments as in `Material.on`."""
        mesh = basis.mesh
        centres = (mesh.p[:, mesh.t].mean(axis=1).T + origin) * length
        given: Any = self.values
        if self.file is not None:
            from dpl.fem.mesh.reading import read_cell_data  # which imports meshio

            (given,) = read_cell_data(self.file, [str(self.values)])
        elif callable(given):
            given = given(centres)
        values = np.asarray(given, dtype=np.float64)
        if values.shape != (len(centres),) or not np.isfinite(values).all():
            raise ValueError(
                f"values of shape {values.shape} must be {len(centres)} finite numbers, one for "
                "each cell"
            )
        return torch.from_numpy(values.copy())[:, None]


if TYPE_CHECKING:
    Constant = Any  # a tensor after `on` and `with_parameters`
else:
    # number, range or field
    Constant = float | Sequence[float] | Mapping[str, float | str] | CellField


class Parametrised:
    """Dataclass whose constants are given as numbers, ranges or fields.

    A constant with a range, [low, high] or {low, high, distribution}, has a value for each load.
    `value` returns a constant as a tensor that broadcasts against the points (B, E, Q): of shape
    (), of a field (E, 1), and of a batch of which each member has its own (B, 1, 1).

    A law may have `parts` with constants of their own. In names of parameters and in messages the
    name of the part comes first: core.poisson.

    Attributes:
        ranged: Names of the constants that may be ranges [low, high] or fields.
        dimensional: Names of those that are moduli, in one unit, see `Scalable`.
        unit: This unit over Young's modulus of the scene [-].
    """

    ranged: ClassVar[tuple[str, ...]] = ()
    dimensional: ClassVar[tuple[str, ...]] = ()
    unit: float = 1.0

    def __post_init__(self) -> None:
        for name, value in self._given.items():
            if is_range(value):
                object.__setattr__(self, name, ParameterRange.of(name, value))
            elif isinstance(value, Tensor) and not value.ndim:  # a modulus of another law
                object.__setattr__(self, name, value.item())
        unknown = any(isinstance(value, CellField) for value in self._given.values())
        if unknown or torch.compiler.is_compiling():  # a traced graph has no values to check
            return
        tensors, ranges = self._tensors, self.parameter_ranges
        if not tensors and not ranges:
            check_options(self)
            self.check_constants()
            return
        for corner, extreme in product(product(*ranges.values()), (torch.amin, torch.amax)):
            numbers = {name: float(extreme(value.detach())) for name, value in tensors.items()}
            replace(cast("Any", self), **dict(zip(ranges, corner, strict=True)), **numbers)

    def check_constants(self) -> None:
        """Raise a ValueError for constants of which no `option` says that they are out of bounds.

        They are numbers here: those given, or the ends of ranges.
        """

    def value(self, name: str) -> Tensor:
        """Return a constant in float64, see the class; moduli over Young's modulus of the scene."""
        value = self.given(name)
        return value * self.unit if name in self.dimensional else value

    def given(self, name: str) -> Tensor:
        """Return a constant in float64 in the unit in which it is given, see `value`."""
        value = getattr(self, name)
        if isinstance(value, CellField):
            raise ValueError(f"{name} is a field; its values are known on a body only")
        if isinstance(value, ParameterRange):
            raise ValueError(
                f"{name} = {list(value)} is a range; choose a value with "
                "Problem.with_parameters, or give Load.parameters for each load"
            )
        if isinstance(value, Tensor):
            return value
        return torch.full((), value, dtype=torch.float64)

    @property
    def parts(self) -> Mapping[str, Any]:
        """Parts with constants of their own, by name."""
        return {}

    def with_parts(self, parts: Mapping[str, Any]) -> Self:
        """Return the law with other parts of the same names."""
        return replace(cast("Any", self), **parts)

    @property
    def constants(self) -> tuple[Any, ...]:
        """Numbers and tensors that the functions of the law in compiled loops take."""
        return tuple(map(self.value, self.ranged))

    @property
    def parameter_ranges(self) -> dict[str, ParameterRange]:
        """Ranges of the constants of which each load has values of its own, by name.

        A law with ranges has no moduli: it answers nothing before `with_parameters`.
        """
        return self._of_ranges(getattr)

    @property
    def units_of_ranges(self) -> dict[str, float | None]:
        """Unit of each range over E [-], by name; None for a number without unit."""
        return self._of_ranges(lambda law, name: law.unit if name in law.dimensional else None)

    def _of_ranges(self, of: Callable[[Any, str], Any]) -> dict[str, Any]:
        """Return a function of law and name for each range of the law and its parts."""
        own = [name for name, value in self._given.items() if isinstance(value, ParameterRange)]
        found = {name: of(self, name) for name in own}
        for key, part in self.parts.items():
            found |= {f"{key}.{name}": value for name, value in part._of_ranges(of).items()}
        return found

    @property
    def _given(self) -> dict[str, Any]:
        """Constants as they are given, by name."""
        return {name: getattr(self, name) for name in self.ranged}

    @property
    def _tensors(self) -> dict[str, Tensor]:
        """Constants that are fields or those of a batch."""
        return {name: v for name, v in self._given.items() if isinstance(v, Tensor)}

    @property
    def moduli_at_rest(self) -> tuple[Tensor, ...]:
        """Independent moduli of a law without parts at rest [-], see `linear_law`."""
        raise NotImplementedError

    @property
    def rest_moduli(self) -> Tensor:
        """Moduli at rest of all cells and parts, a vector (1, M) or (B, M) [-].

        Moduli of a field are those of each cell.
        """
        if not self.parts:
            columns = torch.broadcast_tensors(*self.moduli_at_rest, torch.zeros(1, 1, 1))[:-1]
            return torch.cat(columns, dim=1)[..., 0]
        parts = [part.rest_moduli for part in self.parts.values()]
        batch = torch.broadcast_shapes(*(part.shape[:1] for part in parts))
        return torch.cat([part.expand(*batch, -1) for part in parts], dim=1)

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        """Return the law with the values of its fields in the cells of a body.

        Args:
            basis: scikit-fem basis of one displacement component.
            length: Length unit of its mesh [m].
            origin: Origin of its mesh in that unit, (D,).
        """
        parts, made = {}, {}
        for key, part in self.parts.items():
            with named_errors(f"{key}."):
                parts[key] = part.on(basis, length, origin)
        for name, value in self._given.items():
            if isinstance(value, CellField):
                with named_errors(f"{name}: "):
                    made[name] = value.on(basis, length, origin)
        return self._changed(parts, made)

    def _changed(
        self, parts: Mapping[str, Any], constants: Mapping[str, Any] | None = None
    ) -> Self:
        """Return the law with other parts and constants; itself if none differs."""
        same = all(part is self.parts[key] for key, part in parts.items())
        law = self if same else self.with_parts(parts)
        return replace(cast("Any", law), **constants) if constants else law

    def over(self, modulus: float) -> Self:
        """Return the law with its moduli divided by a modulus in their unit, see `Scalable`."""
        if not self.parts:
            raise ValueError(
                f"the moduli of {type(self).__name__} are over Young's modulus; set young [Pa]"
            )
        return self.with_parts({key: part.over(modulus) for key, part in self.parts.items()})

    def of_cells(self, cells: Tensor) -> Self:
        """Return the law of some cells (C,) of the body."""
        fields = {name: v[..., cells, :] for name, v in self._tensors.items() if v.shape[-2] > 1}
        return self._changed({key: p.of_cells(cells) for key, p in self.parts.items()}, fields)

    def centred(self) -> Self:
        """Return the law without differences between the points of a cell, for one point of each.

        Only fibre frames may differ between points.
        """
        return self._changed({key: part.centred() for key, part in self.parts.items()})

    def with_parameters(self, parameters: Tensor) -> Self:
        """Return the law with values in place of its ranges.

        Args:
            parameters: Values in the order of `parameter_ranges`, (B, P). With B > 1, or if they
                require a gradient, each member of a batch has its own, and the law takes strains
                (B, E, Q, 3, 3).
        """
        names = list(self.parameter_ranges)
        if parameters.shape[-1] != len(names):
            raise ValueError(f"parameters: {type(self).__name__} has ranges of {names}")
        if not names:
            return self
        own = [name for name in names if name in self.ranged]
        counts = [len(part.parameter_ranges) for part in self.parts.values()]
        first, *others = parameters.split([len(own), *counts], dim=-1)
        values: Any = first.T[..., None, None]  # beside cells and points
        # a traced graph has no values, and `len` would fix the size of its batch
        compiling = torch.compiler.is_compiling()
        if not compiling and len(parameters) == 1 and not parameters.requires_grad:
            values = first[0].tolist()
        pairs = zip(self.parts.items(), others, strict=True)
        parts = {key: part.with_parameters(part_values) for (key, part), part_values in pairs}
        return self._changed(parts, dict(zip(own, values, strict=True)))


@dataclass(frozen=True)
class Scalable(Parametrised):
    """Law whose moduli are given in one unit of any size, such as Pa.

    Inside `dpl.fem` all moduli are over Young's modulus E of the scene. The constants, ranges and
    parameters of a law remain as they are given; `value` multiplies those in `dimensional` by
    `unit`. `over` sets this factor from the modulus of the law itself:

        law = YeohK2(c10=0.11e6, c20=0.02e6, c30=0.0, poisson=0.45)     # [Pa]
        young = law.young_at_rest                                       # [Pa]
        problem = Problem.build(mesh, law.over(young), young=young)

    E at rest follows from the linearised law, E = mu (3 lambda + 2 mu) / (lambda + mu) with mu and
    lambda at zero strain. A constant with a range has the middle of the range there.

    Source: Holzapfel (2000), Nonlinear Solid Mechanics, section 6.5, for the shear moduli at rest
    of laws of rubber; Landau, Lifshitz (1986), Theory of Elasticity, section 5, for E, K and nu.

    Attributes:
        unit: Unit of the moduli over E [-].
    """

    unit: float = field(default=1.0, kw_only=True, metadata={"optional": True})

    def over(self, modulus: float) -> Self:
        """Return the law with its moduli divided by a modulus in their unit."""
        return replace(self, unit=self.unit / modulus)
