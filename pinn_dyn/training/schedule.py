"""The learning-rate schedule."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from torch.optim import Optimizer
from torch.optim.lr_scheduler import OneCycleLR


def one_cycle(
    optimizer: Optimizer, *, total_steps: int, warm_up: Annotated[float, Field(ge=0, le=1)] = 0.05
) -> OneCycleLR:
    """Build a schedule of half a cosine from 1/25 of the peak, and one to 1/25,000 of the peak.

    Momentum is constant. Source: Smith and Topin (2019), "Super-convergence".

    ``warm_up`` is the share of the steps in which the rate rises to that of the optimizer.
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
