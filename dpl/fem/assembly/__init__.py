"""Elements, boundary conditions, and the assembly of forces and tangents."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.assembly.boundary_conditions import DirichletBC, RobinBC
    from dpl.fem.assembly.elements import basis_of, gradients
    from dpl.fem.assembly.sparsity import Pattern
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
