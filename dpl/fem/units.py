"""Conversion of boundary values in SI units to dimensionless quantities."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Units(NamedTuple):
    """Length and modulus by which the boundary values of a body are divided.

    All conversions of displacements, tractions, body forces, foundations and sizes of loads are
    methods of this class. Those of the forces of a call are `dpl.Scene.load_of` and
    `dpl.Scene.si_inputs`.

    Attributes:
        length: L, longest side of the body [m].
        young: E, Young's modulus [Pa]. With 1 Pa, values in SI units are values over E. None if the
            loads have a range of moduli: a stress is then not one dimensionless number.
    """

    length: float
    young: float | None = 1.0

    def displacement(self, value: float) -> float:
        """Return a displacement [m] over L [-]."""
        return value / self.length

    def stress(self, value: NDArray[np.float64], words: str) -> NDArray[np.float64]:
        """Return stresses [Pa] over E [-]; `words` name the option in the message of an error."""
        return value / self._one_modulus(words)

    def stress_gradient(self, value: NDArray[np.float64], words: str) -> NDArray[np.float64]:
        """Return forces per volume, or stiffnesses of a foundation, [N/m^3] times L / E [-]."""
        return value * self.length / self._one_modulus(words)

    def force(self, value: NDArray[np.float64], dim: int, words: str) -> NDArray[np.float64]:
        """Return nodal forces [N] (2D: [N/m]) over E L^(D - 1) [-], D = `dim`."""
        return value / (self._one_modulus(words) * self.length ** (dim - 1))

    def _one_modulus(self, words: str) -> float:
        if self.young is None:
            raise ValueError(
                f"{words} must be divided by one Young's modulus [Pa], and young is a range; "
                "set young to one number"
            )
        return self.young


def vector(name: str, value: Sequence[float], dim: int, unit: str) -> NDArray[np.float64]:
    """Return the components of a boundary value, (D,); name and unit are for messages."""
    if len(value) != dim or not np.isfinite(value).all():
        raise ValueError(
            f"{name} = {list(value)} must be {dim} finite numbers [{unit}]; "
            "give one for each direction"
        )
    return np.asarray(value, dtype=np.float64)
