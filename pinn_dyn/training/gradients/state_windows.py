"""Windows in the layout of compiled programs."""

from __future__ import annotations

from dataclasses import dataclass, fields

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import State


@dataclass(frozen=True)
class StateWindows(Windows):
    """Windows with precomputed states of a model."""

    x0: Tensor  # state at the start, (B, 2N), with the batch contiguous in memory
    dx: Tensor  # increments up to each step, (B, H, 2N)

    @classmethod
    def of(cls, windows: Windows, state: State) -> StateWindows:
        """Build from windows, for a model of this state."""
        values = {item.name: getattr(windows, item.name) for item in fields(Windows)}
        x0 = windows.start(state).mT.contiguous().mT
        return cls(**values, x0=x0, dx=windows.increments(state))

    def start(self, state: State, past: int = 0) -> Tensor:
        return self.x0

    def increments(self, state: State) -> Tensor:
        return self.dx
