"""Laws with fibres: an isotropic matrix and the energy of fibres in their frames."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import skfem
import torch
from torch import Tensor

from dpl.fem.materials.fibres.energies import FibreEnergy, LinearFibres, as_tensors, components
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.materials.material import CompiledForm, Material, Response
from dpl.fem.materials.tensors import green_lagrange
from dpl.fem.mesh.regions import Origin
from dpl.system.checks import named_errors

ORTHONORMAL = 1e-6  # largest entry of Q^T Q - I
COMPONENT = ((0, 3, 5), (3, 1, 4), (5, 4, 2))  # number of each component ij


class FibreDirections:
    """Specification of the fibre frames of a body."""

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Tensor:
        """Return the frames of a body [-].

        The columns of a frame are the directions of fibre, sheet and normal: orthonormal, and
        right-handed. Frames are those of the quadrature points, (E, Q, 3, 3), of the cells,
        (E, 3, 3), or (1, 3, 3) if all are equal.

        Args:
            basis: scikit-fem basis of one displacement component.
            origin: Origin of the mesh of the basis in its own unit, (D,).
            length: Length unit of that mesh [m].
        """
        raise NotImplementedError

    def constant(self) -> Tensor | None:
        """Return the frame (1, 3, 3) [-] of all cells of any body; None if it needs a body."""
        return None


@dataclass(frozen=True, eq=False)
class FibreReinforced(Material):
    """Anisotropic law: the energy of an isotropic matrix plus that of fibres in a frame.

    W = matrix.energy(H) + fibres.energy(Q^T (C - I) Q), Q the fibre frame of the cell. The matrix
    has the volumetric term; the fibres have the full strain, see `FibreEnergy`.

    Frames are tensors with the cells as first axis; the law then takes H of (B, E, Q, 3, 3), cells
    at axis -4. One frame for all cells takes any H. A frame is that of a quadrature point, or of
    all points of a cell.

    Source: Holzapfel, Gasser, Ogden (2000), J. Elast. 61.

    Attributes:
        matrix: The isotropic law.
        fibres: The energy of the fibres.
        directions: Fibre directions; after `on` the frames (E, Q, 3, 3), (E, 3, 3) or (1, 3, 3)
            [-], columns f, s and n.
    """

    matrix: InvariantBasedMaterial
    fibres: FibreEnergy
    directions: FibreDirections | Tensor

    def __post_init__(self) -> None:
        is_linear = isinstance(self.fibres, LinearFibres)  # a term of K(0), which is used at rest
        if not (
            isinstance(self.matrix, InvariantBasedMaterial) and (self.matrix.finite or is_linear)
        ):
            name = type(self.matrix).__name__
            raise ValueError(f"matrix = {name} must be a law of the invariants for finite strains")
        frames = self.directions
        if not isinstance(frames, Tensor) or torch.compiler.is_compiling():
            return
        if frames.dim() not in (3, 4) or frames.shape[-2:] != (3, 3) or not frames.numel():
            raise ValueError(
                f"directions of shape {tuple(frames.shape)} must have (cells, 3, 3) or "
                "(cells, points, 3, 3)"
            )
        gap = frames.mT @ frames - torch.eye(3, dtype=frames.dtype, device=frames.device)
        bad = ~(gap.abs().flatten(1).amax(1) <= ORTHONORMAL)
        if bad.any():
            raise ValueError(
                f"directions must have orthonormal columns; in {int(bad.sum())} of {len(frames)} "
                "cells they do not"
            )

    @property
    def finite(self) -> bool:  # type: ignore[override]
        return self.matrix.finite

    @property
    def parts(self) -> Mapping[str, Any]:
        return {"matrix": self.matrix, "fibres": self.fibres}

    def on(self, basis: skfem.Basis, length: float, origin: Origin) -> Self:
        directions, cells = self.directions, basis.mesh.t.shape[1]
        if not isinstance(directions, Tensor):
            with named_errors("directions: "):
                directions = directions.on(basis, length, origin)
        if len(directions) not in (1, cells):
            raise ValueError(
                f"directions has frames of {len(directions)} cells and must have those of {cells}"
            )
        law = super().on(basis, length, origin)
        return law if directions is self.directions else replace(law, directions=directions)

    def of_cells(self, cells: Tensor) -> Self:
        law = super().of_cells(cells)
        if len(self.frames) == 1:
            return law
        return replace(law, directions=self.frames[cells.to(self.frames.device)])

    def centred(self) -> Self:
        """Return the law with the rotation next to the mean of the frames of each cell."""
        law = super().centred()
        if self.frames.shape[1] == 1:
            return law
        U, _, V = torch.linalg.svd(self.frames.mean(1))
        return replace(law, directions=U @ V)

    @property
    def compiled_form(self) -> CompiledForm:
        return CompiledForm(self.matrix, self.fibres, self.frames)

    @property
    def constants(self) -> tuple[Any, ...]:
        return *self.matrix.constants, *self.fibres.constants

    @property
    def frames(self) -> Tensor:
        """Fibre frames, (E or 1, Q or 1, 3, 3) [-]."""
        given = self.directions
        if (frames := given if isinstance(given, Tensor) else given.constant()) is None:
            raise ValueError(
                f"directions = {type(given).__name__} must be evaluated on a body first; "
                "call FibreReinforced.on"
            )
        return frames if frames.ndim == 4 else frames[:, None]

    def energy(self, H: Tensor) -> Tensor:
        Q = self._rotation(H)
        return self.matrix.energy(H) + self.fibres.energy(Q.mT @ (2 * green_lagrange(H)) @ Q)

    def volumetric_energy(self, j: Tensor) -> Tensor:
        return self.matrix.volumetric_energy(j)

    def pressure(self, j: Tensor) -> Tensor:
        return self.matrix.pressure(j)

    @property
    def point_bulk(self) -> Tensor:
        """Twice the shear modulus at rest [-].

        The energy of the fibres depends on the volume too. Without this modulus, fibres under
        tension can invert points of a cell without a change of its projected volume.
        """
        return 2 * self.mu

    def response(self, E: Tensor) -> Response:
        isotropic, fibres = self.matrix.response(E), self._fibre_response(E)
        return Response(isotropic.stress + fibres.stress, isotropic.moduli + fibres.moduli)

    def stress(self, H: Tensor) -> Tensor:
        Q = self._rotation(H)
        e = components(Q.mT @ (2 * green_lagrange(H)) @ Q)
        local, _ = self.fibres.strain_derivatives(self.fibres.constants, e)
        S = Q @ _tensor(as_tensors(local, e)) @ Q.mT
        return self.matrix.stress(H) + S + H @ S

    def tangent(self, H: Tensor) -> Tensor:
        return self.matrix.tangent(H) + self._fibre_response(green_lagrange(H)).tangent(H)

    @property
    def mu(self) -> Tensor:
        """Shear modulus at rest, the average over all directions [-]."""
        normal, mixed = self._fibre_traces
        return self.matrix.mu + (3 * mixed - normal) / 30

    @property
    def lam(self) -> Tensor:
        """First Lame parameter at rest, the average over all directions [-].

        Source: Voigt (1889), Ann. Phys. 274: the average over all rotations of the moduli D has the
        D_iikk and D_ikik of D.
        """
        normal, mixed = self._fibre_traces
        return self.matrix.lam + (2 * normal - mixed) / 15

    @property
    def _fibre_traces(self) -> tuple[Tensor, Tensor]:
        """D_iikk and D_ikik of the moduli D of the fibres at rest, which no rotation changes."""
        matrix = _moduli(self.fibres.moduli_at_rest)
        return matrix[..., ::4, ::4].sum((-2, -1)), matrix.diagonal(dim1=-2, dim2=-1).sum(-1)

    def rest_stress(self, H: Tensor) -> Tensor:
        Q = self._rotation(H)
        strain = Q.mT @ (H + H.mT) @ Q / 2
        D = _moduli(self.fibres.moduli_at_rest).to(H)
        S = (D @ strain.flatten(-2)[..., None])[..., 0].unflatten(-1, (3, 3))
        return self.matrix.rest_stress(H) + Q @ S @ Q.mT

    def _rotation(self, H: Tensor) -> Tensor:
        """Return the frames of the points as H, (E, Q or 1, 3, 3), or (3, 3) if all are equal."""
        frames = self.frames.to(H)
        return frames[0, 0] if frames.shape[:2] == (1, 1) else frames

    def _fibre_response(self, E: Tensor) -> Response:
        """Return stress and moduli of the fibres at Green-Lagrange strains E (..., 3, 3)."""
        Q = self._rotation(E)
        e = components(Q.mT @ (2 * E) @ Q)
        S, D = self.fibres.strain_derivatives(self.fibres.constants, e)
        pairs = torch.einsum("...ik,...jl->...ijkl", Q, Q).flatten(-4, -3).flatten(-2)
        moduli = pairs @ _moduli(as_tensors(D, e)) @ pairs.mT
        moduli = moduli.unflatten(-2, (3, 3)).unflatten(-1, (3, 3))
        return Response(Q @ _tensor(as_tensors(S, e)) @ Q.mT, moduli)


def fibre_frames(material: Material, count: int) -> Tensor:
    """Return the fibre frames of the law of E cells, (E, Q or 1, 3, 3) [-]; NaN without fibres."""
    laws = [
        (law.frames, cells)
        for law, cells in material.groups(count)
        if isinstance(law, FibreReinforced)
    ]
    points = max((own.shape[1] for own, _ in laws), default=1)
    frames = torch.full((count, points, 3, 3), torch.nan, dtype=torch.float64)
    for own, cells in laws:
        frames[cells] = own
    return frames


def _tensor(parts: tuple[Tensor, ...]) -> Tensor:
    """Return the symmetric tensor (..., 3, 3) of six components."""
    return torch.stack([parts[v] for row in COMPONENT for v in row], -1).unflatten(-1, (3, 3))


def _moduli(D: tuple[Tensor, ...]) -> Tensor:
    """Return the matrix (..., 9, 9) of the pairs ij and kl of 21 moduli."""
    parts = iter(D)
    upper = {(v, w): next(parts) for v in range(6) for w in range(v, 6)}
    pairs = [v for row in COMPONENT for v in row]
    entries = [upper[min(v, w), max(v, w)] for v in pairs for w in pairs]
    return torch.stack(entries, -1).unflatten(-1, (9, 9))
