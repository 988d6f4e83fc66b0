"""The learning-rate schedule."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR


def one_cycle(
    optimizer: Optimizer, *, total_steps: int, warm_up: Annotated[float, Field(ge=0, le=1)] = 0.05
) -> OneCycleLR:
    """Build a schedule that rises to the optimizer's learning rate and then falls to nearly zero.

    Both parts are half a cosine. The rate starts at 1/25 and ends at 1/25,000 of the peak. Momentum
    is constant. Source: Smith and Topin (2019), "Super-convergence".

    Args:
        optimizer: the optimizer. Its learning rate is the peak.
        total_steps: number of training steps.
        warm_up: share of the steps in which the rate rises.
    """
    if warm_up * total_steps == 1:  # the slope of a rise in exactly one step is undefined
        total_steps += 1
    return OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=total_steps,
        pct_start=float(warm_up),
        cycle_momentum=False,
        final_div_factor=1000.0,
    )
