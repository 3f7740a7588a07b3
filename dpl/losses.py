"""Physics losses: callables (prediction, batch, physics) -> scalar, Lightning callbacks too.

The module carries its loss into the trainer (`configure_callbacks`), so that a loss may anneal
between epochs and log its own terms. Where mechanics enters, slopes come from the compiled forces
of `Problem.evaluate` and not from automatic differentiation, which takes 3 to 17 times as long.

Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.3, for the first three.
"""

from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dpl.fem.energy import Rest, potential, tangent_product
from dpl.fem.problem import Problem
from dpl.scene import Sample

TINY = 1e-24  # square of an error below which a norm has no slope [-]


class Physics(NamedTuple):
    """What a loss may know of the scene.

    Attributes:
        problem: The body, on the device of the batch; with a range of Poisson's ratios that of a
            batch is `problem.at(batch.poisson)`.
        largest_force: ||Phi q_max||, the paper's normaliser of residuals [-].
    """

    problem: Problem
    largest_force: Tensor


class Loss(L.Callback):
    """A loss; subclasses define `__call__` and put what they want logged into `terms`."""

    def __init__(self) -> None:
        """Start with nothing to log."""
        self.terms: dict[str, Tensor] = {}

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """Return the loss of displacements (B, N, D) [-], float64, as a scalar."""
        raise NotImplementedError(f"{type(self).__name__} computes nothing")

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, *_: Any) -> None:
        """Log the terms."""
        module.log_dict({f"loss/{name}": term.detach() for name, term in self.terms.items()})

    def plan(self) -> list[str]:
        """Return what this loss leaves out, a line each."""
        return []


class MSE(Loss):
    """Mean squared error of u/L over all degrees of freedom."""

    def __init__(self, *, relative: float = 0.0, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            relative: Power of the mean square of its own displacement that each sample's error is
                divided by: at 1 small loads count as much as large ones, at 0 by their size.
            floor: See `floored`; only where `relative` is above 0.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        if not 0 <= relative <= 1:
            raise ValueError(f"relative = {relative} must lie between 0 and 1")
        self.relative, self.floor = relative, _checked(floor)

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        size = batch.displacement.square().mean(dim=(1, 2))
        return self.of_squares(squared_error(prediction, batch), size)

    def of_squares(self, error: Tensor, size: Tensor) -> Tensor:
        """Return the loss of mean squared errors (B,) of displacements of mean squares (B,)."""
        return self._weighted(error, size).mean()

    def _weighted(self, error: Tensor, size: Tensor) -> Tensor:
        return error / floored(size, self.floor) ** self.relative if self.relative else error

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no finite-element evaluation in training: the loss knows no residual"]


class MeanNorm(MSE):
    """Mean over samples of the root mean square error of u/L: e_mean, but for a factor.

    Its slope does not fade as the error falls, and no sample with a large error outweighs a batch.
    """

    def of_squares(self, error: Tensor, size: Tensor) -> Tensor:
        """See `MSE`."""
        return (self._weighted(error, size) + TINY).sqrt().mean()


class LrStar(Loss):
    """L_r^* = MSE x ||R|| / ||Phi q_max||, the residual a constant weight without gradient.

    The residual norm is averaged over the batch as in the paper, where it scales the gradient of
    the whole batch; per sample it also weighs the samples of a batch against each other.
    """

    def __init__(self, *, per_sample: bool = False) -> None:
        """Choose the weighting.

        Args:
            per_sample: Weigh each sample by its own residual instead of the batch's mean.
        """
        super().__init__()
        self.per_sample = per_sample

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch)
        weight = residual_norm(prediction.detach(), batch, physics)
        weight = weight if self.per_sample else weight.mean()
        self.terms = {"mse": error.mean(), "residual": weight.mean()}
        return (error * weight).mean()

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no backward pass through the residual: it is a weight"]


