"""The paper's fully connected network."""

import os
from itertools import pairwise

import torch
from torch import Tensor, nn

from dpl.scene import Scene


class FCNN(nn.Module):
    """Linear layers of equal width with PReLU, one slope per unit, between them.

    Over all N D degrees of freedom this is the paper's network of 4 N^2 + 7 N parameters (there N
    counts degrees of freedom). By default only those enter that loads can reach and that are free,
    and only free ones leave.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.1.1.
    """

    inputs: Tensor
    outputs: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        layers: int = 4,
        width: int | None = None,
        all_dofs: bool = False,
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: What it is to answer.
            layers: Linear layers, 2 or more.
            width: Units in the hidden layers; as many as outputs if left out.
            all_dofs: Let every degree of freedom in and out, as the paper does.
            memory_limit: Memory that training may take [GB]; what the machine has if left out.

        Raises:
            ValueError: `layers` or `width` is out of range.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        if layers < 2:
            raise ValueError(f"layers = {layers} must be 2 or more")
        if width is not None and width < 1:
            raise ValueError(f"width = {width} must be 1 or more")
        everything = torch.ones(scene.problem.shape, dtype=torch.bool)
        inputs = everything if all_dofs else scene.loads.reach
        outputs = everything if all_dofs else scene.problem.free
        ends = int(inputs.sum()), int(outputs.sum())
        hidden = width or ends[1]
        sizes = [ends[0], *[hidden] * (layers - 1), ends[1]]
        self.parameters_needed = _parameters(sizes)
        self.parameters_saved = _parameters([everything.numel()] * (layers + 1)) - _parameters(
            sizes
        )
        _refuse_beyond_memory(self.parameters_needed, memory_limit)
        self.register_buffer("inputs", inputs, persistent=False)
        self.register_buffer("outputs", outputs, persistent=False)
        stages: list[nn.Module] = [nn.Linear(sizes[0], sizes[1])]
        for before, after in pairwise(sizes[1:]):
            stages += [nn.PReLU(before), nn.Linear(before, after)]
        self.stages = nn.Sequential(*stages)

    def forward(self, force: Tensor) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32."""
        displacement = torch.zeros_like(force)
        displacement[:, self.outputs] = self.stages(force[:, self.inputs])
        return displacement

    def plan(self) -> list[str]:
        """Return what the network leaves out, a line."""
        if self.parameters_saved <= 0:
            return []
        return [
            f"{self.parameters_saved:,} of {self.parameters_needed + self.parameters_saved:,} "
            f"parameters: {int(self.inputs.sum())} inputs where loads can act, "
            f"{int(self.outputs.sum())} outputs where the body can move"
        ]


def _parameters(sizes: list[int]) -> int:
    """Return weights, biases and slopes of linear layers between these sizes."""
    linear = sum((before + 1) * after for before, after in pairwise(sizes))
    return linear + sum(sizes[1:-1])


def _refuse_beyond_memory(parameters: int, limit: float | None) -> None:
    """Raise where training in float32 would not fit."""
    needed = parameters * 4 * 4 / 1e9  # parameters, gradients, two moments, 4 bytes each
    if limit is None:
        if torch.cuda.is_available():
            limit = torch.cuda.mem_get_info()[1] / 1e9
        else:
            limit = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    if needed > limit:
        raise MemoryError(
            f"{parameters:,} parameters with gradients and Adam's moments need {needed:.1f} GB, "
            f"there are {limit:.1f} GB; take a coarser mesh, model.width or another model"
        )
