"""From a mesh, a hyperelastic law and a range of loads to a real-time simulator with a proof.

Axis letters used in every docstring:

    B samples   N nodes   D space dimension   E cells   A nodes per cell
    Q quadrature points per cell   M modes   n free degrees of freedom

Inside the package everything is dimensionless: lengths / L, forces / (E L^2) (E L in 2D, per unit
thickness), Young's modulus 1. SI units live at the border, in `dpl.scene.Scene`.
"""

__version__ = "0.1.0"