class LrPlus(Loss):
    """L_r^+ = MSE + weight ||R|| / ||Phi q_max||, differentiable through the residual.

    Attributes:
        weight: Factor on the residual at present [-].
    """

    def __init__(self, *, weight: float = 1.0, warmup_epochs: int = 0) -> None:
        """Choose how much the residual counts.

        Args:
            weight: Factor on the residual; 1 is the paper's.
            warmup_epochs: Epochs in which it rises linearly from zero.

        Raises:
            ValueError: A number is negative.
        """
        super().__init__()
        if weight < 0 or warmup_epochs < 0:
            raise ValueError(
                f"weight = {weight}, warmup_epochs = {warmup_epochs} must be 0 or more"
            )
        self._final, self._warmup = weight, warmup_epochs
        self.weight = weight if warmup_epochs == 0 else 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Anneal the weight."""
        if self._warmup:
            self.weight = self._final * min(1.0, trainer.current_epoch / self._warmup)

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        error = squared_error(prediction, batch).mean()
        residual = residual_norm(prediction, batch, physics).mean()
        self.terms = {"mse": error, "residual": residual}
        return error + self.weight * residual


class Stiffness(Loss):
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
            floor: See `floored`; only where `relative`.

        Raises:
            ValueError: `floor` is out of range.
        """
        super().__init__()
        self.relative, self.floor = relative, _checked(floor)
        self._rest: Rest | None = None

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        self._rest = rest = Rest.of(physics.problem, self._rest)
        with torch.no_grad():
            fields = torch.cat([prediction - batch.displacement, batch.displacement])
            images = rest.product(fields, torch.cat([batch.poisson, batch.poisson]))
            error, size = (fields * images).sum(dim=(1, 2)).chunk(2)
            size = floored(size, self.floor if self.relative else torch.inf)
            slope = 2 * images[: len(prediction)] / size[:, None, None]
        return _Known.apply(prediction, error / size, slope).mean()

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no finite-element evaluation in training: K(0) is assembled once"]


