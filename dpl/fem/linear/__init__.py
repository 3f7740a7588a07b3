"""Sparse linear solvers and their factors."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.linear.backends import BACKENDS, backend, chosen, installed
    from dpl.fem.linear.banded import Band, Band32
    from dpl.fem.linear.interface import (
        Backend,
        Factor,
        Pattern,
        SingularMatrix,
        SymmetricProduct,
        full_matrix,
    )
    from dpl.fem.linear.krylov import CG, conjugate_gradients, multigrid_installed
    from dpl.fem.linear.pardiso import Pardiso
    from dpl.fem.linear.superlu import SuperLU
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
