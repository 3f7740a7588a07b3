"""Losses from the energy: in the norm of K(0), or the potential energy itself."""

import torch
from torch import Tensor

from dpl.fem.postprocess import RestStiffness, potential_energy
from dpl.scene import Sample
from dpl.training.losses.loss import Loss, LossContext, _checked, clamp_scale
from dpl.training.losses.supervised import _FixedGradient


class EnergyNormLoss(Loss):
    """Squared energy norm of the error with the rest stiffness: e^T K(0) e / v^T K(0) v, e = u - v.

    The squared relative error of strains rather than of displacements: a rough error, harmless to
    the eye and in the MSE, is stiff and costs Newton its first steps; here it weighs what it costs.
    One sparse product with a matrix that is assembled once, and no finite element in training.
    """

    def __init__(self, *, relative: bool = True, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Divide each sample's error by the energy of its own displacement; otherwise
                all by the mean energy of the batch.
            floor: See `clamp_scale`; only where `relative`.

        Raises:
            ValueError: `floor` is out of range.
        """
        super().__init__()
        self.relative, self.floor = relative, _checked(floor)
        self._rest: RestStiffness | None = None

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        self._rest = rest = RestStiffness.of(physics.problem, self._rest)
        with torch.no_grad():
            fields = torch.cat([prediction - batch.displacement, batch.displacement])
            images = rest.product(fields, torch.cat([batch.poisson, batch.poisson]))
            error, size = (fields * images).sum(dim=(1, 2)).chunk(2)
            size = clamp_scale(size, self.floor if self.relative else torch.inf)
            slope = 2 * images[: len(prediction)] / size[:, None, None]
        return _FixedGradient.apply(prediction, error / size, slope).mean()

    def skipped_work(self) -> list[str]:
        """See `Loss`."""
        return ["no finite-element evaluation in training: K(0) is assembled once"]


class PotentialEnergyLoss(Loss):
    """Total potential energy (W(u) - W(0) - f.u) / (f.K(0)^-1 f / 2): equilibria without answers.

    Displacements of the batch are not read: stable equilibria are the minima. The scale is the work
    of the linear answer, so that every load counts alike, a light one or one on a single node (a
    scale of ||f||^2 would hardly see that one: nearly all of its norm lies in stiff modes). Near
    rest the loss is -1 + the squared relative energy norm of the error. Its conditioning is that of
    K(0): outputs in modes over the roots of their eigenvalues learn fast, free nodal values slowly,
    as their noise is stiff; those begin better with another loss, see `BlendedLoss`.

    Where elements are inverted the energy is no number or leads to a body inside out. Such a sample
    takes u^T K(0) u / 2 on the same scale instead, without its load: positive, and downhill to
    rest, rough strains first, where nothing is inverted. (With the load it would lead to the linear
    answer, which may be inverted itself.)

    Source: Samaniego, Anitescu, Goswami et al. (2020), CMAME 362, for energies as losses.
    """

    def __init__(self, *, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            floor: See `clamp_scale`.

        Raises:
            ValueError: `floor` is out of range.
        """
        super().__init__()
        self.floor = _checked(floor)
        self._rest: RestStiffness | None = None

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """See `Loss`."""
        self._rest = rest = RestStiffness.of(physics.problem, self._rest)
        with torch.no_grad():
            scale = clamp_scale(rest.work(batch.force, batch.poisson), self.floor)
            energy, slope, sound = potential_energy(prediction, batch.load, physics.problem, rest)
            if not sound.all():
                image = rest.product(prediction, batch.poisson)
                energy = torch.where(sound, energy, (prediction * image).sum(dim=(1, 2)) / 2)
                slope = torch.where(sound[:, None, None], slope, image)
            self.terms = {"inverted": 1 - sound.double().mean()}
        return _FixedGradient.apply(prediction, energy / scale, slope / scale[:, None, None]).mean()

    def skipped_work(self) -> list[str]:
        """See `Loss`."""
        return ["no displacement of the data set in the loss: it is the energy itself"]
