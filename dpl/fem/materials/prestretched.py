"""Residual stress of growth and of prestretch: laws of bodies that are stressed at u = 0."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.identity import plain
from dpl.fem.materials.linear_elastic import linear_law
from dpl.fem.materials.material import Material, Response
from dpl.fem.materials.tensors import green_lagrange, product, volume_change, with_axes
from dpl.fem.mesh.regions import Origin

EYE = torch.eye(3, dtype=torch.float64)
# see `Prestretched.stretch`
Stretch = Sequence[float] | Callable[[NDArray[np.float64]], Any] | NDArray[np.float64] | Tensor


@dataclass(frozen=True, eq=False)
class Prestretched(Material):
    """Law of a body that is stretched at u = 0: W(F) = law.energy(F G) / det G.

    The prestretch G is the deformation gradient from the stress-free state of a point to the mesh.
    Material that has grown by Fg and is held in the shape of the mesh has G = Fg^-1. The stress at
    u = 0 must be in equilibrium: `dpl.fem.relaxed` finds the mesh and the G of which it is.

    Source: Rodriguez, Hoger, McCulloch (1994), J. Biomech. 27, for growth; Johnson, Hoger (1995),
    J. Elast. 41, for the law of the stressed configuration.

    Attributes:
        law: Law of the stress-free material, of finite strains and without ranges.
        stretch: G [-]: three stretches along the axes; an array (E, 3, 3), or (E, Q, 3, 3) with the
            values of the quadrature points; a function of points (n, D) [m] that returns
            (n, 3, 3); or the name of such cell data in `file`, 9 or 9 Q numbers for each cell.
        file: File with this cell data; its cells are those of the mesh.
    """

    law: Material
    stretch: Stretch | str
    file: str | Path | None = None

    def __post_init__(self) -> None:
        if not self.law.finite or self.law.parameter_ranges:
            raise ValueError(
                f"law = {self.law.describe()} must be a law of finite strains without ranges"
            )
        if isinstance(self.stretch, str) != (self.file is not None):
            raise ValueError(
                "stretch must be the name of cell data if there is a file, and three numbers, an "
                "array or a function if not"
            )
        if not isinstance(self.stretch, str) and not callable(self.stretch):
            object.__setattr__(self, "stretch", _as_field(self.stretch))

    @property
    def parts(self) -> Mapping[str, Material]:
        return {"law": self.law}

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        given: Any = self.stretch
        if self.file is not None:
            from dpl.fem.mesh.reading import read_cell_data  # which imports meshio

            (rows,) = read_cell_data(self.file, [str(given)])
            given = rows.reshape(len(rows), -1, 3, 3)
        elif callable(given):
            at = np.asarray(basis.global_coordinates())
            points = (at.reshape(len(at), -1).T + origin) * length
            given = np.reshape(given(np.ascontiguousarray(points)), (*at.shape[1:], 3, 3))
        made = replace(super().on(basis, length, origin), stretch=given, file=None)
        if any(n not in (1, m) for n, m in zip(made.field.shape, basis.dx.shape, strict=False)):
            raise ValueError(
                f"stretch of shape {tuple(made.field.shape)} must have the values of "
                f"{basis.dx.shape[0]} cells with 1 or {basis.dx.shape[1]} points"
            )
        return replace(made, stretch=made.field.expand(len(basis.dx), -1, -1, -1))

    def of_cells(self, cells: Tensor) -> Self:
        law, G = super().of_cells(cells), self.field
        return law if len(G) == 1 else replace(law, stretch=G[cells.to(G.device)])

    def centred(self) -> Self:
        """Return the law with the mean of the prestretch of each cell."""
        return replace(super().centred(), stretch=self.field.mean(1, keepdim=True))

    @property
    def field(self) -> Tensor:
        """G, (E or 1, Q or 1, 3, 3) [-]."""
        if not isinstance(self.stretch, Tensor):
            raise ValueError("stretch is a field; its values are known on a body only")
        return self.stretch

    def identity(self) -> dict[str, Any]:
        both = {"law": self.law.identity(), "stretch": plain(self.field)}
        return {"name": type(self).__name__, **both}

    def describe(self) -> str:
        return f"{self.law.describe()}, prestretched"

    def energy(self, H: Tensor) -> Tensor:
        G, J = self._stretch(H)
        return self.law.energy(_before(H, G)) / J

    def stress(self, H: Tensor) -> Tensor:
        G, J = self._stretch(H)
        P = self.law.stress(_before(H, G))
        return product(P, G.mT.expand_as(P)) / with_axes(J, 2)

    @property
    def has_response(self) -> bool:
        return self.law.has_response

    def response(self, E: Tensor) -> Response:
        G, J = self._stretch(E)
        found = self.law.response(G.mT @ E @ G + green_lagrange(G - EYE.to(G)))
        pairs = torch.einsum("...ik,...jl->...ijkl", G, G).flatten(-4, -3).flatten(-2)
        moduli = pairs @ found.moduli.flatten(-4, -3).flatten(-2) @ pairs.mT / with_axes(J, 2)
        stress = G @ found.stress @ G.mT / with_axes(J, 2)
        return Response(stress, moduli.unflatten(-2, (3, 3)).unflatten(-1, (3, 3)))

    def volumetric_energy(self, j: Tensor) -> Tensor:
        J = self._stretch(j[..., None, None])[1]
        return self.law.volumetric_energy(J * j + (J - 1)) / J

    def pressure(self, j: Tensor) -> Tensor:
        J = self._stretch(j[..., None, None])[1]
        return self.law.pressure(J * j + (J - 1))

    @property
    def point_bulk(self) -> Tensor:
        return self.law.point_bulk

    @property
    def has_residual_stress(self) -> bool:
        return True

    def residual_stress(self, H: Tensor) -> Tensor:
        return self._at_rest[0].to(H)

    def rest_stress(self, H: Tensor) -> Tensor:
        """Return A(0) : H, (..., 3, 3) [-], which depends on the rotation too."""
        return torch.einsum("...iJkL,...kL->...iJ", self._at_rest[1].to(H), H)

    @cached_property
    def _at_rest(self) -> tuple[Tensor, Tensor]:
        """P(0) and A(0) at the points."""
        G = self._stretch(self.field)[0]
        rest = torch.zeros_like(G if G.ndim == 2 else G[None])
        return self.stress(rest), self.tangent(rest)

    @property
    def mu(self) -> Tensor:
        """Shear modulus of the stress-free material over Young's modulus [-]."""
        return self.law.mu

    @property
    def lam(self) -> Tensor:
        """First Lame parameter of the stress-free material over Young's modulus [-]."""
        return self.law.lam

    @property
    def rest_moduli(self) -> Tensor:
        """The number 1, (1, 1): without ranges K(0) is one matrix, see `StiffnessTerms`."""
        return torch.ones(1, 1, dtype=torch.float64)

    @property
    def young_at_rest(self) -> float:
        return self.law.young_at_rest

    def normalised(self) -> Self:
        return replace(self, law=self.law.normalised())

    def _stretch(self, H: Tensor) -> tuple[Tensor, Tensor]:
        """Return G as H, (E, Q or 1, 3, 3), or (3, 3) if all points have the same; and det G."""
        G = self.field.to(H)
        G = G[0, 0] if G.shape[:2] == (1, 1) else G
        return G, 1 + volume_change(G - EYE.to(G))


@linear_law.register
def _of_prestretched(law: Prestretched, moduli: Tensor) -> Prestretched:
    """Return the law itself, whose K(0) is the one term."""
    return law


def _before(H: Tensor, G: Tensor) -> Tensor:
    """Return F G - I of F = I + H."""
    H, G = torch.broadcast_tensors(H, G)
    return product(H, G) + (G - EYE.to(G))


def _as_field(stretch: Any) -> Tensor:
    """Return a prestretch as (E or 1, Q or 1, 3, 3) after a check."""
    G = torch.as_tensor(stretch, dtype=torch.float64)
    G = torch.diag(G)[None] if G.shape == (3,) else G
    G = G[:, None] if G.ndim == 3 else G
    if G.ndim != 4 or G.shape[-2:] != (3, 3) or not (torch.linalg.det(G) > 0).all():
        raise ValueError(
            f"stretch of shape {tuple(G.shape)} must be 3 numbers, (cells, 3, 3) or "
            "(cells, points, 3, 3), with determinants above 0"
        )
    return G
