"""Finite elements of a mesh: which one for which cell, and the gradients of its shape functions."""

import numpy as np
import skfem
from numpy.typing import NDArray

# shape of the cell, degree -> element, polynomial order that the quadrature integrates exactly.
# Full quadrature: fewer points leave hourglass modes, more only cost time.
ELEMENTS = {
    ("Triangular", 1): (skfem.ElementTriP1, 0),
    ("Triangular", 2): (skfem.ElementTriP2, 2),
    ("Quadrilateral", 1): (skfem.ElementQuad1, 3),
    ("Quadrilateral", 2): (skfem.ElementQuad2, 5),
    ("Tetrahedral", 1): (skfem.ElementTetP1, 0),
    ("Tetrahedral", 2): (skfem.ElementTetP2, 2),
    ("Hexahedral", 1): (skfem.ElementHex1, 3),
    ("Hexahedral", 2): (skfem.ElementHex2, 5),
}
QUADRATIC = {element for (_, degree), (element, _) in ELEMENTS.items() if degree == 2}


def basis_of(mesh: skfem.Mesh, degree: int) -> skfem.Basis:
    """Return scikit-fem's basis of one displacement component.

    Raises:
        ValueError: There is no element for such cells.
    """
    shape = mesh.elem.refdom.name
    if (shape, degree) not in ELEMENTS:
        raise ValueError(f"{shape} cells cannot be solved")
    element, order = ELEMENTS[shape, degree]
    if (shape, degree) == ("Triangular", 1):  # scikit-fem's smallest rule has three points
        centre = np.array([[1 / 3], [1 / 3]]), np.array([1 / 2])
        return skfem.Basis(mesh, element(), quadrature=centre)
    return skfem.Basis(mesh, element(), intorder=order)


def gradients(basis: skfem.Basis) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return dN, (E, Q, A, D), and dV, (E, Q), over one cell, E = 1, if all cells are equal."""
    slopes = np.stack([b[0].grad for b in basis.basis])  # (A, D, E, Q)
    dN, dV = slopes.transpose(2, 3, 0, 1), basis.dx
    if np.allclose(dN, dN[:1], rtol=0, atol=1e-11 * np.abs(dN).max()) and np.allclose(
        dV, dV[:1], rtol=1e-11
    ):
        return dN[:1], dV[:1]
    return dN, dV
