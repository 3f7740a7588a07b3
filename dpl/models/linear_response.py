"""The linear solution K(0)^-1 f of every load, by nested static condensation."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import pad

from dpl.fem import Load
from dpl.fem.linear.condensation import (
    Condensed,
    Layers,
    condensed_layers,
    run_length,
    solve_layers,
)
from dpl.fem.linear.krylov import conjugate_gradients, conjugate_gradients_of_tensors
from dpl.fem.materials.material import Material
from dpl.fem.solvers.parity_factor import CondensedBody, OrbitArrays, TermMatrices, split_field
from dpl.fem.symmetry import SymmetryGroup
from dpl.models.interface import full_precision
from dpl.scene import Scene
from dpl.system.threads import on_threads

Array = NDArray[np.float64]
Parts = NDArray[Any]  # values by parity in the type of the blocks, (M, m)
Solve = Callable[[Array], tuple[float, Parts, Parts]]  # see `LinearResponse.at`
FEW = 8  # loads that compiled loops solve faster than products of matrices do
MAX_VALUES = 2**26  # of a batch that are computed at a time by tensor operations


class LinearResponse:
    """The linear solution K(0)^-1 (f - s) of a load; s is the force of the prescribed displacement.

    K(0) is condensed once into dense blocks, one set for each parity of fields under the
    reflections of the body (`dpl.fem.linear.condensation`). A solution is a sequence of products
    with them, the same for every load: there is no basis that a load on a small area could miss.
    If K(0) depends on parameters of the law, the solutions of blocks for a few of them are
    interpolated, or the blocks of one precondition conjugate gradients (`StiffnessTerms`).

    Compiled loops solve few loads on the CPU, and all that need steps, one after the other. Larger
    batches, other devices and traced graphs are solved by tensor operations.

    The blocks depend on the scene only and are computed when they are first used.
    """

    def __init__(self, scene: Scene, group: SymmetryGroup | None = None) -> None:
        """Take the scene and symmetries of the body; None: all.

        Raises:
            ValueError: K(0) changes too much with the parameters, see `StiffnessTerms`.
        """
        own = scene.linear.condensed  # of all symmetries, whose blocks the solvers use too
        is_own = group is None or len(group) == len(scene.linear.symmetries)
        self.scene = scene
        self.group = scene.linear.symmetries if group is None else group
        self.condensed = own if is_own else CondensedBody.of(scene.problem, self.group)
        self.terms, self.form = self.condensed.terms, self.condensed.form
        self.terms.require_few_steps()
        self._kept: dict[tuple[torch.device, str], list[Any]] = {}

    # ------------------------------------------------------------------ blocks

    @property
    def blocks(self) -> Condensed:
        """Blocks of the body."""
        return self.condensed.blocks

    @cached_property
    def _matrices(self) -> TermMatrices:
        return TermMatrices.of(self.terms, self.form)

    def dead_loads(self, force: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return loads without ranged follower loads: forces (B, N, D) and parameters of the law.

        The forces of follower loads on the body at rest are added to the nodal forces.
        """
        problem = self.scene.problem
        if problem.follower_loads.ranges:
            own = parameters[:, len(problem.material.parameter_ranges) :] / (problem.young or 1.0)
            force = force - torch.einsum("br,rnd->bnd", own, self._unit_forces.to(force))
        return force, problem.law_parameters(parameters)

    @cached_property
    def _unit_forces(self) -> Tensor:
        """f_int at u = 0 of each follower load with a range at a stress of E, (R, N, D) [-]."""
        problem = self.scene.problem
        return problem.follower_loads.unit_forces(problem.points.new_zeros(1, *problem.shape))

    # ------------------------------------------------------------------ one load

    @cached_property
    def orbits(self) -> OrbitArrays:
        """Degrees of freedom of the orbits for compiled loops."""
        return self.form.arrays(self.scene.problem.free.flatten().nonzero()[:, 0].numpy())

    def at(self, law: Material) -> Solve:
        """Return the function from forces f (N, D) to linear solutions.

        It returns a unit and, over this unit and by parity, f - s and K(0)^-1 (f - s), (M, m).

        The law has no ranges. For the unit see `split_field`.
        """
        factors = np.append(self.terms.factors(law)[0].numpy(), 1.0)
        inverse, (characters, dofs, _, scales) = self._inverse(factors), self.orbits
        support = (factors @ self.condensed.supports.numpy()).reshape(dofs.shape)
        dtype = self.blocks.dtype

        def solve(force: Array) -> tuple[float, Parts, Parts]:
            parts = np.empty(dofs.shape, dtype)
            unit = split_field(characters, dofs, scales, force.ravel(), support, parts)
            return unit, parts, inverse(parts)

        return solve

    def _inverse(self, factors: Array) -> Callable[[Parts], Parts]:
        """Return f -> K(0)^-1 f, (M, m) each, of factors and 1, (T + 1,); f is of order one."""
        shape = self.orbits.dofs.shape
        inverse = self.condensed.inverse(torch.from_numpy(factors[None, :-1])).apply
        if not self.terms.has_steps:
            return inverse
        matrix, ends = self._matrices.at(factors), (self.terms.rtol, 2 * self.terms.bound)

        def precondition(residual: Array) -> Array:
            return inverse(residual.reshape(shape)).astype(np.float64).ravel()

        def solve(parts: Parts) -> Parts:
            right = parts.astype(np.float64).ravel()
            found = conjugate_gradients(matrix.dot, precondition, right, *ends, natural=True)
            return found.reshape(shape).astype(self.blocks.dtype)

        return solve

    # ------------------------------------------------------------------ batches

    def solutions(self, load: Load) -> Tensor:
        """Return linear solutions, (B, N, D) [-], float64, on the device of the load.

        Moved supports are part of them and keep their prescribed displacements.
        """
        force, parameters = self.dead_loads(load.force.double(), load.parameters)
        _, solved = self.by_parity(force, parameters)
        return self.fields(solved) + self.scene.problem.prescribed.to(solved)

    def __call__(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        """Return linear solutions (B, n) at free degrees of freedom of forces (B, n) on them.

        The parameters, (B, P), are those of the law.
        """
        free = self.scene.problem.free.to(loaded.device)
        force = loaded.new_zeros(loaded.shape[0], *free.shape)
        force = force.flatten(1).index_copy(1, free.flatten().nonzero()[:, 0], loaded)
        return self.fields(self.by_parity(force, parameters)[1])[:, free].to(loaded)

    def by_parity(self, force: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return forces (B, N, D) and their linear solutions by parity, (B, M, m) float64 each."""
        runs, _, scales, characters, supports, _ = self._orbits(force.device)
        law = self.scene.problem.material.with_parameters(parameters)
        factors = pad(self.terms.factors(law).double(), (0, 1), value=1.0)
        with full_precision(force.device.type):
            rows = force.double().flatten(1).unflatten(1, (-1, self._run)).index_select(1, runs)
            parts = characters @ (scales * rows.flatten(1).unflatten(1, scales.shape))
            right = parts.flatten(1) - factors @ supports
            factors = factors.expand(right.shape[0], -1)
            if torch.compiler.is_compiling():
                solved = self.by_tensors(right, factors)
            else:
                solved = _Solve.apply(right, factors, self)
        return parts, solved.view_as(parts)

    def fields(self, parts: Tensor) -> Tensor:
        """Return fields (B, N, D), zero at fixed degrees of freedom, of their parts (B, M, m)."""
        _, signs, _, characters, _, places = self._orbits(parts.device)
        with full_precision(parts.device.type):
            values = signs * (characters.T @ parts)
        rows = pad(values.flatten(1), (0, self._run)).unflatten(1, (-1, self._run))
        return rows.index_select(1, places).flatten(1).unflatten(1, self.scene.problem.shape)

    def solve(self, right: Tensor, factors: Tensor) -> Tensor:
        """Return K(0)^-1 f, (B, M m), of forces by parity, (B, M m), without derivatives.

        The factors are those of the terms, and 1, (B, T + 1). All are float64.
        """
        many = right.shape[0] > FEW and not self.terms.varies  # by the same blocks
        if right.device.type != "cpu" or many:
            return self.by_tensors(right, factors)
        size, shape = largest(right), self.orbits.dofs.shape
        parts = (right / size).numpy().reshape(-1, *shape).astype(self.blocks.dtype)
        rows = list(zip(parts, factors.numpy(), strict=True))
        found = on_threads(lambda row: self._inverse(row[1])(row[0]), rows)
        return size * torch.from_numpy(np.stack(found)).flatten(1) if found else right.clone()

    def by_tensors(self, right: Tensor, factors: Tensor) -> Tensor:
        """Return the same as `solve` by tensor operations."""
        (layers,) = self.layers(right.device)
        columns, entries = self.matrix(right.device) if self.terms.has_steps else (right[:0],) * 2
        count = max(1, MAX_VALUES // max(columns.numel(), self.blocks.values.size))
        if not torch.compiler.is_compiling() and right.shape[0] > count:
            both = zip(right.split(count), factors.split(count), strict=True)
            return torch.cat([self.by_tensors(*pair) for pair in both])
        weights = self.terms.weights(factors[:, :-1])[..., None, None]
        parities = len(self.orbits.dofs)

        def interpolate(f: Tensor) -> Tensor:
            forces = weights * f.unflatten(1, (1, parities, -1))
            forces = forces.flatten(1, 2).permute(1, 2, 0).to(layers.layers[0].inverse.dtype)
            solved = solve_layers(layers, forces).permute(2, 0, 1)
            return solved.unflatten(1, (-1, parities)).sum(dim=1).flatten(1).double()

        if not self.terms.has_steps:
            size = largest(right)
            return interpolate(right / size) * size
        matrix = torch.einsum("bk,knw->bnw", factors, entries)

        def product(x: Tensor) -> Tensor:
            return (matrix * x[:, columns]).sum(dim=-1)

        ends = self.terms.rtol, 2 * self.terms.bound
        return conjugate_gradients_of_tensors(product, interpolate, right, *ends)

    @cached_property
    def _run(self) -> int:
        """Length of the runs of degrees of freedom: 3 if nodes of a solid are free or held."""
        dofs = self.orbits.dofs
        return run_length(
            dofs.ravel(), np.array(dofs.shape[1]), np.array(self.scene.problem.free.numel())
        )

    def _orbits(self, device: torch.device) -> list[Tensor]:
        """Return dofs, signs, scales, characters and forces of supports, see `OrbitArrays`.

        The last one is the position of each degree of freedom among the images; M m of fixed ones.
        Degrees of freedom and positions are those of runs, see `run_length`.
        """

        def make() -> list[Tensor]:
            characters, *arrays = self.orbits
            dofs, signs, scales = map(torch.from_numpy, arrays)
            runs = dofs.flatten()[:: self._run] // self._run
            places = torch.full((self.scene.problem.free.numel() // self._run,), len(runs))
            places[runs] = torch.arange(len(runs))
            own = runs, signs, scales, torch.from_numpy(characters), self.condensed.supports, places
            return [part.to(device) for part in own]

        return self._on(device, "orbits", make)

    def layers(self, device: torch.device) -> list[Layers]:
        """Return `condensed_layers`, one member."""
        return self._on(device, "blocks", lambda: [condensed_layers(self.blocks, device)])

    def matrix(self, device: torch.device) -> list[Tensor]:
        """Return columns and entries of `TermMatrices.padded`."""
        return self._on(device, "matrix", lambda: [x.to(device) for x in self._matrices.padded()])

    def _on(self, device: torch.device, name: str, make: Callable[[], list[Any]]) -> list[Any]:
        """Return tensors, kept for a device unless a graph is traced, whose tensors lack values."""
        found = self._kept.get((device, name)) or make()
        if not torch.compiler.is_compiling():
            self._kept[device, name] = found
        return found


class _Solve(Function):
    """x = K(0)^-1 f with df = K(0)^-1 dx and da_k = -df K_k x: no step is stored."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, factors: Tensor, response: LinearResponse) -> Tensor:
        x = response.solve(right.detach(), factors.detach())
        ctx.save_for_backward(x, factors)
        ctx.response = response
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor | None, None]:
        x, factors = ctx.saved_tensors
        right: Tensor = _Solve.apply(gradients[0], factors, ctx.response)
        of_factors = None
        if ctx.needs_input_grad[1] and ctx.response.terms.varies:
            columns, entries = ctx.response.matrix(x.device)
            of_factors = -torch.einsum("bn,bnw,knw->bk", right, x[:, columns], entries)
        return right, of_factors, None


def largest(right: Tensor) -> Tensor:
    """Return the largest entries (B, 1) of rows, over which float32 holds them; 1 of zeros."""
    size = right.abs().amax(dim=1, keepdim=True)
    return torch.where(size > 0, size, 1.0)
