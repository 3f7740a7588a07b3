"""Compiled internal force and tangent of a body."""

import contextlib
import copy
import math
import sys
import threading
from collections.abc import Iterator, Sequence
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dpl.fem.assembly import element_loops, lanes
from dpl.fem.assembly.mean_dilatation import CellVolumes
from dpl.fem.assembly.numba_laws import Law
from dpl.fem.assembly.simd import SIMD_WIDTH
from dpl.fem.materials.material import Material

Array = NDArray[np.float64]
Gap = tuple[Array, Array]  # of strains and, with mean dilatation, of volume changes
NO_GAP = np.zeros((0, 0, 0, SIMD_WIDTH)), np.zeros((0, 0, SIMD_WIDTH))
NO_VALUES = np.zeros(0)
SPARE = 64  # places for entries that are not stored: additions to one place wait for each other
AFFINE = 1e-13  # relative change of the inverse Jacobian in a cell that counts as rounding


class Kernels:
    """Compiled loops over cells of one law, see `dpl.fem.assembly.element_loops` and `with_law`."""

    constants: Array  # of the law
    _law: tuple[Law, float]  # and 1 for finite strains, else 0
    _frames: Array
    _bulk: Array | None = None

    def __init__(
        self,
        cells: NDArray[np.int64],
        reference: Array,
        dN: Array,
        dV: Array,
        places: NDArray[np.int32],
        volumes: CellVolumes | None = None,
    ) -> None:
        """Copy the arrays in blocks; numba compiles at the first call and caches the code on disk.

        They are copies because sending a problem to a worker moves the memory of its tensors.

        Args:
            cells: Nodes of each cell, (E, A).
            reference: Gradients of the shape functions of the reference element, (Q, A, D).
            dN: Those of the cells, (E or 1, Q, A, D), reference times inverse Jacobian.
            dV: Volumes of the quadrature points, (E or 1, Q).
            places: Position of each entry of a cell matrix among the nnz entries, nnz for those
                that are not stored, (E, A (A + 1)/2 D^2).
            volumes: Polynomials of the volume change in the cells, with mean dilatation.
        """
        trilinear = lanes.trilinear_gradients()
        same = reference.shape == trilinear.shape and np.allclose(4 * reference, trilinear)
        reference = trilinear if same else reference
        inverse = np.linalg.pinv(reference) @ dN
        if np.allclose(inverse, inverse[:, :1], rtol=0, atol=AFFINE * np.abs(inverse).max()):
            inverse = inverse[:, :1]
        missing = 3 - dN.shape[-1]
        inverse = np.pad(inverse, [(0, 0), (0, 0), (0, missing), (0, missing)])
        self.cells = _in_blocks(cells).astype(np.uint32)
        self.reference = None if same else np.pad(reference, [(0, 0), (0, 0), (0, missing)])
        self.inverse = _in_blocks(inverse.reshape(*inverse.shape[:2], 9))
        self.dV = _in_blocks(dV[..., None])
        self._volumes = volumes
        self.functions = None if volumes is None else _in_blocks(volumes.functions.numpy())
        blocks = _in_blocks(places).astype(np.uint32)
        nnz = blocks.max()  # of entries that are not stored, which every cell matrix has
        blocks[-1, :, (len(cells) - 1) % SIMD_WIDTH + 1 :] = nnz
        spare = np.arange(blocks[0].size, dtype=np.uint32).reshape(blocks[0].shape) % SPARE
        self.places = np.where(blocks == nnz, nnz + spare, blocks)
        self._n_cells = len(cells)

    def with_law(self, material: Material) -> "Kernels":
        """Return the loops of a law that has a `compiled_form` over the same cells."""
        loops, form = copy.copy(self), material.compiled_form
        assert form is not None
        loops._law = Law.of(form, element_loops.SOURCES), float(material.finite)
        loops.constants, loops._frames = as_columns(material.constants), frames_of(material)
        if self._volumes is not None:
            loops._bulk = as_columns([self._volumes.point_bulk(material)])
        return loops

    def add(
        self, u: Array, force: Array, values: Array, *, gap: Gap = NO_GAP, member: int = 0
    ) -> float:
        """Add force (N, D) and, unless empty, tangent (nnz + SPARE,) at u (N, D).

        Returns min det F, with a gap min det C of the mixed points. Members of a batch may have
        their own moduli.
        """
        law, finite = self._law
        moduli, volumes = self.constants[member if len(self.constants) > 1 else 0], None
        if self._bulk is not None:
            volumes = self.functions, self._bulk[member if len(self._bulk) > 1 else 0]
        arguments = *self._body, volumes, self.places, force, values
        kernel, given = element_loops.add_system, (law, moduli, self._frames, finite)
        return 1 + call_compiled(kernel, *given, u, gap, *arguments)

    @property
    def _body(self) -> tuple[Any, ...]:
        """Arguments of the loops: cells and their number, gradients and volumes."""
        return (self.cells, self._n_cells), self.reference, self.inverse, self.dV

    def gap_after(self, gap: Gap, length: float, update: Array, u: Array) -> Gap:
        """Return the gaps of the mixed integration points after a step (N, D) to u (N, D)."""
        blocks, points = len(self.cells), self.dV.shape[1]
        functions = 0 if self.functions is None else self.functions.shape[2]
        shapes = (blocks, points, 6, SIMD_WIDTH), (blocks, functions, SIMD_WIDTH)
        pairs = zip(gap, shapes, strict=True)
        strains, volumes = (
            (1 - length) * own if own.size else np.zeros(shape) for own, shape in pairs
        )
        arguments = (strains, volumes), length, update, u, *self._body, self.functions
        call_compiled(element_loops.add_gap, *arguments)
        return strains, volumes


