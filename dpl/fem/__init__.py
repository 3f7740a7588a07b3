"""Finite elements for hyperelastic bodies: meshes, laws, loads, solvers."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.fem.assembly.active_stress import ActiveStress
    from dpl.fem.assembly.boundary_conditions import DirichletBC, RobinBC
    from dpl.fem.assembly.follower_cable import FollowerCable
    from dpl.fem.assembly.follower_pressure import FollowerPressure
    from dpl.fem.linear.backends import installed_backends
    from dpl.fem.linear.interface import SingularMatrix
    from dpl.fem.loads.distributed import CableLoads, FacePressure, FaceTractions, GravityLoads
    from dpl.fem.loads.family import LoadFamily, RandomLoads
    from dpl.fem.loads.file import FileLoads
    from dpl.fem.loads.forces import BodyForce, Traction
    from dpl.fem.loads.mixture import MixtureLoads
    from dpl.fem.loads.modal import ModalLoads, Modes, eigenmodes
    from dpl.fem.loads.patch import PatchLoads
    from dpl.fem.loads.point import PointLoads
    from dpl.fem.materials.fibres.directions import (
        ConstantFibres,
        FibreData,
        FibreFunction,
        LaplaceFibres,
    )
    from dpl.fem.materials.fibres.energies import (
        FibreEnergy,
        Guccione,
        HolzapfelGasserOgdenFibres,
        HolzapfelOgdenFibres,
    )
    from dpl.fem.materials.fibres.reinforced import FibreDirections, FibreReinforced
    from dpl.fem.materials.heterogeneous import Heterogeneous
    from dpl.fem.materials.invariant_based import InvariantBasedMaterial
    from dpl.fem.materials.isochoric import (
        DemirayK2,
        MooneyRivlinK2,
        VolumetricK2,
        VolumetricK4,
        YeohK2,
    )
    from dpl.fem.materials.linear_elastic import (
        LinearElastic,
        SaintVenantKirchhoff,
        UnknownLaw,
    )
    from dpl.fem.materials.material import Material, Response, YoungPoissonMaterial
    from dpl.fem.materials.neo_hookean import (
        NeoHookeanIsoK2,
        NeoHookeanIsoK4,
        NeoHookeanLn,
        StableNeoHookean,
    )
    from dpl.fem.materials.ogden import OgdenK2
    from dpl.fem.materials.parameters import CellField
    from dpl.fem.materials.prestretched import Prestretched
    from dpl.fem.mesh.generators import box, finger, rectangle
    from dpl.fem.mesh.propeller_mesh import propeller
    from dpl.fem.mesh.reading import read_cell_data, read_mesh
    from dpl.fem.mesh.regions import Box, Cylinder, Plane, Sphere, Tag
    from dpl.fem.mesh.writing import write_mesh, write_mesh_exactly, write_series
    from dpl.fem.postprocess.stress import Fields, fields
    from dpl.fem.postprocess.surface import surface
    from dpl.fem.problem import Problem
    from dpl.fem.ranges import ParameterRange
    from dpl.fem.rom.subspace_newton import SubspaceNewton
    from dpl.fem.solvers.anderson import AndersonSolver
    from dpl.fem.solvers.bifurcation import post_buckling_branches
    from dpl.fem.solvers.differentiable import DifferentiableSolve
    from dpl.fem.solvers.error_estimate import ErrorEstimate, estimate_error
    from dpl.fem.solvers.linear import LinearSolver, ReferenceSolver
    from dpl.fem.solvers.newton import Newton
    from dpl.fem.solvers.relaxation import relaxed
    from dpl.fem.solvers.rigid_patch import RigidPatch
    from dpl.fem.solvers.solution import Load, Solution, Solver, Status, evaluate_solution, solve
    from dpl.fem.symmetry import symmetries
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
