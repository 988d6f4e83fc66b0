"""Delays between an input, as it is logged or commanded, and its action: none, or a learned one."""

from __future__ import annotations

import abc

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor, nn

from pinn_dyn.mechanics import ContinuousPredictor, Signal


class Delay(nn.Module, abc.ABC):
    """The delay d >= 0 of an input, one for all its entries: u(t - d) acts at t.

    Attributes:
        longest: the longest d that it may have, s; as much input before a start is needed.
    """

    longest: float

    @abc.abstractmethod
    def forward(self, input: Signal) -> Signal:
        """u(t - d)."""

    def figures(self) -> dict[str, float]:
        """What is learned, by name: nothing here."""
        return {}


class NoDelay(Delay):
    """d = 0."""

    longest = 0.0

    def forward(self, input: Signal) -> Signal:
        return input


class LearnedDelay(Delay):
    """One learned delay of all inputs, trained with the terms that they drive::

        d = longest * clamp(z, 0, 1),      dL/dd = -sum over stages of dL/du . du/dt

    The clamp lets gradients through, so that a d at 0 can grow again. The slope du/dt is that of
    the lines or cubics between the samples. A length of ``longest`` is crossed in some 1/lr steps
    of Adam. Delays that differ between inputs are shifted apart before (the step InputDelay); the
    data determine d only where the input changes faster than the motion that it causes, and
    ``check.py`` shows the curve.

    Args:
        longest: the longest delay that can be learned, s.
        initial: d at the start of the training, s; what ``check.py`` suggests, or 0.

    Raises:
        ValueError: if the initial delay is longer than the longest.
    """

    def __init__(self, longest: PositiveFloat = 0.1, initial: NonNegativeFloat = 0.0):
        super().__init__()
        if initial > longest:
            raise ValueError(
                f"the initial delay is {initial} s, expected at most the longest, {longest} s"
            )
        self.longest = longest
        self.share = nn.Parameter(torch.tensor(initial / longest))

    def seconds(self) -> Tensor:
        """d, ``()``, s."""
        inside = self.share.clamp(0, 1)
        return self.longest * (self.share + (inside - self.share).detach())

    def forward(self, input: Signal) -> Signal:
        return input.delayed(self.seconds())

    def figures(self) -> dict[str, float]:
        return {"input_delay_seconds": float(self.seconds().detach())}


class DelayedPredictor(ContinuousPredictor):
    """A predictor whose input acts as late as its head says.

    Attributes:
        delay: the head.
    """

    delay: Delay

    @property
    def input_history(self) -> float:  # type: ignore[override]
        """The longest delay of its head, s."""
        return self.delay.longest

    def acting_input(self, input: Signal) -> Signal:
        return self.delay(input)

    def learned_figures(self) -> dict[str, float]:
        """The delay of the input, if it is learned."""
        return self.delay.figures()
