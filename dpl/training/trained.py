"""A surrogate without its training; this module does not import Lightning, which takes seconds."""

import math
from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn

from dpl.fem import Load
from dpl.models.interface import Base, HasCorrection, Inputs
from dpl.models.linear_base import SCALE_STREAM
from dpl.scene import Scene
from dpl.training.predictors import Fitted, OnLinearSolution, Predictor, Scaled


class TrainedSurrogate(nn.Module):
    """A network that predicts the displacement in equilibrium with a load.

    `forward` takes newtons and pascals and returns metres; `predict` is dimensionless. `predictor`
    is the network with its scales, perhaps on the linear solution.
    """

    def __init__(
        self, net: nn.Module, scene: Scene, *, base: Base | None = None, young: bool = False
    ) -> None:
        """Combine a network and a scene; the arguments are those of `Surrogate`."""
        super().__init__()
        Inputs.from_scene(scene, base, young=young)  # checks the options
        self.scene = scene
        self.predictor: Predictor
        if hasattr(net, "fit"):
            self.predictor = Fitted(net, scene)
        elif base is None:
            self.predictor = Scaled(net, scene, young=young)
        else:
            self.predictor = OnLinearSolution(net, scene)

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

    @property
    def largest_residual(self) -> float:
        """Residual up to which the errors of `predict_with_errors` hold [-]."""
        return float(getattr(self.net, "largest_residual", math.inf))

    def predict(self, load: Load) -> Tensor:
        """Return displacements over L, (B, N, D) [-], float64."""
        return cast(Tensor, self.predictor(load))

    def predict_with_errors(self, load: Load) -> tuple[Tensor, Tensor]:
        """Return `predict` and its estimated relative errors, (B, 2) [-], see `HasCorrection`.

        They are infinite for a network that does not estimate them.
        """
        if not hasattr(self.net, "forward_with_errors"):
            displacement = self.predict(load)
            return displacement, displacement.new_full((len(displacement), 2), math.inf)
        parameters = self.predictor.parameters_of(load)
        return cast(HasCorrection, self.net).forward_with_errors(load.force, parameters)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """Load weights; raise ValueError for another type, and for values that no fit can give."""
        own = self.state_dict()
        for name, stored in state_dict.items():
            dtype = own[name].dtype if name in own else stored.dtype
            if stored.dtype != dtype and not stored.is_floating_point() & dtype.is_floating_point:
                raise ValueError(f"{name} of {stored.dtype} must be of {dtype}")
            if not stored.to(dtype).isfinite().all():
                raise ValueError(f"{name} must be finite")
        return super().load_state_dict(state_dict, *args, **options)

    def check_predictions(self) -> None:
        """Raise ValueError if a prediction of a load of the scene is not finite."""
        load = self.scene.loads.sample((0, SCALE_STREAM), range(2))
        with torch.no_grad():  # tensors that a network keeps are used for derivatives, too
            if not self.predict(load).isfinite().all():
                raise ValueError("the answers of the network are not finite")
