"""Unrolled reduced solver: a few iterations in a subspace whose linear maps are fitted to data."""

from functools import cached_property
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem import InvariantBasedMaterial, SubspaceNewton, estimate_error, symmetries
from dpl.fem.assembly.kernels import call_compiled
from dpl.fem.materials.heterogeneous import one_law
from dpl.fem.materials.material import Material
from dpl.fem.parity import Parities
from dpl.fem.rom.ecsw import Cubature
from dpl.fem.rom.pod import orthonormal_fields
from dpl.fem.rom.reduced_stiffness import ReducedStiffness
from dpl.fem.symmetry import SymmetryGroup
from dpl.models.interface import StoredBuffers, check_indices
from dpl.models.linear_base import SCALE_STREAM
from dpl.models.linear_response import Array, LinearResponse, OrbitArrays, Solve, largest
from dpl.models.unrolled.compiled import LawArguments, law_arguments, model_arrays
from dpl.models.unrolled.correction import LARGER, choose_newton, error_buffers
from dpl.models.unrolled.fit import fit_in_best_modes, sampled_terms
from dpl.models.unrolled.loops import ModelArrays, predict
from dpl.models.unrolled.products import Tensors, in_rows, nonlinear_coordinates
from dpl.scene import Sample, Scene
from dpl.system.checks import check_range
from dpl.system.threads import on_threads

