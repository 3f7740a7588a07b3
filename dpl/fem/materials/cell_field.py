"""Constants of a law that differ between cells."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.mesh.regions import Origin


@dataclass(frozen=True, eq=False)
class CellField:
    """Constant of a law with a value in each cell.

    Attributes:
        values: Function of the centres of the cells (E, D) [m] that returns the values (E,), or the
            values in the order of the cells of the mesh.
    """

    values: Callable[[NDArray[np.float64]], NDArray[np.float64]] | NDArray[np.float64]

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        """Return the values, (E, 1); arguments as in `Material.on`.

        Raises:
            ValueError: There is not one finite number for each cell.
        """
        mesh = basis.mesh
        centres = (mesh.p[:, mesh.t].mean(axis=1).T + origin) * length
        given = self.values(centres) if callable(self.values) else self.values
        values = np.asarray(given, dtype=np.float64)
        if values.shape != (len(centres),) or not np.isfinite(values).all():
            raise ValueError(
                f"values of shape {values.shape} must be {len(centres)} finite numbers, one for "
                "each cell"
            )
        return torch.from_numpy(values.copy())[:, None]
