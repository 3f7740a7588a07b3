"""Fibre directions of a body: constant, from a function, from data, or by Laplace's equation.

Frames have the columns fibre f, sheet s and normal n = f x s. Where a law depends on f alone, the
sheet may be left out: it is z x f, or x where the fibre lies along z.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from skfem.models.poisson import laplace
from skfem.utils import solver_iter_pcg
from torch import Tensor

from dpl.fem.materials.fibres.reinforced import FibreDirections
from dpl.fem.mesh.reading import read_cell_data
from dpl.fem.mesh.regions import Origin, Region, facets_in
from dpl.fem.mesh.validation import listed
from dpl.fem.options import check_options, option

PARALLEL = 1e-6  # sine of the angle below which two directions are parallel
LAPLACE_TOL = 1e-10  # relative residual of Laplace's equation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConstantFibres(FibreDirections):
    """One direction in the whole body.

    Attributes:
        fibre: Direction f of any length, 3 components, or 2 in a 2D body.
        sheet: Direction in the plane of f and s; default: see the module.
    """

    fibre: Sequence[float]
    sheet: Sequence[float] | None = None

    def __post_init__(self) -> None:
        self.constant()

    def constant(self) -> Tensor:
        """Return the frame, (1, 3, 3) [-]."""
        sheet = None if self.sheet is None else np.array([self.sheet])
        return frames_of(np.array([self.fibre]), sheet)

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        if len(self.fibre) < basis.mesh.dim():
            raise ValueError(f"fibre = {list(self.fibre)} must have {basis.mesh.dim()} components")
        return self.constant()


@dataclass(frozen=True)
class FibreFunction(FibreDirections):
    """Directions as a function of the place.

    Attributes:
        function: Function of points (n, D) [m] that returns the directions f, (n, 3) or (n, 2), or
            a tuple of f and s. Lengths are arbitrary. It is called with the quadrature points.
    """

    function: Callable[[Array], Any]

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        at = np.asarray(basis.global_coordinates())
        points = (at.reshape(len(at), -1).T + origin) * length
        found = self.function(np.ascontiguousarray(points))
        fibre, sheet = found if isinstance(found, tuple) else (found, None)
        return _frames_of_rows(basis, at.shape[1:], fibre, sheet)


@dataclass(frozen=True, eq=False)
class FibreData(FibreDirections):
    """Directions of each cell, as arrays or from a mesh file.

    Attributes:
        fibre: Directions f, (E, 3) or (E, 2), or the name of such cell data in `file`.
        sheet: The same for s.
        file: File with this cell data; its cells are those of the mesh.
    """

    fibre: str | Sequence[Sequence[float]] | Array
    sheet: str | Sequence[Sequence[float]] | Array | None = None
    file: str | Path | None = None

    def __post_init__(self) -> None:
        for name, value in (("fibre", self.fibre), ("sheet", self.sheet)):
            if value is not None and isinstance(value, str) != (self.file is not None):
                raise ValueError(
                    f"{name} must be the name of cell data if there is a file, and an array if not"
                )

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        given: list[Any] = [self.fibre, self.sheet]
        if self.file is not None:
            names = [name for name in given if isinstance(name, str)]
            given[: len(names)] = read_cell_data(self.file, names)
        return _frames_of_rows(basis, (basis.mesh.nelements,), *given)


@dataclass(frozen=True)
class LaplaceFibres(FibreDirections):
    """Directions in a wall, rotating from one surface to the other.

    The solution phi of Laplace's equation, 0 on `inner` and 1 on `outer`, gives the transmural
    direction t = grad phi / |grad phi|, which is the sheet direction. Fibres lie in the plane
    across t, at the angle inner_angle + (outer_angle - inner_angle) phi to the circumferential
    direction `longitudinal` x t, and turn towards `longitudinal`.

    On linear meshes the error of the directions is proportional to the size of the cells: 2 degrees
    with four cells through a wall in which the fibres turn by 120 degrees. Curved quadratic meshes
    are recommended: 0.2 degrees (10-node tetrahedra) or 0.03 degrees (27-node hexahedra).

    Source: Bayer, Blake, Plank, Trayanova (2012), Ann. Biomed. Eng. 40; with a given long axis
    instead of the apicobasal solution, and sheets along t.

    Attributes:
        inner, outer: Surfaces of the wall.
        longitudinal: Long axis of any length, 3 components; [0, 0, 1] in a 2D body.
        inner_angle, outer_angle: Angles on the surfaces [rad].
    """

    inner: Region
    outer: Region
    longitudinal: Sequence[float]
    inner_angle: float = option("rad")
    outer_angle: float = option("rad")

    def __post_init__(self) -> None:
        check_options(self)
        _unit_vectors("longitudinal", np.array([self.longitudinal]))

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        inner, outer = (
            basis.get_dofs(facets_in(part, basis.mesh, length, origin)).all()
            for part in (self.inner, self.outer)
        )
        if len(both := np.intersect1d(inner, outer)):
            raise ValueError(f"inner and outer must not touch; they share {len(both)} nodes")
        values, held = np.zeros(basis.N), np.concatenate([inner, outer])
        values[outer] = 1.0
        system = skfem.condense(laplace.assemble(basis), x=values, D=held)
        depth = basis.interpolate(skfem.solve(*system, solver=solver_iter_pcg(rtol=LAPLACE_TOL)))
        gradient = np.moveaxis(depth.grad, 0, -1)
        transmural = _unit_vectors("gradient between inner and outer", gradient)
        around = np.cross(_unit_vectors("longitudinal", np.array([self.longitudinal])), transmural)
        parallel = np.linalg.norm(around, axis=-1) < PARALLEL
        _refuse(parallel, "longitudinal must not be parallel to the transmural direction")
        around = _unit_vectors("circumferential direction", around)
        angle = (self.inner_angle + (self.outer_angle - self.inner_angle) * np.asarray(depth))[
            ..., None
        ]
        fibre = np.cos(angle) * around + np.sin(angle) * np.cross(transmural, around)
        return frames_of(fibre, transmural)


def frames_of(fibre: Array, sheet: Array | None = None) -> Tensor:
    """Return right-handed orthonormal frames of cells, (E, 3, 3), or points, (E, Q, 3, 3) [-].

    Args:
        fibre: Directions f of any length, (E, D) or (E, Q, D), D = 2 or 3.
        sheet: Directions s, whose part across f is taken; default: z x f, or x where f
            lies along z.
    """
    f = _unit_vectors("fibre", fibre)
    if sheet is None:
        across = np.cross([0.0, 0.0, 1.0], f)
        along_z = np.linalg.norm(across, axis=-1, keepdims=True) < PARALLEL
        sheet = np.where(along_z, [1.0, 0.0, 0.0], across)
    s = _unit_vectors("sheet", sheet)
    s = s - (s * f).sum(-1, keepdims=True) * f
    _refuse(np.linalg.norm(s, axis=-1) < PARALLEL, "sheet must not be parallel to fibre")
    s = s / np.linalg.norm(s, axis=-1, keepdims=True)
    s = s - (s * f).sum(-1, keepdims=True) * f  # again, for directions that are nearly parallel
    s = s / np.linalg.norm(s, axis=-1, keepdims=True)
    return torch.from_numpy(np.stack([f, s, np.cross(f, s)], axis=-1))


def _frames_of_rows(basis: skfem.Basis, shape: tuple[int, ...], *given: Any) -> Tensor:
    """Return frames of given f and s (or None) in rows for cells (E,) or for points (E, Q)."""
    rows, dim = math.prod(shape), basis.mesh.dim()
    parts: list[Any] = []
    for name, part in zip(("fibre", "sheet"), given, strict=True):
        if part is not None and np.shape(part) not in ((rows, dim), (rows, 3)):
            each = "point" if len(shape) > 1 else "cell"
            raise ValueError(
                f"{name} of shape {np.shape(part)} must have ({rows}, {dim}), a row per {each}"
            )
        parts.append(None if part is None else np.asarray(part).reshape(*shape, -1))
    return frames_of(*parts)


def _unit_vectors(name: str, vectors: Array) -> Array:
    """Return vectors (..., 2) or (..., 3) divided by their lengths, (..., 3) [-]."""
    vectors = np.asarray(vectors, dtype=np.float64)
    if vectors.shape[-1] not in (2, 3):
        raise ValueError(f"{name} = {vectors.tolist()} must have 2 or 3 components")
    if vectors.shape[-1] == 2:
        vectors = np.concatenate([vectors, np.zeros_like(vectors[..., :1])], axis=-1)
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    bad = ~((largest > 0) & np.isfinite(largest))[..., 0]
    _refuse(bad, f"{name} must be finite and not zero")
    vectors = vectors / largest  # squares of it neither overflow nor vanish
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _refuse(bad: NDArray[np.bool_], message: str) -> None:
    """Raise a ValueError with the numbers of the cells that are `bad` (E,) or (E, Q)."""
    if bad.any():
        cells = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
        raise ValueError(message + (f" (cells {listed(cells)})" if len(bad) > 1 else ""))
