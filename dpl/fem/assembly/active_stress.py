"""Active stress: tension of muscle along the fibres of a body."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import skfem
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly.elements import gradients
from dpl.fem.assembly.follower_loads import FollowerLoad, LoadedPart, Stress
from dpl.fem.assembly.sparsity import Pattern
from dpl.fem.materials.fibres.reinforced import FibreDirections, fibre_frames
from dpl.fem.materials.material import Material
from dpl.fem.mesh.regions import Origin, Region, cells_in
from dpl.fem.units import Units
from dpl.system.checks import named_errors


@dataclass(frozen=True)
class ActiveStress(FollowerLoad):
    """Tension of muscle along its fibres, the second Piola-Kirchhoff stress T f f^T.

    f is the unit vector of the fibre at rest. The stress adds to that of the law. Its energy is
    the integral of T/2 f.(C - I) f over the body at rest, so that a positive T shortens the fibres.
    The strain is that of the displacement itself, also in a body with `mean_dilatation`.

    Source: Land et al. (2015), Proc. R. Soc. A 471, 20150641, problem 3.

    Attributes:
        value: T [Pa]; or a range [low, high], of which each load has its own T, see
            `Problem.parameter_ranges`. On a problem with E = 1 Pa, the default of `Problem.build`,
            this is T / E.
        region: The cells; None for all.
        directions: Fibre directions f, see `dpl.fem.FibreDirections`; None for those of the law.
        name: Name of the parameter of a range; "active_stress" if left out.
    """

    default_name: ClassVar[str] = "active_stress"
    direction_hint: ClassVar[str] = "it acts along the fibres, see directions"
    value: Stress
    region: Region | None = None
    directions: FibreDirections | None = None
    name: str | None = None

    def on(
        self, basis: skfem.Basis, units: Units, material: Material, origin: Origin = 0.0
    ) -> "ActiveFibres":
        """Return the active fibres, see `FollowerLoad.on`."""
        cells = np.arange(basis.mesh.nelements)
        if self.region is not None:
            cells = cells_in(self.region, basis.mesh, units.length, origin)
        if self.directions is None:
            frames = fibre_frames(material, basis.mesh.nelements)
        else:
            with named_errors("directions: "):
                frames = self.directions.on(basis, units.length, origin)
            frames = frames if frames.ndim == 4 else frames[:, None]
            frames = frames.expand(basis.mesh.nelements, -1, -1, -1)
        dim = basis.mesh.dim()  # in 2D the fibre is its part in the plane
        fibre = frames.expand(-1, basis.dx.shape[1], -1, -1).numpy()[cells, :, :dim, 0]
        if unknown := int(np.isnan(fibre).any(axis=(1, 2)).sum()):
            raise ValueError(
                f"no fibre directions are known in {unknown} of {len(cells)} cells; set "
                "directions, or a region of cells whose law has fibres"
            )
        dN, dV = (np.broadcast_to(x, (basis.nelems, *x.shape[1:])) for x in gradients(basis))
        slopes = (dN[cells] @ fibre[..., None])[..., 0]
        return ActiveFibres(
            nodes=torch.from_numpy(basis.element_dofs.T[cells].astype(np.int64)),
            cells=torch.from_numpy(cells.astype(np.int64)),
            fibre=torch.from_numpy(fibre),
            slopes=torch.from_numpy(slopes),
            volumes=torch.from_numpy(dV[cells]),
        )


@dataclass(frozen=True, eq=False)
class ActiveFibres(LoadedPart):
    """Cells with active fibres of the tension T = E.

    The nodal force is affine in the displacement: the integral of (grad N_a . f) F f, with
    F f = f + du/df. Its derivative is the integral of (grad N_a . f)(grad N_b . f) for each
    component of the displacement: constant and symmetric.

    Attributes:
        cells: Numbers of the cells, (S,).
        fibre: Direction f, (S, Q, D) [-]; in 2D its components in the plane.
        slopes: Derivatives of the shape functions along f, (S, Q, A) [-].
        volumes: Volumes of the quadrature points, (S, Q) [-].
    """

    kind: ClassVar[str] = "active stress"
    key = "active_stress"
    extent: ClassVar[str] = "in {:,} cells"
    cells: Tensor
    fibre: Tensor
    slopes: Tensor
    volumes: Tensor

    @property
    def directions(self) -> Tensor:
        return self.fibre

    def force(self, displacement: Tensor) -> Tensor:
        """Return the part of the internal force, (B, N, D) [-]."""
        image = self.fibre + self.slopes @ displacement[:, self.nodes]  # F f
        forces = (self.slopes * self.volumes[..., None]).mT @ image
        return self._sum_at_nodes(forces, displacement)

    def work(self, displacement: Tensor) -> Tensor:
        """Return the energy, the integral of f.(C - I) f / 2, (B,) [-]."""
        change = self.slopes @ displacement[:, self.nodes]  # du/df, (B, S, Q, D)
        strain = ((self.fibre + change / 2) * change).sum(-1)
        return (strain * self.volumes).sum((-2, -1))

    def stiffness(self, displacement: Tensor) -> list[Tensor]:
        """Return entries of d force / du for pairs of nodes a <= b, b slowest, and components."""
        entries = self._stiffness[:, None].expand(-1, displacement.shape[-1])
        return [entries.flatten().expand(len(displacement), -1)]

    @cached_property
    def _stiffness(self) -> Tensor:
        """Entries of one component, (S A (A + 1)/2,) [-]."""
        matrices = (self.slopes * self.volumes[..., None]).mT @ self.slopes
        b, a = np.tril_indices(self.nodes.shape[1])
        return matrices[:, a, b].flatten()

    def places(self, pattern: Pattern) -> NDArray[np.int32]:
        """Return the positions of the entries on a pattern, (S A (A + 1)/2 D,)."""
        own = pattern.places[self.cells.cpu().numpy()]  # (S, pairs, D, D)
        return own.diagonal(axis1=-2, axis2=-1).ravel()
