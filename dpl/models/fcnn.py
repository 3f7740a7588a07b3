"""The paper's fully connected network."""

from itertools import pairwise

import torch
from torch import Tensor, nn

from dpl.models.poisson_interpolation import normalise_poisson
from dpl.scene import Scene
from dpl.system.memory import refuse_weights

DEEPEST = 1000  # layers


class FCNN(nn.Module):
    """Linear layers of equal width with PReLU, one slope per unit, between them.

    Over all N D degrees of freedom this is the paper's network of 4 N^2 + 7 N parameters (there N
    counts degrees of freedom). By default only those enter that loads can reach and that are free,
    and only free ones leave.

    Source: Odot, Haferssas, Cotin (2022), DeepPhysics, section 2.1.1.
    """

    inputs: Tensor
    outputs: Tensor
    entries: Tensor
    exits: Tensor

    def __init__(
        self,
        scene: Scene,
        *,
        layers: int = 4,
        width: int | None = None,
        all_dofs: bool = False,
        young: bool = False,
        memory_limit: float | None = None,
    ) -> None:
        """Build the network.

        Args:
            scene: What it is to answer.
            layers: Linear layers, 2 or more.
            width: Units in the hidden layers; as many as outputs if left out.
            all_dofs: Let every degree of freedom in and out, as the paper does.
            young: Let forces in as newtons are, and Young's modulus besides, as the paper does for
                a range of moduli; u/L depends on f/(E L^2) alone, so that nothing is gained.
            memory_limit: Memory that training may take [GB]; what the machine has if left out.

        Raises:
            ValueError: `layers` or `width` is out of range.
            MemoryError: Parameters, gradients and Adam's two moments would not fit.
        """
        super().__init__()
        if not 2 <= layers <= DEEPEST:
            raise ValueError(f"layers = {layers} must be 2 or more and at most {DEEPEST}")
        if width is not None and width < 1:
            raise ValueError(f"width = {width} must be 1 or more")
        everything = torch.ones(scene.problem.shape, dtype=torch.bool)
        inputs = everything if all_dofs else scene.loads.loadable_dofs
        outputs = everything if all_dofs else scene.problem.free
        low, high = scene.loads.young_range
        self.largest, self.middle = high, (low + high) / 2  # [Pa]
        self.spread = (high - low) / 2 or high  # of one modulus, itself: others are not far away
        self.poisson_range = scene.loads.poisson_range
        varying = {"young": young, "poisson": self.poisson_range is not None}
        self.extra_inputs = tuple(name for name, enters in varying.items() if enters)
        ends = int(inputs.sum()) + len(self.extra_inputs), int(outputs.sum())
        hidden = width or ends[1]
        sizes = [ends[0], *[hidden] * (layers - 1), ends[1]]
        self.parameters_needed = count_parameters(sizes)
        self.parameters_saved = count_parameters(
            [everything.numel()] * (layers + 1)
        ) - count_parameters(sizes)
        remedy = "take a coarser mesh, model.width or another model"
        refuse_weights(self.parameters_needed, memory_limit, remedy)
        self.register_buffer("inputs", inputs, persistent=False)
        self.register_buffer("outputs", outputs, persistent=False)
        for name, where in {"entries": inputs, "exits": outputs}.items():
            self.register_buffer(name, where.flatten().nonzero()[:, 0], persistent=False)
        stages: list[nn.Module] = [nn.Linear(sizes[0], sizes[1])]
        for before, after in pairwise(sizes[1:]):
            stages += [nn.PReLU(before), nn.Linear(before, after)]
        self.stages = nn.Sequential(*stages)

    def forward(
        self, force: Tensor, young: Tensor | None = None, poisson: Tensor | None = None
    ) -> Tensor:
        """Return the scaled displacement (B, N, D) of a scaled force (B, N, D), float32.

        Args:
            force: Over E L^2, scaled.
            young: E, (B,) [Pa]; wanted where it is an input, ignored elsewhere.
            poisson: Poisson's ratios, (B, 1) [-]; wanted where the law has a range of them.

        Raises:
            ValueError: It is wanted and not there.
        """
        entering = force.flatten(1).index_select(1, self.entries)
        if "young" in self.extra_inputs:
            if young is None:
                raise ValueError("young is an input of this network: give E, (B,) [Pa]")
            size = (young / self.largest).to(force.dtype)[:, None]
            place = ((young - self.middle) / self.spread).to(force.dtype)[:, None]
            entering = torch.cat([size * entering, place], dim=1)
        if self.poisson_range is not None:
            entering = torch.cat(
                [entering, normalise_poisson(poisson, self.poisson_range, force)], dim=1
            )
        whole = torch.zeros_like(force).flatten(1)
        return whole.index_copy(1, self.exits, self.stages(entering)).view_as(force)

    def skipped_work(self) -> list[str]:
        """Return what the network leaves out, a line."""
        if self.parameters_saved <= 0:
            return []
        return [
            f"{self.parameters_saved:,} of {self.parameters_needed + self.parameters_saved:,} "
            f"parameters: {int(self.inputs.sum())} inputs where loads can act, "
            f"{int(self.outputs.sum())} outputs where the body can move"
        ]


def count_parameters(sizes: list[int]) -> int:
    """Return weights, biases and slopes of linear layers between these sizes."""
    linear = sum((before + 1) * after for before, after in pairwise(sizes))
    return linear + sum(sizes[1:-1])
