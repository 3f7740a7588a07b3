"""Mean dilatation: the points of a cell share its mean volume ratio (variational F-bar).

Source: Nagtegaal, Parks, Rice (1974), CMAME 4; Simo, Taylor, Pister (1985), CMAME 51, section 3.
"""

import torch
from torch import Tensor

from dpl.fem.materials.material import InvariantBasedMaterial, Material
from dpl.fem.materials.tensors import inverse_transpose, volume_change


def fbar_gradient(material: Material, H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return the displacement gradient that a law sees, (B, E, Q, 3, 3) [-].

    Args:
        material: The law.
        H: Displacement gradient, (B, E, Q, 3, 3) [-].
        dV: Volumes of the points, (E or 1, Q) [-].
        dim: D.
    """
    return _grown(H, dV, dim)[0] if finite(material) else _swollen(H, dV, dim)


def finite(material: Material) -> bool:
    """Return whether a law is one of finite strain."""
    return not isinstance(material, InvariantBasedMaterial) or material.finite


def _swollen(H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return H with the cell's mean trace, in the plane: B-bar, for linear elasticity.

    Source: Hughes (1980), Int. J. Numer. Methods Eng. 15.
    """
    plane = torch.diag(torch.arange(3, device=H.device) < dim).to(H.dtype)
    swelling = (H * plane).sum((-2, -1))
    mean = (swelling * dV).sum(-1, keepdim=True) / dV.sum(-1, keepdim=True)
    return H + ((mean - swelling) / dim)[..., None, None] * plane


def _grown(H: Tensor, dV: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient that has the cell's mean det F, the factor on F, and what it acts on.

    F -> (mean J / J)^(1/D) F, in the plane for plane strain.
    """
    plane = torch.zeros(3, 3, dtype=H.dtype, device=H.device)
    plane[:dim, :dim] = 1.0
    change = volume_change(H)
    mean = (change * dV).sum(-1, keepdim=True) / dV.sum(-1, keepdim=True)
    growth = torch.expm1((torch.log1p(mean) - torch.log1p(change)) / dim)
    F = (H + torch.eye(3, dtype=H.dtype, device=H.device)) * plane
    return H + growth[..., None, None] * F, 1 + growth, plane


def fbar_stress(material: Material, H: Tensor, dV: Tensor, dim: int) -> Tensor:
    """Return the stress that does work on H, (B, E, Q, 3, 3) [-]; see `fbar_gradient`."""
    if not finite(material):
        stress = material.stress(_swollen(H, dV, dim))
        return _swollen(stress, dV, dim)  # the average is its own adjoint
    averaged, ratio, plane = _grown(H, dV, dim)
    change = volume_change(H)
    stress = material.stress(averaged)
    F = averaged + torch.eye(3, dtype=H.dtype, device=H.device)
    work = (stress * F * plane).sum((-2, -1))  # by a change of all stretches, (B, E, Q)
    total = (work * dV).sum(-1, keepdim=True)
    shared = total * (1 + change) / ((1 + change) * dV).sum(-1, keepdim=True)
    pressure = ((shared - work) / dim)[..., None, None]
    turned = inverse_transpose(H, change) * plane
    return ratio[..., None, None] * stress * plane + pressure * turned
