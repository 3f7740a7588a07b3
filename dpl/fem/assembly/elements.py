"""Finite elements by cell shape and degree, and the gradients of their shape functions."""

import numpy as np
import skfem
from numpy.typing import NDArray
from skfem.quadrature import get_quadrature

from dpl.fem.mesh.generators import aspect_ratio

Array = NDArray[np.float64]
# shape of the cell, degree -> element, polynomial degree that the quadrature integrates exactly.
# Full integration: fewer points leave hourglass modes.
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
# Quadrature of degree 3 for curved tetrahedra: a of points with the barycentric coordinates
# (a, a, a, 1 - 3a), and their weights over the volume. With the rule of scikit-fem, which has a
# negative weight, the energy can be unbounded below.
CURVED = (
    (0.328163263918762614, 0.136218621884634852),
    (0.108046885699134997, 0.113781378115365148),
)
QUADRATICALLY = (  # remedy for linear elements
    "set degree=2 with the same mesh file, or write it with order 2 (Gmsh: Mesh.ElementOrder=2)"
)
STRAIGHT = 1e-8  # relative change of the Jacobian in a cell; the quadrature error is its square


def basis_of(mesh: skfem.Mesh, degree: int) -> skfem.Basis:
    """Return scikit-fem's basis of one displacement component.

    The quadrature integrates the gradients of the shape functions exactly, also in curved cells.
    Therefore every element passes the patch test. The mesh must lie near the origin, because
    scikit-fem evaluates absolute coordinates.
    """
    element, quadrature = _element_of(mesh, degree)
    return skfem.Basis(mesh, element, quadrature=quadrature)


def reference_gradients(mesh: skfem.Mesh, degree: int) -> Array:
    """Return the gradients of the shape functions of the reference element, (Q, A, D)."""
    element, (points, _) = _element_of(mesh, degree)
    count = len(element.doflocs)
    return np.stack([element.lbasis(points, a)[1] for a in range(count)]).transpose(2, 0, 1)


def _element_of(mesh: skfem.Mesh, degree: int) -> tuple[skfem.Element, tuple[Array, Array]]:
    """Return element and quadrature, points (D, Q) and weights (Q,), of `basis_of`."""
    shape = mesh.elem.refdom.name
    if (shape, degree) not in ELEMENTS:
        raise ValueError(
            f"mesh = {shape} cells of degree {degree} must be one of {sorted(ELEMENTS)}; convert it"
        )
    element, order = ELEMENTS[shape, degree]
    if (shape, degree) == ("Triangular", 1):  # scikit-fem's smallest rule has three points
        return element(), (np.array([[1 / 3], [1 / 3]]), np.array([1 / 2]))
    if (shape, degree) == ("Tetrahedral", 2) and _curved(mesh):
        # degree 3: in curved cells the gradient of a shape function times det J is cubic
        points = np.hstack([np.where(np.eye(4)[:3], 1 - 3 * a, a) for a, _ in CURVED])
        return element(), (points, np.repeat([share / 6 for _, share in CURVED], 4))
    return element(), get_quadrature(element.refdom, order)


def _curved(mesh: skfem.Mesh) -> bool:
    """Return True if the Jacobian of a cell is not constant, because mid-edge nodes are moved."""
    if mesh.affine:
        return False
    J = mesh.mapping().DF(mesh.elem.refdom.p)  # (D, D, E, corners)
    change = np.ptp(J, axis=-1).max(axis=(0, 1))
    return bool((change > STRAIGHT * np.abs(J).max(axis=(0, 1, 3))).any())


def gradients(basis: skfem.Basis) -> tuple[Array, Array]:
    """Return dN (E, Q, A, D) and dV (E, Q) of a basis; with E = 1 if all cells are equal."""
    stacked = np.stack([b[0].grad for b in basis.basis])  # (A, D, E, Q)
    dN, dV = stacked.transpose(2, 3, 0, 1), basis.dx
    same = np.allclose(dN, dN[:1], rtol=0, atol=1e-11 * np.abs(dN).max())
    equal = same and np.allclose(dV, dV[:1], rtol=1e-11)
    return (dN[:1], dV[:1]) if equal else (dN, dV)


def is_simplex(mesh: skfem.Mesh) -> bool:
    """Return True for triangles and tetrahedra."""
    return mesh.elem.refdom.name in ("Triangular", "Tetrahedral")


def locking_warnings(
    mesh: skfem.Mesh, degree: int, poisson: float, *, mean_dilatation: bool
) -> list[str]:
    """Return one line for each reason why the elements of a body will lock.

    `poisson` is its largest Poisson's ratio [-].
    """
    lines, shape = [], mesh.elem.refdom.name.lower()
    locking = f"{shape} elements lock at Poisson's ratio {poisson:.4g}"
    if degree == 2:
        locks = poisson > 0.48 and not mean_dilatation and is_simplex(mesh)
        return [f"quadratic {locking}: set mean_dilatation=true"] if locks else []
    if poisson >= 0.45 and not mean_dilatation:
        other = "" if is_simplex(mesh) else ", or set mean_dilatation=true"
        lines.append(f"linear {locking}: {QUADRATICALLY}{other}")
    if (aspect := float(aspect_ratio(mesh).max())) > 20:
        lines.append(
            f"linear {shape} elements of aspect ratio {aspect:.0f} lock in bending: {QUADRATICALLY}"
        )
    return lines
