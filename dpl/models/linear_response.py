"""The linear solution K(0)^-1 f of a load: by a factor of K(0), or in modes."""

import itertools
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from dpl.fem import LinearSolver
from dpl.fem.linear.interface import SymmetricProduct
from dpl.fem.linear.krylov import conjugate_gradients
from dpl.fem.linear.ordering import band_storage
from dpl.fem.materials.material import Material
from dpl.fem.parity import Parities
from dpl.fem.rom.compiled_prediction import LinearPrediction
from dpl.fem.rom.reduced_problem import support_force
from dpl.fem.rom.reduced_stiffness import ReducedInverse, ReducedStiffness
from dpl.fem.solvers.parity_factor import ParityFactor
from dpl.fem.symmetry import Symmetry
from dpl.models.invariant_basis import InvariantPOD, image_columns, modes_of_parity, stride
from dpl.scene import Scene

MAX_ENTRIES = 4_000_000  # of a factor of K(0) by parity that is applied to every load
MAX_SIZE = 50_000  # degrees of freedom of a body with such a factor
MODE_TOL = 5e-4  # default of `tol` where the linear solution is computed in modes
MAX_LOADS = 1024  # loads whose linear solutions the modes represent
FEW_LOADS = 256  # the same where only exported graphs use the modes
FEW_CHECKED = 16  # loads on which the rounding of the factor is measured
MAX_ROUNDING = 1e-4  # relative error of a linear solution with a factor in float32 [-]
MIN_PROBES = 16  # random fields that estimate the size of the missing part
RTOL = 1e-5  # relative residual of a linear solution whose parameters differ from the reference
MAX_ITER = 200
NO_INVERSE: ReducedInverse = np.zeros((0, 0)), np.zeros(0)
CHUNK = 256  # loads that are solved at a time
MAX_SINGLE = 4  # loads that are solved one by one: solves of blocks cost as much as many loads


