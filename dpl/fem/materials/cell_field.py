"""Constants of a law that differ between cells."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.mesh.reading import read_cell_data
from dpl.fem.mesh.regions import Origin


@dataclass(frozen=True, eq=False)
class CellField:
    """Constant of a law with a value in each cell.

    Attributes:
        values: Function of the centres of the cells (E, D) [m] that returns the values (E,), the
            values in the order of the cells of the mesh, or the name of such cell data in `file`.
        file: File with this cell data; its cells are those of the mesh.

    Raises:
        ValueError: There is a name without a file, or a file without a name.
    """

    values: Callable[[NDArray[np.float64]], NDArray[np.float64]] | Sequence[float] | str
    file: str | Path | None = None

    def __post_init__(self) -> None:
        """Check the attributes."""
        if isinstance(self.values, str) != (self.file is not None):
            raise ValueError(
                "values must be the name of cell data if there is a file, and a function or an "
                "array if not"
            )

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        """Return the values, (E, 1); arguments as in `Material.on`.

        Raises:
            ValueError: There is not one finite number for each cell.
        """
        mesh = basis.mesh
        centres = (mesh.p[:, mesh.t].mean(axis=1).T + origin) * length
        given: Any = self.values
        if self.file is not None:
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
