"""Learning-rate schedules."""

import math

import torch


def warmup_cosine(
    optimizer: torch.optim.Optimizer, *, total_steps: int, warmup: float = 0.05
) -> torch.optim.lr_scheduler.LambdaLR:
    """Return a schedule with a linear warm-up and a cosine decay to zero.

    Args:
        optimizer: The optimiser; its learning rate is the maximum of the schedule.
        total_steps: Number of steps after which the learning rate is zero.
        warmup: Fraction of the steps in which the learning rate rises.

    Raises:
        ValueError: `warmup` lies outside [0, 1).
    """
    if not 0 <= warmup < 1:
        raise ValueError(f"warmup = {warmup} must be 0 or more and less than 1")

    def factor(step: int) -> float:
        rise = max(1, round(warmup * total_steps))
        if step < rise:
            return (step + 1) / (rise + 1)
        return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (step - rise) / max(1, total_steps - rise)))

    return torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
