"""Fully connected network of the paper."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from dpl.models.interface import Inputs
from dpl.scene import Scene
from dpl.system.checks import check_range
from dpl.system.memory import refuse_weights

MAX_LAYERS = 1000


class FCNN(nn.Module):
    """Linear layers of equal width with PReLU, one slope per unit, between them.

    By default the inputs are the degrees of freedom at which the field is not zero (`Inputs.dofs`),
    and the outputs the free ones. With `all_dofs` this is the network of the paper with 4 n^2 + 7 n
    parameters for n degrees of freedom.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.1.1.
    """

    input_index: Tensor
    output_index: Tensor

    def __init__(
        self,
        scene: Scene,
        inputs: Inputs | None = None,
        *,
        layers: int = 4,
        width: int | None = None,
        all_dofs: bool = False,
        slope: float = 0.25,
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: The scene to predict.
            inputs: Its inputs; None for scaled forces.
            layers: Number of linear layers, 2 or more.
            width: Units of the hidden layers; None for the number of outputs.
            all_dofs: Use all degrees of freedom as inputs and outputs, as in the paper.
            slope: Slope at negative inputs at the start of the training. A network on the linear
                solution learns faster if its units are nearly linear at first.
            memory_limit: Memory for training [GB]; None for that of the machine.

        Raises:
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        check_range(2, MAX_LAYERS, layers=layers)
        if width is not None:
            check_range(1, width=width)
        inputs = inputs or Inputs.from_scene(scene)
        every = torch.ones(scene.problem.shape, dtype=torch.bool)
        masks = (every, every) if all_dofs else (inputs.dofs, scene.problem.free)
        read, written = (mask.flatten().nonzero()[:, 0] for mask in masks)
        hidden = [width or len(written)] * (layers - 1)
        sizes = [len(read) + inputs.scalars, *hidden, len(written)]
        self.parameters_needed = count_parameters(sizes)
        all_sizes = [every.numel()] * (layers + 1)
        self.parameters_saved = count_parameters(all_sizes) - self.parameters_needed
        remedy = "take a coarser mesh, model.width or another model"
        refuse_weights(self.parameters_needed, memory_limit, remedy)
        self.register_buffer("input_index", read, persistent=False)
        self.register_buffer("output_index", written, persistent=False)
        stages: list[nn.Module] = [nn.Linear(sizes[0], sizes[1])]
        for before, after in pairwise(sizes[1:]):
            stages += [nn.PReLU(before, slope), nn.Linear(before, after)]
        self.stages = nn.Sequential(*stages)

    def forward(self, field: Tensor, scalars: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a field (B, N, D) and scalars (B, S)."""
        inputs = field.flatten(1).index_select(1, self.input_index)
        inputs = torch.cat([inputs, scalars], dim=1)
        outputs = self.stages(inputs).to(field.dtype)  # of lower precision with bf16-mixed
        whole = torch.zeros_like(field).flatten(1)
        return whole.index_copy(1, self.output_index, outputs).view_as(field)

    def skipped_work(self) -> list[str]:
        """Return the work that the network saves, one line."""
        if self.parameters_saved <= 0:
            return []
        return [
            f"{self.parameters_saved:,} of {self.parameters_needed + self.parameters_saved:,} "
            f"parameters: inputs are {len(self.input_index)} degrees of freedom, outputs "
            f"{len(self.output_index)} free ones"
        ]


def count_parameters(sizes: list[int]) -> int:
    """Return the number of weights, biases and slopes of layers with the given sizes."""
    linear = sum((before + 1) * after for before, after in pairwise(sizes))
    return linear + sum(sizes[1:-1])
