"""Fit of `dpl.models.Unrolled` to samples: modes, sample cells and maps."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpl.fem.materials.material import Material
from dpl.fem.problem import Problem
from dpl.fem.rom.pod import MIN_SKETCH_SIZE, pod, scatter_fields
from dpl.fem.rom.reduced_stiffness import ReducedStiffness, reduced_terms
from dpl.fem.solvers.stiffness_terms import StiffnessTerms
from dpl.fem.symmetry import Symmetry
from dpl.models.linear_response import LinearResponse
from dpl.models.unrolled.features import SampleCells, cell_gradients, mechanical_maps
from dpl.models.unrolled.regression import MapParities, fit_map, weighted_error
from dpl.scene import Sample
from dpl.system.threads import one_thread

CHUNK = 256  # samples whose fields are computed at a time
FEW = 16  # samples whose features are computed at a time, in the caches of a processor
SIZE_EXPONENT = -0.4  # errors count relative to the displacement to this power
MAX_ROWS = 2**14  # samples and images to which maps are fitted
MAX_BYTES = 2**31  # of snapshots and images from which modes are computed, in float32
MIN_RANK = 40  # modes; fewer are not tried
NOISE = 5e-7  # singular value over the largest below which a mode is rounding error
STEPPED = 256  # samples to which the gains of a step are fitted
LIMIT = 1.5  # factor on the largest ratio of corrections in the samples
MIN_GAIN = 0.97  # largest ratio of held-out errors for which another map is worth its time
INSIDE = 0.7  # part of held-out errors inside the modes above which more modes cannot pay


def sampled_terms(terms: StiffnessTerms) -> StiffnessTerms:
    """Return K(0) of the body with the law that is sampled, see `Material.compressible`.

    Modes change the volume of cells. The stress by which a nearly incompressible law resists hides
    the stress that deforms the body.
    """
    law = terms.problem.material.compressible()
    same = law is terms.problem.material
    return terms if same else StiffnessTerms.of(replace(terms.problem, material=law))


class Maps(NamedTuple):
    """Maps of the iterations at sample cells.

    Attributes:
        cells: The sample cells.
        matrices: B_0, (C D D, R), and B_1, B_2, ..., (2 C D D, R) each.
        limits: Largest ratio of each correction to the one before, (1 + K,); that of the first is
            to the linear solution.
    """

    cells: SampleCells
    matrices: Sequence[Tensor]
    limits: Tensor


def limit_step(step: Tensor, before: Tensor, limit: Tensor, dim: Any = 1) -> Tensor:
    """Return steps, shortened to `limit` times the norm of the steps before, both (B, R)."""
    most, size = limit * before.norm(dim=dim, keepdim=True), step.norm(dim=dim, keepdim=True)
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
    """Return samples in coordinates of modes V (n, R), in which K(0) is `stiffness`.

    `rest` are their displacements minus the linear solutions, (S, n).
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


