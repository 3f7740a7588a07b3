"""Unrolled reduced solver: a few iterations in a subspace whose linear maps are fitted to data."""

from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dpl.fem import InvariantBasedMaterial, SubspaceNewton, symmetries
from dpl.fem.rom.compiled_prediction import CompiledPrediction, LawArguments, law_arguments
from dpl.fem.rom.ecsw import Cubature
from dpl.fem.rom.reduced_stiffness import ReducedStiffness
from dpl.fem.rom.sampled_stress import SampleCells
from dpl.fem.symmetry import cell_images
from dpl.models.invariant_basis import orthonormal_fields
from dpl.models.local_response import LocalResponse, resize_buffers
from dpl.models.newton_choice import LOADS, choose_newton
from dpl.models.unrolled_fit import (
    Maps,
    cell_positions,
    fit_maps,
    fit_modes,
    in_coordinates,
    linear_of_modes,
    modes_of_parity,
)
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range

Array = NDArray[np.float64]
CELL_STATES = 256  # states at which the cells of a correction are chosen
MAX_COMPILED = 8  # loads; more of them are predicted together by tensor operations
MAX_SIZE = 100_000  # of rank, cells and stages


class Unrolled(nn.Module):
    """Galerkin linear solution and a few quasi-Newton iterations with fitted maps.

    With the R modes V of the displacement and G, which maps their coordinates to displacement
    gradients at C sample cells:

        c_lin = (V^T K(0) V)^-1 V^T f,   H_lin = G c_lin
        c_1   = c_lin + phi_0(H_lin) B_0
        c_k+1 = c_k + phi(G c_k, H_lin) B_k

    phi_0 is the rotated strain of the linear solution minus the linear one (`rotated_strain`), phi
    the stress that is not balanced, in the present and in the rotated frame (`unbalanced_stress`).
    The matrices B are found by ridge regression on the training samples, one after the other. Each
    iteration is a quasi-Newton iteration of the reduced equilibrium: the residual is sampled at
    a few cells (hyper-reduction), and the preconditioner and the weights of the cells are fitted.

    Number of cells, ridges and number of maps are chosen by the error of the held-out samples. The
    modes and the cells are invariant under the symmetries of the body and the maps commute with
    them. The answer has the symmetries, those with diagonal matrices exactly and others up to the
    rounding of modes and maps.

    A load whose linear solution the modes do not represent (a local load) gets the missing part
    from the factor of K(0), see `LocalResponse`.

    The module takes and returns dimensionless float64 fields. It has no trained parameters.

    Sources: Gregor, LeCun (2010), Learning fast approximations of sparse coding, ICML (unrolled
    iterations); Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98
    (hyper-reduction).

    Attributes:
        scene: The scene to predict.
        modes: V at free degrees of freedom, (n, R).
        parity: Parity of each mode, (R,), see `dpl.fem.rom.parity`.
        stiffness: V^T K(0) [V, p] by its dependence on the moduli, see `ReducedStiffness`,
            (3, R, R + 1); p is the prescribed displacement.
        cells: Numbers of the sample cells, (C,).
        gradients: G and the gradients of p, (R + 1, C, D, D).
        first_map: B_0, (C D D, R).
        maps: B_1, B_2, ..., (K, 2 C D D, R).
        limits: Largest ratio of each correction to the one before, (1 + K,): 1.5 times that of the
            samples. They keep loads far out of range from running away.
        newton_rank: Number of modes of Newton's method that follows; 0: none, ().
        newton_cells: Cells of its tangent, (K,).
        newton_weights: Their weights, (K,).
        outside_error: Largest relative error that it left at held-out samples, ().
        fitted: True after `fit`, ().
    """

    modes: Tensor
    parity: Tensor
    stiffness: Tensor
    cells: Tensor
    gradients: Tensor
    first_map: Tensor
    maps: Tensor
    limits: Tensor
    newton_rank: Tensor
    newton_cells: Tensor
    newton_weights: Tensor
    outside_error: Tensor
    fitted: Tensor
    dofs: Tensor
    prescribed: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        rank: int = 200,
        cells: int = 160,
        stages: int = 3,
        symmetry: bool = True,
        linear_tol: float = 5e-4,
    ) -> None:
        """Build the module; `fit` computes its contents.

        Args:
            scene: The scene to predict.
            rank: Largest number of modes of the displacement.
            cells: Largest number of sample cells; a few more, if symmetries demand it.
            stages: Largest number of iterations after the first map.
            symmetry: Find the symmetries of the body and build them into the answer.
            linear_tol: Relative size of the part of the linear solution that the modes miss, above
                which it is computed with the factor of K(0). 0: for all loads; infinity: for none.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        check_range(1, MAX_SIZE, rank=rank, cells=cells)
        check_range(0, MAX_SIZE, stages=stages)
        if not linear_tol >= 0:
            raise ValueError(f"linear_tol = {linear_tol} must be 0 or more")
        self.scene = scene
        self.rank, self.sample_count, self.stages = rank, cells, stages
        constant = scene.loads.constant_force
        also = [] if constant is None else [constant]
        self.group = symmetries(scene.problem, also=also) if symmetry else []
        self.extra_inputs = ("parameters",) if scene.loads.parameter_ranges else ()
        self.local = LocalResponse(scene, linear_tol)
        dim = scene.problem.shape[1]
        empty = torch.zeros(0, dtype=torch.float64)
        for name, value in {
            "modes": torch.zeros(int(scene.problem.free.sum()), 0),
            "parity": torch.zeros(0, dtype=torch.int64),
            "stiffness": empty.view(3, 0, 1),
            "cells": torch.zeros(0, dtype=torch.int64),
            "gradients": torch.zeros(1, 0, dim, dim, dtype=torch.float64),
            "first_map": torch.zeros(0, 0),
            "maps": torch.zeros(0, 0, 0),
            "limits": torch.ones(1, dtype=torch.float64),
            "newton_rank": torch.tensor(0),
            "newton_cells": torch.zeros(0, dtype=torch.int64),
            "newton_weights": empty,
            "outside_error": torch.tensor(0.0, dtype=torch.float64),
            "fitted": torch.tensor(False),
        }.items():
            self.register_buffer(name, value)
        self._stiffness = ReducedStiffness(self.stiffness)
        self._compiled: tuple[Tensor, CompiledPrediction] | None = None
        self._inverted: tuple[tuple[Tensor, Any], tuple[LawArguments, Array, Array]] | None = None
        dofs = scene.problem.free.flatten().nonzero()[:, 0]
        self.register_buffer("dofs", dofs, persistent=False)
        self.register_buffer("prescribed", scene.problem.prescribed, persistent=False)

    # ------------------------------------------------------------------ prediction

    def forward(self, force: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return displacements over L (B, N, D) [-] of forces (B, N, D) [-].

        Args:
            force: Nodal forces.
            parameters: Parameters of the law, (B, P); required if it has ranges.
        """
        given = self._given_parameters(force, parameters)
        if self._is_compiled(force, given):
            return self._compiled_fields(force, given)
        loaded = force.flatten(1)[:, self.dofs]
        linear, whole = self.coordinates(loaded, given)
        columns = self._at_free_dofs(whole)
        local = self._is_local(loaded, linear)
        if local.any():
            galerkin = self._at_free_dofs(linear[local])
            missing = self.local.missing(loaded[local], galerkin, given[local])
            columns = columns.index_add(0, local.nonzero()[:, 0], missing)
        return self._field(columns)

    def forward_in_basis(
        self, force: Tensor, parameters: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return displacements within the modes (B, N, D) and a mask of local loads, (B,)."""
        loaded = force.flatten(1)[:, self.dofs]
        linear, whole = self.coordinates(loaded, self._given_parameters(force, parameters))
        columns = self._at_free_dofs(whole)
        return self._field(columns), self._is_local(loaded, linear)

    @property
    def linear_tol(self) -> float:
        """See `FlagsLocalLoads`."""
        return self.local.tol

    @property
    def flags_local_loads(self) -> bool:
        """See `FlagsLocalLoads`."""
        return self.local.tol < torch.inf

    def coordinates(self, loaded: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return coordinates (B, R) of the Galerkin linear solution and of the prediction.

        Args:
            loaded: Forces at free degrees of freedom, (B, n).
            parameters: Parameters of the law, (B, P).
        """
        law = self.scene.problem.material.with_parameters(parameters)
        linear = self._stiffness.solve(law, loaded @ self.modes.to(loaded))
        cells = SampleCells(self.gradients.to(linear))
        matrices = self.first_map.to(linear), list(self.maps.to(linear))
        return linear, Maps(cells, *matrices, self.limits)(law, linear)

    def _at_free_dofs(self, coordinates: Tensor) -> Tensor:
        """Return V c at free degrees of freedom, (B, n), of c (B, R)."""
        return coordinates @ self.modes.mT.to(coordinates)

    def _is_compiled(self, force: Tensor, parameters: Tensor) -> bool:
        """Return True if compiled loops can predict these loads: few, and without derivatives."""
        tracing = torch.compiler.is_compiling() or torch.jit.is_tracing()
        if tracing or force.device.type != "cpu" or force.dtype != torch.float64:
            return False
        differentiable = torch.is_grad_enabled() and (
            force.requires_grad or parameters.requires_grad
        )
        law = self.scene.problem.material
        return (
            self.is_fitted
            and len(force) <= MAX_COMPILED
            and not differentiable
            and isinstance(law, InvariantBasedMaterial)
        )

    def _compiled_fields(self, force: Tensor, parameters: Tensor) -> Tensor:
        """Return displacements (B, N, D) of forces (B, N, D), one after the other."""
        fields = self.prescribed.repeat(force.shape[0], 1, 1)
        material, predict = self.scene.problem.material, self._prediction
        for one, own, field in zip(force.detach(), parameters.detach(), fields, strict=True):
            law = cast(InvariantBasedMaterial, material.with_parameters(own[None]))
            if predict(*self._at_law(law), one.numpy(), field.numpy()):
                loaded = one.flatten()[self.dofs].numpy()
                field.view(-1)[self.dofs] += torch.from_numpy(self.local.solve(loaded, own))
        return fields

    @property
    def _prediction(self) -> CompiledPrediction:
        """Compiled prediction with the present buffers."""
        if self._compiled is None or self._compiled[0] is not self.maps:
            problem = self.scene.problem
            positions = cell_positions(cell_images(problem, self.group), self.cells)
            names = ("parity", "modes", "gradients", "first_map", "maps", "limits")
            prediction = CompiledPrediction.of(
                self.group,
                problem.free,
                positions=positions,
                probes=self.local.probes,
                tol=self.local.tol,
                **{name: getattr(self, name) for name in names},
            )
            self._compiled = self.maps, prediction
        return self._compiled[1]

    def _at_law(self, law: InvariantBasedMaterial) -> tuple[LawArguments, Array, Array]:
        """Return the law, (V^T K(0) V)^-1 (R, R) and V^T K(0) p (R,), kept for the last law."""
        if self._inverted is None or not (
            self._inverted[0][0] is self.stiffness and self._inverted[0][1] == law
        ):
            whole = self._stiffness.at(law).numpy()
            inverse = np.ascontiguousarray(np.linalg.inv(whole[:, :-1]))
            known = law_arguments(law), inverse, whole[:, -1].copy()
            self._inverted = (self.stiffness, law), known
        return self._inverted[1]

    def _given_parameters(self, force: Tensor, parameters: Tensor | None) -> Tensor:
        if parameters is not None:
            return parameters
        if self.extra_inputs:
            names = list(self.scene.loads.parameter_ranges)
            raise ValueError(f"parameters are an input of this model; give {names}, (B, P)")
        return force.new_zeros(force.shape[0], 0)

    def _is_local(self, loaded: Tensor, linear: Tensor) -> Tensor:
        return self.local.is_local(loaded, linear.norm(dim=1))  # the modes are orthonormal

    def _field(self, columns: Tensor) -> Tensor:
        """Return fields (B, N, D) of values at free degrees of freedom, (B, n)."""
        fields = self.prescribed.flatten().to(columns).expand(columns.shape[0], -1)
        return fields.index_copy(1, self.dofs, columns).unflatten(1, self.prescribed.shape)

    # ------------------------------------------------------------------ fit

    @property
    def is_fitted(self) -> bool:
        """True after `fit`, or once a checkpoint has been loaded."""
        return bool(self.fitted)

    def fit(self, samples: Sample, held_out: Sample) -> None:
        """Compute modes, sample cells and maps.

        Args:
            samples: Dimensionless samples to fit to, (S, N, D).
            held_out: Samples by whose error cells, ridges and number of maps are chosen.

        Raises:
            ValueError: There are too few samples, or they are not finite.
        """
        problem = self.scene.problem
        modes = fit_modes(self.scene, samples, self.rank, self.group)
        modes, self.parity = modes_of_parity(modes, problem.free, self.group)
        stiffness = self._stiffness = ReducedStiffness.of(problem, modes).prepared()
        self.modes, self.stiffness = modes.float(), stiffness.parts
        inverse = torch.linalg.inv(stiffness.at(problem.reference.material)[:, :-1])
        self.local.fit(modes, inverse, self.group)
        solved = None if self.extra_inputs else linear_of_modes(self.scene, modes)
        sets = [
            in_coordinates(problem, modes, stiffness, part, solved, self._is_local)
            for part in (samples, held_out)
        ]
        numbers, found = fit_maps(
            problem,
            modes,
            self.group,
            self.parity,
            (sets[0], sets[1]),
            cells=self.sample_count,
            stages=self.stages,
        )
        maps = found.maps
        self.cells, self.gradients = numbers, maps.cells.gradients
        self.first_map, self.limits = maps.first.float(), maps.limits
        rows = 2 * len(self.first_map)
        none = torch.zeros(0, rows, modes.shape[1])
        self.maps = torch.stack([one.float() for one in maps.others]) if maps.others else none
        self.fitted = torch.tensor(True)
        self._fit_newton(samples, held_out)

    def _fit_newton(self, samples: Sample, held_out: Sample) -> None:
        """Choose modes and cells of Newton's method that follows the maps."""
        few = Sample(*(column[:LOADS] for column in held_out))
        guesses = self(few.force, *((few.parameters,) if self.extra_inputs else ()))
        vectors = self._orthonormal(self.modes.shape[1])
        found = choose_newton(self.scene.problem, vectors, samples.displacement, few, guesses)
        self.newton_rank = torch.tensor(0)
        if found is not None and found.cubature is not None:
            self.newton_rank = torch.tensor(found.vectors.shape[2])
            self.newton_cells, self.newton_weights = found.cubature.cells, found.cubature.weights
            self.outside_error = torch.tensor(found.outside_error, dtype=torch.float64)

    def correction(self) -> SubspaceNewton | None:
        """See `HasCorrection`."""
        rank = int(self.newton_rank)
        if not rank:
            return None
        cells = Cubature(self.newton_cells, self.newton_weights, 0.0)
        error = float(self.outside_error)
        problem = self.scene.problem
        return SubspaceNewton(problem, self._orthonormal(rank), cells, outside_error=error)

    def _orthonormal(self, rank: int) -> Tensor:
        """Return the first modes, orthonormal, (N, D, rank)."""
        return orthonormal_fields(self.modes[:, :rank], self.scene.problem.free)

    def galerkin(self, states: Tensor, *, rank: int, tolerance: float) -> SubspaceNewton:
        """Return Newton's method in the first modes; see `Correctable`.

        Args:
            states: Equilibrium displacements, (S, N, D) [-]; cells are chosen at the first 256.
            rank: Number of modes.
            tolerance: Tolerance of the choice of cells, see `dpl.fem.rom.ecsw`.

        Raises:
            ValueError: A number is out of range.
        """
        some = states[:CELL_STATES]
        modes = self._orthonormal(rank)
        return SubspaceNewton.within(self.scene.problem, modes, some, tolerance=tolerance)

    def skipped_work(self) -> list[str]:
        """Return the work that the model saves, one line each."""
        members = max(1, len(self.group))
        lines = ["no gradient descent: the maps are found by linear regression"]
        if members > 1:
            lines.append(f"no learning of {members} symmetries: the maps commute with them")
        if self.flags_local_loads:
            lines.append(
                "no modes for near fields: where the modes miss more than "
                f"{self.local.tol:.2g} of the linear solution, K(0)^-1 f is computed"
            )
        return lines

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Take the sizes of the checkpoint, which the fit has chosen."""
        resize_buffers(self, state, prefix)
        super()._load_from_state_dict(state, prefix, *rest)
        self._stiffness = ReducedStiffness(self.stiffness.detach().cpu().clone()).prepared()