class CompiledLoops(NamedTuple):
    """Compiled loops over the cells of a body, with the interface of `TensorAssembly`.

    Attributes:
        groups: One for the cells of each class of law.
        n_entries: nnz, the number of stored entries of the tangent.
    """

    groups: Sequence[Kernels]
    n_entries: int

    def evaluate(self, displacement: Tensor) -> tuple[Tensor, Tensor]:
        """Return internal force (B, N, D) and min det F (B,) [-]."""
        displacement = displacement.detach().contiguous()
        internal = torch.zeros(displacement.shape, dtype=torch.float64)
        pairs = enumerate(zip(displacement.numpy(), internal.numpy(), strict=True))
        lowest = [
            min(group.add(u, out, NO_VALUES, member=k) for group in self.groups)
            for k, (u, out) in pairs
        ]
        return internal, torch.tensor(lowest, dtype=torch.float64)

    def linearise(
        self, displacement: Tensor, gap: Sequence[Gap] | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return force (1, N, D), tangent (1, nnz) and min det C of the mixed points (1,)."""
        if any(len(group.constants) > 1 for group in self.groups):
            raise ValueError("parameters must be the same for all loads; linearise them one by one")
        u = displacement[0].detach().contiguous().numpy()
        force, values = np.zeros(u.shape), np.zeros(self.n_entries + SPARE)
        pairs = self._with_gaps(gap)
        lowest = min(group.add(u, force, values, gap=own) for group, own in pairs)
        tangent = torch.from_numpy(values[: self.n_entries])[None]
        lowest = math.inf if gap is None else lowest
        return torch.from_numpy(force)[None], tangent, torch.tensor([lowest])

    def update_strain_gap(
        self,
        gap: Sequence[Gap] | None,
        length: float,
        update: Tensor,
        displacement: Tensor | None = None,
    ) -> list[Gap]:
        """Return the gap of each group after a step, see `Problem.update_strain_gap`."""
        step = update[0].contiguous().numpy()
        u = np.zeros_like(step) if displacement is None else displacement[0].contiguous().numpy()
        return [group.gap_after(own, length, step, u) for group, own in self._with_gaps(gap)]

    def _with_gaps(self, gap: Sequence[Gap] | None) -> Iterator[tuple[Kernels, Gap]]:
        return zip(self.groups, [NO_GAP] * len(self.groups) if gap is None else gap, strict=True)


def constants_of(material: Material) -> Array:
    """Return the constants of a law with one frame in each cell, (B or 1, E or 1, n).

    The entries of the frames, row by row, follow the other constants.
    """
    return as_columns([*material.constants, *frames_of(material)[:, 0].T[..., None]])


def frames_of(material: Material) -> Array:
    """Return the fibre frames of a law, (E or 1, Q or 1, 9), or (1, 1, 0) without fibres.

    They are a copy: sending a problem to a worker moves the memory of its tensors.
    """
    form = material.compiled_form
    if form is None or form.frames is None:
        return np.zeros((1, 1, 0))
    return form.frames.flatten(2).contiguous().numpy().copy()


def as_columns(values: Sequence[Any]) -> Array:
    """Return numbers and tensors of cells or of a batch as (B or 1, E or 1, n)."""
    columns = [np.asarray(value, dtype=np.float64) for value in values]
    full = np.broadcast_arrays(*columns, np.zeros((1, 1, 1)))[:-1]
    return np.ascontiguousarray(np.concatenate(full, axis=-1))


PATIENCE = 2.0  # time after which a compilation is announced [s]
COMPILING = "compiling element kernels for this law, once per machine ..."
# kernels, laws and given arguments that this process has compiled or loaded
_LOADED: set[tuple[Any, ...]] = set()


def call_compiled(kernel: Any, *arguments: Any) -> Any:
    """Return the result of a kernel; lock numba's cache on disk at its first call.

    Two processes that save kernels of different laws at the same time would choose the same file
    name, and one law would then run the code of the other.
    """
    given = (a if isinstance(a, Law) else a is None for a in arguments)  # numba compiles for each
    variant = (kernel, *given)
    if variant in _LOADED:
        return kernel(*arguments)
    with contextlib.ExitStack() as stack:
        # no lock on other systems, or in a read-only folder, where numba does not save
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            folder = Path(kernel.stats.cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context((folder / "kernels.lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        if parent_process() is None:
            timer = threading.Timer(PATIENCE, _announce)
            timer.daemon = True
            timer.start()
            stack.callback(timer.cancel)
        result = kernel(*arguments)
    _LOADED.add(variant)
    return result


@cache  # once in a process
def _announce() -> None:
    """Say on stderr that kernels are compiled."""
    print(COMPILING, file=sys.stderr, flush=True)


def _in_blocks(values: NDArray[Any]) -> NDArray[Any]:
    """Return an array (E, ...) as (blocks, ..., SIMD_WIDTH), the last cell repeated."""
    blocks = -(-len(values) // SIMD_WIDTH)
    cell = np.minimum(np.arange(blocks * SIMD_WIDTH), len(values) - 1).reshape(blocks, -1)
    return np.ascontiguousarray(np.moveaxis(values[cell], 1, -1))
