"""Reduced stiffness at rest as a function of the moduli of the law."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.linear.interface import full_matrix
from dpl.fem.materials.linear_elastic import LinearElastic
from dpl.fem.materials.material import Material
from dpl.fem.problem import Problem
from dpl.fem.rom.reduced_problem import support_force

ReducedInverse = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class ReducedStiffness:
    """V^T K(0) [V, p] = mu A + lambda B + C, since every law is isotropic at rest.

    p is the prescribed displacement and C is that of the springs.

    Attributes:
        parts: A, B and C, (3, R, R + 1).
    """

    parts: Tensor

    @classmethod
    def of(cls, problem: Problem, modes: Tensor) -> "ReducedStiffness":
        """Return the stiffness of a body in modes V at its free degrees of freedom, (n, R)."""
        columns = modes.double().numpy()
        soft, stiff = LinearElastic(0.0), LinearElastic(0.3)
        products = []
        for law in (soft, stiff):
            body = problem.with_material(law)
            matrix = full_matrix(body.pattern, body.stiffness_at_rest().numpy())
            own = torch.from_numpy(columns.T @ (matrix @ columns))
            moved = support_force(body)[problem.free]
            products.append(torch.cat([(own + own.T) / 2, modes.double().T @ moved[:, None]], 1))
        springs = _springs(problem, modes.double())
        first, second = products[0] - springs, products[1] - springs
        mu = first / soft.mu
        return cls(torch.stack([mu, (second - stiff.mu * mu) / stiff.lam, springs]))

    def prepared(self) -> Self:
        """Return the stiffness with its factors, which a traced graph takes as constants."""
        if not self._has_springs and self.parts.numel():
            self._spectrum  # noqa: B018  # computed and kept
        return self

    def solve(self, law: Material, right: Tensor) -> Tensor:
        """Return the coordinates (B, R) of Galerkin linear solutions.

        Without springs A and B are diagonal in one basis, W^T A W = I and W^T B W = diag(b), so
        that the inverse is W diag(1 / (mu + lambda b)) W^T for all moduli.

        Args:
            law: The law; of a batch, each member has moduli of its own.
            right: V^T f, (B, R).
        """
        if self._has_springs:
            whole = self.at(law).to(right)
            right = right - whole[..., -1]
            return torch.linalg.solve(whole[..., :-1], right[..., None])[..., 0]
        mu, lam = (_row(modulus) for modulus in (law.mu, law.lam))
        A, B, _ = self.parts[..., -1].to(right)
        vectors, values = (part.to(right) for part in self._spectrum)
        return ((right - mu * A - lam * B) @ vectors / (mu + lam * values)) @ vectors.T

    def inverse(self, law: Material) -> ReducedInverse:
        """Return (V^T K(0) V)^-1, (R, R), and V^T K(0) p, (R,), of a law with numbers as moduli."""
        if self._has_springs:
            whole = self.at(law).numpy()
            return np.ascontiguousarray(np.linalg.inv(whole[:, :-1])), whole[:, -1].copy()
        mu, lam = float(law.mu), float(law.lam)
        vectors, values = (part.numpy() for part in self._spectrum)
        A, B, _ = self.parts[..., -1].numpy()
        return (vectors / (mu + lam * values)) @ vectors.T, mu * A + lam * B

    @cached_property
    def _has_springs(self) -> bool:
        return bool(self.parts[2].any())

    @cached_property
    def _spectrum(self) -> tuple[Tensor, Tensor]:
        """W, (R, R), and b, (R,), see `solve`."""
        A, B = (part[:, :-1].numpy() for part in self.parts[:2].cpu())
        values, vectors = scipy.linalg.eigh(B, A)
        return torch.from_numpy(vectors), torch.from_numpy(values)

    def at(self, law: Material) -> Tensor:
        """Return V^T K(0) [V, p], (R, R + 1), or (B, R, R + 1) for a law of a batch."""
        mu, lam = (_column(modulus) for modulus in (law.mu, law.lam))
        A, B, C = self.parts.to(mu.device) if isinstance(mu, Tensor) else self.parts
        return mu * A + lam * B + C


def _column(modulus: Any) -> Any:
    """Return a modulus that multiplies matrices: a number, or (B, 1, 1)."""
    return modulus.reshape(-1, 1, 1) if isinstance(modulus, Tensor) else modulus


def _row(modulus: Any) -> Any:
    """Return a modulus that multiplies rows: a number, or (B, 1)."""
    return modulus.reshape(-1, 1) if isinstance(modulus, Tensor) else modulus


def _springs(problem: Problem, modes: Tensor) -> Tensor:
    """Return V^T C [V, p], (R, R + 1), of the foundation."""
    count = modes.shape[1]
    if problem.springs is None:
        return torch.zeros(count, count + 1, dtype=torch.float64)
    fields = torch.zeros(count + 1, *problem.shape, dtype=torch.float64)
    fields[:-1, problem.free] = modes.T
    fields[-1] = problem.prescribed
    return modes.T @ problem.springs.force(fields)[:, problem.free].T
