"""The LightningModule: a surrogate with loss, metrics and optimiser."""

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Self

import lightning as L
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from dpl.fem.symmetry import NO_SYMMETRIES, SymmetryGroup
from dpl.models.interface import Base, Inputs
from dpl.scene import Sample, Scene
from dpl.training import checkpoints
from dpl.training.callbacks.averaged_weights import AveragedWeights
from dpl.training.losses import Loss, LossContext
from dpl.training.metrics import ErrorMetrics
from dpl.training.schedules import time_fraction, total_steps
from dpl.training.trained import TrainedSurrogate


class Surrogate(TrainedSurrogate, L.LightningModule):
    """A network that predicts the displacement in equilibrium with a load, with its training."""

    if TYPE_CHECKING:  # type checkers do not follow Lightning

        def __getattr__(self, name: str) -> Any: ...

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
        """
        super().__init__(net, scene, base=base, young=young)
        if loss.needs_law:
            scene.problem.material.require_known(f"loss {type(loss).__name__}")
        self.loss = loss
        self._random_states: dict[str, Any] | None = None  # of a resumed run
        self._optimizer, self._scheduler = optimizer, scheduler
        self.metrics, self._largest_force = ErrorMetrics(scene.problem), scene.loads.largest_force

    @classmethod
    def from_network(
        cls,
        network: Callable[..., nn.Module],
        loss: Loss,
        scene: Scene,
        *,
        base: Base | None = "linear",
        young: bool = False,
        **options: Any,
    ) -> Self:
        """Return a surrogate with `network(scene, inputs)`; the options are those of the class."""
        net = network(scene, Inputs.from_scene(scene, base, young=young))
        return cls(net, loss, scene, base=base, young=young, **options)

    @property
    def physics(self) -> LossContext:
        """The part of the scene that losses need, on the device of the network."""
        return LossContext(self.predictor.problem, self._largest_force)

    def describe(self) -> list[tuple[str, str]]:
        """Return name and size of the network, and the loss unless the model is fitted."""
        name, loss = type(self.net).__name__, type(self.loss).__name__
        if self.predictor.is_closed_form:
            return [("model", f"{name}, fitted by linear regression")]
        count = sum(weights.numel() for weights in self.net.parameters())
        return [("model", f"{name}, {count:,} weights; loss {loss}")]

    def skipped_work(self) -> list[str]:
        """Return the work that network, loss and predictor save, one line each."""
        of_loss = () if self.predictor.is_closed_form else self.loss.saves
        return [*getattr(self.net, "skipped_work", list)(), *of_loss, *self.predictor.saves]

    def encode(self, samples: Sample, group: SymmetryGroup = NO_SYMMETRIES) -> Dataset:
        """Return the training set of samples and their images, see `Predictor.dataset`."""
        fields = (column.to(self.loss.dtype) for column in (samples.force, samples.displacement))
        force, displacement = fields
        samples = samples._replace(force=force, displacement=displacement)
        return self.predictor.dataset(samples, group)

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Return the loss of a batch, ()."""
        loss = self.loss(*self.predictor.predict_batch(batch), self.physics)
        self.log("loss/train", loss, prog_bar=True, batch_size=len(batch[0]))
        return loss

    def validation_step(self, batch: Sample, batch_idx: int) -> None:
        """Log the loss and update the metrics."""
        prediction = self.predict(batch.load)
        loss = self.loss(prediction, batch, self.physics)
        self.log("loss/val", loss, batch_size=len(batch.force))
        self.metrics.update(prediction, batch)

    def test_step(self, batch: Sample, batch_idx: int) -> None:
        """Update the test metrics."""
        self.metrics.update(self.predict(batch.load), batch)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics as `val/NAME`, those of a test as `test/NAME`."""
        part = "test" if self.trainer.testing else "val"
        numbers = self.metrics.compute()  # those of all processes
        self.metrics.reset()
        self.log_dict({f"{part}/{name}": value for name, value in numbers.items()}, sync_dist=True)

    on_test_epoch_end = on_validation_epoch_end

    def setup(self, stage: str) -> None:
        """Fit the bases of the network."""
        if stage == "fit" and self.predictor.lacks_bases:
            data = self.trainer.datamodule
            self.predictor.fit_bases(data.snapshots(), data.group)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the module, and the problem of the metrics to the same device.

        All ways to move a module end here. Lightning moves it after the hook `setup`.
        """
        super()._apply(fn, recurse)
        self.metrics.problem = self.predictor.problem
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
        """Return the optimiser with its schedule."""
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
        """Make a step of the schedule.

        A function of the step advances further if the time limit is nearer than the last step.
        """
        fraction = time_fraction(self.trainer)
        if fraction and isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR):
            reached = math.floor(fraction * total_steps(self.trainer)) - 1
            scheduler.last_epoch = max(scheduler.last_epoch, reached)
        super().lr_scheduler_step(scheduler, metric)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the scene, the states of random number generators and averaged weights."""
        checkpoint |= checkpoints.entries_of_scene(self.scene)
        checkpoint["random"] = checkpoints.random_states()
        # not a hook of the callback: Lightning calls those only for complete checkpoints
        for callback in self._trainer.callbacks if self._trainer else ():
            if isinstance(callback, AveragedWeights):
                checkpoint["state_dict"] = {**checkpoint["state_dict"], **callback.average}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raise ValueError if the checkpoint belongs to another scene."""
        checkpoints.check_scene(checkpoint, self.scene)
        self._random_states = checkpoint.get("random")

    def on_train_start(self) -> None:
        """Restore the states of random number generators of a resumed run."""
        if self._random_states is not None:
            checkpoints.set_random_states(self._random_states)
