"""Learning-rate schedules."""

import math

import lightning as L
import torch
from lightning.pytorch.callbacks import Timer

STEPS_OF_UNLIMITED = 10_000  # of a schedule whose training is limited by time alone


def warmup_cosine(
    optimizer: torch.optim.Optimizer, *, total_steps: int, warmup: float = 0.05
) -> torch.optim.lr_scheduler.LambdaLR:
    """Return a schedule with a linear warm-up and a cosine decay to zero.

    Args:
        optimizer: The optimiser; its learning rate is the maximum of the schedule.
        total_steps: Number of steps after which the learning rate is zero.
        warmup: Fraction of the steps in which the learning rate rises.
    """
    if not 0 <= warmup < 1:
        raise ValueError(f"warmup = {warmup} must be 0 or more and less than 1")

    def factor(step: int) -> float:
        rise = max(1, round(warmup * total_steps))
        if step < rise:
            return (step + 1) / (rise + 1)
        return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (step - rise) / max(1, total_steps - rise)))

    return torch.optim.lr_scheduler.LambdaLR(optimizer, factor)


def total_steps(trainer: L.Trainer) -> int:
    """Return the number of steps of a schedule; that of a training without limit is arbitrary."""
    steps = trainer.estimated_stepping_batches
    return int(steps) if math.isfinite(steps) else STEPS_OF_UNLIMITED


def time_fraction(trainer: L.Trainer) -> float:
    """Return the elapsed part of `trainer.max_time`, the same in all processes; 0 without limit."""
    for timer in trainer.callbacks:
        if isinstance(timer, Timer) and (remaining := timer.time_remaining()) is not None:
            elapsed = timer.time_elapsed()
            part = elapsed / max(elapsed + remaining, 1e-9)
            return float(trainer.strategy.broadcast(part))
    return 0.0
