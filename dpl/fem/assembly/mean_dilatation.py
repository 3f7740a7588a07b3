"""Mean dilatation: the volumetric energy takes the volume ratio of a cell as a low polynomial.

The energy of a law is W(F) - U(J) + U(Jm). Jm is the projection of J = det F onto polynomials of
the place in each cell: constants in linear quadrilaterals and hexahedra and in quadratic triangles
and tetrahedra, linear functions in quadratic quadrilaterals and hexahedra. U(J) is the energy of a
change of volume alone, see `Material.volumetric_energy`, minus s/4 (J^2 - 1 - 2 ln J), so that a
bulk modulus s, see `CellVolumes.point_bulk`, stays at the points. Nearly incompressible bodies then
do not lock. For a law of small strains J - 1 is tr H, and the energy of s is s/2 (tr H)^2.

Source: Nagtegaal, Parks, Rice (1974), CMAME 4; Simo, Taylor, Pister (1985), CMAME 51, section 3;
Sussman, Bathe (1987), Comput. Struct. 26, the elements 4/1, 9/3, 8/1 and 27/4.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpl.fem.materials.material import Material, Response
from dpl.fem.materials.tensors import (
    cofactor,
    dyad,
    green_lagrange,
    invariants,
    inverse_transpose,
    symmetric_product,
    trace,
    volume_change,
)

# dP/dF at the points (B, E, Q, 3, 3, 3, 3) [-]. With mean dilatation it lacks the volumetric
# stiffness, and two parts follow: dJ/dF (B, E, Q, 3, 3), and the volumetric stiffness between the
# coefficients of dJ/dF (B, E, M, M) [-]
Tangent = tuple[Tensor, ...]
# Bulk modulus over shear modulus that stays at the points of quadratic triangles and tetrahedra
# [-]. With 0 coarse meshes of Cook's membrane are too soft, with 1 bonded blocks are too stiff.
POINT_SHEAR = 0.5


class CellVolumes(NamedTuple):
    """Polynomials of the volume change in the cells of a body.

    Attributes:
        functions: Their values, orthonormal in each cell, (E or 1, Q, M), see `polynomials`.
        dV: Volumes of the quadrature points, (E or 1, Q) [-].
        point_shear: Part of the shear modulus that stays at the points as a bulk modulus [-].
    """

    functions: Tensor
    dV: Tensor
    point_shear: float = 0.0

    def point_bulk(self, material: Material) -> Tensor:
        """Return the bulk modulus over E that stays at the points [-]."""
        return (material.point_bulk + self.point_shear * material.mu).to(self.functions)

    def coefficients(self, values: Tensor) -> Tensor:
        """Return the coefficients, (B, E, M), of the projection of values (B, E, Q)."""
        return ((values * self.dV)[..., None, :] @ self.functions)[..., 0, :]

    def at_points(self, coefficients: Tensor) -> Tensor:
        """Return the values at the points, (B, E, Q), of coefficients (B, E, M)."""
        return (self.functions @ coefficients[..., None])[..., 0]

    def project(self, values: Tensor) -> Tensor:
        """Return the projection of values (B, E, Q) at the points, (B, E, Q)."""
        return self.at_points(self.coefficients(values))

    def matrices(self, values: Tensor) -> Tensor:
        """Return the matrices of a factor (B, E, Q) between functions, (B, E, M, M)."""
        weighted = self.functions * (values * self.dV)[..., None]
        return weighted.mT @ self.functions


def polynomials(points: Tensor, dV: Tensor, *, linear: bool) -> Tensor:
    """Return constants, or with `linear` linear functions, orthonormal in cells, (E or 1, Q, M).

    The quadrature points are (E or 1, Q, D) [-], their volumes dV (E or 1, Q) [-].
    """
    one = torch.ones_like(dV)[..., None]
    offsets = points - points.mean(1, keepdim=True)
    columns = torch.cat([one, offsets], dim=-1) if linear else one
    root = dV.sqrt()[..., None]
    return (torch.linalg.qr(root * columns).Q / root).contiguous()


@dataclass(frozen=True, eq=False)
class PointwiseLaw:
    """A law whose stress at a quadrature point depends on the displacement gradient there.

    Methods take displacement gradients H (B, E, Q, 3, 3) [-]. Mixed integration points have the
    strain of u minus a gap, (B, E, Q, 3, 3) [-].

    Attributes:
        material: The law.
    """

    material: Material

    def energy(self, H: Tensor) -> Tensor:
        """Return the energy density over E, (B, E, Q) [-]."""
        return self.material.energy(H)

    def stress(self, H: Tensor) -> Tensor:
        """Return the stress conjugate to H over E, (B, E, Q, 3, 3) [-]."""
        return self.material.stress(H)

    def tangent(self, H: Tensor) -> Tangent:
        """Return the parts of the tangent, see `Tangent`."""
        return (self.material.tangent(H),)

    def mixed_system(self, H: Tensor, gap: Any) -> tuple[Tensor, Tangent, Tensor]:
        """Return stress, tangent, and the least det C - 1 (B,) [-], of mixed integration points.

        Source: Magisano, Leonetti, Garcea (2017), CMAME 313, section 3.
        """
        strain = green_lagrange(H) - gap
        response = self.material.response(strain)
        S = response.stress + response.product(gap)
        return S + H @ S, (response.tangent(H),), volume_change(2 * strain).flatten(1).amin(1)

    def gap_after(self, gap: Any, length: float, update: Tensor, H: Tensor | None) -> Any:
        """Return the gap after length * update, gradients as H, see `Problem.update_strain_gap`.

        H after the step is needed with mean dilatation only. A gap of None is zero.
        """
        wider = length**2 * update.mT @ update / 2
        return wider if gap is None else (1 - length) * gap + wider


class MixedGap(NamedTuple):
    """Gap of strains, (B, E, Q, 3, 3), and of the coefficients of the projected J, (B, E, M)."""

    strain: Tensor
    volume: Tensor


@dataclass(frozen=True, eq=False)
class MeanDilatation(PointwiseLaw):
    """A law whose volumetric energy U takes the projected volume ratio of a cell.

    Attributes:
        volumes: Polynomials of the volume change in the cells.
    """

    volumes: CellVolumes

    def energy(self, H: Tensor) -> Tensor:
        j = self._change_of_volume(H)
        mean = self._volumetric_energy(self.volumes.project(j))
        return self.material.energy(H) - self._volumetric_energy(j) + mean

    def stress(self, H: Tensor) -> Tensor:
        j, volumes = self._change_of_volume(H), self.volumes
        p = volumes.project(self._pressure(volumes.project(j))) - self._pressure(j)
        return self.material.stress(H) + p[..., None, None] * self._slope(H)

    def tangent(self, H: Tensor) -> Tangent:
        j, volumes = self._change_of_volume(H), self.volumes
        own, own_modulus = self._pressure_and_modulus(j)
        mean, mean_modulus = self._pressure_and_modulus(volumes.project(j))
        slope = self._slope(H)
        A = self.material.tangent(H) - _at_moduli(own_modulus) * dyad(slope, slope)
        if self.material.finite:
            minors = dyad(slope, slope)
            curvature = (minors - minors.transpose(-3, -1)) / _at_moduli(1 + j)  # d2J/dF2
            A = A + _at_moduli(volumes.project(mean) - own) * curvature
        return A, slope, volumes.matrices(mean_modulus)

    def mixed_system(self, H: Tensor, gap: MixedGap) -> tuple[Tensor, Tangent, Tensor]:
        """Return stress, tangent, and the least det C - 1 or J - 1 of points and cells.

        Each cell eliminates the coefficients of a volume change and of a pressure, each point a
        strain, on which all but the volumetric energy depends. The equations are linear in the
        pressure, so that the number of iterations does not grow with the bulk modulus.
        """
        E, volumes = green_lagrange(H), self.volumes
        strain, change = E - gap.strain, volume_change(H)
        law = self._without_volume(strain)
        mean = volumes.at_points(volumes.coefficients(change) - gap.volume)
        p, modulus = self._pressure_and_modulus(mean)
        ahead = p + modulus * volumes.at_points(gap.volume)
        X = inverse_transpose(2 * E, invariants(2 * E)[2])
        unit = Response((1 + change)[..., None, None] * X, _volume_moduli(X, 1 + change))
        p, ahead = volumes.project(p), volumes.project(ahead)
        S = law.stress + law.product(gap.strain) + ahead[..., None, None] * unit.stress
        at_points = Response(
            law.stress + p[..., None, None] * unit.stress, law.moduli + _at_moduli(p) * unit.moduli
        )
        lowest = torch.minimum(volume_change(2 * strain), mean).flatten(1).amin(1)
        parts = at_points.tangent(H), self._slope(H), volumes.matrices(modulus)
        return S + H @ S, parts, lowest

    def gap_after(
        self, gap: MixedGap | None, length: float, update: Tensor, H: Tensor | None
    ) -> MixedGap:
        assert H is not None
        step = length * update
        # J(F) - J(F - D) - cof(F - D) : D = F : cof D - 2 det D
        minors = cofactor(step)
        F = H + torch.eye(3, dtype=H.dtype, device=H.device)
        third = (step * minors).sum((-2, -1)) / 3  # det D
        volume = self.volumes.coefficients((F * minors).sum((-2, -1)) - 2 * third)
        strain = super().gap_after(gap and gap.strain, length, update, H)
        return MixedGap(strain, volume if gap is None else (1 - length) * gap.volume + volume)

    def _change_of_volume(self, H: Tensor) -> Tensor:
        """Return J - 1, for a law of small strains tr H, (B, E, Q) [-]."""
        return volume_change(H) if self.material.finite else trace(H)

    def _slope(self, H: Tensor) -> Tensor:
        """Return dJ/dF, for a law of small strains I, (B, E, Q, 3, 3) [-]."""
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        return cofactor(H + eye) if self.material.finite else eye.expand_as(H)

    def _volumetric_energy(self, j: Tensor) -> Tensor:
        """Return U at J - 1 = j, (B, E, Q) [-]."""
        own = j * (2 + j) / 4 - torch.log1p(j) / 2 if self.material.finite else j.square() / 2
        return self.material.volumetric_energy(j) - self.volumes.point_bulk(self.material) * own

    def _pressure(self, j: Tensor) -> Tensor:
        """Return U' at J - 1 = j, (B, E, Q) [-]."""
        own = j * (2 + j) / (2 + 2 * j) if self.material.finite else j
        return self.material.pressure(j) - self.volumes.point_bulk(self.material) * own

    def _pressure_and_modulus(self, j: Tensor) -> tuple[Tensor, Tensor]:
        """Return U' and U'' at J - 1 = j, (B, E, Q) [-]."""
        p, modulus, *_ = torch.func.jvp(self._pressure, (j,), (torch.ones_like(j),))
        return p, modulus

    def _without_volume(self, E: Tensor) -> Response:
        """Return stress and moduli of W - U at strains E, (B, E, Q, 3, 3) [-]."""
        response, square = self.material.response(E), invariants(2 * E)[2]
        j = square / (1 + (1 + square).sqrt())
        p, modulus = self._pressure_and_modulus(j)
        J, X = 1 + j, inverse_transpose(2 * E, square)
        moduli = _at_moduli(p) * _volume_moduli(X, J) + _at_moduli(modulus * J * J) * dyad(X, X)
        return Response(response.stress - (p * J)[..., None, None] * X, response.moduli - moduli)


def _volume_moduli(X: Tensor, J: Tensor) -> Tensor:
    """Return the derivative of J X with respect to E, X = C^-1, (B, E, Q, 3, 3, 3, 3) [-]."""
    return _at_moduli(J) * (dyad(X, X) - 2 * symmetric_product(X))


def _at_moduli(values: Tensor) -> Tensor:
    """Return values of points as factors of moduli."""
    return values[..., None, None, None, None]
