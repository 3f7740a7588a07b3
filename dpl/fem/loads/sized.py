"""Base of load families whose size is given in SI units or follows from a linear deflection."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from dpl.fem.loads.family import RandomLoads
from dpl.fem.loads.fit import amplitudes
from dpl.fem.loads.sampling import Array, direction
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.units import Units

MIN_DEFLECTION = 1e-12  # below it the displacement is rounding error [-]
DIGITS = 12  # digits of a size that identify a family; the last ones depend on units


@dataclass(frozen=True, eq=False)
class SizedLoads(RandomLoads):
    """Base of load families whose forces have a random size.

    A subclass defines `given_sizes` and `unit_deflection`, and names its options in SI units in
    `si_options`.

    Attributes:
        deflection: Largest linear deflection over L [-]: the sizes lie between 0 and the size at
            which the largest load deflects the body as far. Options in SI units replace it.
    """

    _: KW_ONLY
    deflection: float = 0.2
    si_options: ClassVar[tuple[str, ...]] = ("largest",)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range.
        """
        check_deflection(self.deflection)
        super().__post_init__()

    @property
    @abstractmethod
    def given_sizes(self) -> Array | None:
        """Smallest and largest size in the options, (2,) [-]; None if `deflection` decides.

        Raises:
            ValueError: The loads have a range of moduli.
        """

    @property
    @abstractmethod
    def unit_deflection(self) -> float:
        """Largest linear deflection over L of the loads of size 1 [-]."""

    @cached_property
    def sizes(self) -> tuple[float, float]:
        """Smallest and largest size [-].

        Raises:
            ValueError: The loads have a range of moduli, or do not deflect the body.
        """
        if (given := self.given_sizes) is not None:
            return float(given[0]), float(given[1])
        unit = self.unit_deflection
        if not 0 < unit < math.inf:
            raise ValueError("these loads act on fixed nodes only; they must act on a free node")
        return 0.0, self.deflection / unit

    @property
    def largest_size(self) -> float:
        """Largest magnitude of a size [-]."""
        return max(map(abs, self.sizes))

    def size_at(self, t: Array) -> Array:
        """Return the sizes of numbers in [0, 1), of the same shape [-]."""
        low, high = self.sizes
        return low + (high - low) * t

    def amplitudes(self, sizes: Array) -> Array:
        """Return the amplitudes of sizes [-], of the same shape, see `LoadFamily.project`."""
        return amplitudes(sizes, *self.sizes, self.largest_size)

    def vector_at(self, point: Array) -> Array:
        """Return the vector (D,) [-] of a point (D,) of the unit cube: its size and direction."""
        return self.size_at(point[0]) * direction(point[1:])

    def identity(self) -> dict[str, Any]:
        """Return the options with those in SI units as `sizes`, or with `deflection`."""
        given = self.given_sizes
        unused = self.si_options if given is None else (*self.si_options, "deflection")
        options = {name: one for name, one in super().identity().items() if name not in unused}
        return options if given is None else options | {"sizes": rounded(given)}

    def __getstate__(self) -> dict[str, object]:
        """Pickle with the sizes, so that workers need not compute them again."""
        self.sizes  # noqa: B018
        return self.__dict__


def rounded(values: Array) -> list[float]:
    """Return numbers for an identity without the last digits, which depend on units."""
    return [float(f"{value:.{DIGITS}g}") for value in values]


def check_deflection(deflection: float) -> None:
    """Check a deflection over L.

    Raises:
        ValueError: It is out of range.
    """
    if not MIN_DEFLECTION <= deflection <= 10:
        span = f"between {MIN_DEFLECTION:g} and 10 (times L)"
        raise ValueError(f"deflection = {deflection} must lie {span}")


def check_largest(name: str, value: float | None, unit: str) -> None:
    """Check a largest size, which may be left out.

    Raises:
        ValueError: It is not a positive number.
    """
    if value is not None and not 0 < value < math.inf:
        raise ValueError(f"{name} = {value} must be a number above 0 [{unit}], or null")


def check_range(
    name: str, value: Sequence[float] | None, unit: str, *, least: float = -math.inf
) -> None:
    """Check a range, which may be left out.

    Args:
        name: Name of the option.
        value: Smallest and largest value.
        unit: Unit, for the message.
        least: Least smallest value.

    Raises:
        ValueError: The range is not ascending or finite, begins below `least` or is 0 only.
    """
    if value is None:
        return
    low, high = value if len(value) == 2 else (math.nan, math.nan)
    if not (least <= low <= high and math.isfinite(low) and math.isfinite(high)):
        span = "" if least == -math.inf else f" from {least:g}"
        raise ValueError(
            f"{name} = {list(value)} must be a smallest and a largest number{span} [{unit}]"
        )
    if low == high == 0:
        raise ValueError(f"{name} = {list(value)} must contain a number other than 0 [{unit}]")


def traction_sizes(units: Units, largest: float | None) -> Array | None:
    """Return 0 and a largest traction [Pa] over E, (2,) [-]; None if it is left out.

    Raises:
        ValueError: The loads have a range of moduli.
    """
    if largest is None:
        return None
    return units.stress(np.array([0.0, largest]), f"largest = {largest}")


def largest_deflection(linear: LinearSolver, axes: Tensor) -> float:
    """Return the largest linear deflection of a combination of forces with |c| = 1 [-].

    Args:
        linear: The body.
        axes: The forces (K, N, D) [-].
    """
    moved = torch.stack([linear.solve_force(force) for force in axes], dim=-1)  # (N, D, K)
    return float(torch.linalg.matrix_norm(moved, 2).max())


def point_forces(shape: Sequence[int], nodes: Tensor) -> Tensor:
    """Return unit forces at each of some nodes (n,) along each axis, (D, N, D)."""
    forces = torch.zeros(shape[1], *shape, dtype=torch.float64)
    for axis in range(shape[1]):
        forces[axis, nodes, axis] = 1.0
    return forces


def softest_node(linear: LinearSolver, nodes: Tensor) -> int:
    """Return a node that yields most to forces of any direction, among `nodes` (n,).

    The compliance C is positive definite, so that |C_ij|^2 <= |C_ii| |C_jj| for its blocks. If
    forces at a node move another node further than their own, the other one is therefore softer.
    The search begins at the node that forces on all nodes move most, and goes to softer nodes until
    there is none.
    """
    shape = linear.problem.shape
    forces = point_forces(shape, nodes)
    found: int | None = None
    while True:
        moved = torch.stack([linear.solve_force(force) for force in forces], dim=-1)  # (N, D, D)
        sizes = torch.linalg.matrix_norm(moved, 2)
        best = int(nodes[int(sizes[nodes].argmax())])
        if found is not None and not sizes[best] > sizes[found] * (1 + 1e-9):
            return found
        found = best
        forces = point_forces(shape, torch.tensor([found]))
