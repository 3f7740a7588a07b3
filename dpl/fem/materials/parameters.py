"""Constants of laws: numbers, ranges, or fields with a value for each cell."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import skfem
import torch
from torch import Tensor

from dpl.fem.materials.cell_field import CellField
from dpl.fem.mesh.regions import Origin
from dpl.fem.ranges import ParameterRange, is_range
from dpl.system.checks import named_errors

if TYPE_CHECKING:
    Constant = Any  # a batch of values goes through the same arithmetic
else:
    # number, range or field
    Constant = float | Sequence[float] | Mapping[str, float | str] | CellField


class Parametrised:
    """Dataclass whose constants are numbers, ranges or fields.

    A constant with a range, [low, high] or {low, high, distribution}, has a value for each load.
    Constants are then numbers, fields with a value for each cell (E, 1), or, in a batch, values for
    each member (B, 1, 1). They multiply quantities of the points, (B, E, Q).

    Attributes:
        ranged: Names of the constants that may be ranges [low, high] or fields.
    """

    ranged: ClassVar[tuple[str, ...]] = ()

    @property
    def parameter_ranges(self) -> dict[str, ParameterRange]:
        """Ranges of the constants of which each load has values of its own, by name.

        A law with ranges has no moduli: it answers nothing before `with_parameters`.
        """
        values = {name: getattr(self, name) for name in self.ranged}
        return {name: v for name, v in values.items() if isinstance(v, ParameterRange)}

    @property
    def is_batched(self) -> bool:
        """True if each member of a batch has constants of its own, see `with_parameters`."""
        values = (getattr(self, name) for name in self.ranged)
        return any(isinstance(value, Tensor) and value.ndim == 3 for value in values)

    @property
    def fields(self) -> dict[str, Tensor]:
        """Constants that are fields, (E, 1), by name."""
        values = {name: getattr(self, name) for name in self.ranged}
        return {n: v for n, v in values.items() if isinstance(v, Tensor) and v.ndim == 2}

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        """Return the law with the values of its fields in the cells of a body.

        Args:
            basis: scikit-fem basis of one displacement component.
            length: Length unit of its mesh [m].
            origin: Origin of its mesh in that unit, (D,).

        Raises:
            ValueError: A field is invalid.
        """
        made = {}
        for name in self.ranged:
            if hasattr(value := getattr(self, name), "on"):
                with named_errors(f"{name}: "):
                    made[name] = value.on(basis, length, origin)
        return replace(cast("Any", self), **made) if made else self

    def of_cells(self, cells: Tensor) -> Self:
        """Return the law of some cells (C,) of the body."""
        chosen = {name: values[cells] for name, values in self.fields.items()}
        return replace(cast("Any", self), **chosen) if chosen else self

    def centred(self) -> Self:
        """Return the law without differences between the points of a cell, for one point of each.

        Only fibre frames may differ between points.
        """
        return self

    def with_parameters(self, parameters: Tensor) -> Self:
        """Return the law with values in place of its ranges.

        Args:
            parameters: Values in the order of `parameter_ranges`, (B, P). With B > 1, or if they
                require a gradient, each member of a batch has its own, and the law takes strains
                (B, E, Q, 3, 3).

        Raises:
            ValueError: The law has another number of ranges, or does not allow a value.
        """
        names = tuple(self.parameter_ranges)
        if parameters.shape[-1] != len(names):
            raise ValueError(f"parameters: {type(self).__name__} has ranges of {list(names)}")
        if not names:
            return self
        law: Any = self  # a dataclass if it has ranges
        if not torch.compiler.is_compiling():  # a traced graph has no values to check
            values = parameters.detach()
            if len(parameters) == 1 and not parameters.requires_grad:
                return replace(law, **dict(zip(names, values[0].tolist(), strict=True)))
            for extreme in (values.amin(0), values.amax(0)):
                self.with_parameters(extreme[None])
        # beside cells and points, so that numbers of a point, (B, E, Q), take their own
        columns = parameters.T[..., None, None]
        return replace(law, **dict(zip(names, columns, strict=True)))

    def __post_init__(self) -> None:
        """Check the constants of a dataclass, and both ends of its ranges.

        Raises:
            ValueError: The law does not allow a value, or a range is none.
        """
        for name in self.ranged:
            if is_range(value := getattr(self, name)):
                object.__setattr__(self, name, ParameterRange.of(name, value))
        unknown = any(hasattr(getattr(self, name), "on") for name in self.ranged)
        if self.is_batched or unknown:
            return
        if fields := self.fields:
            for extreme in (torch.amin, torch.amax):
                replace(cast("Any", self), **{n: float(extreme(v)) for n, v in fields.items()})
            return
        if not (ranges := self.parameter_ranges):
            self.check_constants()
            return
        for corner in product(*ranges.values()):
            self.with_parameters(torch.tensor([corner], dtype=torch.float64))

    def _number(self, name: str) -> Any:
        """Return a constant; a field or a batch of values goes through the same arithmetic.

        Raises:
            ValueError: It is a range.
        """
        value = getattr(self, name)
        if isinstance(value, ParameterRange):
            raise ValueError(
                f"{name} = {list(value)} is a range; choose a value with "
                "Problem.with_parameters, or give Load.parameters for each load"
            )
        return value

    def check_constants(self) -> None:
        """Check the values of the constants.

        Raises:
            ValueError: The law does not allow a value.
        """


class Composed(Parametrised):
    """Law of several parts, whose parameters have the name of the part before their own."""

    @property
    def parts(self) -> Mapping[str, Parametrised]:
        """The parts, by name."""
        raise NotImplementedError

    def with_parts(self, parts: Mapping[str, Any]) -> Self:
        """Return the law with other parts of the same names."""
        raise NotImplementedError

    @property
    def parameter_ranges(self) -> dict[str, ParameterRange]:
        """See `Parametrised.parameter_ranges`."""
        return self._by_part(lambda part: part.parameter_ranges)

    @property
    def fields(self) -> dict[str, Tensor]:
        """See `Parametrised.fields`."""
        return self._by_part(lambda part: part.fields)

    def _by_part(self, names: Callable[[Parametrised], Mapping[str, Any]]) -> dict[str, Any]:
        parts = self.parts.items()
        return {f"{key}.{name}": one for key, part in parts for name, one in names(part).items()}

    @property
    def is_batched(self) -> bool:
        """See `Parametrised.is_batched`."""
        return any(part.is_batched for part in self.parts.values())

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        """See `Parametrised.on`."""
        parts = {}
        for key, part in self.parts.items():
            with named_errors(f"{key}."):
                parts[key] = part.on(basis, length, origin)
        return self._changed(parts)

    def of_cells(self, cells: Tensor) -> Self:
        """See `Parametrised.of_cells`."""
        return self._changed({key: part.of_cells(cells) for key, part in self.parts.items()})

    def centred(self) -> Self:
        """See `Parametrised.centred`."""
        return self._changed({key: part.centred() for key, part in self.parts.items()})

    def _changed(self, parts: Mapping[str, Parametrised]) -> Self:
        same = all(part is self.parts[key] for key, part in parts.items())
        return self if same else self.with_parts(parts)

    def with_parameters(self, parameters: Tensor) -> Self:
        """See `Parametrised.with_parameters`."""
        counts = [len(part.parameter_ranges) for part in self.parts.values()]
        if parameters.shape[-1] != sum(counts):
            names = list(self.parameter_ranges)
            raise ValueError(f"parameters: {type(self).__name__} has ranges of {names}")
        if not sum(counts):
            return self
        pairs = zip(self.parts.items(), parameters.split(counts, dim=-1), strict=True)
        return self.with_parts({key: part.with_parameters(own) for (key, part), own in pairs})
