"""K(0) of a body as a sum of a few matrices whose factors are functions of the parameters.

K(0)^-1 f of any parameters is interpolated between inverses for a few of them, or follows by
conjugate gradients that the inverse for one preconditions.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import qr
from torch import Tensor

from dpl.fem.assembly.follower_loads import NO_LOADS
from dpl.fem.materials.linear_elastic import linear_law
from dpl.fem.materials.material import Material
from dpl.fem.problem import Problem

SAMPLES = 64  # points of the parameters at which moduli are compared
INDEPENDENT = 1e-10  # part of the largest modulus below which a direction counts as rounding [-]
MAX_CELLS = 32  # different cells by which condition numbers are bounded
MAX_CORNERS = 6  # parameters of which all corners of the ranges are samples
MAX_ERROR = 1e-4  # energy norm of the error of a solution over that of the solution [-]
MAX_NODES, MAX_USED = 9, 4  # inverses that are kept, and those that a solution interpolates between
MAX_BOUND = 200  # largest value of `StiffnessTerms.bound`


class Interpolation(NamedTuple):
    """K(a)^-1 = sum_i w_i(a) K(a_i)^-1 with the inverses at nodes a_i, for two terms.

    The energy of a displacement is (1 - q) b_0 + q b_1 with the stiffnesses b of the two extreme
    strains and a number q from 0 to 1. The range of x = b_1 / b_0 is divided into K intervals of L
    nodes x_i. The weights are exact for L numbers q_j, so that the error of every load in the
    energy norm, over that of the solution, is at most the maximum of

        |prod_j (x - x_j) (q - q_j) / ((1 - q_j + q_j x) (1 - q + q x_j))|

    at the ends of an interval and q = 0. The nodes and q_j make it nearly as small as possible.

    Source: Beckermann, Townsend (2017), SIAM J. Matrix Anal. Appl. 38 (Zolotarev's third problem).
    """

    nodes: Tensor  # factors a_i, (K L, 2)
    strains: Tensor  # b of a, (2, 2)
    ends: Tensor  # between intervals of x, (K - 1,)
    q: Tensor  # (K, L)
    inverse: Tensor  # of the matrices 1 / (1 - q_j + q_j x_i), (K, L, L)

    def weights(self, factors: Tensor) -> Tensor:
        """Return w, (B, K L), of factors (B, 2); only those of one interval are not zero."""
        _, strains, ends, q, inverse = (part.to(factors) for part in self)
        b_0, b_1 = (factors @ strains.mT)[..., None].unbind(1)
        exact = 1 / (b_0[..., None] * (1 - q) + b_1[..., None] * q)
        interval = (b_1 / b_0 > ends).sum(dim=1, keepdim=True)
        is_used = torch.arange(len(q), device=q.device) == interval
        return (is_used[..., None] * torch.einsum("kij,bkj->bki", inverse, exact)).flatten(1)


@dataclass(frozen=True, eq=False)
class StiffnessTerms:
    """K(0) = sum_k a_k K_k + C with factors a_k of the law and stiffness C of the foundation.

    The moduli of a law at rest are a vector, see `Material.rest_moduli`, on which K(0) depends
    linearly. Over all parameters these vectors span a space of few dimensions, of which `vectors`
    is a basis. A homogeneous isotropic law has the factors mu and lambda. Otherwise the basis
    consists of moduli of the law itself, so that the matrices K_k are positive definite.

    Two terms without a foundation have an `Interpolation` unless the ranges are too wide. Otherwise
    the inverse for one point of the ranges, the node, is the preconditioner of all others. The
    condition number of K(node)^-1 K(0) is bounded for every load (`condition_numbers`), and with it
    the error of conjugate gradients in the energy norm and their number of steps. Neither depends
    on the number of terms.

    Attributes:
        problem: The body; its law may have ranges.
        vectors: Moduli of the terms, (T, M).
    """

    problem: Problem
    vectors: Tensor

    @classmethod
    def of(cls, problem: Problem) -> "StiffnessTerms":
        """Return the terms of a body with the fewest matrices."""
        law = problem.material
        values = law.with_parameters(_samples(law)).rest_moduli
        if values.shape[1] == 2:  # mu and lambda
            return cls(problem, torch.eye(2, dtype=torch.float64))
        _, R, order = qr(values.numpy().T, mode="economic", pivoting=True)
        size = np.abs(np.diag(R))
        return cls(problem, values[torch.from_numpy(order[: (size > INDEPENDENT * size[0]).sum()])])

    def __len__(self) -> int:
        """Return the number of terms, T."""
        return len(self.vectors)

    def factors(self, law: Material) -> Tensor:
        """Return the factors a of a law, (1, T), or of the members of a batch, (B, T)."""
        moduli = law.rest_moduli
        return moduli if moduli.shape[1] == 2 else moduli @ self._inverse.to(moduli)

    @cached_property
    def _inverse(self) -> Tensor:
        return torch.linalg.pinv(self.vectors)

    @cached_property
    def bodies(self) -> list[Problem]:
        """Linear elastic bodies of the stiffness K_k, without foundation and follower loads."""
        bare = replace(self.problem, springs=None, follower_loads=NO_LOADS)
        laws = (linear_law(self.problem.reference.material, row) for row in self.vectors)
        return [replace(bare, material=law) for law in laws]

    @cached_property
    def node(self) -> Tensor:
        """Factors of the body from whose K(0) the others differ least, (1, T)."""
        middle, samples = self.factors(self.problem.reference.material), self._sampled_factors
        if not self.varies:
            return middle
        candidates = torch.cat([middle, samples])
        worst = [self.condition_numbers(samples, node).max() for node in candidates.split(1)]
        return candidates[torch.stack(worst).argmin()][None]

    @cached_property
    def node_body(self) -> Problem:
        """The reference body, with its foundation, with the stiffness K(node)."""
        body = self.problem.reference
        if not self.varies:
            return body
        return replace(body, material=linear_law(body.material, self.node[0] @ self.vectors))

    @cached_property
    def interpolation(self) -> Interpolation | None:
        """The interpolation with the fewest inverses; None if one is enough or more are not."""
        if not self.varies or len(self) != 2 or self.problem.springs is not None:
            return None
        samples, node = self._sampled_factors, self.node
        ratios = self._energy_ratios(samples, node)
        farthest = int((ratios[:, 1] / ratios[:, 0]).argmax())
        b = torch.stack([torch.ones(2), ratios[farthest]])
        strains = torch.linalg.solve(torch.stack([node[0], samples[farthest]]), b).mT
        b_0, b_1 = strains @ samples.mT
        least, most = (b_1 / b_0).aminmax()
        for used, count in product(range(1, MAX_USED + 1), range(1, MAX_NODES + 1)):
            t = np.sin(0.5 * np.pi * np.arange(1 - used, used, 2) / used)
            ends = np.geomspace(least, most, 2 * count + 1)
            middles, root = ends[1::2, None], math.sqrt(ends[2] / ends[0])
            d = (root - 1) / (root + 1) * t
            x, q = middles * (1 + d) / (1 - d), (1 - t) / (1 - t + middles * (1 + t))
            error = np.prod(q * np.abs(ends[0] - x) / (1 - q + q * ends[0]), axis=1)[0]
            if used * count <= MAX_NODES and error <= MAX_ERROR:
                inverse = np.linalg.inv(1 / (1 - q[..., None] + q[..., None] * x[:, None]))
                nodes = np.linalg.solve(strains, np.stack([np.ones(x.size), x.ravel()])).T
                arrays = nodes, strains.numpy(), ends[2:-1:2], q, inverse
                return Interpolation(*map(torch.from_numpy, arrays))
        return None

    @property
    def has_steps(self) -> bool:
        """True if solutions need conjugate gradients."""
        return self.varies and self.interpolation is None

    @cached_property
    def kept_bodies(self) -> list[Problem]:
        """Bodies whose inverses are kept: at the nodes of the interpolation, or `node_body`."""
        if self.interpolation is None:
            return [self.node_body]
        body, moduli = self.problem.reference, self.interpolation.nodes @ self.vectors
        return [replace(body, material=linear_law(body.material, row)) for row in moduli]

    def weights(self, factors: Tensor) -> Tensor:
        """Return weights of the inverses of `kept_bodies`, (B, K), for factors (B, T)."""
        if self.interpolation is None:
            return factors.new_ones(factors.shape[0], 1)
        return self.interpolation.weights(factors)

    @cached_property
    def varies(self) -> bool:
        """False if K(0) is the same for all parameters."""
        middle = self.factors(self.problem.reference.material)
        return not torch.allclose(self._sampled_factors, middle, rtol=1e-12, atol=0.0)

    @cached_property
    def condition(self) -> float:
        """Bound of the condition number of K(node)^-1 K(0) for all parameters [-]."""
        if not self.varies:
            return 1.0
        return float(self.condition_numbers(self._sampled_factors, self.node).max())

    @property
    def bound(self) -> int:
        """Number of steps after which the error is at most `MAX_ERROR` for every load.

        The residual is below `rtol` after twice as many, at conditions up to 1e8.

        Source: Saad (2003), Iterative Methods for Sparse Linear Systems, eq. 6.128.
        """
        root = math.sqrt(self.condition)
        if root - 1 < 1e-6:
            return 1
        return math.ceil(math.log(2 / MAX_ERROR) / math.log((root + 1) / (root - 1)))

    @property
    def rtol(self) -> float:
        """Relative residual, in the norm of K(node)^-1, below which the error is `MAX_ERROR`.

        The squares of this norm and of the energy norm of the error have a ratio between the
        smallest and the largest eigenvalue of K(node)^-1 K(0).
        """
        return MAX_ERROR / math.sqrt(self.condition)

    def require_few_steps(self) -> None:
        """Raise a ValueError if the bound of the number of steps exceeds `MAX_BOUND`."""
        if self.bound > MAX_BOUND:
            raise ValueError(
                f"the parameters {list(self.problem.material.parameter_ranges)} change K(0) by "
                f"factors whose ratio is up to {self.condition:.3g}, so that the linear solution "
                f"of this network takes more than {MAX_BOUND} steps; give them smaller ranges, or "
                "use model.base=null (fcnn, cnn, gnn)"
            )

    def support_forces(self) -> Tensor:
        """Return K_k p of moved supports p, and C p plus follower loads at rest, (T + 1, N, D)."""
        problem = self.problem
        rest, p = torch.zeros(1, *problem.shape, dtype=torch.float64), problem.prescribed[None]
        moved = problem.moved_supports
        forces = [b.tangent_product(rest, p)[0] if moved else rest[0] for b in self.bodies]
        constant = problem.force_at_rest
        if problem.springs is not None and moved:
            constant = constant + problem.springs.force(p)[0]
        return torch.stack([*forces, constant])

    def condition_numbers(self, factors: Tensor, node: Tensor) -> Tensor:
        """Return bounds of the condition numbers of K(node)^-1 K(0), (S,), for every load.

        The factors of K(0) are (S, T), those of the node (1, T). An energy is a sum over points, so
        that the ratio of two energies of a displacement lies between those of the moduli of the
        cells, strain by strain. Springs have the ratio 1. Of bodies with many different cells,
        `MAX_CELLS` are taken. With mean dilatation the bound is approximate for laws with fibres,
        whose strain has the volume change of the point and not of the cell.
        """
        low, high = self._energy_ratios(factors, node).unbind(1)
        return high / low

    def _energy_ratios(self, factors: Tensor, node: Tensor) -> Tensor:
        """Return the smallest and the largest ratio, (S, 2), see `condition_numbers`."""
        moduli = self._some_cells
        of_node, others = (torch.einsum("st,teij->seij", a, moduli) for a in (node, factors))
        inverse = torch.linalg.inv(torch.linalg.cholesky(of_node))
        ratios = torch.linalg.eigvalsh(inverse @ others @ inverse.mT).flatten(1)
        low, high = ratios.amin(dim=1), ratios.amax(dim=1)
        if self.problem.springs is not None:
            low, high = low.clamp(max=1.0), high.clamp(min=1.0)
        return torch.stack([low, high], dim=1)

    @cached_property
    def _some_cells(self) -> Tensor:
        """Moduli of the terms in at most `MAX_CELLS` different cells, (T, C, 6, 6).

        They are quadratic forms of six strains.
        """
        rest = torch.zeros(1, len(self.problem.cells), 1, 3, 3, dtype=torch.float64)
        every = torch.stack([b.material.tangent(rest)[0, :, 0] for b in self.bodies])
        i, j = torch.tensor([0, 1, 2, 0, 1, 0]), torch.tensor([0, 1, 2, 1, 2, 2])
        every = every[:, :, i[:, None], j[:, None], i, j]
        moduli = every.transpose(0, 1).flatten(1)  # (E, T 36)
        digits = (moduli / moduli.abs().amax() * 1e9).round()
        first = np.unique(digits.numpy(), axis=0, return_index=True)[1]
        if len(first) > MAX_CELLS:
            order = torch.randperm(len(first), generator=torch.Generator().manual_seed(0))
            first = first[order[:MAX_CELLS]]
        return every[:, first]

    @cached_property
    def _sampled_factors(self) -> Tensor:
        """Factors at corners and random points of the parameters, (S, T)."""
        law = self.problem.material
        return self.factors(law.with_parameters(_samples(law)))


def _samples(law: Material) -> Tensor:
    """Return points of the parameters of a law, (S, P): corners and random points."""
    ranges = list(law.parameter_ranges.values())
    if not ranges:
        return torch.zeros(1, 0, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    points = torch.rand(SAMPLES, len(ranges), generator=random, dtype=torch.float64)
    if len(ranges) <= MAX_CORNERS:
        corners = torch.tensor(list(product((0.0, 1.0), repeat=len(ranges))), dtype=torch.float64)
        points = torch.cat([corners, points])
    return torch.stack([ends.at(t) for ends, t in zip(ranges, points.T, strict=True)], dim=1)