def modes_of_parity(linear: LinearResponse, snapshots: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Return POD modes (n, R) of snapshots (S, n) and their images, and their parities (R,).

    Each mode has one parity. The largest mode is the first. They are rounded to float32.
    """
    (parities, orbits, _), free = linear.form, linear.scene.problem.free
    others = linear.group.coset_representatives()
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
    return map(Sample._make, zip(*(column.split(CHUNK) for column in samples), strict=True))


def choose_cells(images: Tensor, centres: Tensor, count: int) -> Tensor:
    """Return cells (C,) that cover the body evenly, with all their images.

    Each cell is the one farthest from the centre of the body and the cells before, with their
    images. C >= `count`, if there are as many cells.

    Source: Gonzalez (1985), Clustering to minimize the maximum intercluster distance, Theor.
    Comput. Sci. 38.

    Args:
        images: Numbers of the images of each cell under the symmetries, (G, E).
        centres: Centres of the cells, (E, D).
        count: Wanted number of cells.
    """
    distance = (centres - centres.mean(dim=0)).norm(dim=1)
    taken = torch.zeros(len(centres), dtype=torch.bool)
    while int(taken.sum()) < min(count, len(centres)):
        orbit = images[:, distance.argmax()].unique()
        taken[orbit] = True
        distance = torch.minimum(distance, torch.cdist(centres, centres[orbit]).amin(dim=1))
        distance[taken] = -1.0
    return taken.nonzero()[:, 0]


def maps_at_cells(
    law: Material,
    cells: SampleCells,
    symmetry: MapParities,
    priors: Sequence[Tensor],
    sets: tuple[Columns, Columns],
    *,
    copies: int,
    stages: int,
    threads: int,
) -> tuple[Maps, list[Tensor]]:
    """Fit maps one after the other, as long as the held-out error decreases enough.

    A map that is fitted to few samples predicts them better than others. The next map is therefore
    fitted to states of each sample that follow from maps which are fitted to the other samples.

    Returns:
        The maps, and what they miss of the targets of both sets, (S, R) each: of the first set by
        maps that are fitted to the other samples. The first map is zero if none is good enough.
    """
    (fitted, held), (count, dim, _) = sets, cells.gradients.shape[1:]
    matrices, limits = list[Tensor](), list[Tensor]()
    present, steps = [torch.zeros_like(part.target) for part in sets], [c.linear for c in sets]
    error = weighted_error(held.target, held.weights)
    for k in range(1 + stages):
        pairs = zip(sets, present, strict=True)
        rows, unseen = (_features(law, cells, part, c if k else None) for part, c in pairs)
        targets, prior = fitted.target - present[0], priors[min(k, 1)]
        matrix, left_out = fit_map(rows, targets, fitted.weights, symmetry, prior, copies, threads)
        matrix = matrix.float().double()
        usual, proposed = (part.flatten(1) @ matrix for part in (rows, unseen))
        reached = weighted_error(held.target - present[1] - proposed, held.weights)
        if not reached < MIN_GAIN * error:
            break
        sizes = steps[0].norm(dim=1)
        limit = LIMIT * (usual.norm(dim=1)[sizes > 0] / sizes[sizes > 0]).max()
        both = zip((targets - left_out, proposed), steps, strict=True)
        steps = [limit_step(step, before, limit) for step, before in both]
        present = [c + step for c, step in zip(present, steps, strict=True)]
        matrices.append(matrix)
        limits.append(limit)
        error = reached
    if not matrices:
        matrices = [torch.zeros(count * dim * dim, fitted.linear.shape[1], dtype=torch.float64)]
        limits = [torch.tensor(1.0, dtype=torch.float64)]
    missed = [part.target - c for part, c in zip(sets, present, strict=True)]
    return Maps(cells, matrices, torch.stack(limits)), missed


def _features(law: Material, cells: SampleCells, samples: Columns, c: Tensor | None) -> Tensor:
    """Return features (S, C, F, D, D) of the first map, or of the others at coordinates (S, R)."""
    if c is None:
        parts = [cells.first_features(cells.gradient(part)) for part in samples.linear.split(FEW)]
        return torch.cat(parts)
    columns = (column.split(FEW) for column in (samples.linear, c, samples.parameters))
    return torch.cat(
        [
            cells.features(law.with_parameters(own), linear + part, cells.gradient(linear))
            for linear, part, own in zip(*columns, strict=True)
        ]
    )


def fit_maps(
    linear: LinearResponse,
    body: Problem,
    in_modes: tuple[Tensor, Tensor, Tensor],
    sets: tuple[Columns, Columns],
    *,
    copies: int,
    cells: int,
    stages: int,
    threads: int,
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """Return buffers of the maps at sample cells, and what they miss, see `maps_at_cells`.

    Args:
        linear: Linear solutions of the body.
        body: The body with the law that is sampled.
        in_modes: V, (n, R), the parity of each mode, (R,), and (V^T K(0) V)^-1 of `body`, (R, R).
        sets: Samples to fit to, and to choose by.
        copies, threads: Images of each sample in the first set, and threads, see `fit_map`.
        cells, stages: Number of sample cells, and largest number of maps after the first.
    """
    problem, parities = linear.scene.problem, linear.form.parities
    modes, parity, inverse = in_modes
    images = linear.group.cell_images(problem)
    fields = torch.cat([scatter_fields(modes.T, problem.free), problem.prescribed[None]])
    parity_of_fields = torch.cat([parity, torch.zeros(1, dtype=torch.int64)])
    centres = problem.points[problem.cells].mean(dim=1)
    numbers = choose_cells(images, centres, cells)
    positions = torch.searchsorted(numbers, images[:, numbers])
    symmetry = MapParities(parities, positions[parities.members], parity)
    gradients = cell_gradients(problem, fields, numbers)
    columns = symmetry.orbits(1).symmetrised(gradients.flatten(1).T, parity_of_fields, parities)
    # rounded before the fit: the maps cancel digits, so that G must stay what it is
    sample_cells = SampleCells(columns.T.reshape(gradients.shape).float().double())
    law = body.material.of_cells(numbers).centred()
    priors = mechanical_maps(body, numbers, sample_cells.gradients[:-1], inverse)
    options = {"copies": copies, "stages": stages, "threads": threads}
    maps, missed = maps_at_cells(law, sample_cells, symmetry, priors, sets, **options)
    first, *others = (one.float() for one in maps.matrices)
    buffers = {
        "cells": numbers,
        "gradients": sample_cells.gradients,
        "first_map": first,
        "maps": torch.stack(others) if others else first.new_zeros(0, 2 * len(first), len(parity)),
        "limits": maps.limits,
    }
    return buffers, missed


def fit_in_best_modes(
    linear: LinearResponse, terms: StiffnessTerms, both: tuple[Sample, Sample], *, rank: int,
    cells: int, stages: int,
) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor], Tensor]:  # fmt: skip
    """Fit the maps in few modes, then in more, as long as that is better.

    `terms` are those of the body whose law is sampled. The samples are those to fit to, and those
    to choose by. `rank` and `stages` are the largest numbers of modes, and of maps after the first;
    `cells` is the number of sample cells, see `choose_cells`.

    Returns:
        The buffers of `dpl.models.Unrolled`, by name, of the fit with the smallest weighted mean
        error of held-out samples; all modes, (n, R), and their parities, (R,); and predictions
        (S, N, D) of the first `STEPPED` samples by maps that are fitted to the other samples.
    """
    threads = torch.get_num_threads()
    with one_thread():  # threads of small operations wait for each other
        free = linear.scene.problem.free
        rests = [
            torch.cat([u[:, free] - linear(f[:, free], own) for f, u, _, own in _chunks(part)])
            for part in both
        ]
        weights = sample_weights(both[0].displacement[:, free])
        every, parity = modes_of_parity(linear, weights[:, None] * rests[0], rank)
        inverses = [symmetry.inverse for symmetry in linear.group.coset_representatives()]
        few = inverses[: max(1, MAX_ROWS // len(rests[0]))]
        turned = [_image(every.T, one, free).T for one in few]
        factors = terms.factors(terms.problem.reference.material)

        def fit(count: int) -> tuple[float, dict[str, Tensor], Tensor, float]:
            modes = every[:, :count]
            stiffness = ReducedStiffness(reduced_terms(terms, modes), terms)
            # coordinates of images of the samples are those of the samples in images of the modes
            copies = (one[:, :count] for one in turned)
            fitted = _joined(in_coordinates(terms, V, stiffness, both[0], rests[0]) for V in copies)
            held = in_coordinates(terms, modes, stiffness, both[1], rests[1])
            inverse = torch.from_numpy(stiffness.inverse(factors)[0])
            options = {"copies": len(turned), "cells": cells, "stages": stages, "threads": threads}
            in_modes, sets = (modes, parity[:count], inverse), (fitted, held)
            found, missed = fit_maps(linear, terms.problem, in_modes, sets, **options)
            outside = rests[1].square().sum(dim=1) - held.target.square().sum(dim=1)
            inside = missed[1].square().sum(dim=1)
            squares = inside, inside + outside.clamp(min=0)
            inner, error = (float((square.sqrt() * held.weights).mean()) for square in squares)
            own = {"modes": modes.float(), "parity": parity[:count], "stiffness": stiffness.parts}
            few = slice(min(STEPPED, len(rests[0])))  # the samples without their images
            left_out = rests[0][few] + (missed[0] - fitted.target)[few] @ modes.T
            return error, own | found, left_out, inner / max(error, 1e-300)

        counts = [every.shape[1]]
        while counts[0] // 2 >= MIN_RANK:
            counts.insert(0, counts[0] // 2)
        best = fit(counts[0])
        for count in counts[1:]:
            if best[3] > INSIDE or not (other := fit(count))[0] < best[0]:
                break
            best = other
        predicted = both[0].displacement[:STEPPED] - scatter_fields(best[2], free)
        return best[1], (every, parity), predicted
