"""Fit of `dpl.models.Unrolled` to samples: modes, sample cells and maps."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dpl.fem import Problem
from dpl.fem.materials.material import Material
from dpl.fem.parity import Parities, SignedOrbits
from dpl.fem.rom.pod import MIN_SKETCH_SIZE, pod, scatter_fields
from dpl.fem.rom.reduced_stiffness import ReducedStiffness, reduced_terms
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import Symmetry, SymmetryGroup
from dpl.models.linear_response import LinearResponse
from dpl.models.unrolled.features import SampleCells, cell_gradients, mechanical_maps
from dpl.models.unrolled.regression import MapParities, Rows, fit_map, weighted_error
from dpl.scene import Sample

CHUNK = 256  # samples whose fields or features are computed at a time
SIZE_EXPONENT = -0.4  # errors count relative to the displacement to this power
MAX_ROWS = 2**14  # samples and images to which maps are fitted
MAX_BYTES = 2**31  # of snapshots and images from which modes are computed, in float32
MIN_RANK = 40  # modes; fewer are not tried
NOISE = 5e-7  # singular value over the largest below which a mode is rounding error
LIMIT = 1.5  # factor on the largest ratio of corrections in the samples
MIN_GAIN = 0.97  # largest ratio of held-out errors for which another map is worth its time


class Maps(NamedTuple):
    """Maps of the iterations at sample cells.

    Attributes:
        cells: The sample cells.
        first: B_0, (C D D, R).
        others: B_1, B_2, ..., (2 C D D, R) each.
        limits: Largest ratio of each correction to the one before, (1 + K,); that of the first is
            to the linear solution.
    """

    cells: SampleCells
    first: Tensor
    others: Sequence[Tensor]
    limits: Tensor

    def __call__(self, law: Material, linear: Tensor) -> tuple[Tensor, Tensor]:
        """Return coordinates (B, R) of nonlinear displacements, and sizes (B, K + 2).

        The sizes are the norms of the linear coordinates and of the correction by each map.

        Args:
            law: The law, see `Material.with_parameters`.
            linear: Coordinates of Galerkin linear solutions, (B, R).
        """
        H = self.cells.gradient(linear)
        step = self.cells.first_features(H).flatten(1) @ self.first
        c = step = limit_step(step, linear, self.limits[0])
        steps = [linear, step]
        for matrix, limit in zip(self.others, self.limits[1:], strict=True):
            proposed = self.cells.features(law, linear + c, H).flatten(1) @ matrix
            step = limit_step(proposed, step, limit)
            c = c + step
            steps.append(step)
        return c, torch.stack(steps, dim=1).norm(dim=2)


def limit_step(step: Tensor, before: Tensor, limit: Tensor) -> Tensor:
    """Return steps (B, R), shortened to `limit` times the norm of the steps before (B, R)."""
    most = limit * before.norm(dim=1, keepdim=True)
    size = step.norm(dim=1, keepdim=True)
    return torch.where(size > most, step * (most / size.clamp(min=1e-300)), step)


class Columns(NamedTuple):
    """Samples in coordinates of the modes.

    Attributes:
        linear: Coordinates of the Galerkin linear solution, (S, R).
        target: Coordinates of the nonlinear displacement, (S, R).
        weights: Factor of the error of each sample, (S,).
        parameters: Parameters of the law, (S, P).
    """

    linear: Tensor
    target: Tensor
    weights: Tensor
    parameters: Tensor


def sample_weights(displacement: Tensor) -> Tensor:
    """Return ||u||^-0.4, (S,), of displacements (S, n); 0 for u = 0."""
    size = displacement.norm(dim=1)
    return torch.where(size > 0, size.clamp(min=1e-300) ** SIZE_EXPONENT, 0.0)


def in_coordinates(
    terms: StiffnessTerms, modes: Tensor, stiffness: ReducedStiffness, samples: Sample, rest: Tensor
) -> Columns:
    """Return samples in coordinates of the modes.

    Args:
        terms: Terms of K(0).
        modes: V, (n, R).
        stiffness: V^T K(0) V.
        samples: The samples, (S, N, D).
        rest: Their displacements minus the linear solutions, (S, n).
    """
    parts, problem = [], terms.problem
    for part, own in zip(_chunks(samples), rest.split(CHUNK), strict=True):
        factors = terms.factors(problem.material.with_parameters(part.parameters))
        linear = stiffness.solve(factors, part.force[:, problem.free] @ modes)
        weights = sample_weights(part.displacement[:, problem.free])
        parts.append(Columns(linear, own @ modes, weights, part.parameters))
    return _joined(parts)


def _joined(parts: Iterable[Columns]) -> Columns:
    """Return the samples of several sets as one set."""
    return Columns(*map(torch.cat, zip(*parts, strict=True)))


def _image(columns: Tensor, symmetry: Symmetry, free: Tensor) -> Tensor:
    """Return the images (S, n) of fields (S, n) at free degrees of freedom."""
    return symmetry.image(scatter_fields(columns, free))[:, free]


def modes_of_parity(
    snapshots: Tensor, group: SymmetryGroup, free: Tensor, rank: int
) -> tuple[Tensor, Tensor]:
    """Return POD modes (n, R) of snapshots (S, n) and their images, and their parities (R,).

    Each mode has one parity. The largest mode is the first. They are rounded to float32.

    Args:
        snapshots: Fields at free degrees of freedom.
        group: Symmetries of the body.
        free: Mask of free degrees of freedom, (N, D).
        rank: Largest number of modes.
    """
    parities = Parities.of(group, free.shape[1])
    orbits = SignedOrbits.of_field(parities, group, free)
    others = group.coset_representatives()
    count, size = len(snapshots) * len(others), snapshots.shape[1]
    some = snapshots[:: max(1, -(-4 * count * size // MAX_BYTES))]
    dtype = torch.float32 if len(some) * len(others) > MIN_SKETCH_SIZE else torch.float64
    modes, values, numbers = [], [], []
    for p, characters in enumerate(parities.characters):
        parts = [
            orbits.coordinates(_image(part, symmetry, free), characters).to(dtype)
            for symmetry in others
            for part in some.split(CHUNK)
        ]
        rows = torch.cat(parts)
        found = pod(rows, min(rank, *rows.shape))
        most = found.vectors.shape[1]
        modes.append(orbits.fields(found.vectors.T, characters, size))
        values.append(found.values[:most])
        numbers.append(torch.full((most,), p))
    value = torch.cat(values)
    order = value.argsort(descending=True, stable=True)[:rank]
    order = order[value[order] >= NOISE * value.max()]
    return torch.cat(modes)[order].T.contiguous().float().double(), torch.cat(numbers)[order]


def _chunks(samples: Sample) -> Iterator[Sample]:
    for start in range(0, len(samples.force), CHUNK):
        yield Sample(*(column[start : start + CHUNK] for column in samples))


def nonlinear_displacement(problem: Problem, samples: Sample, linear: LinearResponse) -> Tensor:
    """Return displacements minus linear solutions at free degrees of freedom, (S, n)."""
    parts = [
        part.displacement[:, problem.free] - linear(part.force[:, problem.free], part.parameters)
        for part in _chunks(samples)
    ]
    return torch.cat(parts)


def choose_cells(images: Tensor, count: int) -> Tensor:
    """Return random cells (C,), C >= count if there are as many, with all their images.

    Args:
        images: Image of each cell under each symmetry, (G, E).
        count: Number of cells.
    """
    orbit = images.amin(dim=0)  # smallest number of a cell of the orbit
    names = orbit.unique()
    order = names[torch.randperm(len(names), generator=torch.Generator().manual_seed(0))]
    sizes = torch.bincount(orbit, minlength=len(orbit))[order]
    taken = int((sizes.cumsum(0) < count).sum()) + 1
    return torch.isin(orbit, order[:taken]).nonzero()[:, 0]


class Regression:
    """Fit of the maps at given sample cells, one after the other.

    A map that is fitted to few samples predicts them better than others. The next map is therefore
    fitted to states of each sample that follow from maps which are fitted to the other samples.

    Attributes:
        maps: The maps so far.
        errors: Weighted held-out errors of the linear solution and after each map.
    """

    def __init__(
        self,
        law: Material,
        cells: SampleCells,
        symmetry: MapParities,
        priors: Sequence[Tensor],
        fitted: Columns,
        held: Columns,
        images: int,
    ) -> None:
        """Start from the linear solution.

        Args:
            law: The law of the cells, perhaps with ranges.
            cells: The sample cells.
            symmetry: Parities of values at the cells and of coordinates.
            priors: See `mechanical_maps`.
            fitted, held: Samples to fit to, and to choose by.
            images: Number of images of each sample in `fitted`, see `fit_map`.
        """
        self._images = images
        self._law, self._cells, self._symmetry, self._priors = law, cells, symmetry, priors
        self._sets = fitted, held
        self._present = [torch.zeros_like(part.linear) for part in self._sets]
        self._steps = [fitted.linear, held.linear]
        self._matrices: list[Tensor] = []
        self._limits: list[Tensor] = []
        self.errors = [weighted_error(held.target, held.weights)]

    @property
    def maps(self) -> Maps:
        """The maps so far; without one, a first map of zeros."""
        count, dim = self._cells.gradients.shape[1:3]
        none = torch.zeros(count * dim * dim, self._sets[0].linear.shape[1], dtype=torch.float64)
        first = self._matrices[0] if self._matrices else none
        limits = torch.stack(self._limits or [torch.tensor(1.0, dtype=torch.float64)])
        return Maps(self._cells, first, self._matrices[1:], limits)

    def error_with(self, squares: Tensor) -> float:
        """Return the weighted mean error of held-out samples.

        Args:
            squares: Squared errors outside the modes, (S,).
        """
        held = self._sets[1]
        inside = (held.target - self._present[1]).square().sum(dim=1)
        return float(((inside + squares.clamp(min=0)).sqrt() * held.weights).mean())

    def add_map(self) -> bool:
        """Fit the next map; return False, without adding it, if it gains too little."""
        rows, held = (self._rows(*pair) for pair in zip(self._sets, self._present, strict=True))
        prior = self._priors[min(len(self._matrices), 1)]
        matrix, left_out = fit_map(rows, self._symmetry, prior, self._images)
        matrix = matrix.float().double()
        usual, proposed = (part.features.flatten(1) @ matrix for part in (rows, held))
        error = weighted_error(held.targets - proposed, held.weights)
        if not error < MIN_GAIN * self.errors[-1]:
            return False
        self._matrices.append(matrix)
        sizes = self._steps[0].norm(dim=1)
        limit = LIMIT * (usual.norm(dim=1)[sizes > 0] / sizes[sizes > 0]).max()
        self._limits.append(limit)
        steps = rows.targets - left_out, proposed
        self._steps = [
            limit_step(step, before, limit) for step, before in zip(steps, self._steps, strict=True)
        ]
        self._present = [c + step for c, step in zip(self._present, self._steps, strict=True)]
        self.errors.append(error)
        return True

    def _rows(self, samples: Columns, present: Tensor) -> Rows:
        parts = zip(samples.linear.split(CHUNK), present.split(CHUNK), strict=True)
        laws = (self._law.with_parameters(p) for p in samples.parameters.split(CHUNK))
        features = [self._features(law, *part) for law, part in zip(laws, parts, strict=True)]
        return Rows(torch.cat(features), samples.target - present, samples.weights)

    def _features(self, law: Material, linear: Tensor, present: Tensor) -> Tensor:
        H = self._cells.gradient(linear)
        if not self._matrices:
            return self._cells.first_features(H)
        return self._cells.features(law, linear + present, H)


def fit_maps(
    problem: Problem,
    modes: Tensor,
    parity: Tensor,
    group: SymmetryGroup,
    inverse: Tensor,
    samples: tuple[Columns, Columns],
    *,
    copies: int,
    cells: int,
    stages: int,
) -> tuple[Tensor, Regression]:
    """Return sample cells (C,) and maps with the smallest held-out error.

    Half as many cells are tried as long as that is better.

    Args:
        problem: The body.
        modes: V, (n, R).
        parity: Parities of the modes, (R,).
        group: Symmetries of the body.
        inverse: (V^T K(0) V)^-1, (R, R).
        samples: Samples to fit to, and to choose by.
        copies: Number of images of each sample to fit to.
        cells: Number of sample cells.
        stages: Largest number of maps after the first.
    """
    images = group.cell_images(problem)
    parities = Parities.of(group, problem.shape[1])
    fields = torch.cat([scatter_fields(modes.T, problem.free), problem.prescribed[None]])
    parity_of_fields = torch.cat([parity, torch.zeros(1, dtype=torch.int64)])
    best: tuple[Tensor, Regression] | None = None
    while cells:
        numbers = choose_cells(images, cells)
        positions = torch.searchsorted(numbers, images[:, numbers])
        symmetry = MapParities(parities, positions[parities.members], parity)
        gradients = cell_gradients(problem, fields, numbers)
        columns = symmetry.orbits(1).symmetrised(gradients.flatten(1).T, parity_of_fields, parities)
        # rounded before the fit: the maps cancel digits, so that G must stay what it is
        sample_cells = SampleCells(columns.T.reshape(gradients.shape).float().double())
        law = problem.material.of_cells(numbers).centred()
        priors = mechanical_maps(problem, numbers, sample_cells.gradients[:-1], inverse)
        regression = Regression(law, sample_cells, symmetry, priors, *samples, copies)
        while len(regression.errors) <= 1 + stages and regression.add_map():
            pass
        if best is not None and regression.errors[-1] >= best[1].errors[-1]:
            break
        best, cells = (numbers, regression), cells // 2
    assert best is not None
    return best


def fit_in_best_modes(
    problem: Problem,
    group: SymmetryGroup,
    linear: LinearResponse,
    both: tuple[Sample, Sample],
    *,
    rank: int,
    cells: int,
    stages: int,
) -> tuple[dict[str, Tensor], Tensor]:
    """Fit the maps in all modes, in half and in a quarter of them.

    Args:
        problem: The body.
        group: Symmetries of the body.
        linear: Linear solutions.
        both: Samples to fit to, and to choose by.
        rank: Largest number of modes.
        cells: Largest number of sample cells.
        stages: Largest number of maps after the first.

    Returns:
        The buffers of `dpl.models.Unrolled`, by name, of the fit with the smallest weighted mean
        error of held-out samples; and all modes, (n, R).
    """
    rests = [nonlinear_displacement(problem, part, linear) for part in both]
    weights = sample_weights(both[0].displacement[:, problem.free])
    every, parity = modes_of_parity(weights[:, None] * rests[0], group, problem.free, rank)
    inverses = [symmetry.inverse for symmetry in group.coset_representatives()]
    few = inverses[: max(1, MAX_ROWS // len(rests[0]))]
    turned = [_image(every.T, one, problem.free).T for one in few]
    fits: list[tuple[float, dict[str, Tensor]]] = []
    factors, count = linear.terms.factors(problem.reference.material), every.shape[1]
    while count:
        modes = every[:, :count]
        stiffness = ReducedStiffness(reduced_terms(linear.terms, modes), linear.terms)
        inverse = torch.from_numpy(stiffness.inverse(factors)[0])
        # coordinates of images of the samples are those of the samples in images of the modes
        fitted = _joined(
            in_coordinates(linear.terms, images[:, :count], stiffness, both[0], rests[0])
            for images in turned
        )
        held = in_coordinates(linear.terms, modes, stiffness, both[1], rests[1])
        sets = fitted, held
        options = {"copies": len(turned), "cells": cells, "stages": stages}
        numbers, found = fit_maps(problem, modes, parity[:count], group, inverse, sets, **options)
        squares = rests[1].square().sum(dim=1) - held.target.square().sum(dim=1)  # not in V
        buffers = _buffers(modes, parity[:count], stiffness, numbers, found.maps)
        fits.append((found.error_with(squares), buffers))
        count = count // 2 if count // 2 >= MIN_RANK else 0
    return min(fits, key=lambda pair: pair[0])[1], every


def _buffers(
    modes: Tensor, parity: Tensor, stiffness: ReducedStiffness, cells: Tensor, maps: Maps
) -> dict[str, Tensor]:
    first = maps.first.float()
    none = torch.zeros(0, 2 * len(first), modes.shape[1])
    return {
        "modes": modes.float(),
        "parity": parity,
        "stiffness": stiffness.parts,
        "cells": cells,
        "gradients": maps.cells.gradients,
        "first_map": first,
        "maps": torch.stack([one.float() for one in maps.others]) if maps.others else none,
        "limits": maps.limits,
    }