FEW = 8  # loads by which stored errors are compared with measured ones
MAX_SIZE = 100_000  # of rank, cells and stages
# buffers and axes with the numbers of modes, cells, maps, and modes and cells of Newton's method
SIZES = (("modes", 1), ("cells", 0), ("maps", 0), ("newton_modes", 1), ("newton_cells", 0))


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
    Each iteration is a quasi-Newton iteration of the reduced equilibrium: the residual is sampled
    at a few cells (hyper-reduction), and the preconditioner and the weights of the cells are
    fitted. The matrices B are found one after the other by ridge regression on the training
    samples. The ridge shrinks them to the matrices of a modified Newton iteration
    (`mechanical_maps`). It is chosen by leave-one-out errors.

    c_lin is the equilibrium of the linear body in the same modes as c. It differs from the linear
    solution, but the maps only ever see fields in the modes. c_lin and phi of a nearly
    incompressible body are those of a compressible one, see `sampled_terms`.

    The numbers of modes and maps are chosen by the error of the held-out samples. Each mode
    is even or odd under the reflections and half turns of the body (`dpl.fem.parity`), and the maps
    commute with these, so that the answer has these symmetries exactly. The fit uses the images of
    the samples under the others. The answer has them nearly.

    K(0)^-1 f is computed for every load by products with dense blocks, see `LinearResponse`. The
    module takes and returns dimensionless float64 fields. It has no trained parameters.

    Sources: Gregor, LeCun (2010), Learning fast approximations of sparse coding, ICML (unrolled
    iterations); Farhat, Avery, Chapman, Cortial (2014), Int. J. Numer. Methods Eng. 98
    (hyper-reduction).

    Attributes:
        scene: The scene to predict.
        linear: The linear solution.
        terms: K(0) of the body whose law is sampled.
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
        newton_cells, newton_weights: Cells of its tangent, and their weights, (C,).
        newton_gains: Gains of its steps, (K, K), see `SubspaceNewton`.
        error_factors, error_exponents: Estimated errors of the prediction, and of what Newton's
            method leaves, by the sizes of the corrections, (2,) and (2, K + 2), see `fit_errors`;
            the factors are logarithms.
        least_sizes: Sizes that a tenth of the held-out samples do not reach, (K + 2,). Smaller ones
            count as these.
        largest_residual: `LARGER` times that of the held-out predictions, see `HasCorrection`.
        ratios: Measured over estimated errors of the first `FEW` loads of a stream, (`FEW`, 2).
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
    newton_gains: Tensor
    error_factors: Tensor
    error_exponents: Tensor
    least_sizes: Tensor
    largest_residual: Tensor
    ratios: Tensor
    fitted: Tensor
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
            cells: Number of sample cells; a few more, if symmetries demand it.
            stages: Largest number of iterations after the first map.
            symmetry: Find the symmetries of the body and build them into the answer.
        """
        super().__init__()
        check_range(1, MAX_SIZE, rank=rank, cells=cells)
        check_range(0, MAX_SIZE, stages=stages)
        constant, problem = scene.loads.constant_force, scene.problem
        problem.material.require_known("Unrolled")
        self.scene, self.rank, self.sample_count, self.stages = scene, rank, cells, stages
        also = [] if constant is None else [constant]
        self.group = symmetries(problem, also=also) if symmetry else SymmetryGroup.identity(problem)
        self.linear = LinearResponse(scene, self.group)
        self.terms = sampled_terms(self.linear.terms)
        self._has_loops = isinstance(one_law(problem.reference.material), InvariantBasedMaterial)
        for name, (shape, dtype) in self._layout().items():
            self.register_buffer(name, torch.zeros(shape, dtype=dtype))
        self.register_buffer("prescribed", problem.prescribed, persistent=False)
        self._prepare()

    def _layout(
        self, modes: int = 0, cells: int = 0, maps: int = 0, newton_modes: int = 0, newton: int = 0
    ) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Return shapes and types of the buffers for numbers of modes, cells, maps, see `SIZES`."""
        free, dim = int(self.scene.problem.free.sum()), self.scene.problem.shape[1]
        entries = cells * dim * dim
        return {
            "modes": ((free, modes), torch.float32),
            "parity": ((modes,), torch.int64),
            "stiffness": ((len(self.terms) + 1, modes, modes + 1), torch.float64),
            "cells": ((cells,), torch.int64),
            "gradients": ((modes + 1, cells, dim, dim), torch.float64),
            "first_map": ((entries, modes), torch.float32),
            "maps": ((maps, 2 * entries, modes), torch.float32),
            "limits": ((1 + maps,), torch.float64),
            "newton_modes": ((free, newton_modes), torch.float32),
            "newton_cells": ((newton,), torch.int64),
            "newton_weights": ((newton,), torch.float64),
            "newton_gains": ((newton_modes, newton_modes), torch.float64),
            "error_factors": ((2,), torch.float64),
            "error_exponents": ((2, 2 + maps), torch.float64),
            "least_sizes": ((2 + maps,), torch.float64),
            "largest_residual": ((), torch.float64),
            "ratios": ((FEW, 2), torch.float64),
            "fitted": ((), torch.bool),
        }

    # ------------------------------------------------------------------ prediction

    def forward(self, force: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return displacements over L (B, N, D) [-] of forces (B, N, D) [-].

        The parameters (B, P) of a law with ranges are required.
        """
        return self._fields(force, parameters)[0]

    def forward_with_errors(
        self, force: Tensor, parameters: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return displacements and their estimated errors, see `HasCorrection`."""
        fields, sizes = self._fields(force, parameters)
        return fields, self._doubt * self._stored_errors(sizes)

    def _stored_errors(self, sizes: Tensor) -> Tensor:
        """Return the estimated relative errors (B, 2) of sizes (B, K + 2)."""
        logs = torch.maximum(sizes, self.least_sizes).log()
        return torch.addmm(self.error_factors, logs, self.error_exponents.T).exp()

    @cached_property
    def _doubt(self) -> float:
        """Factor on stored errors, above 1 if measured ones exceed them by more than at the fit."""
        change = float((self._ratios() / self.ratios.clamp(min=1e-300)).max())
        return 1.0 if change <= LARGER else change

    def _ratios(self) -> Tensor:
        """Return measured over stored errors of a few random loads, (`FEW`, 2).

        The measured error is a corotational correction, a hundred times too large on thin bodies.
        """
        scene, load = self.scene, self.scene.loads.sample((0, SCALE_STREAM), range(FEW))
        fields, sizes = self._fields(load.force, load.parameters)
        pairs = zip(load.unbatch(), fields.split(1), strict=True)
        measured = [estimate_error(scene.linear, *pair, products=0).error for pair in pairs]
        return torch.tensor(measured, dtype=torch.float64)[:, None] / self._stored_errors(sizes)

    def _fields(self, force: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return displacements and the sizes of their corrections, (B, K + 2)."""
        if parameters is None:
            if names := list(self.scene.loads.parameter_ranges):
                raise ValueError(f"parameters are an input of this model; give {names}, (B, P)")
            parameters = force.new_zeros(force.shape[0], 0)
        force, parameters = self.linear.dead_loads(force, parameters)
        if self._is_compiled(force, parameters):
            return self._compiled_fields(force, parameters)
        factors = self.terms.factors(self.terms.problem.material.with_parameters(parameters))
        parts, solved = self.linear.by_parity(force, parameters)  # (B, M, m)
        model, of_samples, places = self._tensors(force.device)
        unit = largest(parts.flatten(1))  # over which float32 holds forces, displacements, (B, 1)
        scaled = (parts.permute(1, 2, 0) / unit.T).to(model.modes)  # (M, m, B)
        right = (model.modes @ scaled).flatten(0, 1).index_select(0, places)
        linear = self._stiffness.solve(factors, unit * right.T)  # Galerkin
        padded = pad(linear, (0, 1)).T.index_select(0, model.columns.flatten())
        law = of_samples.with_parameters(parameters)
        c, sizes = nonlinear_coordinates(model, law, padded.unflatten(0, model.columns.shape))
        added = (model.modes.mT @ (c / unit.T).to(model.modes)).permute(2, 0, 1)
        solved = solved + unit[..., None] * added
        return (self.prescribed + self.linear.fields(solved)).to(force), sizes

    def _prepare(self) -> None:
        """Prepare what follows from the buffers."""
        parts = self.stiffness.detach().cpu().clone()
        self._stiffness = ReducedStiffness(parts, self.terms)
        self._last: tuple[Tensor, tuple[LawArguments, Array, Solve]] | None = None
        self._kept: dict[torch.device, tuple[Tensors, Material, Tensor]] = {}
        for name in ("_doubt", "_arrays"):
            self.__dict__.pop(name, None)

    def _tensors(self, device: torch.device) -> tuple[Tensors, Material, Tensor]:
        """Return arrays as tensors, the law of their cells, and positions of the modes, (R,)."""
        if device in self._kept:
            return self._kept[device]
        arrays, cells = self._arrays

        def on_device(array: Any) -> Any:
            return torch.from_numpy(array).to(device)

        orbits = OrbitArrays(*map(on_device, arrays.orbits))
        modes = on_device(arrays.modes.astype(self.linear.blocks.dtype))
        model = in_rows(ModelArrays(orbits, *map(on_device, arrays[1:])))._replace(modes=modes)
        law = self.terms.problem.material.of_cells(self.cells.cpu()[cells]).centred()
        places = on_device(arrays.columns.ravel().argsort()[: self.modes.shape[1]])
        found = model, law, places
        if not torch.compiler.is_compiling():  # tensors of a traced graph lack values
            self._kept[device] = found
        return found

    def _is_compiled(self, force: Tensor, parameters: Tensor) -> bool:
        """Return True if compiled loops can predict these loads: on the CPU, no derivatives."""
        tracing = torch.compiler.is_compiling() or torch.jit.is_tracing()
        if tracing or force.device.type != "cpu" or force.dtype != torch.float64:
            return False
        tracked = torch.is_grad_enabled() and (force.requires_grad or parameters.requires_grad)
        return self.is_fitted and self._has_loops and not tracked

    def _compiled_fields(self, force: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the same as `_fields` by compiled loops, on the threads of torch."""
        fields = torch.empty_like(force).copy_(self.prescribed)
        sizes = fields.new_zeros(force.shape[0], 2 + len(self.maps))
        arrays, _ = self._arrays
        forces, parameters = force.detach(), parameters.detach()

        def predict_one(k: int) -> None:
            law, inverse, solve = self._at(parameters[k : k + 1])
            linear = solve(forces[k].numpy())
            out = fields[k].view(-1).numpy(), sizes[k].numpy()
            call_compiled(predict, *law, arrays, inverse, *linear, *out)

        on_threads(predict_one, range(len(forces)))
        return fields, sizes

    @cached_property
    def _arrays(self) -> tuple[ModelArrays, Tensor]:
        """Arrays of the compiled prediction, see `model_arrays`."""
        images = self.group.cell_images(self.scene.problem)[:, self.cells]
        buffers = {name: getattr(self, name) for name in self._layout()}
        return model_arrays(self.linear, torch.searchsorted(self.cells, images), buffers)

    def _at(self, parameters: Tensor) -> tuple[LawArguments, Array, Solve]:
        """Return law, reduced inverse and linear solution of parameters (1, P), the last kept."""
        last = self._last  # read once: another thread may replace it
        if last and torch.equal(last[0], parameters):
            return last[1]
        law = self.terms.problem.material.with_parameters(parameters)
        of_cells = one_law(law.of_cells(self.cells[self._arrays[1]]).centred())
        inverse, _ = self._stiffness.inverse(self.terms.factors(law))
        arguments = law_arguments(cast("InvariantBasedMaterial", of_cells))
        linear = self.linear.at(self.scene.problem.material.with_parameters(parameters))
        found = arguments, inverse, linear
        self._last = parameters.clone(), found
        return found

    # ------------------------------------------------------------------ fit

    @property
    def is_fitted(self) -> bool:
        """True after `fit`, or once a checkpoint has been loaded."""
        return bool(self.fitted)

    def fit(self, samples: Sample, held_out: Sample) -> None:
        """Compute modes, sample cells and maps; Newton's method in modes; and estimated errors.

        Args:
            samples: Dimensionless samples to fit to, (S, N, D).
            held_out: Samples by whose errors the numbers of modes and maps are chosen, and to
                which the estimated errors are fitted.

        Raises:
            ValueError: There are too few samples, or they are not finite.
        """
        options = {"rank": self.rank, "cells": self.sample_count, "stages": self.stages}
        dead = self._of_dead_loads(samples), self._of_dead_loads(held_out)
        best, modes, unseen = fit_in_best_modes(self.linear, self.terms, dead, **options)
        for name, buffer in best.items():
            setattr(self, name, buffer)
        self._prepare()
        self.fitted = torch.tensor(True)
        guesses, sizes = self._fields(held_out.force, held_out.parameters)
        found, left = choose_newton(self.scene.problem, modes, samples, unseen, held_out, guesses)
        assert found.cubature is not None  # cells and gains are always chosen
        self.newton_modes = modes[0][:, : found.vectors.shape[2]].float()
        self.newton_cells, self.newton_weights = found.cubature.cells, found.cubature.weights
        self.newton_gains = cast("Tensor", found.gains)
        found_errors = error_buffers(self.scene.problem, held_out, guesses, sizes, left)
        for name, buffer in found_errors.items():
            setattr(self, name, buffer)
        self.ratios = self._ratios()

    def _of_dead_loads(self, samples: Sample) -> Sample:
        """Return samples whose nodal forces contain the follower loads at rest."""
        force, parameters = self.linear.dead_loads(samples.force, samples.parameters)
        return samples._replace(force=force, parameters=parameters)

    def correction(self) -> SubspaceNewton | None:
        if not self.newton_modes.shape[1]:
            return None
        self._doubt  # noqa: B018  # computed here, so that the first prediction is not slower
        vectors = orthonormal_fields(self.newton_modes, self.scene.problem.free)
        cells = Cubature(self.newton_cells, self.newton_weights, 0.0)
        return SubspaceNewton(self.scene.problem, vectors, cells, gains=self.newton_gains)

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
        problem, cells = self.scene.problem, self.cells
        check_indices(len(problem.cells), cells=cells, newton_cells=self.newton_cells)
        parities = Parities.of(self.group, problem.shape[1])
        check_indices(len(parities.members), parity=self.parity)
        images = self.group.cell_images(problem)[:, cells.cpu()]
        if (cells.diff() <= 0).any() or not torch.isin(images, cells.cpu()).all():
            raise ValueError("cells must ascend and have all images under the symmetries")
        for name in ("limits", "newton_weights", "least_sizes", "largest_residual", "ratios"):
            if (getattr(self, name) < 0).any():
                raise ValueError(f"{name} must be 0 or more")
        factors = self.terms.factors(self.terms.problem.reference.material)
        matrix = ReducedStiffness(self.stiffness.cpu(), self.terms).at(factors)[0, :, :-1]
        if torch.linalg.cholesky_ex(matrix).info:
            raise ValueError("stiffness must be positive definite")
