"""Fully connected network of the paper."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from dpl.models.linear_base import Base
from dpl.models.scalar_inputs import ScalarInputs
from dpl.scene import Scene
from dpl.system.memory import refuse_weights

MAX_LAYERS = 1000


class FCNN(nn.Module):
    """Linear layers of equal width with PReLU, one slope per unit, between them.

    By default the inputs are the loadable degrees of freedom, or with a linear base the free ones,
    and the outputs the free ones. With `all_dofs` this is the network of the paper with 4 n^2 + 7 n
    parameters for n degrees of freedom.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.1.1.
    """

    inputs: Tensor
    outputs: Tensor
    input_index: Tensor
    output_index: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        layers: int = 4,
        width: int | None = None,
        all_dofs: bool = False,
        young: bool = False,
        base: Base = "none",
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: The scene to predict.
            layers: Number of linear layers, 2 or more.
            width: Units of the hidden layers; None for the number of outputs.
            all_dofs: Use all degrees of freedom as inputs and outputs, as in the paper.
            young: Use forces over the largest Young's modulus, and Young's modulus, as inputs. The
                paper does so for a range of moduli. The second input is E, or log E for moduli with
                a logarithmic distribution, mapped to [-1, 1]. It adds no information, since u/L
                depends on f/(E L^2) alone.
            base: "linear" for the nonlinear displacement as output, see `LinearBase`.
            memory_limit: Memory for training [GB]; None for that of the machine.

        Raises:
            ValueError: `layers` or `width` is out of range, there is no such base, or `young` is
                combined with a base.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        if not 2 <= layers <= MAX_LAYERS:
            raise ValueError(f"layers = {layers} must be 2 or more and at most {MAX_LAYERS}")
        if width is not None and width < 1:
            raise ValueError(f"width = {width} must be 1 or more")
        if young and base != "none":
            raise ValueError(f"young = true requires base = none, not {base}")
        self.base = base
        self.scalars = ScalarInputs(scene, base)
        everything = torch.ones(scene.problem.shape, dtype=torch.bool)
        loaded = scene.problem.free if base == "linear" else scene.loads.loadable_dofs
        inputs = everything if all_dofs else loaded
        outputs = everything if all_dofs else scene.problem.free
        self.moduli = scene.loads.moduli
        self.extra_inputs = (*(("young",) if young else ()), *self.scalars.names)
        n_inputs = int(inputs.sum()) + young + self.scalars.count
        n_outputs = int(outputs.sum())
        sizes = [n_inputs, *[width or n_outputs] * (layers - 1), n_outputs]
        self.parameters_needed = count_parameters(sizes)
        all_sizes = [everything.numel()] * (layers + 1)
        self.parameters_saved = count_parameters(all_sizes) - self.parameters_needed
        remedy = "take a coarser mesh, model.width or another model"
        refuse_weights(self.parameters_needed, memory_limit, remedy)
        self.register_buffer("inputs", inputs, persistent=False)
        self.register_buffer("outputs", outputs, persistent=False)
        for name, mask in {"input_index": inputs, "output_index": outputs}.items():
            self.register_buffer(name, mask.flatten().nonzero()[:, 0], persistent=False)
        stages: list[nn.Module] = [nn.Linear(sizes[0], sizes[1])]
        for before, after in pairwise(sizes[1:]):
            stages += [nn.PReLU(before), nn.Linear(before, after)]
        self.stages = nn.Sequential(*stages)

    def forward(
        self,
        force: Tensor,
        young: Tensor | None = None,
        parameters: Tensor | None = None,
        amplitude: Tensor | None = None,
    ) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: Scaled nodal forces, or scaled linear solutions with a linear base.
            young: Young's moduli, (B,) [Pa]; required if they are an input, else ignored.
            parameters: Values of `Problem.parameter_ranges`, (B, P); required if there are any.
            amplitude: Amplitudes of the linear solutions, (B,); required with a linear base.

        Raises:
            ValueError: A required input is None.
        """
        inputs = force.flatten(1).index_select(1, self.input_index)
        if "young" in self.extra_inputs:
            if young is None:
                raise ValueError(
                    "young is an input of this network; give Young's moduli, (B,) [Pa]"
                )
            stiffness = (young / self.moduli[1]).to(force.dtype)[:, None]
            normalised = self.moduli.normalise(young).to(force.dtype)[:, None]
            inputs = torch.cat([stiffness * inputs, normalised], dim=1)
        if self.scalars.count:
            values = self.scalars(force, amplitude, parameters)
            inputs = torch.cat([inputs, values], dim=1)
        outputs = self.stages(inputs).to(force.dtype)  # of lower precision with bf16-mixed
        whole = torch.zeros_like(force).flatten(1)
        return whole.index_copy(1, self.output_index, outputs).view_as(force)

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line."""
        if self.parameters_saved <= 0:
            return []
        return [
            f"{self.parameters_saved:,} of {self.parameters_needed + self.parameters_saved:,} "
            f"parameters: inputs are {int(self.inputs.sum())} degrees of freedom, outputs "
            f"{int(self.outputs.sum())} free ones"
        ]


def count_parameters(sizes: list[int]) -> int:
    """Return the number of weights, biases and slopes of layers with the given sizes."""
    linear = sum((before + 1) * after for before, after in pairwise(sizes))
    return linear + sum(sizes[1:-1])
