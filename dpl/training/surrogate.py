"""The LightningModule: a predictor with loss, metrics and optimiser."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self, cast

import lightning as L
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from dpl.fem import Load
from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.models.inputs import Base, Inputs
from dpl.models.linear_base import SCALE_STREAM
from dpl.scene import Sample, Scene
from dpl.training import checkpoints
from dpl.training.callbacks.averaged_weights import AveragedWeights
from dpl.training.losses.loss import Loss, LossContext
from dpl.training.metrics import default_metrics
from dpl.training.predictors import predictor_of
from dpl.training.random_states import random_states, set_random_states
from dpl.training.schedules import step_in_time, time_fraction, total_steps


class Surrogate(L.LightningModule):
    """A network that predicts the displacement in equilibrium with a load.

    `forward` takes newtons and pascals and returns metres; `predict` is dimensionless.

    Attributes:
        predictor: The network with its scales, perhaps on the linear solution, see `Predictor`.
        scene: The scene.
        loss: The loss.
        physics: The part of the scene that losses need, on the device of the network.
    """

    def __init__(
        self,
        net: nn.Module,
        loss: Loss,
        scene: Scene,
        *,
        base: Base | None = None,
        young: bool = False,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = torch.optim.AdamW,
        scheduler: Callable[..., Any] | None = None,
    ) -> None:
        """Combine a network, a loss and a scene.

        Args:
            net: Module from a field (B, N, D) and scalars (B, S) to a scaled displacement
                (B, N, D), float32; built for `Inputs.from_scene(scene, base, young=young)`. Or a
                model that `ClosedFormFit` describes.
            loss: The loss.
            scene: The scene.
            base: "linear": the network adds to the linear solution, see `OnLinearSolution`; None:
                it predicts the displacement from the force, see `Scaled`.
            young: Young's modulus is an input of the network, see `Scaled`.
            optimizer: Function of the parameters that returns an optimiser.
            scheduler: Function of an optimiser and `total_steps` that returns a learning-rate
                schedule, stepped every batch; None for a constant learning rate. With a time limit
                of the trainer a `LambdaLR` is a function of max(step / total_steps, elapsed part
                of the time).

        Raises:
            ValueError: There is no such base, or it excludes the network or another option.
        """
        super().__init__()
        self.predictor = predictor_of(net, scene, base, young=young)
        self.loss, self.scene = loss, scene
        self._random_states: dict[str, Any] | None = None  # of a resumed run
        self._optimizer, self._scheduler = optimizer, scheduler
        self.largest_force: Tensor
        largest_force = torch.tensor(scene.loads.largest_force, dtype=torch.float64)
        self.register_buffer("largest_force", largest_force)
        self.physics = LossContext(scene.problem, self.largest_force)
        self.val_metrics = default_metrics(scene.problem).clone(prefix="val/")
        self.test_metrics = default_metrics(scene.problem).clone(prefix="test/")

    @classmethod
    def from_network(
        cls,
        network: Callable[..., nn.Module],
        loss: Loss,
        scene: Scene,
        *,
        base: Base | None = None,
        young: bool = False,
        **options: Any,
    ) -> Self:
        """Return a surrogate with `network(scene, inputs)`; the options are those of the class."""
        net = network(scene, Inputs.from_scene(scene, base, young=young))
        return cls(net, loss, scene, base=base, young=young, **options)

    @property
    def net(self) -> nn.Module:
        """The network."""
        return self.predictor.net

    def forward(self, force: Tensor, young: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return displacements (B, N, D) [m] under nodal forces (B, N, D) [N].

        Args:
            force: Nodal forces, (B, N, D) [N].
            young: Young's moduli, (B,) [Pa].
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.
        """
        return self.scene.length * self.predict(self.scene.load_of(force, young, parameters))

    def predict(self, load: Load) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64."""
        return cast(Tensor, self.predictor(load))

    def describe(self) -> list[tuple[str, str]]:
        """Return name and size of the network, and the loss."""
        return [("model", self.predictor.describe(self.loss))]

    def skipped_work(self) -> list[str]:
        """Return the work that network and loss save, one line each."""
        return self.predictor.skipped_work(self.loss)

    def encode(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> Dataset:
        """Return the training set of samples and their images, see `Predictor.dataset`."""
        return self.predictor.dataset(samples, group)

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Return the loss of a batch, ()."""
        loss = self.predictor.loss(batch, self.loss, self.physics)
        self.log("loss/train", loss, prog_bar=True, batch_size=len(batch[0]))
        return loss

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
        if stage == "fit" and self.predictor.lacks_bases:
            data = self.trainer.datamodule
            self.fit_bases(data.snapshots(), data.group)

    def fit_bases(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> None:
        """Fit the bases of a network that `HasBases` to samples (S, N, D) and their images."""
        self.predictor.fit_bases(samples, group)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the module, and the problem of the loss and of the metrics to the same device.

        All ways to move a module end here. Lightning moves it after the hook `setup`.
        """
        super()._apply(fn, recurse)
        problem = self.predictor.problem
        self.physics = LossContext(problem, self.largest_force)
        for collection in (self.val_metrics, self.test_metrics):
            for metric in collection.values():
                if hasattr(metric, "problem"):
                    metric.problem = problem
        return self

    def configure_callbacks(self) -> list[L.Callback]:
        """Return the loss, which is a callback."""
        return [self.loss]

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        """Let the weights be validated with which the training ends."""
        trainer = self.trainer
        last = trainer.is_last_batch and self.current_epoch + 1 == trainer.max_epochs
        if last or trainer.global_step == trainer.max_steps:
            trainer.should_stop = True  # Lightning then validates after this batch
        if trainer.should_stop and trainer.check_val_every_n_epoch is not None:
            trainer.check_val_every_n_epoch = 1

    def configure_optimizers(self) -> Any:
        """Return the optimiser with its schedule.

        Raises:
            TypeError: The network is fitted in closed form.
        """
        if self.predictor.is_closed_form:
            name = type(self.net).__name__
            raise TypeError(f"{name} has no gradient descent; call dpl.training.fit")
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
        checkpoint |= checkpoints.entries_of_scene(self.scene) | {"random": random_states()}
        # not a hook of the callback: Lightning calls those only for complete checkpoints
        for callback in self._trainer.callbacks if self._trainer else ():
            if isinstance(callback, AveragedWeights):
                callback.replace_weights(checkpoint)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check that the checkpoint belongs to this scene.

        Raises:
            ValueError: The checkpoint belongs to another scene.
        """
        checkpoints.check_scene(checkpoint, self.scene)
        self._random_states = checkpoint.get("random")

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """Load weights; the arguments are those of `torch.nn.Module`.

        Raises:
            ValueError: A tensor has another type, is not finite, or is none that a fit can give.
            RuntimeError: The weights are of another network.
        """
        own = self.state_dict()
        if "force_scale" in state_dict:
            raise ValueError("was written by an earlier version of dpl; train the run again")
        for name, stored in state_dict.items():
            dtype = own[name].dtype if name in own else stored.dtype
            if stored.dtype != dtype and not stored.is_floating_point() & dtype.is_floating_point:
                raise ValueError(f"{name} of {stored.dtype} must be of {dtype}")
            if not stored.to(dtype).isfinite().all():
                raise ValueError(f"{name} must be finite")
        found = super().load_state_dict(state_dict, *args, **options)
        if not self.largest_force > 0:
            raise ValueError(f"largest_force = {float(self.largest_force)} must be above 0")
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