class LinearResponse(nn.Module):
    """The linear solution of a load.

    Banded factors of K(0) by parity that are small enough are applied to every load. Otherwise the
    linear solution is the Galerkin solution in POD modes of linear solutions. A few global modes
    cannot represent the displacement near a load on a small area. The size of the missing part is
    estimated from products with random fields and all their images, without a solve, so that it is
    the same for a load and its images. Where it is too large, the load is local and K(0)^-1 f is
    computed, with the factor as preconditioner if the law has ranges.

    Source: Halko, Martinsson, Tropp (2011), SIAM Rev. 53, section 4.3 (estimate of a norm from
    random products).

    Attributes:
        tol: Norm of the missing part over that of the linear solution above which a load is local
            [-].
        exact: True if the factor is applied to every load, ().
        modes: L at free degrees of freedom, (n, R).
        parity: Parity of each mode, (R,), see `dpl.fem.parity`.
        stiffness: L^T K(0) [L, p], see `ReducedStiffness`, (3, R, R + 1).
        probes: Random fields, multiplied by K(0)^-1 - L (L^T K(0) L)^-1 L^T, (n, F).
    """

    exact: Tensor
    modes: Tensor
    parity: Tensor
    stiffness: Tensor
    probes: Tensor

    def __init__(self, scene: Scene, group: list[Symmetry], tol: float | None) -> None:
        """Choose the method.

        Args:
            scene: The scene with the factor of K(0).
            group: Symmetries of the body.
            tol: See the attribute. 0: the factor for every load; None: the same if it is small
                enough and float32 accurate enough, and the law has no ranges, else 5e-4.
        """
        super().__init__()
        self._scene, self.group = scene, group
        ranges = bool(scene.loads.parameter_ranges)
        self._is_chosen = tol is None
        exact = tol == 0 or (tol is None and not ranges and self._is_cheap)
        self.tol = tol or MODE_TOL
        count = int(scene.problem.free.sum())
        for name, value in {
            "exact": torch.tensor(exact),
            "modes": torch.zeros(count, 0),
            "parity": torch.zeros(0, dtype=torch.int64),
            "stiffness": torch.zeros(3, 0, 1, dtype=torch.float64),
            "probes": torch.zeros(count, 0),
        }.items():
            self.register_buffer(name, value)
        self.reduced = ReducedStiffness(self.stiffness)

    @property
    def is_exact(self) -> bool:
        """True if the factor is applied to every load."""
        return bool(self.exact)

    @cached_property
    def _is_cheap(self) -> bool:
        """True if banded factors of K(0) by parity have few entries."""
        problem = self._scene.problem
        if problem.pattern.size > MAX_SIZE:
            return False
        members = len(Parities.of(self.group, problem.shape[1]).members)
        entries = problem.pattern.size * (band_storage(problem.pattern).half + 1)
        return entries <= MAX_ENTRIES * members

    @cached_property
    def _factor(self) -> ParityFactor | None:
        """Factor of K(0) of the reference body; None where compiled loops use modes."""
        if not self.is_exact or self._scene.loads.parameter_ranges or not self._is_cheap:
            return None
        reference = self._scene.linear.reference
        shared = reference.float32_factor
        if isinstance(shared, ParityFactor) and len(self.group) == len(reference.symmetries):
            return shared  # of the same group, in the same order
        return ParityFactor.of(reference.problem, self.group)

    def compiled(self) -> LinearPrediction:
        """Return the linear solution as a part of a compiled prediction.

        Loads that need a solve which compiled loops do not contain are marked as local.
        """
        factor, count = self._factor, self.modes.shape[1]
        tol = 0.0 if self.is_exact else self.tol
        used = 0 if factor else count  # modes
        probes = self.probes[:, : 0 if factor else None]
        supports = support_force(self._scene.problem.reference)
        modes, parity = self.modes[:, :used], self.parity[:used]
        return LinearPrediction(factor, supports, modes, parity, probes, tol)

    def inverse(self, law: Material) -> ReducedInverse:
        """Return (L^T K(0) L)^-1, (R, R), and L^T K(0) p, (R,), as far as `compiled` uses them."""
        return self.reduced.inverse(law) if self._factor is None else NO_INVERSE

    # ------------------------------------------------------------------ fit

    def fit(self, force: Tensor, rank: int) -> None:
        """Compute modes and probes.

        For laws with ranges the modes represent solutions at their ends and centres.

        Args:
            force: Forces of the training samples, (S, N, D).
            rank: Largest number of modes.
        """
        self.__dict__.pop("_factor", None)
        if self.is_exact and self._is_chosen:
            self.exact = torch.tensor(self._rounding(force[:FEW_CHECKED]) < MAX_ROUNDING)
        most = FEW_LOADS if self.is_exact else MAX_LOADS
        some = force[:: max(1, -(-len(force) // most))][:, self._free]
        some = some[:: stride(len(some), some.shape[1])]
        basis = InvariantPOD(self._free, self.group, len(some))
        solvers = self._corners()
        for k, solver in enumerate(solvers):
            for part in some[k :: len(solvers)].split(CHUNK):
                basis.add(self._solved(solver, part))
        modes, self.parity = modes_of_parity(basis.modes(rank), self._free, self.group)
        problem = self._scene.problem
        self.reduced = ReducedStiffness.of(problem, modes).prepared()
        self.modes, self.stiffness = modes.float(), self.reduced.parts
        reference = self._scene.linear.reference
        inverse, _ = self.reduced.inverse(reference.problem.material)
        members = max(1, len(self.group))
        random = torch.Generator().manual_seed(0)
        count = -(-MIN_PROBES // members)
        fields = torch.randn(count, len(modes), generator=random, dtype=torch.float64)
        parts = [image_columns(fields, self._free, self.group, k) for k in range(members)]
        every = torch.cat(parts)
        exact = torch.from_numpy(reference.factor.solve_many(every.numpy()))
        inside = modes @ (torch.from_numpy(inverse) @ (modes.T @ every.T))
        self.probes = (exact.T - inside).to(self.probes)

    def _rounding(self, force: Tensor) -> float:
        """Return the largest relative error of linear solutions with the factor in float32."""
        loaded = force[:, self._free]
        right = loaded[loaded.any(dim=1)].numpy()
        if not len(right):
            return 0.0
        reference = self._scene.linear.reference
        exact = reference.factor.solve_many(right)
        error = reference.float32_factor.solve_many(right) - exact
        return float((np.linalg.norm(error, axis=1) / np.linalg.norm(exact, axis=1)).max())

    def _corners(self) -> list[LinearSolver]:
        """Return the linear solvers at the ends and centres of all ranges of the law."""
        ranges = self._scene.loads.parameter_ranges.values()
        if not ranges:
            return [self._scene.linear.reference]
        corners = itertools.product(*((low, (low + high) / 2, high) for low, high in ranges))
        rows = torch.tensor(list(corners), dtype=torch.float64)
        return [self._scene.linear.with_parameters(row[None]) for row in rows]

    def _load_from_state_dict(self, state: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Take the sizes of the checkpoint."""
        resize_buffers(self, state, prefix)
        self.__dict__.pop("_factor", None)
        super()._load_from_state_dict(state, prefix, *rest)
        self.reduced = ReducedStiffness(self.stiffness.detach().cpu().clone()).prepared()

    # ------------------------------------------------------------------ solution

    @property
    def _free(self) -> Tensor:
        return self._scene.problem.free.cpu()

    def forward(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        """Return linear solutions at free degrees of freedom, (B, n).

        Args:
            loaded: Forces at free degrees of freedom, (B, n).
            parameters: Parameters of the law, (B, P).
        """
        if self.is_exact:
            return self.solution(loaded, parameters)
        columns, local = self.in_modes(loaded, parameters)
        if local.any():
            exact = self.solution(loaded[local], parameters[local])
            columns = columns.index_copy(0, local.nonzero()[:, 0], exact)
        return columns

    def in_modes(self, loaded: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return Galerkin linear solutions (B, n), and the mask of local loads, (B,)."""
        law = self._scene.problem.material.with_parameters(parameters)
        coordinates = self.reduced.solve(law, loaded @ self.modes.to(loaded))
        missing = (loaded.to(self.probes) @ self.probes).double().square().mean(dim=1)
        size = coordinates.square().sum(dim=1)  # of the solution: the modes are orthonormal
        return coordinates @ self.modes.mT.to(loaded), missing > self.tol**2 * (size + missing)

    def solution(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        """Return K(0)^-1 (f - s), (B, n), by the factor for all loads; see `solve`."""
        solved: Tensor = _LinearSolve.apply(loaded, parameters, self)
        return solved

    def solve(self, loaded: NDArray[np.float64], parameters: Tensor) -> NDArray[np.float64]:
        """Return K(0)^-1 (f - s), (B, n), of forces (B, n) and parameters (B, P).

        s = K(0) p is the force of the prescribed displacement p.
        """
        reference = self._scene.linear.reference
        if not parameters.shape[1]:
            return self._solved(reference, torch.from_numpy(loaded)).numpy()
        rows = [self._solve_one(*pair) for pair in zip(loaded, parameters.cpu(), strict=True)]
        return np.stack(rows)

    def _solved(self, solver: LinearSolver, loaded: Tensor) -> Tensor:
        """Return K(0)^-1 (f - s), (B, n), of forces (B, n)."""
        right = loaded - support_force(solver.problem)[solver.problem.free]
        factor = solver.float32_factor if self.is_exact else solver.factor
        if 0 < len(right) <= MAX_SINGLE:
            return torch.from_numpy(np.stack([factor.solve(one, RTOL) for one in right.numpy()]))
        return torch.from_numpy(factor.solve_many(right.numpy(), RTOL))

    def _solve_one(self, loaded: NDArray[np.float64], parameters: Tensor) -> NDArray[np.float64]:
        problem = self._scene.problem.with_parameters(parameters[None])
        values = problem.stiffness_at_rest().numpy()
        product = SymmetricProduct(problem.pattern, values)
        right = loaded - support_force(problem)[self._free].numpy()
        preconditioner = self._scene.linear.reference.float32_factor
        return conjugate_gradients(product, preconditioner.apply, right, RTOL, MAX_ITER)


def resize_buffers(module: nn.Module, state: dict[str, Any], prefix: str) -> None:
    """Give the buffers of a module the sizes that they have in a state dict."""
    for name, buffer in module.named_buffers(recurse=False):
        found = state.get(f"{prefix}{name}")
        if isinstance(found, Tensor) and found.ndim == buffer.ndim:
            setattr(module, name, buffer.new_empty(found.shape))


class _LinearSolve(torch.autograd.Function):
    """K(0)^-1 (f - s)."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, parameters: Tensor, response: LinearResponse) -> Tensor:
        """Return solutions (B, n) of forces (B, n)."""
        ctx.response, ctx.parameters = response, parameters
        solved = response.solve(force.detach().cpu().double().numpy(), parameters)
        return torch.from_numpy(solved).to(force)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient with respect to forces, (B, n); K(0) is symmetric."""
        response, parameters = ctx.response, ctx.parameters
        known = response.solve(np.zeros(gradient.shape), parameters)  # of the supports alone
        right = gradient.detach().cpu().double().numpy()
        return torch.from_numpy(response.solve(right, parameters) - known).to(gradient), None, None
