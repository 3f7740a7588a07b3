"""Prediction of an unrolled reduced solver as tensor operations: batches, gradients, graphs.

The operations are those of `dpl.models.unrolled.loops` on the same arrays by parity. The batch is
the last axis, so that one load is a column of products of matrices.
"""

from typing import Any

import torch
from torch import Tensor

from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.material import Material
from dpl.models.unrolled import features
from dpl.models.unrolled.fit import limit_step

Tensors = Any  # `dpl.models.unrolled.loops.ModelArrays` of tensors
BOTH = (0, 1)  # axes of coordinates by parity, (M, r, B)


def nonlinear_coordinates(model: Tensors, law: Material, linear: Tensor) -> tuple[Tensor, Tensor]:
    """Return coordinates (M, r, B) of nonlinear displacements, and sizes (B, K + 2).

    The sizes are the norms of the linear coordinates and of the correction by each map.

    Args:
        model: The arrays of a model, as tensors.
        law: The law of the sample cells in the order of the arrays.
        linear: Coordinates of Galerkin linear solutions, (M, r, B).
    """
    H = _gradients(model, linear)
    proposed = _coordinates(model, model.first_map, model.first_signs, features.rotated_strain(H))
    c = step = limit_step(proposed, linear, model.limits[0], BOTH)
    steps = [linear, step]
    for matrix, limit in zip(model.maps, model.limits[1:], strict=True):
        stress = features.unbalanced_stress(law, _gradients(model, linear + c), H)[:, :, 0]
        step = limit_step(_coordinates(model, matrix, model.map_signs, stress), step, limit, BOTH)
        c = c + step
        steps.append(step)
    return c, torch.stack(steps).norm(dim=(1, 2)).T


def _gradients(model: Tensors, c: Tensor) -> Tensor:
    """Return H at the sample cells, (B, C, 1, 3, 3), of coordinates (M, r, B)."""
    characters = model.orbits.characters
    parts = model.gradients.mT.to(c) @ c
    joined: Tensor = characters.T @ parts.flatten(1)
    images = model.entry_signs[..., None] * joined.view_as(parts)  # (M, b, B)
    H: Tensor = model.rest[..., None] + images
    blocks = H.unflatten(1, (-1, 9, SIMD_WIDTH))
    return blocks.permute(4, 0, 1, 3, 2).reshape(H.shape[-1], -1, 1, 3, 3)


def _coordinates(model: Tensors, matrix: Tensor, signs: Tensor, found: Tensor) -> Tensor:
    """Return coordinates (M, r, B) of F features (B, C, F, 3, 3) at the sample cells."""
    characters = model.orbits.characters
    shape = found.shape[0], len(signs), -1, SIMD_WIDTH, found[0, 0].numel()
    rows = found.reshape(shape).permute(1, 2, 4, 3, 0).flatten(1, 3)  # (M, F b, B)
    images = signs[..., None] * rows
    parts: Tensor = characters @ images.flatten(1)
    return matrix.to(images) @ parts.view_as(images)
