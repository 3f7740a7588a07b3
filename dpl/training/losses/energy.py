"""Energy-based losses: the energy norm of the error, and the potential energy."""

import torch
from torch import Tensor

from dpl.fem.postprocess import RestStiffness, potential_energy
from dpl.scene import Sample
from dpl.system.checks import check_range
from dpl.training.losses.loss import Loss, LossContext, clamp_scale, with_gradient


class _ScaledByStiffness(Loss):
    """A loss over a strain energy of K(0), which is assembled once."""

    def __init__(self, *, floor: float = 1e-2) -> None:
        """Choose the floor, see `clamp_scale`."""
        super().__init__()
        check_range(0, 1, floor=floor)
        self.floor = floor
        self._rest: RestStiffness | None = None


class EnergyNormLoss(_ScaledByStiffness):
    """Squared energy norm of the error, e^T K(0) e / v^T K(0) v with e = u - v.

    This is the squared relative error of strains. High-frequency errors are small in the MSE but
    have a large stiffness-weighted norm and cost Newton its first iterations; this loss weights
    them accordingly. An evaluation is one product with the sparse matrix K(0), assembled once.
    """

    saves = ("no finite-element evaluation in training: K(0) is assembled once",)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        self._rest = rest = RestStiffness.of(physics.problem, self._rest)
        with torch.no_grad():
            fields = torch.cat([prediction - batch.displacement, batch.displacement])
            images = rest.product(fields, torch.cat([batch.parameters, batch.parameters]))
            error, size = (fields * images).sum(dim=(1, 2)).chunk(2)
            size = clamp_scale(size, self.floor)
            slope = 2 * images[: len(prediction)] / size[:, None, None]
        return with_gradient(prediction, error / size, slope).mean()


class PotentialEnergyLoss(_ScaledByStiffness):
    """Total potential energy (W(u) - W(0) - f.u) / (f.K(0)^-1 f / 2), without reference solutions.

    Stable equilibria minimise the potential energy, so the displacements of the batch are not read.
    The scale is the work of the linear solution, which weights all loads equally. (||f||^2 would
    give little weight to a load on a single node, whose norm lies in stiff modes.) For small
    displacements the loss is -1 plus the squared relative energy norm of the error. It is
    conditioned like K(0). A network with modal outputs, scaled by the inverse roots of the
    eigenvalues, therefore learns fast. A network with nodal outputs learns slowly and should start
    with another loss, see `BlendedLoss`.

    Where elements are inverted, the energy is NaN or has minima with inverted elements. The loss of
    such a sample is u^T K(0) u / 2 on the same scale, without the load, which would pull towards
    the linear solution: it can have inverted elements, u = 0 has none.

    Source: Samaniego, Anitescu, Goswami et al. (2020), CMAME 362, for energies as losses.
    """

    saves = ("no displacement of the data set in the loss: it is the potential energy",)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        self._rest = rest = RestStiffness.of(physics.problem, self._rest)
        with torch.no_grad():
            work = rest.linear_strain_energy(batch.force, batch.parameters)
            scale = clamp_scale(work, self.floor)
            energy, slope, sound = potential_energy(prediction, batch.load, physics.problem, rest)
            if not sound.all():
                image = rest.product(prediction, batch.parameters)
                energy = torch.where(sound, energy, (prediction * image).sum(dim=(1, 2)) / 2)
                slope = torch.where(sound[:, None, None], slope, image)
            slope = slope / scale[:, None, None]
            self.terms = {"inverted": 1 - sound.double().mean()}
        return with_gradient(prediction, energy / scale, slope).mean()
