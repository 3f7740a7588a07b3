"""Load families: the interface that the package needs, and base classes for new ones."""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.identity import identity_of, plain
from dpl.fem.loads.sampling import SAMPLINGS, Array
from dpl.fem.mesh.regions import Region, facets_in
from dpl.fem.options import check_options
from dpl.fem.problem import Problem
from dpl.fem.ranges import ParameterRange, Young
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load
from dpl.system.checks import named_errors

MAX_DISTANCE = 1e-3  # distance from a family up to which a force counts as a load of it [-]


@runtime_checkable
class LoadFamily(Protocol):
    """Random loads on a body, each a function of a point of the unit cube.

    Any class with these attributes can be the loads of a scene; `RandomLoads` implements all but
    the force itself. The configuration calls the class with the keywords `linear` (a
    `LinearSolver`), `young` and `constant_force`.
    """

    @property
    def n_random(self) -> int:
        """d, dimension of the unit cube."""

    @property
    def moduli(self) -> ParameterRange:
        """Range of Young's moduli with its distribution [Pa]; without width for one modulus."""

    @property
    def parameter_ranges(self) -> Mapping[str, ParameterRange]:
        """Ranges of what differs between loads beside these, see `Problem.parameter_ranges`."""

    @property
    def constant_force(self) -> Tensor | None:
        """Force that is part of every load, (N, D) [-]; None if there is none."""

    @property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom on which these loads can act, (N, D), boolean."""

    @property
    def largest_force(self) -> float:
        """Norm of the largest force [-], the scale of residuals in the losses of the paper."""

    def points(self, seed: int | Sequence[int], indices: Sequence[int]) -> Tensor:
        """Return the points of the unit cube of loads `indices` of a stream, (B, d)."""

    def loads_at(self, points: Tensor) -> Load:
        """Return the loads of points (B, d) of the unit cube."""

    def young_at(self, points: Tensor) -> Tensor:
        """Return the Young's moduli of points (B, d), (B,) [Pa]."""

    def parameters_at(self, points: Tensor) -> Tensor:
        """Return the parameters of the law of points (B, d), (B, P), see `parameter_ranges`."""

    def sample(
        self, seed: int | Sequence[int], indices: Sequence[int], *, amplitude: float = 1.0
    ) -> Load:
        """Return loads `indices` of the stream `seed`, their forces multiplied by `amplitude`."""
        load = self.loads_at(self.points(seed, indices))
        return load._replace(force=amplitude * load.force)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return amplitudes (B,) and distances (B,) of forces (B, N, D) [-] from the family.

        The amplitude is the size over the largest one of the family, at most 1 in the range of the
        family. Outside of it, it is 1 plus the distance from the range over the largest size, also
        of a load that is too small or has the opposite sign.
        The distance is the part of the force that no load of the family explains, in [0, 1]. It is
        NaN where the family cannot recognise its loads.
        """

    def identity(self) -> dict[str, Any]:
        """Return the options that determine the loads, as plain data, without Young's moduli.

        Options in SI units are to be divided by E and L, on whose ratios the samples depend.
        """

    def skipped_work(self) -> list[str]:
        """Return notes for the plan that a command prints, one line each."""
        return []


@dataclass(frozen=True, eq=False)
class RandomLoads(LoadFamily):
    """Base of load families: subclasses define the force of a point of the unit cube.

    A subclass defines `n_force`, `force_at` and `largest_force`. It overrides `project` if it can
    recognise its forces, and `loadable_dofs` if it loads nodes inside the body. Options that it
    declares by `option` are checked here.

    The point of a load has the numbers of its force, then Young's modulus and, where the law has
    ranges, its parameters.

    Attributes:
        linear: Body, with the factor of its K(0).
        young: Young's modulus [Pa], a range [low, high] from which each load draws one, or
            {low, high, distribution}: "uniform", or "log" where log E is uniform.
        constant_force: Force that is part of every load, (N, D) [-]; none if left out.
        sampling: "independent" points of the unit cube, or a "sobol" sequence.
    """

    linear: LinearSolver
    _: KW_ONLY
    young: Young = 1.0
    constant_force: Tensor | None = None
    sampling: str = "independent"

    def __post_init__(self) -> None:
        check_options(self)
        if self.sampling not in SAMPLINGS:
            raise ValueError(f"sampling = {self.sampling!r} must be {' or '.join(SAMPLINGS)}")
        self.moduli  # noqa: B018  # raises if it is out of range

    @property
    @abstractmethod
    def n_force(self) -> int:
        """Number of random numbers from which a force is made."""

    @abstractmethod
    def force_at(self, point: Array) -> Tensor:
        """Return the force (N, D) [-] of a point (n_force,) of the unit cube.

        `constant_force` is added to it.
        """

    @property
    def problem(self) -> Problem:
        """Body."""
        return self.linear.problem

    @cached_property
    def moduli(self) -> ParameterRange:
        return ParameterRange.of("young", self.young, is_modulus=True)

    @property
    def parameter_ranges(self) -> Mapping[str, ParameterRange]:
        return self.problem.parameter_ranges

    @property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom of the boundary, (N, D), boolean."""
        return self.problem.boundary[:, None] & self.problem.free

    @property
    def n_random(self) -> int:
        """d: the numbers of a force, Young's modulus, and the parameters with a range."""
        return self.n_force + 1 + len(self.parameter_ranges)

    def points(self, seed: int | Sequence[int], indices: Sequence[int]) -> Tensor:
        drawn = [SAMPLINGS[self.sampling](seed, index, self.n_random) for index in indices]
        return torch.from_numpy(np.stack(drawn))

    def loads_at(self, points: Tensor) -> Load:
        force = torch.stack([self.force_at(point[: self.n_force].numpy()) for point in points])
        if self.constant_force is not None:
            force = force + self.constant_force
        return Load(force, self.young_at(points), self.parameters_at(points))

    def young_at(self, points: Tensor) -> Tensor:
        moduli: Tensor = self.moduli.at(points[:, self.n_force])
        return moduli.clamp(*self.moduli)  # rounding of a power

    def parameters_at(self, points: Tensor) -> Tensor:
        own = points[:, self.n_force + 1 :]
        pairs = zip(self.parameter_ranges.values(), own.unbind(1), strict=True)
        columns = [ends.at(column) for ends, column in pairs]
        return torch.stack(columns, dim=1) if columns else own

    def own_force(self, force: Tensor) -> Tensor:
        """Return forces (B, N, D) [-] on free degrees of freedom, without `constant_force`."""
        own = force if self.constant_force is None else force - self.constant_force
        return self.problem.acting(own)

    def project(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return ||f|| / `largest_force`, (B,), and the part outside `loadable_dofs`, (B,).

        The latter is NaN up to `MAX_DISTANCE`: only a subclass can recognise forces on these.
        """
        own = self.own_force(force)
        size = own.flatten(1).norm(dim=1)
        foreign = torch.where(self.loadable_dofs, 0.0, own).flatten(1).norm(dim=1) / size
        distance = torch.where(foreign > MAX_DISTANCE, foreign, math.nan)
        return size / self.largest_force, distance

    def identity(self) -> dict[str, Any]:
        return identity_of(self, exclude=("linear", "young"))

    def __getstate__(self) -> dict[str, object]:
        """Pickle with what the largest force needs, so that workers need not compute it again."""
        self.largest_force  # noqa: B018
        return self.__dict__


@dataclass(frozen=True, eq=False)
class SurfaceLoads(RandomLoads):
    """Base of load families that act on facets of the boundary.

    Attributes:
        region: Part of the boundary, see `dpl.fem.mesh.facets_in`; None for all of it.
    """

    _: KW_ONLY
    region: Region | None = None

    @cached_property
    def facets(self) -> NDArray[np.int_]:
        """Numbers of the boundary facets on which these loads act, (E,)."""
        problem = self.problem
        if self.region is None:
            return np.asarray(problem.mesh.boundary_facets())
        with named_errors("region = "):
            return facets_in(self.region, problem.mesh, problem.length, problem.origin)

    @cached_property
    def loadable_dofs(self) -> Tensor:
        """Free degrees of freedom of the nodes of `facets`, (N, D), boolean."""
        nodes = torch.zeros(self.problem.shape[0], dtype=torch.bool)
        nodes[self.problem.basis.get_dofs(self.facets).all()] = True
        loadable = nodes[:, None] & self.problem.free
        if not loadable.any():
            words = "the boundary" if self.region is None else f"region = {self.region}"
            raise ValueError(f"{words} is fixed everywhere; loads must act on a free node")
        return loadable

    def identity(self) -> dict[str, Any]:
        """Return the options; a region is identified by the facets that it selects."""
        options = super().identity()
        del options["region"]
        return options if self.region is None else options | {"region": plain(self.facets)}
