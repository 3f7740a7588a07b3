"""Losses of displacements: supervised, residual-based and energy-based.

A loss is a callable (prediction, batch, physics) -> scalar and a Lightning callback, which can
anneal between epochs and log its terms. Losses with mechanics take gradients from the compiled
forces of `Problem.evaluate`; automatic differentiation takes 3 to 17 times as long.

Source of L_r^* and L_r^+: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3.
"""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor

from dpl.fem import Problem
from dpl.fem.postprocess import RestStiffness, potential_energy, tangent_product
from dpl.scene import Sample
from dpl.system.checks import check_range

SMALLEST_SQUARE = 1e-24  # added to squared errors: the root has no gradient at zero [-]
MAX_RESIDUALS = 64  # samples whose residual norms are averaged


class LossContext(NamedTuple):
    """The part of the scene that losses need, on the device of the batch."""

    problem: Problem  # without parameters; those of a batch are `batch.parameters`
    largest_force: float  # ||Phi q_max||, by which the paper divides residuals [-]


class Loss(L.Callback):
    """Base class of losses; subclasses define `__call__`."""

    saves: tuple[str, ...] = ()  # work that this loss saves, one line each
    needs_law = False  # evaluates stresses
    # precision of displacements and forces of training batches; energies and residuals cancel
    # digits that float32 does not have
    dtype = torch.float64

    def __init__(self) -> None:
        """Start without terms."""
        self.terms: dict[str, Tensor] = {}  # scalars of the last batch, logged as `loss/NAME`

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        """Return the loss of displacements over L, (B, N, D), of `dtype`, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} must define __call__")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    saves = ("no finite-element evaluation in training: the loss has no residual term",)
    dtype = torch.float32

    def __init__(self, *, relative: float = 0.0, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Exponent of the mean squared displacement by which the error of each sample is
                divided. 1 gives relative errors, 0 absolute errors.
            floor: See `clamp_scale`; has no effect if `relative` is 0.
        """
        super().__init__()
        check_range(0, 1, relative=relative, floor=floor)
        self.relative, self.floor = relative, floor

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        return self.errors(prediction, batch).mean()

    def errors(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return mean squared errors over powers of mean squared displacements, (B,)."""
        error = (prediction - batch.displacement).square().mean(dim=(1, 2))
        if not self.relative:
            return error
        size = batch.displacement.square().mean(dim=(1, 2))
        return error / clamp_scale(size, self.floor) ** self.relative


class RMSELoss(MSE):
    """Mean over samples of the root mean square error of u/L: e_mean times the root of N.

    Its gradient does not vanish with the error, and samples with large errors dominate a batch less
    than in the mean squared error.
    """

    def errors(self, prediction: Tensor, batch: Sample) -> Tensor:
        """Return the roots of the errors of `MSE`, (B,)."""
        return (super().errors(prediction, batch) + SMALLEST_SQUARE).sqrt()


class BlendedLoss(Loss):
    """(1 - weight) first + weight second, with a weight [-] that rises from 0 to 1."""

    def __init__(self, first: Loss, second: Loss, *, epochs: int, start: int = 0) -> None:
        """Choose the two losses and the schedule of the weight.

        Args:
            first: Loss up to the epoch `start`.
            second: Loss from the epoch `start + epochs` on; should have the magnitude of `first`.
            epochs: Number of epochs in which the weight rises linearly from 0 to 1.
            start: Epoch in which the weight begins to rise.
        """
        super().__init__()
        check_range(1, epochs=epochs)
        check_range(0, start=start)
        self.first, self.second = first, second
        self.saves = tuple(line for line in first.saves if line in second.saves)
        self.needs_law = first.needs_law or second.needs_law
        self._epochs, self._start, self.weight = epochs, start, 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Set the weight of the epoch, and the weights of both losses."""
        passed = (trainer.current_epoch - self._start) / self._epochs
        self.weight = min(1.0, max(0.0, passed))
        for loss in (self.first, self.second):
            loss.on_train_epoch_start(trainer, module)

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        # a loss of weight 0 is not evaluated
        total = prediction.new_zeros(())
        self.terms = {"weight": total + self.weight}
        parts = {"first": (1 - self.weight, self.first), "second": (self.weight, self.second)}
        for name, (weight, loss) in parts.items():
            if weight > 0:
                value = loss(prediction, batch, physics)
                total = total + weight * value
                self.terms |= {name: value}
                self.terms |= {f"{name}/{term}": scalar for term, scalar in loss.terms.items()}
        return total


class LrStar(Loss):
    """L_r^* = error x ||R|| / ||Phi q_max||; the residual norm is a weight without gradient.

    As in the paper, the residual norm is averaged over the batch and scales the gradient of the
    whole batch. The error of the paper is the mean squared one. The mean residual norm of a large
    batch is that of at most `MAX_RESIDUALS` of its samples.
    """

    saves = ("no backward pass through the residual: it is a constant weight",)
    needs_law = True
    dtype = torch.float32

    def __init__(self, *, error: MSE | None = None, limit: float | None = None) -> None:
        """Choose the error and the weighting.

        Args:
            error: Error of displacements; None for `MSE()`.
            limit: Largest residual norm over the median of its batch; larger ones count as that.
                None: no limit. Almost inverted elements have residuals that are thousands of times
                larger than usual, so that a few batches dominate the momentum of an optimiser.
        """
        super().__init__()
        if limit is not None:
            check_range(1, limit=limit)
        self.error, self.limit = error or MSE(), limit

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = self.error(prediction, batch, physics)
        stride = -(-len(prediction) // MAX_RESIDUALS)
        some = Sample(*(column[::stride] for column in batch))
        weight = residual_norm(prediction.detach()[::stride].double(), some, physics)
        if self.limit is not None:
            weight = weight.clamp(max=self.limit * weight.median())
        self.terms = {"error": error, "residual": weight.mean()}
        return error * weight.mean()


class LrPlus(Loss):
    """L_r^+ = MSE + weight ||R|| / ||Phi q_max||, differentiable through the residual."""

    needs_law = True

    def __init__(self, *, weight: float = 1.0) -> None:
        """Choose the factor on the residual; the paper has 1.

        `BlendedLoss` from `MSE` to this loss is the same with a factor that rises from zero.
        """
        super().__init__()
        check_range(0, weight=weight)
        self.error, self.weight = MSE(), weight

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        error = self.error(prediction, batch, physics)
        residual = residual_norm(prediction, batch, physics).mean()
        self.terms = {"error": error, "residual": residual}
        return error + self.weight * residual


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
    needs_law = True

    def __call__(self, prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
        self._rest = rest = RestStiffness.of(physics.problem, self._rest)
        with torch.no_grad():
            work = rest.linear_strain_energy(batch.force, batch.parameters)
            scale = clamp_scale(work, self.floor)
            energy, slope, sound = potential_energy(prediction, batch.load, physics.problem)
            if not sound.all():
                image = rest.product(prediction, batch.parameters)
                energy = torch.where(sound, energy, (prediction * image).sum(dim=(1, 2)) / 2)
                slope = torch.where(sound[:, None, None], slope, image)
            slope = slope / scale[:, None, None]
            self.terms = {"inverted": 1 - sound.double().mean()}
        return with_gradient(prediction, energy / scale, slope).mean()


def clamp_scale(sizes: Tensor, floor: float) -> Tensor:
    """Return divisors of errors, (B,): squares or energies, but at least `floor` of their mean.

    Without a floor a load near zero, whose relative error is always large, dominates a batch. 1e-2
    corresponds to a tenth of the usual displacement.
    """
    sizes = torch.maximum(sizes, floor * sizes.mean())
    return torch.where(sizes > 0, sizes, 1.0)


def with_gradient(displacement: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
    """Return values (B,) with a prescribed gradient with respect to displacements (B, N, D)."""
    zero = displacement - displacement.detach()
    return value + (gradient * zero).sum(dim=(1, 2))


def residual_norm(prediction: Tensor, batch: Sample, physics: LossContext) -> Tensor:
    """Return ||R_free(u)|| / ||Phi q_max||, (B,) [-].

    Its gradient K R / ||R|| takes two more evaluations, see `tangent_product`. If elements are
    inverted so far that the law has no stress, the norm is not finite. Such samples get the largest
    finite norm of the batch (1 if there is none) and a zero gradient.
    """
    problem = physics.problem.with_parameters(batch.parameters)
    residual = torch.where(problem.free, problem.evaluate(prediction).internal - batch.force, 0.0)
    length = residual.flatten(1).norm(dim=1)
    norm, sound = length / physics.largest_force, length.isfinite()
    largest = norm[sound].max() if sound.any() else torch.ones_like(norm[0])
    norm = torch.where(sound, norm, largest)
    if not (prediction.requires_grad and torch.is_grad_enabled()):
        return norm
    unit = residual / length.clamp(min=torch.finfo(length.dtype).tiny)[:, None, None]
    slope = tangent_product(problem, prediction.detach(), unit) / physics.largest_force
    slope = torch.where(slope.isfinite() & sound[:, None, None], slope, 0.0)
    return with_gradient(prediction, norm, slope)
