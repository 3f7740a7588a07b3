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
ONE_TENSOR = "gradients", "rest", "entry_signs", "first_signs", "first_map"
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
    rest = features.rest_stress(law, H)
    strain = features.rotated_strain(H)
    proposed = _coordinates(model, model.first_map, model.first_signs, strain)
    c = step = limit_step(proposed, linear, model.limits[0], BOTH)
    steps = [linear, step]
    for matrix, limit in zip(model.maps, model.limits[1:], strict=True):
        stress = features.unbalanced_stress(law, _gradients(model, linear + c), rest)
        step = limit_step(_coordinates(model, matrix, model.map_signs, stress), step, limit, BOTH)
        c = c + step
        steps.append(step)
    return c, torch.stack(steps).norm(dim=(1, 2)).T


def in_rows(model: Tensors) -> Tensors:
    """Return a model whose b entries at the sample cells are 9 rows of all cells, or 18."""

    def moved(values: Tensor, count: int) -> Tensor:
        return values.unflatten(-1, (-1, count, SIMD_WIDTH)).transpose(-3, -2).flatten(-3)

    one = {name: moved(getattr(model, name), 9) for name in ONE_TENSOR}
    two = {name: moved(getattr(model, name), 18) for name in ("map_signs", "maps")}
    return model._replace(**one, **two)


def _gradients(model: Tensors, c: Tensor) -> Tensor:
    """Return H at the sample cells in rows, (B, M, 9, C / M), of coordinates (M, r, B)."""
    parts = (model.gradients.mT.to(c) @ c).permute(2, 0, 1)  # (B, M, b)
    images = model.entry_signs * (model.orbits.characters.T @ parts)
    H: Tensor = (model.rest + images).unflatten(2, (9, -1))
    return H


def _coordinates(model: Tensors, matrix: Tensor, signs: Tensor, rows: Tensor) -> Tensor:
    """Return coordinates (M, r, B) of features at the sample cells in rows, (B, M, k, C / M)."""
    parts: Tensor = model.orbits.characters @ (signs * rows.flatten(2))
    return matrix.to(parts) @ parts.permute(1, 2, 0)
