"""The learning-rate schedule."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR


def one_cycle(
    optimizer: Optimizer, *, total_steps: int, warm_up: Annotated[float, Field(ge=0, le=1)] = 0.05
) -> OneCycleLR:
    """Half a cosine up to the optimizer's learning rate, then one down to next to nothing.

    Smith and Topin 2019, "Super-convergence". The rate starts at a 25th of the peak and ends at a
    25,000th of it; momentum stays as it is.

    Args:
        optimizer: its learning rate is the peak.
        total_steps: steps of the training.
        warm_up: the part of them that the rate rises in, 0 to 1.
    """
    if warm_up * total_steps == 1:  # the slope of a rise of exactly one step is not defined
        total_steps += 1
    return OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=total_steps,
        pct_start=float(warm_up),
        cycle_momentum=False,
        final_div_factor=1000.0,
    )
