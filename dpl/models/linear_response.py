"""The linear solution K(0)^-1 f of every load, by nested static condensation."""

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from dpl.fem.linear.condensation import Condensed, condense, condensed_block_solve
from dpl.fem.materials.material import Material
from dpl.fem.rom.iterated_inverse import IteratedInverse
from dpl.fem.rom.stiffness_interpolation import StiffnessInterpolation
from dpl.fem.rom.stiffness_iteration import (
    StiffnessIteration,
    TermMatrices,
    count_steps,
)
from dpl.fem.solvers.condensed_layers import CondensedLayers
from dpl.fem.solvers.parity_factor import OrbitForm
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import Symmetry
from dpl.models.precision import full_precision
from dpl.models.unrolled.compiled import (
    IterationArrays,
    LawEntries,
    LawWeights,
    LinearPrediction,
)
from dpl.scene import Scene

MAX_ROUNDING = 1e-4  # relative error of solutions up to which blocks are float32 [-]
MAX_VALUES = 2**26  # of a batch that are computed at a time


class LinearResponse:
    """The linear solution K(0)^-1 (f - s) of a load; s is the force of the prescribed displacement.

    K(0) is condensed once into dense blocks, one set for each parity of fields under the
    reflections of the body (`dpl.fem.linear.condensation`). A solution is a sequence of products
    with them, the same for every load: there is no basis that a load on a small area could miss.
    If the law has ranges, K(0)^-1 is a sum of the inverses for a few parameters
    (`StiffnessInterpolation`). If K(0) has three or more terms, the inverse for one parameter is
    the preconditioner of a fixed number of steps of conjugate gradients (`StiffnessIteration`).

    The blocks depend on the scene only and are computed when they are first used.
    """

    def __init__(self, scene: Scene, group: list[Symmetry]) -> None:
        """Take the scene and the symmetries of the body.

        Raises:
            ValueError: K(0) changes too much with the parameters, see `StiffnessIteration`.
        """
        self._scene, self._group = scene, group
        if self.is_iterated:
            self.iteration  # noqa: B018  # computed and kept
        self._on_device: dict[torch.device, _Tensors] = {}

    # ------------------------------------------------------------------ blocks

    @cached_property
    def terms(self) -> StiffnessTerms:
        """Terms of K(0) of the body."""
        problem = self._scene.problem
        return StiffnessTerms.of(replace(problem, follower_loads=problem.follower_loads.constant))

    @property
    def is_iterated(self) -> bool:
        """True if K(0) has three or more terms, so that each solution takes several steps."""
        return len(self.terms) > 2

    @cached_property
    def iteration(self) -> StiffnessIteration:
        """Parameter for which K(0) is condensed if it has three or more terms."""
        return StiffnessIteration.of_terms(self.terms)

    @cached_property
    def interpolation(self) -> StiffnessInterpolation:
        """Weights of the parameters for which K(0) is condensed if it has one or two terms."""
        return StiffnessInterpolation.of_terms(self.terms)

    @cached_property
    def _form(self) -> OrbitForm:
        return OrbitForm.of(self._scene.problem.reference, self._group)

    @cached_property
    def blocks(self) -> Condensed:
        """Blocks of K nodes and M parities, values (K M, V) in float32.

        They are float64 if the solutions of random forces lose more than `MAX_ROUNDING`.
        """
        bodies = [self._scene.problem.reference]
        nodes = (self.iteration.node,) if self.is_iterated else self.interpolation.nodes
        if self.is_iterated or len(nodes) > 1:
            laws = [self.terms.body(torch.tensor(one).double()).material for one in nodes]
            bodies = [replace(bodies[0], material=law) for law in laws]
        matrices = [matrix for one in bodies for matrix in self._form.matrices(one)]
        exact = condense(matrices, self._form.points)
        rounded = exact._replace(values=exact.values.astype(np.float32))
        return rounded if _difference(rounded, exact) < MAX_ROUNDING else exact

    @cached_property
    def iterated(self) -> IteratedInverse:
        """The solutions if K(0) has three or more terms."""
        matrices = TermMatrices.of(self.terms, self._form)
        steps = count_steps(self.iteration, self.terms, self._form, self.blocks, matrices)
        return IteratedInverse(self.blocks, matrices, steps)

    @cached_property
    def _supports(self) -> Tensor:
        return self.terms.support_forces()

    def compiled(self) -> LinearPrediction:
        """Return the linear solution as a part of a compiled prediction."""
        values = self.blocks.values
        blocks = values.reshape(-1, len(self._form.parities.members), values.shape[1])
        found = LinearPrediction(self.blocks.fronts, blocks, self._supports)
        if not self.is_iterated:
            return found
        first_entry, columns, _ = self.iterated.matrices
        return found._replace(iteration=IterationArrays(first_entry, columns, self.iterated.steps))

    def law_weights(self, law: Material) -> LawWeights | LawEntries:
        """Return the numbers of a law that `compiled` needs; its moduli are numbers."""
        factors = self.terms.factors(law)
        moduli = np.array([*factors[0].tolist(), 1.0])
        if self.is_iterated:
            return LawEntries(moduli, self.iterated.matrices.at(moduli))
        return LawWeights(self.interpolation.weights(factors)[0].numpy(), moduli)

    # ------------------------------------------------------------------ solution

    def __call__(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        """Return linear solutions at free degrees of freedom, (B, n).

        Args:
            loaded: Forces at free degrees of freedom, (B, n).
            parameters: Parameters of the law, (B, P).
        """
        count = max(1, MAX_VALUES // (self.blocks.fronts.unknowns.size * len(self.blocks.values)))
        with full_precision(loaded.device.type):
            if torch.compiler.is_compiling() or loaded.shape[0] <= count:
                return self._solve(loaded, parameters)
            both = zip(loaded.split(count), parameters.split(count), strict=True)
            return torch.cat([self._solve(*pair) for pair in both])

    def _solve(self, loaded: Tensor, parameters: Tensor) -> Tensor:
        own = self._tensors(loaded.device)
        law = self._scene.problem.material.with_parameters(parameters)
        factors = self.terms.factors(law).to(loaded).expand(loaded.shape[0], -1)
        if own.supports is not None:
            supports = own.supports.to(loaded)
            loaded = loaded - factors @ supports[:-1] - supports[-1]
        size = loaded.abs().amax(dim=1, keepdim=True)
        size = torch.where(size > 0, size, 1.0)  # of order one, so that float32 holds it
        scaled = (loaded / size).to(own.scales)
        parts = own.characters @ (own.scales * scaled[:, own.images])  # (B, M, m)
        solved = self._by_parity(own.layers, parts, factors)
        values = own.signs * (own.characters.T @ solved)
        return values.flatten(1)[:, own.places].to(loaded) * size

    def _by_parity(self, layers: CondensedLayers | None, parts: Tensor, factors: Tensor) -> Tensor:
        """Return solutions of forces by parity, (B, M, m), for factors (B, T)."""
        if layers is None:
            return self.iterated(parts, pad(factors, (0, 1), value=1.0).double())
        weights = self.interpolation.weights(factors).to(parts)  # (B, K)
        count = weights.shape[1]
        solved = layers.solve(parts.transpose(0, 1).repeat(count, 1, 1))  # (K M, B, m)
        return torch.einsum("kmbj,bk->bmj", solved.unflatten(0, (count, -1)), weights)

    def _tensors(self, device: torch.device) -> "_Tensors":
        if device not in self._on_device:
            self._on_device[device] = self._make_tensors(device)
        return self._on_device[device]

    def _make_tensors(self, device: torch.device) -> "_Tensors":
        parities, orbits, _ = self._form
        layers = None if self.is_iterated else CondensedLayers.of(self.blocks, device)
        dtype = torch.float64 if layers is None else layers.layers[0].inverse.dtype
        signs, characters = orbits.sign.to(dtype), parities.characters.to(dtype)
        free = self._scene.problem.free.cpu()
        places = torch.empty(int(free.sum()), dtype=torch.int64)
        places[orbits.images.flatten()] = torch.arange(orbits.images.numel())
        supports = self._supports[:, free].to(device) if self._supports.any() else None
        return _Tensors(
            layers=layers,
            images=orbits.images.to(device),
            signs=signs.to(device),
            scales=(signs * orbits.weight.to(dtype)).to(device),
            characters=characters.to(device),
            places=places.to(device),
            supports=supports,
        )


class _Tensors(NamedTuple):
    """Tensors of the linear solution on one device.

    Attributes:
        layers: Blocks of K(0); None if its solutions are iterated.
        images, signs: Degrees of freedom of the orbits and their signs, (M, m).
        scales: Signs times weights of the orbits, (M, m).
        characters: Factor of each parity under each symmetry, (M, M).
        places: Position of each free degree of freedom among the images, (n,).
        supports: See `StiffnessTerms.support_forces`, at free degrees of freedom, (T + 1, n); None
            if they are zero.
    """

    layers: CondensedLayers | None
    images: Tensor
    signs: Tensor
    scales: Tensor
    characters: Tensor
    places: Tensor
    supports: Tensor | None


def _difference(blocks: Condensed, exact: Condensed) -> float:
    """Return the largest relative difference of solutions of random forces [-]."""
    size = len(np.unique(exact.fronts.unknowns))
    random = np.random.default_rng(0).standard_normal((size, 2))
    found = []
    for pair in zip(blocks.values, exact.values, strict=True):
        x, y = random.copy(), random.copy()
        condensed_block_solve(blocks.fronts, pair[0], x)
        condensed_block_solve(exact.fronts, pair[1], y)
        found.append(float((np.linalg.norm(x - y, axis=0) / np.linalg.norm(y, axis=0)).max()))
    return max(found)
