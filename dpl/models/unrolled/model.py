"""Unrolled reduced solver: a few iterations in a subspace whose linear maps are fitted to data."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from dpl.fem import InvariantBasedMaterial, Material, SubspaceNewton, symmetries
from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.parity import Parities
from dpl.fem.rom.ecsw import Cubature, refuse_follower_loads
from dpl.fem.rom.pod import orthonormal_fields
from dpl.fem.rom.reduced_stiffness import ReducedInverse, ReducedStiffness
from dpl.fem.symmetry import SymmetryGroup
from dpl.models.linear_base import SCALE_STREAM
from dpl.models.linear_response import Array, LinearResponse
from dpl.models.stored_buffers import StoredBuffers, check_indices
from dpl.models.unrolled.compiled import CompiledPrediction, LawArguments, law_arguments
from dpl.models.unrolled.correction import LOADS, choose_newton, remaining_error
from dpl.models.unrolled.features import SampleCells
from dpl.models.unrolled.fit import Maps, fit_in_best_modes
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.threads import on_threads

FEW = 8  # loads at which the error outside the modes is measured
LARGER = 3.0  # ratio of a measured to a stored error up to which both are plausible
MAX_SIZE = 100_000  # of rank, cells and stages
# buffers and axes with the numbers of modes, cells, maps, and modes and cells of Newton's method
SIZES = (("modes", 1), ("cells", 0), ("maps", 0), ("newton_modes", 1), ("newton_cells", 0))
_AtLaw = tuple[LawArguments, ReducedInverse, Callable[[Array], Array]]


class Unrolled(StoredBuffers):
    """Linear solution and a few quasi-Newton iterations with fitted maps.

    With R modes V of the nonlinear displacement and G, which maps their coordinates to displacement
    gradients at C sample cells:

        c_lin = (V^T K(0) V)^-1 V^T f,   H_lin = G c_lin
        c_1   = phi_0(H_lin) B_0
        c_k+1 = c_k + phi(G (c_lin + c_k), H_lin) B_k
        u     = K(0)^-1 f + V c

    phi_0 is the rotated strain of the linear solution minus the linear one (`rotated_strain`), phi
    the stress that is not balanced, in the present and in the rotated frame (`unbalanced_stress`).
    The matrices B are found by ridge regression on the training samples, one after the other. Each
    iteration is a quasi-Newton iteration of the reduced equilibrium: the residual is sampled at
    a few cells (hyper-reduction), and the preconditioner and the weights of the cells are fitted.

    c_lin is the equilibrium of the linear body in the same modes as c. It differs from the linear
    solution, but the maps only ever see fields in the modes.

    Number of modes and of cells, ridges and number of maps are chosen by the error of the held-out
    samples. Each mode is even or odd under the reflections and half turns of the body
    (`dpl.fem.parity`), and the maps commute with these, so that the answer has these symmetries
    exactly. The fit uses the images of the samples under the others. The answer has them nearly.

    K(0)^-1 f is computed for every load by products with dense blocks, see `LinearResponse`.

    The module takes and returns dimensionless float64 fields. It has no trained parameters.

    Sources: Gregor, LeCun (2010), Learning fast approximations of sparse coding, ICML (unrolled
    iterations); Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98
    (hyper-reduction).

    Attributes:
        scene: The scene to predict.
        linear: The linear solution.
        modes: V at free degrees of freedom, (n, R).
        parity: Parity of each mode, (R,), see `dpl.fem.parity`.
        stiffness: V^T K(0) [V, p] by its dependence on the moduli, see `ReducedStiffness`,
            (T + 1, R, R + 1); p is the prescribed displacement.
        cells: Numbers of the sample cells, (C,).
        gradients: G and the gradients of p, (R + 1, C, D, D).
        first_map: B_0, (C D D, R).
        maps: B_1, B_2, ..., (K, 2 C D D, R).
        limits: Largest ratio of each correction to the one before, (1 + K,): 1.5 times that of the
            samples. They keep loads far out of range from running away.
        newton_modes: Modes of Newton's method that follows, (n, K).
        newton_cells: Cells of its tangent, (C,).
        newton_weights: Their weights, (C,).
        outside_error: Largest relative error that it left at held-out samples, (). `correction`
            takes the error that it measures at a few loads if that is `LARGER` times as large.
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
    newton_modes: Tensor
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
    ) -> None:
        """Build the module; `fit` computes its contents.

        Args:
            scene: The scene to predict.
            rank: Largest number of modes of the displacement.
            cells: Largest number of sample cells; a few more, if symmetries demand it.
            stages: Largest number of iterations after the first map.
            symmetry: Find the symmetries of the body and build them into the answer.
        """
        super().__init__()
        check_range(1, MAX_SIZE, rank=rank, cells=cells)
        check_range(0, MAX_SIZE, stages=stages)
        self.scene = scene
        self.rank, self.sample_count, self.stages = rank, cells, stages
        refuse_follower_loads(scene.problem, "model=unrolled")
        constant = scene.loads.constant_force
        also = [] if constant is None else [constant]
        problem = scene.problem
        self.group = symmetries(problem, also=also) if symmetry else SymmetryGroup.identity(problem)
        self.extra_inputs = ("parameters",) if scene.loads.parameter_ranges else ()
        self.linear = LinearResponse(scene, self.group)
        for name, (shape, dtype) in self._layout().items():
            self.register_buffer(name, torch.zeros(shape, dtype=dtype))
        self._stiffness = ReducedStiffness(self.stiffness, self.linear.iteration)
        self._compiled: tuple[Tensor, CompiledPrediction] | None = None
        self._law_of_samples = scene.problem.material  # perhaps with ranges
        self._at_last_law: tuple[tuple[Tensor, Any], _AtLaw] | None = None
        dofs = scene.problem.free.flatten().nonzero()[:, 0]
        self.register_buffer("dofs", dofs, persistent=False)
        self.register_buffer("prescribed", scene.problem.prescribed, persistent=False)

    def _layout(
        self, modes: int = 0, cells: int = 0, maps: int = 0, newton_modes: int = 0, newton: int = 0
    ) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Return shapes and types of the buffers for numbers of modes, cells, maps, see `SIZES`."""
        free, dim = int(self.scene.problem.free.sum()), self.scene.problem.shape[1]
        entries = cells * dim * dim
        return {
            "modes": ((free, modes), torch.float32),
            "parity": ((modes,), torch.int64),
            "stiffness": ((len(self.linear.terms) + 1, modes, modes + 1), torch.float64),
            "cells": ((cells,), torch.int64),
            "gradients": ((modes + 1, cells, dim, dim), torch.float64),
            "first_map": ((entries, modes), torch.float32),
            "maps": ((maps, 2 * entries, modes), torch.float32),
            "limits": ((1 + maps,), torch.float64),
            "newton_modes": ((free, newton_modes), torch.float32),
            "newton_cells": ((newton,), torch.int64),
            "newton_weights": ((newton,), torch.float64),
            "outside_error": ((), torch.float64),
            "fitted": ((), torch.bool),
        }

    # ------------------------------------------------------------------ prediction

    def forward(self, force: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return displacements over L (B, N, D) [-] of forces (B, N, D) [-].

        Args:
            force: Nodal forces.
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.
        """
        given = self._given_parameters(force, parameters)
        if self._is_compiled(force, given):
            return self._compiled_fields(force, given)
        loaded = force.flatten(1)[:, self.dofs]
        linear = self.linear(loaded, given)
        return self._field(linear + self._at_free_dofs(self.coordinates(loaded, given)))

    def coordinates(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        """Return coordinates (B, R) of the nonlinear displacement.

        Args:
            loaded: Forces at free degrees of freedom, (B, n).
            parameters: Parameters of the law, (B, P).
        """
        law = self.scene.problem.material
        factors = self.linear.terms.factors(law.with_parameters(parameters))
        linear = self._stiffness.solve(factors, loaded @ self.modes.to(loaded))
        cells = SampleCells(self.gradients.to(linear))
        matrices = self.first_map.to(linear), list(self.maps.to(linear))
        of_cells = self._law_of_samples.with_parameters(parameters)
        return Maps(cells, *matrices, self.limits)(of_cells, linear)

    def _prepare(self) -> None:
        """Prepare what a traced graph takes as constants, after the buffers have changed."""
        parts = self.stiffness.detach().cpu().clone()
        self._stiffness = ReducedStiffness(parts, self.linear.iteration)
        self._law_of_samples = self.scene.problem.material.of_cells(self.cells.cpu()).centred()

    def _at_free_dofs(self, coordinates: Tensor) -> Tensor:
        """Return V c at free degrees of freedom, (B, n), of c (B, R)."""
        return coordinates @ self.modes.mT.to(coordinates)

    def _is_compiled(self, force: Tensor, parameters: Tensor) -> bool:
        """Return True if compiled loops can predict these loads: on the CPU, no derivatives."""
        tracing = torch.compiler.is_compiling() or torch.jit.is_tracing()
        if tracing or force.device.type != "cpu" or force.dtype != torch.float64:
            return False
        differentiable = torch.is_grad_enabled() and (
            force.requires_grad or parameters.requires_grad
        )
        law = one_law(self.scene.problem.reference.material)
        return self.is_fitted and not differentiable and isinstance(law, InvariantBasedMaterial)

    def _compiled_fields(self, force: Tensor, parameters: Tensor) -> Tensor:
        """Return displacements (B, N, D) of forces (B, N, D), on the threads of torch."""
        fields = self.prescribed.repeat(force.shape[0], 1, 1)
        material, predict = self.scene.problem.material, self._prediction
        forces, parameters = force.detach(), parameters.detach()

        def predict_one(k: int) -> None:
            law = material.with_parameters(parameters[k : k + 1])
            arguments, reduced, solve = self._at_law(law)
            parts = self.linear.parts(forces[k].numpy())
            predict(arguments, reduced, parts, solve(parts), fields[k].numpy())

        on_threads(predict_one, range(len(forces)))
        return fields

    @property
    def _prediction(self) -> CompiledPrediction:
        """Compiled prediction with the present buffers."""
        if self._compiled is None or self._compiled[0] is not self.maps:
            problem = self.scene.problem
            images = self.group.cell_images(problem)[:, self.cells]
            names = ("parity", "modes", "gradients", "first_map", "maps", "limits")
            prediction = CompiledPrediction.of(
                self.group,
                problem.free,
                positions=torch.searchsorted(self.cells, images),
                **{name: getattr(self, name) for name in names},
            )
            self._compiled = self.maps, prediction
        return self._compiled[1]

    def _at_law(self, law: Material) -> _AtLaw:
        """Return the law, the reduced body and the linear solution, kept for one law."""
        last = self._at_last_law  # read once: another thread may replace it
        if last is not None and last[0][0] is self.stiffness and last[0][1] == law:
            return last[1]
        of_cells = one_law(law.of_cells(self.cells[self._prediction.cells]).centred())
        reduced = self._stiffness.inverse(self.linear.terms.factors(law))
        isotropic = cast("InvariantBasedMaterial", of_cells)
        found = law_arguments(isotropic), reduced, self.linear.at(law)
        self._at_last_law = (self.stiffness, law), found
        return found

    def _given_parameters(self, force: Tensor, parameters: Tensor | None) -> Tensor:
        if parameters is not None:
            return parameters
        if self.extra_inputs:
            names = list(self.scene.loads.parameter_ranges)
            raise ValueError(f"parameters are an input of this model; give {names}, (B, P)")
        return force.new_zeros(force.shape[0], 0)

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
        options = {"rank": self.rank, "cells": self.sample_count, "stages": self.stages}
        best, every = fit_in_best_modes(
            problem, self.group, self.linear, (samples, held_out), **options
        )
        for name, buffer in best._asdict().items():
            setattr(self, name, buffer)
        self._prepare()
        self.fitted = torch.tensor(True)
        self._fit_newton(every, samples, held_out)

    def _fit_newton(self, every: Tensor, samples: Sample, held_out: Sample) -> None:
        """Choose modes and cells of Newton's method that follows the maps.

        Args:
            every: Modes to choose from, the most important one first, (n, R).
            samples, held_out: See `fit`.
        """
        few = Sample(*(column[:LOADS] for column in held_out))
        guesses = self(few.force, *((few.parameters,) if self.extra_inputs else ()))
        problem, states = self.scene.problem, samples.displacement
        vectors = orthonormal_fields(every, problem.free)
        found = choose_newton(problem, vectors, states, few, guesses)
        self.newton_modes = every[:, : found.vectors.shape[2]].float()
        assert found.cubature is not None  # cells are always chosen
        self.newton_cells, self.newton_weights = found.cubature.cells, found.cubature.weights
        self.outside_error = torch.tensor(found.outside_error, dtype=torch.float64)

    def correction(self) -> SubspaceNewton | None:
        if not self.newton_modes.shape[1]:
            return None
        problem, load = self.scene.problem, self.scene.loads.sample((0, SCALE_STREAM), range(FEW))
        vectors = orthonormal_fields(self.newton_modes, problem.free)
        cells = Cubature(self.newton_cells, self.newton_weights, 0.0)
        solver = SubspaceNewton(problem, vectors, cells)
        guesses = self(load.force, *((load.parameters,) if self.extra_inputs else ()))
        measured = remaining_error(solver, self.scene.linear, load, guesses)
        stored = float(self.outside_error)  # of more loads, by their solutions
        return replace(solver, outside_error=stored if measured <= LARGER * stored else measured)

    def skipped_work(self) -> list[str]:
        """Return the work that the model saves, one line each."""
        members = len(self.group)
        lines = [
            "no gradient descent: the maps are found by linear regression",
            "no modes for linear solutions: K(0) is condensed into dense blocks",
        ]
        if members > 1:
            lines.append(f"no solves for {members - 1} symmetries: images of samples are fitted")
        return lines

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Take the sizes of the checkpoint, which the fit has chosen."""
        known = [name for name in self._layout() if f"{prefix}{name}" in state]
        shapes = {name: tuple(state[f"{prefix}{name}"].shape) for name in known}
        sizes = [dict(enumerate(shapes.get(name, ()))).get(axis, 0) for name, axis in SIZES]
        for name, (shape, _) in self._layout(*sizes).items():
            if shapes.get(name, shape) != shape:
                raise ValueError(f"{prefix}{name} of shape {shapes[name]} must have shape {shape}")
            setattr(self, name, getattr(self, name).new_zeros(shape))
        super()._load_from_state_dict(state, prefix, *rest)
        self._prepare()

    def check_buffers(self) -> None:
        problem = self.scene.problem
        count, cells = len(problem.cells), self.cells
        check_indices(count, cells=cells, newton_cells=self.newton_cells)
        parities = Parities.of(self.group, problem.shape[1])
        check_indices(len(parities.members), parity=self.parity)
        images = self.group.cell_images(problem)[:, cells.cpu()]
        if (cells.diff() <= 0).any() or not torch.isin(images, cells.cpu()).all():
            raise ValueError("cells must ascend and have all images under the symmetries")
        for name in ("limits", "newton_weights", "outside_error"):
            if (getattr(self, name) < 0).any():
                raise ValueError(f"{name} must be 0 or more")
        factors = self.linear.terms.factors(problem.reference.material)
        matrix = ReducedStiffness(self.stiffness.cpu(), self.linear.iteration).at(factors)[
            0, :, :-1
        ]
        if torch.linalg.cholesky_ex(matrix).info:
            raise ValueError("stiffness must be positive definite")
