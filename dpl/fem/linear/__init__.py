"""Sparse linear solvers and their factors."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.linear.backends import BACKENDS, installed_backends, make_backend, select_backend
    from dpl.fem.linear.banded import BandedCholesky, MixedPrecisionBandedCholesky
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
