"""Newton-Krylov for many loads at once, in tensor operations: made for a GPU."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dpl.fem.materials.tensors import volume_change
from dpl.fem.problem import Evaluation, Problem
from dpl.fem.solvers.linear import LinearSolver
from dpl.fem.solvers.solution import Load, Solution, Status, check_tol


@dataclass(frozen=True, eq=False)
class BatchedNewton:
    """Newton with mixed points on a whole batch, K(0)^-1 as preconditioner of all linear solves.

    The inverse of K(0) is formed once, dense, so that preconditioning is one matrix product for
    all loads. There are no load steps, and conjugate gradients want positive definite tangents: a
    load that loses them on the way ends as NOT_CONVERGED, for `Newton`. Memory: n^2 numbers
    for the inverse, and about 81 numbers per quadrature point and load.

    Source: Knoll, Keyes (2004), J. Comput. Phys. 193; Magisano, Leonetti, Garcea (2017).

    Attributes:
        problem: The body, on the device that is to do the work.
        tol: Residual ratio ||R_free|| / ||f|| of an answer [-], see
            `Problem.relative_residual_of`; at least 1e-15, below 1.
        max_iter: Newton iterations.
        max_linear: Conjugate-gradient iterations in one of them.
        min_detF_ratio: Part of det F that one step may leave of the smallest one [-].
    """

    problem: Problem
    tol: float = 1e-8
    max_iter: int = 15
    max_linear: int = 200
    min_detF_ratio: float = 0.2

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ValueError: An attribute is out of range, supports are moved, or the law is not one.
        """
        if self.problem.material.poisson_range is not None:
            raise ValueError("poisson: a range of them needs dpl.fem.Newton")
        check_tol(self.tol)
        if not 0 < self.min_detF_ratio < 1:
            raise ValueError(f"keep = {self.min_detF_ratio} must lie between 0 and 1")
        if self.problem.moved_supports:
            raise ValueError("prescribed displacements other than zero need dpl.fem.Newton")

    @torch.no_grad()
    def iterate(self, load: Load) -> Iterator[Solution]:
        """Yield the batch before the first update and after each one.

        Raises:
            ValueError: Loads bring Poisson's ratios of their own.
        """
        if load.poisson.shape[-1]:
            raise ValueError("poisson: loads with their own need dpl.fem.Newton")
        problem, start = self.problem, time.perf_counter()
        force = load.force.to(self.inverse.device)
        u, gap = torch.zeros_like(force), None
        count = torch.zeros(len(force), dtype=torch.int64, device=force.device)
        state = self._evaluated(u)
        solution = self._report(u, state, force, count, start)
        yield solution
        going = ~solution.converged
        for _ in range(self.max_iter):
            if not going.any():
                return
            system = (
                problem.mixed_system(u[going], gap[going])
                if gap is not None
                else (state.internal[going], problem.tangent(u[going]))
            )
            step = torch.zeros_like(u)
            step[going] = self._solved(system[1], force[going] - system[0])
            length = self._lengths(u, step, state.volume_ratio)
            going &= length > 0
            step *= length[:, None, None]
            if problem.supports_mip:
                rest = (1 - length)[:, None, None, None, None]
                gap = problem.quadratic_strain(step) + (0.0 if gap is None else rest * gap)
                strain = 2 * (problem.strain(u + step) - gap)
                lowest = 1 + volume_change(strain).flatten(1).amin(dim=1)
                gap = torch.where((lowest > 1e-3)[:, None, None, None, None], gap, 0.0)
            u = u + step
            count += going
            state = self._evaluated(u)
            solution = self._report(u, state, force, count, start)
            yield solution
            going &= ~solution.converged & solution.residual.isfinite()

    def _evaluated(self, u: Tensor) -> Evaluation:
        return Evaluation(self.problem.internal_force(u), self.problem.volume_ratio(u))

    def _lengths(self, u: Tensor, step: Tensor, before: Tensor) -> Tensor:
        """Return the longest of 1, 1/2, 1/4, ... that inverts nothing, (B,); 0: none does."""
        lengths = torch.zeros_like(before)
        for length in (0.5 ** np.arange(10)).tolist():
            after = self.problem.volume_ratio(u + length * step)
            safe = (lengths == 0) & (after > self.min_detF_ratio * before.clamp(max=1.0))
            lengths = torch.where(safe, length, lengths)
            if (lengths > 0).all():
                break
        return lengths

    def _solved(self, tangent: Tensor, right: Tensor) -> Tensor:
        """Return the steps (B, N, D): conjugate gradients, each load to its own tolerance.

        A load whose tangent has negative curvature keeps what it had found before.
        """
        free, (rows, columns, off) = self.problem.free, self._links
        b = right[:, free]
        unit = b.abs().amax(1, keepdim=True)  # without it squares of small forces are 0
        unit = torch.where(unit > 0, unit, 1.0)
        b = b / unit
        x, r = torch.zeros_like(b), b
        z = r @ self.inverse
        p, rho = z, (r * z).sum(1)
        going = torch.ones(len(b), dtype=torch.bool, device=b.device)
        for _ in range(self.max_linear):
            product = torch.zeros_like(p).index_add(1, rows, tangent * p[:, columns])
            product.index_add_(1, columns[off], (tangent * p[:, rows])[:, off])
            curvature = (p * product).sum(1)
            going &= curvature > 0
            alpha = torch.where(going, rho / torch.where(going, curvature, 1.0), 0.0)[:, None]
            x, r = x + alpha * p, r - alpha * product
            going &= r.norm(dim=1) > 1e-10 * b.norm(dim=1)
            if not going.any():
                break
            z = r @ self.inverse
            rho, last = (r * z).sum(1), rho
            p = z + torch.where(going, rho / last, 0.0)[:, None] * p
        step = torch.zeros_like(right)
        step[:, free] = unit * x
        return step

    @cached_property
    def inverse(self) -> Tensor:
        """K(0)^-1, (n, n), on the problem's device."""
        factor = LinearSolver(self.problem.to("cpu"), linear="auto").factor
        size = self.problem.pattern.size
        columns = [factor.solve(column, 1e-10) for column in np.eye(size)]
        return torch.from_numpy(np.stack(columns)).to(self.problem.points.device)

    @cached_property
    def _links(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns of the tangent's entries, and which lie off the diagonal."""
        pattern, device = self.problem.pattern, self.problem.points.device
        rows = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
        off = np.flatnonzero(rows != pattern.indices)
        arrays = (rows, pattern.indices.astype(np.int64), off)
        on_device = (torch.from_numpy(array).to(device) for array in arrays)
        return next(on_device), next(on_device), next(on_device)

    def _report(
        self, u: Tensor, state: Evaluation, force: Tensor, count: Tensor, start: float
    ) -> Solution:
        problem = self.problem
        good = problem.is_equilibrium(u, state.internal, force, self.tol) & (state.volume_ratio > 0)
        seconds = time.perf_counter() - start
        return Solution(
            displacement=u,
            residual=problem.relative_residual_of(state.internal, force),
            volume_ratio=state.volume_ratio,
            status=torch.where(good, int(Status.CONVERGED), int(Status.NOT_CONVERGED)),
            negative_pivots=torch.full_like(count, -1),
            iterations=count.clone(),
            factorisations=torch.zeros_like(count),
            load_factor=good.to(u.dtype),
            seconds=torch.full_like(state.volume_ratio, seconds),
            from_guess=torch.zeros_like(good),
        )
