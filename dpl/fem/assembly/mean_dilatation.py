"""Mean dilatation: the volumetric energy takes the volume ratio of a cell as a low polynomial.

The energy of a law is W(F) - U(J) + U(Jm). Jm is the projection of J = det F onto polynomials of
the place in each cell: constants in linear quadrilaterals and hexahedra, linear functions in
quadratic ones. U(J) is the energy of a change of volume alone, see `Material.volumetric_energy`,
minus s/4 (J^2 - 1 - 2 ln J), so that a bulk modulus s, see `Material.point_bulk`, stays at the
points. Nearly incompressible bodies then do not lock. For a law of small strains J - 1 is tr H, and
the energy of s is s/2 (tr H)^2.

Source: Nagtegaal, Parks, Rice (1974), CMAME 4; Simo, Taylor, Pister (1985), CMAME 51, section 3;
Sussman, Bathe (1987), Comput. Struct. 26, the elements 4/1, 9/3, 8/1 and 27/4.
"""

from typing import NamedTuple

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

# dP/dF at the points without the volumetric stiffness (B, E, Q, 3, 3, 3, 3), dJ/dF (B, E, Q, 3, 3),
# and the volumetric stiffness between the coefficients of dJ/dF (B, E, M, M) [-]
Tangent = tuple[Tensor, Tensor, Tensor]


class CellVolumes(NamedTuple):
    """Polynomials of the volume change in the cells of a body.

    Attributes:
        functions: Their values, orthonormal in each cell, (E or 1, Q, M).
        dV: Volumes of the quadrature points, (E or 1, Q) [-].
    """

    functions: Tensor
    dV: Tensor

    @classmethod
    def of(cls, points: Tensor, dV: Tensor, *, linear: bool) -> "CellVolumes":
        """Return constants, or with `linear` linear functions, in cells.

        Args:
            points: Quadrature points, (E or 1, Q, D) [-].
            dV: Their volumes, (E or 1, Q) [-].
            linear: False for constants.
        """
        one = torch.ones_like(dV)[..., None]
        offsets = points - points.mean(1, keepdim=True)
        columns = torch.cat([one, offsets], dim=-1) if linear else one
        root = dV.sqrt()[..., None]
        return cls((torch.linalg.qr(root * columns).Q / root).contiguous(), dV)

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


class MixedGap(NamedTuple):
    """Gap of the mixed integration points of a body with mean dilatation.

    Attributes:
        strain: Strain of u minus that of the points, (B, E, Q, 3, 3) [-].
        volume: Coefficients of the projected J of u minus those of the cells, (B, E, M).
    """

    strain: Tensor
    volume: Tensor


def change_of_volume(material: Material, H: Tensor) -> Tensor:
    """Return J - 1, for a law of small strains tr H, (B, E, Q) [-]."""
    return volume_change(H) if material.finite else trace(H)


def energy(material: Material, H: Tensor, volumes: CellVolumes) -> Tensor:
    """Return the energy density over E at H (B, E, Q, 3, 3), (B, E, Q) [-]."""
    j = change_of_volume(material, H)
    mean = _projected_energy(material, volumes.project(j))
    return material.energy(H) - _projected_energy(material, j) + mean


def stress(material: Material, H: Tensor, volumes: CellVolumes) -> Tensor:
    """Return the stress conjugate to H over E, (B, E, Q, 3, 3) [-]."""
    j = change_of_volume(material, H)
    p = volumes.project(_pressure(material, volumes.project(j))) - _pressure(material, j)
    return material.stress(H) + p[..., None, None] * _slope(material, H)


def tangent(material: Material, H: Tensor, volumes: CellVolumes) -> Tangent:
    """Return the parts of the tangent at H (B, E, Q, 3, 3), see `Tangent`."""
    j = change_of_volume(material, H)
    own, own_modulus = _pressure_and_modulus(material, j)
    mean, mean_modulus = _pressure_and_modulus(material, volumes.project(j))
    slope = _slope(material, H)
    A = material.tangent(H) - _at_moduli(own_modulus) * dyad(slope, slope)
    if material.finite:
        minors = dyad(slope, slope)
        curvature = (minors - minors.transpose(-3, -1)) / _at_moduli(1 + j)  # d2J/dF2
        A = A + _at_moduli(volumes.project(mean) - own) * curvature
    return A, slope, volumes.matrices(mean_modulus)


