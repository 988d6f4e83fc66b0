"""A learned delay between a logged or commanded input and its action."""

from __future__ import annotations

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor, nn

from pinn_dyn.mechanics import ContinuousPredictor, Signal


class LearnedDelay(nn.Module):
    """A learned delay of all inputs, trained together with the dynamics::

        d = longest * clamp(z, 0, 1),      dL/dd = -sum over stages of dL/du . du/dt

    The clamp passes gradients, so that a d at 0 can grow again. Inputs with different delays must
    be shifted before (the cleaning step InputDelay).

    Args:
        longest: the longest delay that can be learned, s.
        initial: initial d, s, for example the delay that ``check.py`` measures.

    Raises:
        ValueError: if the initial delay is longer than the longest.
    """

    def __init__(self, longest: PositiveFloat = 0.1, initial: NonNegativeFloat = 0.0):
        super().__init__()
        if initial > longest:
            raise ValueError(f"initial delay is {initial} s, expected at most {longest} s")
        self.longest = longest
        self.share = nn.Parameter(torch.tensor(initial / longest))

    def seconds(self) -> Tensor:
        """Return d, ``()``, s."""
        inside = self.share.clamp(0, 1)
        return self.longest * (self.share + (inside - self.share).detach())

    def forward(self, input: Signal) -> Signal:
        """Return u(t - d)."""
        return input.delayed(self.seconds())


class DelayedPredictor(ContinuousPredictor):
    """Predictor with an optional head for the delay of its input."""

    delay: LearnedDelay | None

    @property
    def input_history(self) -> float:  # type: ignore[override]
        """Longest delay, s."""
        return 0.0 if self.delay is None else self.delay.longest

    def acting_input(self, input: Signal) -> Signal:
        return input if self.delay is None else self.delay(input)

    def learned_figures(self) -> dict[str, float]:
        if self.delay is None:
            return {}
        return {"input_delay_seconds": float(self.delay.seconds().detach())}
