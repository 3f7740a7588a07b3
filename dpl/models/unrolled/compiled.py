"""Arrays of the compiled prediction of an unrolled reduced solver."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.assembly.kernels import constants_of
from dpl.fem.assembly.numba_laws import Law
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.invariant_based import InvariantBasedMaterial
from dpl.fem.parity import SignedOrbits
from dpl.models.linear_response import LinearResponse
from dpl.models.unrolled.loops import SOURCES, ModelArrays

LawArguments = tuple[Law, NDArray[np.float64], float]


def law_arguments(law: InvariantBasedMaterial) -> LawArguments:
    """Return a law as the first arguments of `predict`: key, constants, finite.

    Its constants are followed by mu and lambda, (1, n + 2) or (C, n + 2).

    Args:
        law: The law of the sample cells in the order of the loop.
    """
    rows = [constants_of(law)[0], *(one.reshape(-1, 1).numpy() for one in (law.mu, law.lam))]
    count = max(map(len, rows))
    constants = np.concatenate([np.broadcast_to(row, (count, row.shape[1])) for row in rows], 1)
    key = Law.of(law.compiled_form, SOURCES)
    return key, constants, float(law.finite)


def model_arrays(
    linear: LinearResponse, images: Tensor, fitted: Mapping[str, Tensor]
) -> tuple[ModelArrays, Tensor]:
    """Arrange the buffers of a model by parity.

    Args:
        linear: Linear response of the body.
        images: Position to which each symmetry maps each sample cell, (G, C).
        fitted: Buffers of `dpl.models.Unrolled` by name.

    Returns:
        The arrays, and the position among the sample cells of each cell of the loops, (C,).
    """
    parities, fields, _ = linear.form
    images = images[parities.members]
    one, two = (SignedOrbits.of_tensors(parities, images, k, SIMD_WIDTH) for k in (1, 2))
    parity, gradients, maps = fitted["parity"], fitted["gradients"], fitted["maps"]
    own = [(parity == p).nonzero()[:, 0] for p in range(len(parities.members))]
    most = max(map(len, own))

    def by_parity(orbits: SignedOrbits, matrix: Tensor) -> Tensor:
        """Return the columns of a matrix (n, R) at one value of each orbit, (M, r, m)."""
        rows = torch.where(orbits.weight[:, None] > 0, matrix[orbits.images[0]], 0.0).mT
        parts = (rows[columns] for columns in own)
        return torch.stack([pad(part, (0, 0, 0, most - len(part))) for part in parts])

    flat = gradients.flatten(1).T  # (C D D, R + 1)
    none = torch.zeros(0, len(own), most, two.images.shape[1])
    columns = [pad(part, (0, most - len(part)), value=len(parity)) for part in own]
    arrays = ModelArrays(
        orbits=linear.orbits,
        columns=torch.stack(columns).cpu().numpy(),
        modes=_single(by_parity(fields, fitted["modes"])),
        gradients=_single(by_parity(one, flat[:, :-1])),
        rest=_double(torch.where(one.weight > 0, flat[one.images, -1], 0.0)),
        entry_signs=_double(one.sign),
        first_signs=_double(one.sign * one.weight),
        map_signs=_double(two.sign * two.weight),
        first_map=_single(by_parity(one, fitted["first_map"])),
        maps=_single(torch.stack([by_parity(two, B) for B in maps]) if len(maps) else none),
        limits=_double(fitted["limits"]),
    )
    blocks = one.images.unflatten(1, (-1, 9, SIMD_WIDTH))
    return arrays, blocks[:, :, 0].flatten() // gradients[0, 0].numel()


def _double(tensor: Tensor) -> NDArray[np.float64]:
    return np.ascontiguousarray(tensor.detach().cpu().double().numpy())


def _single(tensor: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().cpu().float().numpy())
