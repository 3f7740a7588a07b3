"""Random choices among forces that a user gives in a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpl.fem.identity import plain
from dpl.fem.loads.fit import best_fit
from dpl.fem.loads.sampling import Array
from dpl.fem.loads.sized import CombinedLoads
from dpl.fem.options import option
from dpl.system.files import read_array


@dataclass(frozen=True, eq=False)
class FileLoads(CombinedLoads):
    """One of the forces of a file times a random factor.

    The numbers of a force are its number in the file and the factor.

    Attributes:
        path: An array in .npy, or a .npz file with one array: nodal forces (S, N, D) [N] (2D:
            [N/m]), 2^27 numbers at most, the nodes in the order of `Problem.points`. Each force
            acts on a free degree of freedom. The file need not be trusted.
        factor: Smallest and largest factor; None: `deflection` decides, and the unit of the forces
            has no effect.
    """

    path: str | Path
    factor: Sequence[float] | None = option("", default=(0.0, 1.0), nonzero=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.shapes  # noqa: B018  # raises if the file cannot be used

    @cached_property
    def _forces(self) -> Array:
        """Forces of the file, (S, N, D) [N]."""
        free = self.problem.free.numpy()
        try:
            forces = read_array(Path(self.path), free.shape)
            for number, force in enumerate(forces):
                if not np.isfinite(force).all():
                    raise ValueError(f"force {number} must have finite components")
                if not force[free].any():
                    raise ValueError(f"force {number} must act on a free degree of freedom")
            return forces
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise ValueError(f"path = {self.path}: {' '.join(str(reason).split())}") from error

    @property
    def _unit(self) -> float:
        """Largest component of a force [N]."""
        return float(np.abs(self._forces).max())

    @cached_property
    def shapes(self) -> Tensor:
        """Forces over their largest component, (S, N, D) [-]."""
        return torch.from_numpy(self._forces / self._unit)

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest factor times the largest component over E L^(D - 1), (2,) [-]."""
        if self.factor is None:
            return None
        largest = self._unit * np.asarray(self.factor, dtype=np.float64)
        return self.problem.units.force(largest, self.problem.shape[1], f"path = {self.path} [N]")

    @property
    def n_force(self) -> int:
        """2: the number of the force and the factor."""
        return 2

    def force_at(self, point: Array) -> Tensor:
        """Return the force (N, D) [-] of a point (2,) of the unit cube."""
        number = int(point[0] * len(self.shapes))
        return float(self.size_at(point[1])) * self.shapes[number]

    @property
    def unit_deflection(self) -> float:
        """Largest linear deflection [-] of a force of the file over the largest component."""
        linear = self.linear.reference
        return max(float(linear.solve_force(shape).norm(dim=1).max()) for shape in self.shapes)

    @property
    def unit_force(self) -> float:
        """Largest norm [-] of a force of the file over the largest component."""
        return float(self.problem.acting(self.shapes).flatten(1).norm(dim=1).max())

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes (B,) and relative residuals (B,) for the force that fits best."""
        shapes = torch.from_numpy(self._acting_shapes)  # (N D, S)
        own = self.own_force(force).flatten(1)
        products, squares = own @ shapes, shapes.square().sum(dim=0)
        factors, size = products / squares, own.norm(dim=1).clamp(min=1e-300)
        cosines = products / squares.sqrt() / size[:, None]
        amplitude = torch.from_numpy(self.amplitudes(factors.numpy()))
        apart = (1 - cosines.square()).clamp(min=0.0).sqrt()
        rows, best = torch.arange(len(own)), best_fit(amplitude.T.numpy(), apart.T.numpy())
        rest = (own - factors[rows, best][:, None] * shapes[:, best].T).norm(dim=1)
        return amplitude[rows, best], rest / size

    def identity(self) -> dict[str, Any]:
        """Return the options; the file is identified by its forces over the largest component."""
        options = super().identity()
        del options["path"], options["factor"]
        return options | {"forces": plain(self.shapes)}
