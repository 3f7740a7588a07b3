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
from dpl.fem.mesh.nodal_fields import read_nodal_fields
from dpl.fem.options import option
from dpl.system.checks import named_errors

BUCKETS = 256  # numbers of a sketch
CANDIDATES = 4  # forces with the most similar sketches, which are compared with a force


@dataclass(frozen=True, eq=False)
class FileLoads(CombinedLoads):
    """One of the forces of a file times a random factor.

    Attributes:
        path: Nodal forces (S, N, D) [N] (2D: [N/m]), 2^27 numbers at most: a file of arrays or a
            folder of VTK files, see `dpl.fem.mesh.nodal_fields`. Each force acts on a free degree
            of freedom.
        factor: Smallest and largest factor; None: `deflection` decides, and the unit of the forces
            has no effect.
        field: Name of the array, in a file with several.
        unit: Unit of the forces [N].
        scale: Unit of the points in the file [m].
    """

    path: str | Path
    factor: Sequence[float] | None = option("", default=(0.0, 1.0), nonzero=True)
    field: str = "force"
    unit: float = 1.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", str(self.path))  # plain data
        super().__post_init__()
        self.shapes  # noqa: B018  # raises if the file cannot be used

    @cached_property
    def _forces(self) -> Array:
        """Forces of the file, (S, N, D) [N]."""
        body, names = self.problem, [self.field]
        with named_errors(f"path = {self.path}: "):
            (forces,) = read_nodal_fields(self.path, names, body.points_in_metres, self.scale)
            for number, force in enumerate(forces):
                if not np.isfinite(force).all():
                    raise ValueError(f"force {number} must have finite components")
                if not force[body.free.numpy()].any():
                    raise ValueError(f"force {number} must act on a free degree of freedom")
            return self.unit * forces

    @cached_property
    def shapes(self) -> Tensor:
        """Forces over their largest component, (S, N, D) [-]."""
        return torch.from_numpy(self._forces / np.abs(self._forces).max())

    @property
    def given_sizes(self) -> Array | None:
        """Smallest and largest factor times the largest component over E L^(D - 1), (2,) [-]."""
        if self.factor is None:
            return None
        largest = np.abs(self._forces).max() * np.asarray(self.factor, dtype=np.float64)
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
        own = self.own_force(force).flatten(1)
        size = own.norm(dim=1, keepdim=True).clamp(min=1e-300)
        cosines = (_sketch(own / size) @ self._sketches).abs()
        near = cosines.topk(min(CANDIDATES, len(self.shapes)), dim=1).indices  # (B, C)
        shapes = self.problem.acting(self.shapes[near]).flatten(2)  # (B, C, N D)
        factors = (shapes @ own[..., None])[..., 0] / shapes.square().sum(dim=2)
        rest = (own[:, None] - factors[..., None] * shapes).norm(dim=2) / size
        amplitude = torch.from_numpy(self.amplitudes(factors.numpy()))
        rows, best = torch.arange(len(own)), best_fit(amplitude.T.numpy(), rest.T.numpy())
        return amplitude[rows, best], rest[rows, best]

    @cached_property
    def _sketches(self) -> Tensor:
        """Unit vectors of the sketches of all forces, (BUCKETS, S)."""
        sketches = _sketch(self.problem.acting(self.shapes).flatten(1))
        return torch.nn.functional.normalize(sketches, dim=1).T.contiguous()

    def identity(self) -> dict[str, Any]:
        """Return the options; the file is identified by its forces over the largest component."""
        unused = ("path", "field", "unit", "scale", "factor")
        options = {key: one for key, one in super().identity().items() if key not in unused}
        return options | {"forces": plain(self.shapes)}


def _sketch(vectors: Tensor) -> Tensor:
    """Return sums of random parts of vectors (B, n) with random signs, (B, BUCKETS).

    Sketches of parallel vectors are parallel, and those of other vectors seldom are.

    Source: Charikar, Chen, Farach-Colton (2002), ICALP, section 3 (count sketch).
    """
    generator, n = torch.Generator().manual_seed(0), vectors.shape[1]
    signs = 2.0 * torch.randint(2, (n,), generator=generator) - 1
    buckets = torch.randint(BUCKETS, (n,), generator=generator)
    return vectors.new_zeros(len(vectors), BUCKETS).index_add_(1, buckets, signs * vectors)
