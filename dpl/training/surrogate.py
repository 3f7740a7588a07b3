"""Surrogate: a network with its scales and its loss, trained by Lightning."""

from collections.abc import Callable, Iterable
from typing import Any, cast

import lightning as L
import torch
from torch import Tensor, nn

from dpl.fem import Load
from dpl.models.reduced_samples import ReducedDataset, ReducedOrderNet, ReducedSamples
from dpl.scene import Sample, Scene
from dpl.training.losses.loss import Loss, LossContext
from dpl.training.losses.supervised import MSE
from dpl.training.metrics import default_metrics
from dpl.training.rng_state import random_states, set_random_states

SCALES = 3  # the stream of the loads that give the scales; those of samples are below


class Surrogate(L.LightningModule):
    """A network's answer to which displacement balances a load.

    Here is the one border between float64 physics and the float32 network: `predict` scales,
    casts, asks the network, scales back, and sets what is held to exactly zero. Called with newtons
    and pascals the module answers in metres.

    Attributes:
        net: Scaled force (B, N, D) to scaled displacement (B, N, D). What it takes besides of a
            load, by name, its `extra_inputs` says: "young", "poisson".
        scene: What it answers for.
        loss: What it is trained with.
        batch_errors: Relative L2 errors on the last training batch, (B,); None before the first.
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
        """Put the parts together.

        Args:
            net: The network.
            loss: The loss.
            scene: What it answers for.
            optimizer: From parameters to an optimiser.
            scheduler: From an optimiser and `total_steps` to a learning-rate schedule, stepped
                every batch; none if left out.

        Raises:
            ValueError: The law has a range of Poisson's ratios that the network does not take.
        """
        super().__init__()
        self.net, self.loss, self.scene = net, loss, scene
        self.batch_errors: Tensor | None = None
        self._random_states: dict[str, Any] | None = None  # of the run that this one resumes
        self._optimizer, self._scheduler = optimizer, scheduler
        span = scene.loads.poisson_range
        self._own = int(span is not None)
        if span is not None and "poisson" not in getattr(net, "extra_inputs", ()):
            raise ValueError(
                f"{type(net).__name__} takes no Poisson's ratio, and the law has a range of them, "
                f"{list(span)}; take one of them (material.poisson) or another model"
            )
        force_scale, displacement_scale = scales(scene)
        self.register_buffer("force_scale", force_scale)
        self.register_buffer("displacement_scale", displacement_scale)
        self.register_buffer(
            "largest_force", torch.tensor(scene.loads.largest_force, dtype=torch.float64)
        )
        self.physics = LossContext(scene.problem, self.largest_force)
        self.val_metrics = default_metrics(scene.problem).clone(prefix="val/")
        self.test_metrics = default_metrics(scene.problem).clone(prefix="test/")

    def forward(self, force: Tensor, young: Tensor, poisson: Tensor | None = None) -> Tensor:
        """Return displacements (B, N, D) [m] under nodal forces (B, N, D) [N].

        Args:
            force: What acts.
            young: E, (B,) [Pa].
            poisson: Poisson's ratios, (B,) [-]; wanted where the law has a range of them.
        """
        return self.scene.length * self.predict(self.scene.load_of(force, young, poisson))

    def predict(self, load: Load) -> Tensor:
        """Return displacements over L, (B, N, D), float64."""
        scaled, more = self.scale_inputs(load)
        return self.unscale_outputs(self.net(scaled, **more))

    def scale_inputs(self, load: Load) -> tuple[Tensor, dict[str, Tensor]]:
        """Return what the network takes of loads: scaled forces (B, N, D), and more by name."""
        scaled = (self._felt(load.force) / self.force_scale).to(self.dtype)
        if load.poisson.shape[-1] != self._own:
            raise ValueError(
                "poisson: the law has a range of them, and the load does not say which"
                if self._own
                else "poisson: the law has one for all loads, and this load brings its own"
            )
        return scaled, {name: getattr(load, name) for name in getattr(self.net, "extra_inputs", ())}

    def _felt(self, force: Tensor) -> Tensor:
        """Return forces (B, N, D) that are on held degrees of freedom as they were in training.

        Those have no effect on the body, so a network must not answer to them.
        """
        problem, always = self.physics.problem, self.scene.loads.constant_force
        force = problem.acting(force)
        if always is None:
            return force
        return force + torch.where(problem.free, 0.0, always.to(force.device))

    def unscale_outputs(self, answer: Tensor) -> Tensor:
        """Return displacements over L, float64, of the network's answers, (B, N, D)."""
        displacement = answer.double() * self.displacement_scale
        return torch.where(self.physics.problem.free, displacement, 0.0)

    def skipped_work(self) -> list[str]:
        """Return what network and loss leave out, a line each."""
        lines = [*getattr(self.net, "skipped_work", list)(), *self.loss.skipped_work()]
        if isinstance(self.net, ReducedOrderNet) and isinstance(self.loss, MSE):
            lines.append("no field in training from disk: squared errors are those of coordinates")
        return lines

    def training_step(self, batch: Sample | ReducedSamples, batch_idx: int) -> Tensor:
        """Return the loss."""
        if isinstance(batch, ReducedSamples):
            loss = self._loss_of_coordinates(batch)
        else:
            prediction = self.predict(batch.load)
            loss = self.loss(prediction, batch, self.physics)
            error = (prediction.detach() - batch.displacement).flatten(1).norm(dim=1)
            size = batch.displacement.flatten(1).norm(dim=1)
            self.batch_errors = error / size.clamp(min=1e-12)
        self.log("loss/train", loss, prog_bar=True, batch_size=len(batch[0]))
        return loss

    def _loss_of_coordinates(self, batch: ReducedSamples) -> Tensor:
        """Return the loss of a batch in coordinates: of its mean squared errors alone."""
        net = cast(ReducedOrderNet, self.net)
        missed = (net.network(batch.inputs) - batch.targets).square().sum(dim=1) + batch.rest
        square = self.displacement_scale**2
        error = square * missed / self.scene.problem.free.numel()
        return cast(MSE, self.loss).from_squared_errors(error, square * batch.size)

    def encode(self, samples: Sample, *, images: bool = False) -> ReducedDataset | None:
        """Return training samples (S, N, D) in the coordinates of the network; None if it has none.

        With their images if the network knows the symmetries; None if only the caller does.

        In an orthonormal basis the squared error of a displacement is that of its coordinates: a
        loss that is a function of squared errors needs no field.
        """
        if not (isinstance(self.net, ReducedOrderNet) and isinstance(self.loss, MSE)):
            return None
        if images and not self.net.group:
            return None
        return self.net.encode(self._scaled(samples))

    def _scaled(self, samples: Sample) -> Sample:
        return samples._replace(
            force=samples.force / self.force_scale.cpu(),
            displacement=samples.displacement / self.displacement_scale.cpu(),
        )

    def fit_bases(self, samples: Sample) -> None:
        """Let the network make its bases from training samples (S, N, D)."""
        unit = float(self.force_scale / self.displacement_scale)
        cast(ReducedOrderNet, self.net).fit_bases(self._scaled(samples), unit)

    def validation_step(self, batch: Sample, batch_idx: int) -> None:
        """Update the metrics."""
        prediction = self.predict(batch.load)
        loss = self.loss(prediction, batch, self.physics)
        self.log("loss/val", loss, batch_size=len(batch.force))
        self.val_metrics.update(prediction, batch)
        self.log_dict(self.val_metrics, batch_size=len(batch.force))

    def test_step(self, batch: Sample, batch_idx: int) -> None:
        """Update the metrics."""
        self.test_metrics.update(self.predict(batch.load), batch)
        self.log_dict(self.test_metrics, batch_size=len(batch.force))

    def setup(self, stage: str) -> None:
        """Bring the physics to the device of the network; let the network see the samples."""
        problem = self.scene.problem
        if problem.points.device != self.device:
            problem = problem.to(self.device)
        self.physics = LossContext(problem, self.largest_force)
        # here: schedules ask for the batches, which want the bases, before any later hook
        if stage == "fit" and isinstance(self.net, ReducedOrderNet) and not self.net.prepared:
            self.fit_bases(self.trainer.datamodule.snapshots())
        for collection in (self.val_metrics, self.test_metrics):
            for metric in collection.values():
                if hasattr(metric, "problem"):
                    metric.problem = problem

    def configure_callbacks(self) -> list[L.Callback]:
        """Carry the loss into the trainer."""
        return [self.loss]

    def configure_optimizers(self) -> Any:
        """Return the optimiser with its schedule."""
        optimizer = self._optimizer(self.parameters())
        if self._scheduler is None:
            return optimizer
        steps = int(self.trainer.estimated_stepping_batches)
        scheduler = self._scheduler(optimizer, total_steps=steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write down whose surrogate this is, and where random numbers are."""
        checkpoint["scene"] = self.scene.fingerprint
        checkpoint["identity"] = self.scene.identity()
        checkpoint["nodes"] = self.scene.problem.shape[0]
        checkpoint["random"] = random_states()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another scene.

        Raises:
            ValueError: It is one.
        """
        theirs, identity = checkpoint.get("scene", "unknown"), checkpoint.get("identity", {})
        if theirs != self.scene.fingerprint and not self.scene.matches(identity):
            raise ValueError(
                f"the checkpoint is of scene {theirs[:12]}, this scene is "
                f"{self.scene.fingerprint[:12]}"
                + "".join(f"; {line}" for line in self.scene.differences(identity))
            )
        self._random_states = checkpoint.get("random")

    def on_train_start(self) -> None:
        """Go on with the random numbers of the run that this one resumes."""
        if self._random_states is not None:
            set_random_states(self._random_states)


def scales(scene: Scene, count: int = 256) -> tuple[Tensor, Tensor]:
    """Return the scales of forces and of displacements of the scene's loads, scalars [-].

    Root mean squares over the first loads of a stream of their own, over the degrees of freedom
    that loads can act on and over those that move; displacements are linear answers. So no sample
    is needed, and online and offline training share the scales. One number each, so that forces
    and displacements keep their proportions within the body.
    """
    force = scene.loads.sample((0, SCALES), range(count)).force
    displacement = torch.stack([scene.linear.reference.solve(one) for one in force])
    acting, moving = force[:, scene.loads.loadable_dofs], displacement[:, scene.problem.free]
    return acting.square().mean().sqrt(), moving.square().mean().sqrt()