class Energy(Loss):
    """Total potential energy (W(u) - W(0) - f.u) / (f.K(0)^-1 f / 2): equilibria without answers.

    Displacements of the batch are not read: stable equilibria are the minima. The scale is the work
    of the linear answer, so that every load counts alike, a light one or one on a single node (a
    scale of ||f||^2 would hardly see that one: nearly all of its norm lies in stiff modes). Near
    rest the loss is -1 + the squared relative energy norm of the error. Its conditioning is that of
    K(0): outputs in modes over the roots of their eigenvalues learn fast, free nodal values slowly,
    as their noise is stiff; those begin better with another loss, see `Annealed`.

    Where elements are inverted the energy is no number or leads to a body inside out. Such a sample
    takes u^T K(0) u / 2 on the same scale instead, without its load: positive, and downhill to
    rest, rough strains first, where nothing is inverted. (With the load it would lead to the linear
    answer, which may be inverted itself.)

    Source: Samaniego, Anitescu, Goswami et al. (2020), CMAME 362, for energies as losses.
    """

    def __init__(self, *, floor: float = 1e-2) -> None:
        """Choose the weighting.

        Args:
            floor: See `floored`.

        Raises:
            ValueError: `floor` is out of range.
        """
        super().__init__()
        self.floor = _checked(floor)
        self._rest: Rest | None = None

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`."""
        self._rest = rest = Rest.of(physics.problem, self._rest)
        with torch.no_grad():
            scale = floored(rest.work(batch.force, batch.poisson), self.floor)
            energy, slope, sound = potential(prediction, batch.load, physics.problem, rest)
            if not sound.all():
                image = rest.product(prediction, batch.poisson)
                energy = torch.where(sound, energy, (prediction * image).sum(dim=(1, 2)) / 2)
                slope = torch.where(sound[:, None, None], slope, image)
            self.terms = {"inverted": 1 - sound.double().mean()}
        return _Known.apply(prediction, energy / scale, slope / scale[:, None, None]).mean()

    def plan(self) -> list[str]:
        """See `Loss`."""
        return ["no displacement of the data set in the loss: it is the energy itself"]


class Annealed(Loss):
    """One loss that turns into another: (1 - weight) first + weight second.

    Attributes:
        weight: Part of the second loss at present [-].
    """

    def __init__(self, first: Loss, second: Loss, *, epochs: int, start: int = 0) -> None:
        """Choose from what to what, and when.

        Args:
            first: The loss up to `start`.
            second: The loss from `start + epochs` on; best of the same size as the first one.
            epochs: Epochs in which the weight rises linearly from 0 to 1.
            start: Epoch in which it begins to.

        Raises:
            ValueError: A number is out of range.
        """
        super().__init__()
        if epochs < 1 or start < 0:
            raise ValueError(f"epochs = {epochs} must be 1 or more, start = {start} 0 or more")
        self.first, self.second = first, second
        self._epochs, self._start = epochs, start
        self.weight = 0.0

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Anneal the weight, and those of the parts."""
        passed = (trainer.current_epoch - self._start) / self._epochs
        self.weight = min(1.0, max(0.0, passed))
        for loss in (self.first, self.second):
            loss.on_train_epoch_start(trainer, module)

    def __call__(self, prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
        """See `Loss`; a part of weight 0 is not evaluated."""
        total = prediction.new_zeros(())
        self.terms = {"weight": total + self.weight}
        parts = {"first": (1 - self.weight, self.first), "second": (self.weight, self.second)}
        for name, (share, loss) in parts.items():
            if share > 0:
                value = loss(prediction, batch, physics)
                total = total + share * value
                self.terms |= {name: value}
                self.terms |= {f"{name}/{term}": what for term, what in loss.terms.items()}
        return total

    def plan(self) -> list[str]:
        """Return what both leave out."""
        return [line for line in self.first.plan() if line in self.second.plan()]


class _Known(torch.autograd.Function):
    """Values (B,) of displacements (B, N, D), their slope (B, N, D) found by other means."""

    @staticmethod
    def forward(ctx: Any, displacement: Tensor, value: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(slope)
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (slope,) = ctx.saved_tensors
        return gradient[:, None, None] * slope, None, None


def squared_error(prediction: Tensor, batch: Sample) -> Tensor:
    """Return the mean square of (u - v)/L over degrees of freedom, (B,) [-]."""
    return (prediction - batch.displacement).square().mean(dim=(1, 2))


def floored(sizes: Tensor, floor: float) -> Tensor:
    """Return what to divide samples by: their own sizes (B,), but no less than a part of the mean.

    Without a floor a load near zero, which no network answers to many digits, outweighs a batch.

    Args:
        sizes: Squares or energies, 0 or more.
        floor: Part of their mean; 1e-2 is a tenth of the usual displacement. Infinity: all take
            the mean.
    """
    mean = sizes.mean()
    sizes = mean.expand_as(sizes) if floor == torch.inf else torch.maximum(sizes, floor * mean)
    return torch.where(sizes > 0, sizes, 1.0)


def residual_norm(prediction: Tensor, batch: Sample, physics: Physics) -> Tensor:
    """Return ||R_free(u)|| / ||Phi q_max||, (B,) [-].

    Its slope K R / ||R|| takes two more evaluations, see `tangent_product`. Where elements are
    inverted so far that the law has no stress, the norm is not finite; such samples take the
    largest finite norm of the batch (1 if there is none) and no gradient.
    """
    problem = physics.problem.at(batch.poisson)
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
    return _Known.apply(prediction, norm, slope)


def _checked(floor: float) -> float:
    """Return a floor.

    Raises:
        ValueError: It lies outside [0, 1].
    """
    if not 0 <= floor <= 1:
        raise ValueError(f"floor = {floor} must lie between 0 and 1")
    return floor
