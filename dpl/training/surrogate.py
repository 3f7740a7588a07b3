"""The LightningModule: a network with scales, loss, metrics and optimiser."""

import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self, cast

import lightning as L
import torch
from torch import Tensor, nn

from dpl.fem import Load
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.models.linear_base import SCALE_STREAM, LinearBase, check_base, sampled_solutions
from dpl.models.protocols import ClosedFormFit, HasBase, TrainsInCoordinates
from dpl.models.reduced_samples import ReducedDataset, ReducedSamples
from dpl.scene import Sample, Scene
from dpl.training.callbacks.averaged_weights import AveragedWeights
from dpl.training.callbacks.closed_form import ClosedFormTraining
from dpl.training.linear_samples import LinearBatch, LinearSamples, linear_solutions
from dpl.training.losses.loss import Loss, LossContext
from dpl.training.losses.supervised import SquaredErrorLoss
from dpl.training.metrics import default_metrics
from dpl.training.random_states import random_states, set_random_states
from dpl.training.schedules import step_in_time, time_fraction, total_steps

SCALES = ("force_scale", "displacement_scale", "largest_force")


class Surrogate(L.LightningModule):
    """A network that predicts the displacement in equilibrium with a load.

    `predict` is the only border between float64 mechanics and the float32 network. `forward` takes
    newtons and pascals and returns metres.

    Attributes:
        net: Module from scaled forces (B, N, D) to scaled displacements (B, N, D). Its optional
            attribute `extra_inputs` names further inputs: "young", "parameters", and with a
            linear base "amplitude".
        base: The linear solutions that the output of the network is added to; None without.
        scene: The scene.
        loss: The loss.
        batch_errors: Relative L2 errors of the last training batch, (B,); None before the first.
    """

    def __init__(
        self,
        net: nn.Module,
        loss: Loss,
        scene: Scene,
        *,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = torch.optim.AdamW,
        scheduler: Callable[..., Any] | None = None,
    ) -> None:
        """Combine a network, a loss and a scene.

        Args:
            net: The network, see the class.
            loss: The loss.
            scene: The scene.
            optimizer: Function of the parameters that returns an optimiser.
            scheduler: Function of an optimiser and `total_steps` that returns a learning-rate
                schedule, stepped every batch; None for a constant learning rate. With a time limit
                of the trainer a `LambdaLR` is a function of max(step / total_steps, elapsed part
                of the time).

        Raises:
            ValueError: The body has ranges and the network no input for parameters, or the network
                has a base that does not exist or that its training excludes.
        """
        super().__init__()
        self.net, self.loss, self.scene = net, loss, scene
        self._is_closed_form = isinstance(net, ClosedFormFit)
        self._has_coordinates = isinstance(net, TrainsInCoordinates)
        self.batch_errors: Tensor | None = None
        self._random_states: dict[str, Any] | None = None  # of a resumed run
        self._optimizer, self._scheduler = optimizer, scheduler
        stresses = scene.problem.follower_loads.ranges
        for name, ends in scene.loads.parameter_ranges.items():
            if "parameters" not in getattr(net, "extra_inputs", ()):
                key = f"forces.{name}.value" if name in stresses else f"material.{name}"
                raise ValueError(
                    f"{key} is a range, {list(ends)}, and {type(net).__name__} has no input for "
                    f"it; set {key} to a number or choose another model"
                )
        largest_force = torch.tensor(scene.loads.largest_force, dtype=torch.float64)
        self.base, factors = None, torch.ones(2).double().unbind()
        adds_to_base = _adds_to_base(net)
        if not self._is_closed_form:
            force, linear = sampled_solutions(scene)
            self.base = LinearBase(scene, linear) if adds_to_base else None
            factors = scales(scene, force, linear)
        for name, value in zip(SCALES, (*factors, largest_force), strict=True):
            self.register_buffer(name, value.clone())
        self.physics = LossContext(scene.problem, self.largest_force)
        self.val_metrics = default_metrics(scene.problem).clone(prefix="val/")
        self.test_metrics = default_metrics(scene.problem).clone(prefix="test/")

    def forward(self, force: Tensor, young: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return displacements (B, N, D) [m] under nodal forces (B, N, D) [N].

        Args:
            force: Nodal forces, (B, N, D) [N].
            young: Young's moduli, (B,) [Pa].
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.
        """
        return self.scene.length * self.predict(self.scene.load_of(force, young, parameters))

    def predict(self, load: Load, linear: Tensor | None = None) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64.

        Args:
            load: The loads.
            linear: Their linear solutions, (B, N, D) [-], if they are known; used with a base only.
        """
        if self.base is not None:
            return self._predict_from_base(
                self.base, load, self.base.solve(load) if linear is None else linear.double()
            )
        scaled, more = self.scale_inputs(load)
        return self.unscale_outputs(self.net(scaled, **more))

    def _predict_from_base(self, base: LinearBase, load: Load, linear: Tensor) -> Tensor:
        """Return displacements over L, (B, N, D) [-], of a network with a linear base."""
        field, amplitude = base.scale_inputs(linear, self.displacement_scale)
        more = self._extra_inputs(load, amplitude=amplitude)
        field = field.to(self.dtype)
        if not self._has_coordinates:  # a network with coordinates whitens these
            field = base.whiten(field)
        output = self.net(field, **more).double() * self.displacement_scale
        nonlinear = base.gate(amplitude)[:, None, None] * output
        return linear + torch.where(self.physics.problem.free, nonlinear, 0.0)

    def scale_inputs(self, load: Load) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the inputs of the network: scaled forces (B, N, D), and its extra inputs by name.

        Networks with a linear base have other inputs.

        Raises:
            ValueError: The load has not one parameter for each range of the body.
        """
        scaled = load.force
        if not self._is_closed_form:
            scaled = (self._effective_force(scaled) / self.force_scale).to(self.dtype)
        return scaled, self._extra_inputs(load)

    def _extra_inputs(self, load: Load, **computed: Tensor) -> dict[str, Tensor]:
        if load.parameters.shape[-1] != len(names := list(self.scene.loads.parameter_ranges)):
            found = load.parameters.shape[-1]
            raise ValueError(f"Load.parameters has {found} columns; the body has ranges of {names}")
        known = {"young": load.young, "parameters": load.parameters} | computed
        return {name: known[name] for name in getattr(self.net, "extra_inputs", ())}

    def _effective_force(self, force: Tensor) -> Tensor:
        """Return forces (B, N, D) with the values of training on fixed degrees of freedom."""
        problem, constant = self.physics.problem, self.scene.loads.constant_force
        force = problem.acting(force)
        if constant is None:
            return force
        return force + torch.where(problem.free, 0.0, constant.to(force.device))

    def unscale_outputs(self, output: Tensor) -> Tensor:
        """Return displacements over L (B, N, D) [-], float64, from outputs of the network."""
        if self._is_closed_form:
            return output
        problem, displacement = self.physics.problem, output.double() * self.displacement_scale
        return torch.where(problem.free, displacement, problem.prescribed)

    def describe(self) -> list[tuple[str, str]]:
        """Return name and size of the network, and the loss."""
        kind = type(self.net).__name__
        if self._is_closed_form:
            return [("model", f"{kind}, fitted by linear regression")]
        count = sum(weights.numel() for weights in self.net.parameters())
        return [("model", f"{kind}, {count:,} weights; loss {type(self.loss).__name__}")]

    def skipped_work(self) -> list[str]:
        """Return the work that network and loss save, one line each."""
        lines = [*getattr(self.net, "skipped_work", list)(), *self.loss.skipped_work()]
        if self.base is not None:
            lines.append("no learning of linear elasticity: the network adds to K(0)^-1 f")
        if self._trains_in_coordinates:
            lines.append("no fields in training from disk: the loss is computed in coordinates")
        return lines

    @property
    def _trains_in_coordinates(self) -> bool:
        return self._has_coordinates and isinstance(self.loss, SquaredErrorLoss)

    def training_step(
        self, batch: Sample | LinearBatch | ReducedSamples, batch_idx: int
    ) -> Tensor | None:
        """Return the loss of a batch, (); None for a model that has been fitted."""
        if self._is_closed_form:
            return None
        if isinstance(batch, ReducedSamples):
            loss = self._reduced_loss(batch)
        else:
            linear, sample = batch if isinstance(batch, LinearBatch) else (None, batch)
            prediction = self.predict(sample.load, linear)
            loss = self.loss(prediction, sample, self.physics)
            error = (prediction.detach() - sample.displacement).flatten(1).norm(dim=1)
            size = sample.displacement.flatten(1).norm(dim=1)
            self.batch_errors = error / size.clamp(min=1e-12)
        self.log("loss/train", loss, prog_bar=True, batch_size=len(batch[0]))
        return loss

    def _reduced_loss(self, batch: ReducedSamples) -> Tensor:
        """Return the loss of a batch in reduced coordinates, ()."""
        net = cast(TrainsInCoordinates, self.net)
        error = (net.network(batch.inputs) - batch.targets).square().sum(dim=1)
        square = self.displacement_scale**2
        error = square * batch.factor.square() * (error + batch.squared_error)
        error = error / self.scene.problem.free.numel()
        loss = cast(SquaredErrorLoss, self.loss)
        return loss.from_squared_errors(error, square * batch.mean_square)

    def encode(
        self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES
    ) -> ReducedDataset | LinearSamples | None:
        """Return training samples (S, N, D) in reduced coordinates or with their linear solutions.

        In an orthonormal basis the squared error of a displacement is the squared error of its
        coordinates plus the squared projection error. A loss that is a function of squared errors
        therefore needs no fields.

        Returns None if the network or the loss needs fields and no linear solutions, or if images
        of the samples are wanted and the network does not compute them.

        Args:
            samples: The samples.
            group: Symmetries of the body whose images of samples are wanted; empty for none.
        """
        net = cast(TrainsInCoordinates, self.net)
        if self._trains_in_coordinates and (len(group) < 2 or net.is_symmetric):
            return self._encode_in_coordinates(net, samples)
        return None if self.base is None else LinearSamples(samples, self.base, group)

    def _encode_in_coordinates(self, net: TrainsInCoordinates, samples: Sample) -> ReducedDataset:
        scaled, amplitude = self._scale(samples)
        if self.base is None:
            return net.encode(scaled)
        data = net.encode(scaled, amplitude)
        whole = samples.displacement / self.displacement_scale.cpu()
        images = len(data) // len(whole)
        data.samples = data.samples._replace(
            mean_square=whole.square().flatten(1).mean(dim=1).repeat(images),
            factor=self.base.gate(amplitude).repeat(images),
        )
        return data

    def _scale(self, samples: Sample) -> tuple[Sample, Tensor]:
        """Return samples (S, N, D) as a network of coordinates sees them, and amplitudes (S,)."""
        size = self.displacement_scale.cpu()
        if self.base is None:
            force = samples.force / self.force_scale.cpu()
            scaled = samples._replace(force=force, displacement=samples.displacement / size)
            return scaled, torch.ones_like(samples.young)
        linear = linear_solutions(samples.load, self.base).double()
        field, amplitude = self.base.scale_inputs(linear, size)
        wanted = self.base.scale_outputs(samples.displacement - linear, amplitude, size)
        return samples._replace(force=field, displacement=wanted), amplitude

    def fit_bases(self, samples: Sample) -> None:
        """Fit the bases of the network to training samples (S, N, D)."""
        cast(TrainsInCoordinates, self.net).fit_bases(self._scale(samples)[0])

    def validation_step(self, batch: Sample, batch_idx: int) -> None:
        """Update the validation metrics."""
        prediction = self.predict(batch.load)
        loss = self.loss(prediction, batch, self.physics)
        self.log("loss/val", loss, batch_size=len(batch.force))
        self.val_metrics.update(prediction, batch)
        self.log_dict(self.val_metrics, batch_size=len(batch.force))

    def test_step(self, batch: Sample, batch_idx: int) -> None:
        """Update the test metrics."""
        self.test_metrics.update(self.predict(batch.load), batch)
        self.log_dict(self.test_metrics, batch_size=len(batch.force))

    def setup(self, stage: str) -> None:
        """Fit the bases of the network."""
        # before later hooks: schedules load the batches, and encoding them takes the bases
        net = cast(TrainsInCoordinates, self.net)
        if stage == "fit" and self._has_coordinates and not net.is_fitted:
            self.fit_bases(self.trainer.datamodule.snapshots())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the module, and the problem of the loss and of the metrics to the same device.

        All ways to move a module end here. Lightning moves it after the hook `setup`.
        """
        super()._apply(fn, recurse)
        device, problem = self.largest_force.device, self.physics.problem
        if problem.points.device != device:
            own = self.scene.problem
            problem = own if own.points.device == device else own.to(device)
        self.physics = LossContext(problem, self.largest_force)
        for collection in (self.val_metrics, self.test_metrics):
            for metric in collection.values():
                if hasattr(metric, "problem"):
                    metric.problem = problem
        return self

    def configure_callbacks(self) -> list[L.Callback]:
        """Return the loss, which is a callback, and that of a model without gradient descent."""
        return [self.loss, ClosedFormTraining()] if self._is_closed_form else [self.loss]

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Let the weights be validated with which the training ends."""
        trainer = self.trainer
        last = trainer.is_last_batch and self.current_epoch + 1 == trainer.max_epochs
        if last or trainer.global_step == trainer.max_steps:
            trainer.should_stop = True  # Lightning then validates after this batch
        if trainer.should_stop and trainer.check_val_every_n_epoch is not None:
            trainer.check_val_every_n_epoch = 1

    def configure_optimizers(self) -> Any:
        """Return the optimiser with its schedule; None without parameters."""
        if self._is_closed_form:
            for message in (".*configure_optimizers. returned .None", ".*training_step. returned"):
                warnings.filterwarnings("ignore", message)
            return None
        optimizer = self._optimizer(self.parameters())
        if self._scheduler is None:
            return optimizer
        steps = total_steps(self.trainer)
        schedule = {"scheduler": self._scheduler(optimizer, total_steps=steps), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}

    def lr_scheduler_step(self, scheduler: Any, metric: Any | None) -> None:
        """Make a step of the schedule; functions of the step follow a time limit of the trainer."""
        fraction = time_fraction(self.trainer)
        if fraction and isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR):
            step_in_time(scheduler, total_steps(self.trainer), fraction)
        else:
            super().lr_scheduler_step(scheduler, metric)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the scene, the states of random number generators and averaged weights."""
        checkpoint |= {
            "scene": self.scene.fingerprint,
            "identity": self.scene.identity(),
            "nodes": self.scene.problem.shape[0],
            "random": random_states(),
        }
        # not a hook of the callback: Lightning calls those only for complete checkpoints
        for callback in self._trainer.callbacks if self._trainer else ():
            if isinstance(callback, AveragedWeights):
                callback.replace_weights(checkpoint)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that the checkpoint belongs to this scene.

        Raises:
            ValueError: The checkpoint belongs to another scene.
        """
        stored, identity = checkpoint.get("scene", "unknown"), checkpoint.get("identity", {})
        if stored != self.scene.fingerprint and not self.scene.matches(identity):
            raise ValueError(
                f"the checkpoint is of scene {stored[:12]}, this scene is "
                f"{self.scene.fingerprint[:12]}"
                + "".join(f"; {line}" for line in self.scene.differences(identity))
            )
        self._random_states = checkpoint.get("random")

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """Load weights; the arguments are those of `torch.nn.Module`.

        Raises:
            ValueError: A tensor has another type, is not finite, or is none that a fit can give.
            RuntimeError: The weights are of another network.
        """
        own = self.state_dict()
        for name, stored in state_dict.items():
            dtype = own[name].dtype if name in own else stored.dtype
            if stored.dtype != dtype and not stored.is_floating_point() & dtype.is_floating_point:
                raise ValueError(f"{name} of {stored.dtype} must be of {dtype}")
            if not stored.to(dtype).isfinite().all():
                raise ValueError(f"{name} must be finite")
        found = super().load_state_dict(state_dict, *args, **options)
        for name in SCALES:
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name} = {float(value)} must be above 0")
        return found

    def check_predictions(self) -> None:
        """Raise ValueError if a prediction of a load of the scene is not finite."""
        load = self.scene.loads.sample((0, SCALE_STREAM), range(2))
        with torch.no_grad():  # tensors that a network keeps are used for derivatives, too
            if not self.predict(load).isfinite().all():
                raise ValueError("the answers of the network are not finite")

    def on_train_start(self) -> None:
        """Restore the states of random number generators of a resumed run."""
        if self._random_states is not None:
            set_random_states(self._random_states)


def _adds_to_base(net: nn.Module) -> bool:
    """Return True if the output of a network is added to linear solutions.

    Raises:
        ValueError: There is no such base, or the network is not trained by gradient descent.
    """
    if not isinstance(net, HasBase) or net.base == "none":
        return False
    check_base(net.base)
    if isinstance(net, ClosedFormFit):
        raise ValueError(f"{type(net).__name__} requires base = none, not {net.base}")
    return True


def scales(scene: Scene, force: Tensor, displacement: Tensor) -> tuple[Tensor, Tensor]:
    """Return the scales of forces and displacements, scalars [-].

    They are root mean squares: of forces over loadable degrees of freedom, of displacements over
    free degrees of freedom.

    Args:
        scene: The scene.
        force: Forces of random loads, (S, N, D) [-].
        displacement: Their linear solutions, (S, N, D) [-].
    """
    force = force[:, scene.loads.loadable_dofs]
    displacement = displacement[:, scene.problem.free]
    return force.square().mean().sqrt(), displacement.square().mean().sqrt()
