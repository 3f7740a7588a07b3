"""Generalised minimal residual method, for matrices with a small unsymmetric part."""

from collections.abc import Callable

import numpy as np

from dpl.fem.linear.interface import Array, SingularMatrix

Map = Callable[[Array], Array]  # (n,) -> (n,)


def gmres(product: Map, precondition: Map, right: Array, rtol: float, max_iter: int) -> Array:
    """Return x, (n,), with ||right - K x|| <= rtol ||right||, for any regular matrix K.

    Source: Saad, Schultz (1986), SIAM J. Sci. Stat. Comput. 7; Saad (2003), Iterative Methods for
    Sparse Linear Systems, algorithm 9.5 (preconditioned from the right, without restarts).

    Args:
        product: Function x -> K x.
        precondition: Function r -> M^-1 r, linear, near K^-1 r.
        right: Right-hand side, (n,).
        rtol: Relative residual at which to stop [-].
        max_iter: Largest number of iterations, and of stored vectors.

    Raises:
        SingularMatrix: `max_iter` is not enough, or a number is not finite.
    """
    size = float(np.linalg.norm(right))
    if size == 0:
        return np.zeros_like(right)
    basis = [right / size]
    hessenberg = np.zeros((max_iter + 1, max_iter))
    target = np.zeros(max_iter + 1)
    target[0] = size
    for k in range(max_iter):
        image = product(precondition(basis[k]))
        for _ in range(2):  # the second pass keeps the basis orthogonal to rounding
            for j, vector in enumerate(basis):
                share = vector @ image
                hessenberg[j, k] += share
                image -= share * vector
        hessenberg[k + 1, k] = np.linalg.norm(image)
        if not np.isfinite(hessenberg[k + 1, k]):
            break
        block = hessenberg[: k + 2, : k + 1]
        weights = np.linalg.lstsq(block, target[: k + 2], rcond=None)[0]
        residual = np.linalg.norm(block @ weights - target[: k + 2])
        if residual <= rtol * size:
            return precondition(np.stack(basis, axis=1) @ weights)
        if hessenberg[k + 1, k] == 0:  # K M^-1 is singular
            break
        basis.append(image / hessenberg[k + 1, k])
    raise SingularMatrix(f"no convergence to {rtol:g} in {max_iter} GMRES steps")