def mixed_system(
    material: Material, H: Tensor, gap: MixedGap, volumes: CellVolumes
) -> tuple[Tensor, Tangent]:
    """Return the stress conjugate to H and the tangent with mixed integration points.

    Each cell eliminates the coefficients of a volume change and of a pressure, each point a strain,
    on which all but the volumetric energy depends. The equations are linear in the pressure, so
    that the number of iterations does not grow with the bulk modulus.
    """
    E = green_lagrange(H)
    law = _without_volume(material, E - gap.strain)
    change = volume_change(H)
    mean = volumes.coefficients(change) - gap.volume
    p, modulus = _pressure_and_modulus(material, volumes.at_points(mean))
    ahead = p + modulus * volumes.at_points(gap.volume)
    X = inverse_transpose(2 * E, invariants(2 * E)[2])
    unit = Response((1 + change)[..., None, None] * X, _volume_moduli(X, 1 + change))
    p, ahead = volumes.project(p), volumes.project(ahead)
    S = law.stress + law.product(gap.strain) + ahead[..., None, None] * unit.stress
    at_points = Response(
        law.stress + p[..., None, None] * unit.stress, law.moduli + _at_moduli(p) * unit.moduli
    )
    tangent = at_points.tangent(H), _slope(material, H), volumes.matrices(modulus)
    return S + H @ S, tangent


def volume_gap(H: Tensor, update: Tensor, volumes: CellVolumes) -> Tensor:
    """Return the part of the projected J that a step changes nonlinearly, (B, E, M).

    Args:
        H: After the step, (B, E, Q, 3, 3) [-].
        update: Change of H, (B, E, Q, 3, 3) [-].
        volumes: Polynomials of the cells.
    """
    # J(F) - J(F - D) - cof(F - D) : D = F : cof D - 2 det D
    minors = cofactor(update)
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    third = (update * minors).sum((-2, -1)) / 3  # det D
    return volumes.coefficients((F * minors).sum((-2, -1)) - 2 * third)


def _slope(material: Material, H: Tensor) -> Tensor:
    """Return dJ/dF, for a law of small strains I, (B, E, Q, 3, 3) [-]."""
    eye = torch.eye(3, dtype=H.dtype, device=H.device)
    return cofactor(H + eye) if material.finite else eye.expand_as(H)


def _projected_energy(material: Material, j: Tensor) -> Tensor:
    """Return U at J - 1 = j, (B, E, Q) [-]."""
    own = j * (2 + j) / 4 - torch.log1p(j) / 2 if material.finite else j.square() / 2
    return material.volumetric_energy(j) - material.point_bulk * own


def _pressure(material: Material, j: Tensor) -> Tensor:
    """Return U' at J - 1 = j, (B, E, Q) [-]."""
    own = j * (2 + j) / (2 + 2 * j) if material.finite else j
    return material.pressure(j) - material.point_bulk * own


def _pressure_and_modulus(material: Material, j: Tensor) -> tuple[Tensor, Tensor]:
    """Return U' and U'' at J - 1 = j, (B, E, Q) [-]."""
    p, modulus, *_ = torch.func.jvp(lambda j: _pressure(material, j), (j,), (torch.ones_like(j),))
    return p, modulus


def _without_volume(material: Material, E: Tensor) -> Response:
    """Return stress and moduli of W - U at strains E, (B, E, Q, 3, 3) [-]."""
    response, square = material.response(E), invariants(2 * E)[2]
    j = square / (1 + (1 + square).sqrt())
    p, modulus = _pressure_and_modulus(material, j)
    J, X = 1 + j, inverse_transpose(2 * E, square)
    moduli = _at_moduli(p) * _volume_moduli(X, J) + _at_moduli(modulus * J * J) * dyad(X, X)
    return Response(response.stress - (p * J)[..., None, None] * X, response.moduli - moduli)


def _volume_moduli(X: Tensor, J: Tensor) -> Tensor:
    """Return the derivative of J X with respect to E, X = C^-1, (B, E, Q, 3, 3, 3, 3) [-]."""
    return _at_moduli(J) * (dyad(X, X) - 2 * symmetric_product(X))


def _at_moduli(values: Tensor) -> Tensor:
    """Return values of points as factors of moduli."""
    return values[..., None, None, None, None]
