"""Muon for matrices with Adam for all else, as one optimiser."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn


class Muon(torch.optim.Optimizer):
    """Orthogonalised momentum for weight matrices, Adam for biases, slopes and convolutions.

    Both take the same learning rate: the steps of Muon are scaled to the root mean square of
    Adam's. Where an accurate fit of a smooth function is wanted, it needs a fraction of the steps
    that Adam needs.

    Source: Jordan et al. (2024), Muon: an optimizer for hidden layers in neural networks; scale of
    the steps after Liu et al. (2025), Muon is scalable for LLM training, section 2.2.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        *,
        lr: float = 1e-2,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        """Share the parameters out.

        Args:
            params: All of them.
            lr: Learning rate.
            momentum: Of Muon.
            betas: Of Adam.
            weight_decay: Decoupled, of both.

        Raises:
            ValueError: A number is out of range.
        """
        if not 0 <= momentum < 1:
            raise ValueError(f"momentum = {momentum} must be 0 or more and less than 1")
        every = list(params)
        matrices = [p for p in every if p.ndim == 2]
        others = [p for p in every if p.ndim != 2]
        self.parts: list[torch.optim.Optimizer] = []
        if matrices:
            self.parts.append(
                torch.optim.Muon(
                    matrices,
                    lr=lr,
                    momentum=momentum,
                    weight_decay=weight_decay,
                    adjust_lr_fn="match_rms_adamw",
                )
            )
        if others:
            adam = torch.optim.AdamW(others, lr=lr, betas=betas, weight_decay=weight_decay)
            self.parts.append(adam)
        # the very dictionaries of the parts: a schedule that sets a rate here sets it there
        super().__init__([group for part in self.parts for group in part.param_groups], {"lr": lr})

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take a step of each part; return what the closure returns."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.parts:
            part.step()
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the parts, one after the other."""
        return {"parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take up the states of the parts."""
        for part, state in zip(self.parts, state_dict["parts"], strict=True):
            part.load_state_dict(state)
        self.param_groups = [group for part in self.parts for group in part.param_groups]
