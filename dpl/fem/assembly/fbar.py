"""Mean dilatation (variational F-bar): the points of a cell share its mean volume ratio.

Source: Nagtegaal, Parks, Rice (1974), CMAME 4; Simo, Taylor, Pister (1985), CMAME 51, section 3.
"""

import torch
from torch import Tensor

from dpl.fem.materials.material import Material
from dpl.fem.materials.tensors import inverse_transpose, volume_change


def fbar_gradient(material: Material, H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return the displacement gradient H, (B, E, Q, 3, 3) [-], with the mean volume ratio.

    The volumes dV of the points are (E or 1, Q) [-].
    """
    return _fbar(H, dV, dim)[0] if material.finite else _bbar(H, dV, dim)


def _bbar(H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return H with the mean trace of the cell, in 2D that of the plane (B-bar).

    Source: Hughes (1980), Int. J. Numer. Methods Eng. 15.
    """
    plane = torch.diag(torch.arange(3, device=H.device) < dim).to(H.dtype)
    trace = (H * plane).sum((-2, -1))
    mean = (trace * dV).sum(-1, keepdim=True) / dV.sum(-1, keepdim=True)
    return H + ((mean - trace) / dim)[..., None, None] * plane


def _fbar(H: Tensor, dV: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return H of (mean J / J)^(1/D) F, this factor, and a mask (3, 3) of the scaled components.

    In plane strain the components out of the plane are not scaled.
    """
    plane = torch.zeros(3, 3, dtype=H.dtype, device=H.device)
    plane[:dim, :dim] = 1.0
    change = volume_change(H)
    mean = (change * dV).sum(-1, keepdim=True) / dV.sum(-1, keepdim=True)
    change_of_F = torch.expm1((torch.log1p(mean) - torch.log1p(change)) / dim)
    F = (H + torch.eye(3, dtype=H.dtype, device=H.device)) * plane
    return H + change_of_F[..., None, None] * F, 1 + change_of_F, plane


def fbar_stress(material: Material, H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return the stress conjugate to H, (B, E, Q, 3, 3) [-]; arguments as in `fbar_gradient`."""
    if not material.finite:
        stress = material.stress(_bbar(H, dV, dim))
        return _bbar(stress, dV, dim)  # the averaging is self-adjoint
    averaged, ratio, plane = _fbar(H, dV, dim)
    change = volume_change(H)
    stress = material.stress(averaged)
    F = averaged + torch.eye(3, dtype=H.dtype, device=H.device)
    work = (stress * F * plane).sum((-2, -1))  # P : F, (B, E, Q)
    total = (work * dV).sum(-1, keepdim=True)
    shared = total * (1 + change) / ((1 + change) * dV).sum(-1, keepdim=True)
    pressure = ((shared - work) / dim)[..., None, None]
    cofactor = inverse_transpose(H, change) * plane
    return ratio[..., None, None] * stress * plane + pressure * cofactor
