"""The learning rate over a training."""

from __future__ import annotations

from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR


def one_cycle(optimizer: Optimizer, *, total_steps: int, peak: float) -> OneCycleLR:
    """A short rise from peak/25 to the peak, then a cosine down to peak/25000.

    The rise takes 5 % of the steps, at least two. Smith and Topin (2018), "Super-convergence".

    Args:
        optimizer: whose learning rate it is.
        total_steps: of the training.
        peak: the largest learning rate.
    """
    total = max(total_steps, 3)  # OneCycleLR divides by zero in phases of a single step
    return OneCycleLR(
        optimizer,
        max_lr=peak,
        total_steps=total,
        pct_start=max(0.05, 2 / total),
        cycle_momentum=False,
        final_div_factor=1000.0,
    )
