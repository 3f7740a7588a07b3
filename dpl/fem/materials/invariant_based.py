"""Laws of the invariants of C, which are compiled."""

from typing import Any

import torch
from torch import Tensor

from dpl.fem.materials.material import CompiledForm, Material, Response
from dpl.fem.materials.tensors import (
    dyad,
    green_lagrange,
    invariants,
    inverse_transpose,
    product,
    symmetric_product,
    trace,
    volume_change,
    with_axes,
)

Derivatives = tuple[Any, ...]  # see `InvariantBasedMaterial.invariant_derivatives`


class InvariantBasedMaterial(Material):
    """Law of the invariants, W(I1, I2, J) of C = F^T F, with its `invariant_derivatives`.

    `invariant_derivatives` is plain arithmetic on numbers of any kind: tensors here, SIMD vectors
    in `dpl.fem.assembly.element_loops`. With X = C^-1, the stress is

        S = (rest + 2 W2 i1) I - 4 W2 E - p (I - X),   I - X = 2 E X,

    where rest, W2 and p are the first of these derivatives. No terms cancel at zero strain.
    """

    @property
    def compiled_form(self) -> CompiledForm:
        return CompiledForm(self)

    @staticmethod
    def invariant_derivatives(c: Any, i1: Any, i2: Any, j: Any, log_j: Any, m1: Any) -> Derivatives:
        """Return (rest, W2, p, W11, W12, W22, J W1J, J W2J, J p_J).

        Indices are derivatives, p = J W_J, and rest = p + 2 W1 + 4 W2, which is zero at rest and
        must be given in a form that is small there.

        Args:
            c: `constants`.
            i1, i2, j: I1 - 3, I2 - 3, J - 1.
            log_j: ln J.
            m1: J^(-2/3) - 1.
        """
        raise NotImplementedError

    def response(self, E: Tensor) -> Response:
        square = invariants(2 * E)[2]
        return self._response(E, square / (1 + (1 + square).sqrt()))

    def tangent(self, H: Tensor) -> Tensor:
        """Return dP/dF, see `Material.tangent`; J is that of H, with its sign."""
        return self._response(green_lagrange(H), volume_change(H)).tangent(H)

    def _response(self, E: Tensor, j: Tensor) -> Response:
        """Return stress and moduli at strains E where J = 1 + j."""
        e = 2 * E
        eye = torch.eye(3, dtype=E.dtype, device=E.device)
        i1, X = trace(e), inverse_transpose(e, volume_change(e))
        S, invariant_derivatives = self._stress(e, j)
        _, W2, p, *curvatures = (with_axes(s, 4) for s in invariant_derivatives)
        W11, W12, W22, W1J, W2J, pJ = curvatures
        T1, T2 = 2 * eye.expand_as(e), 2 * ((2 + i1)[..., None, None] * eye - e)
        D = W11 * dyad(T1, T1) + W22 * dyad(T2, T2) + pJ * dyad(X, X)
        for factor, A, B in ((W12, T1, T2), (W1J, T1, X), (W2J, T2, X)):
            D = D + factor * (dyad(A, B) + dyad(B, A))
        D = D + 4 * W2 * (dyad(eye, eye) - symmetric_product(eye)) - 2 * p * symmetric_product(X)
        return Response(S, D)

    def stress(self, H: Tensor) -> Tensor:
        """Return the first Piola-Kirchhoff stress, see `Material.stress`.

        J is that of H, with its sign: inverted, a law with ln J has no stress (NaN).
        """
        S, _ = self._stress(2 * green_lagrange(H), volume_change(H))
        return S + product(H, S)

    def _stress(self, e: Tensor, j: Tensor) -> tuple[Tensor, Derivatives]:
        """Return S (..., 3, 3) at e = C - I where J = 1 + j, and the derivatives that make it."""
        i1, second, square = invariants(e)
        log_j = torch.log1p(j)
        m1 = torch.expm1(-2 / 3 * log_j)
        found = self.invariant_derivatives(self.constants, i1, 2 * i1 + second, j, log_j, m1)
        rest, W2, p = (with_axes(s, 2) for s in found[:3])
        S = (rest + 2 * W2 * i1[..., None, None]) * torch.eye(3, dtype=e.dtype, device=e.device)
        if isinstance(W2, Tensor) or W2:
            S = S - 2 * W2 * e
        if isinstance(p, Tensor) or p:  # else a collapsed body, C singular, has a stress too
            S = S - p * product(e, inverse_transpose(e, square))
        return S, found
