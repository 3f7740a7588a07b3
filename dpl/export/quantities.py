"""Quantities that an exported surrogate returns, as tensor operations."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from dpl.fem import Load
from dpl.fem.loads.family import MAX_DISTANCE, LoadFamily
from dpl.fem.loads.file import FileLoads
from dpl.fem.loads.fit import EDGE
from dpl.fem.loads.mixture import MixtureLoads
from dpl.fem.loads.modal import ModalLoads
from dpl.fem.loads.patch import PatchLoads
from dpl.fem.loads.sized import CombinedLoads, VectorLoads
from dpl.inference.answer import ROUNDOFF
from dpl.training import TrainedSurrogate

RIDGE = 1e-10  # of normal equations over their largest diagonal entry [-]
BODY_NUMBERS = ("residual", "min_det_F")  # which need all cells
LOAD_NUMBERS = ("error", "amplitude")  # which need the range of the loads
NUMBERS = (*LOAD_NUMBERS, *BODY_NUMBERS)  # of each load
SEARCHING = FileLoads, MixtureLoads, PatchLoads  # families whose `project` a graph cannot contain


class Quantities(nn.Module):
    """A surrogate that returns displacements (B, N, D) [m] and numbers of each load, (B,) [-].

    The numbers are those that are named among `NUMBERS`; others are not computed. `error` is the
    estimated relative error of the displacement, infinite where the model states none and for loads
    that are not known to be in range. `amplitude` is that of `LoadFamily.project`, `residual` is
    ||R_free|| / ||f||.
    """

    def __init__(self, surrogate: TrainedSurrogate, names: Iterable[str]) -> None:
        """Take a surrogate and names of numbers; numbers that a graph cannot have are refused."""
        super().__init__()
        self.surrogate, self.names = surrogate, tuple(names)
        if "residual" in self.names:
            surrogate.scene.problem.material.require_known("numbers = residual")
        loads = surrogate.scene.loads
        refused = [name for name in self.names if name in LOAD_NUMBERS]
        if refused and isinstance(loads, SEARCHING):
            raise ValueError(
                f"numbers = {', '.join(refused)} must be left out for {type(loads).__name__}: "
                "graphs do not contain its range"
            )
        ranges = list(loads.parameter_ranges)
        if ranges and (refused := [name for name in self.names if name in BODY_NUMBERS]):
            raise ValueError(
                f"numbers = {', '.join(refused)} must be evaluated without ranges {ranges}; leave "
                "them out"
            )

    def forward(
        self, force: Tensor, young: Tensor, parameters: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Return displacements and numbers; the arguments are those of the surrogate."""
        scene, found = self.surrogate.scene, dict[str, Tensor]()
        load, names = scene.load_of(force, young, parameters), {*self.names}
        if "error" in names:
            u, errors = self.surrogate.predict_with_errors(load)
            found["error"] = torch.where(self._is_in_range(load), errors[:, 0], math.inf)
        else:
            u = self.surrogate.predict(load)
        if "amplitude" in names:
            found["amplitude"] = position(scene.loads, load.force)[0]
        if names & {*BODY_NUMBERS}:
            body = scene.problem
            found["residual"] = body.relative_residual_of(body.internal_force(u), load.force)
            found["min_det_F"] = body.volume_ratio(u)
        return scene.length * u, *(found[name] for name in self.names)

    def _is_in_range(self, load: Load) -> Tensor:
        """Return True for loads that are known to be in range, (B,), as `RangeCheck.inside`."""
        loads = self.surrogate.scene.loads
        amplitude, distance = position(loads, load.force)
        inside = (amplitude <= 1 + ROUNDOFF) & (distance <= MAX_DISTANCE)  # False for NaN
        columns = load.parameters.unbind(1), loads.parameter_ranges.values()
        for values, (low, high) in zip(*columns, strict=True):
            inside = inside & (values >= low) & (values <= high)
        return inside


def position(loads: LoadFamily, force: Tensor) -> tuple[Tensor, Tensor]:
    """Return `LoadFamily.project` of forces (B, N, D) [-] as operations that a graph can contain.

    Families of a few fixed forces are fitted by elimination. Where these forces are dependent on
    the nodes on which a load acts, the amplitude is that of the smallest coefficients, and
    `project` may find a smaller one.
    """
    project = type(loads).project
    if isinstance(loads, ModalLoads) and project is ModalLoads.project:
        shapes, (low, high), largest = loads.modal_forces, loads._span, 1.0
        own = loads.own_force(force)
    elif isinstance(loads, CombinedLoads) and project is CombinedLoads.project:
        shapes = torch.from_numpy(loads._acting_shapes)[None]
        (low, high), largest = loads.sizes, loads.largest_size
        own = loads.own_force(force).flatten(1)[:, None]
    else:
        return loads.project(force)
    q, distance = _fit(shapes.to(force), own)
    if isinstance(loads, VectorLoads):
        q = q.norm(dim=1, keepdim=True)
    beyond = torch.maximum(low - q, q - high)
    amplitude = torch.where(beyond > EDGE * largest, 1 + beyond / largest, q.abs() / largest)
    return amplitude.amax(dim=1), distance


def _fit(shapes: Tensor, force: Tensor) -> tuple[Tensor, Tensor]:
    """Return coefficients (B, K) and relative residuals (B,) of fits of shapes (N, D, K).

    The least-squares fits of forces (B, N, D) are over the nodes on which they act.
    """
    unit = force.abs().amax(dim=(1, 2))
    unit = torch.where(unit > 0, unit, 1.0)
    force = force / unit[:, None, None]
    loaded, count = (force != 0).any(dim=2).to(force), shapes.shape[2]
    squares = torch.einsum("ndk,ndl->nkl", shapes, shapes).flatten(1)
    G = (loaded @ squares).unflatten(1, (count, count))
    largest = G.diagonal(dim1=1, dim2=2).amax(dim=1)[:, None, None]
    eye = torch.eye(count).to(force)
    ridge = RIDGE * torch.where(largest > 0, largest, 1.0) * eye
    rows = torch.cat([G + ridge, eye.expand_as(G)], dim=2)
    for k in range(count):  # Gauss-Jordan
        row = rows[:, k : k + 1] / rows[:, k : k + 1, k : k + 1]
        rows = rows - (rows[:, :, k : k + 1] - eye[k, :, None]) * row
    inverse = rows[:, :, count:]
    right = (force.flatten(1) @ shapes.flatten(0, 1))[..., None]  # (B, K, 1)
    q = inverse @ right
    q = q + inverse @ (right - G @ q)  # removes most of the effect of the ridge
    whole = force.square().sum(dim=(1, 2))
    rest = (whole - (q * (2 * right - G @ q)).sum(dim=(1, 2))).clamp(min=0)
    return unit[:, None] * q[..., 0], (rest / torch.where(whole > 0, whole, 1.0)).sqrt()
