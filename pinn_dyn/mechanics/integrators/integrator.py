"""The contract of a one-step method, and the loop over its steps."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator
from typing import Protocol

import torch
from pydantic import PositiveInt
from torch import Tensor

from pinn_dyn.mechanics.signal import Signal

BLOCK = 64
"""Number of steps whose inputs are computed at once, to limit the memory of large batches."""


class Dynamics(Protocol):
    """Dynamics dx/dt = f(x, u), with x ``(*batch, S)`` and u ``(*batch, M)``."""

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return f(x, u), ``(*batch, S)``."""

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Return a function from r to k with (1 - s J) k = r, with J the stiff part of df/dx."""

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """Take a step of the integrator, see :meth:`Integrator.step`."""


class Integrator(abc.ABC):
    """A one-step method, which integrates the increment x(t) - x(t_0) instead of the state::

        d_{k+1} = step(d_k),    x(t_k) = x(t_0) + d_k

    In float32 the increment of a small step is far below the resolution of the state.

    Args:
        substeps: integrator steps in a step of the data; more than one for a low sample rate.

    Attributes:
        nodes: times of the stages in a step, from 0 to 1.
        order: exponent of the error O(h^order).
        mean_input: true to shift the inputs at the nodes to the mean input over the step.
        implicit: true for a method that is stable where damping outweighs inertia.
    """

    nodes: tuple[float, ...]
    order: int
    mean_input: bool = False
    implicit: bool = False

    def __init__(self, substeps: PositiveInt = 1):
        self.substeps = substeps

    @abc.abstractmethod
    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """Return the increment after a step, ``(*batch, S)``.

        Args:
            dynamics: f and its stiff part.
            increment: increment before the step, ``(*batch, S)``.
            start: x(t_0), ``(*batch, S)``.
            inputs: u at the nodes, ``(stages, *batch, M)``.
            h: length of the step, ``()``, s.
        """

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        """Return increments ``(T, *batch, S)`` at the grid ``(T,)``, the ends of the steps."""
        blocks = [torch.zeros_like(start)[None]]
        for inputs, lengths in self.blocks(grid, signal):
            steps = []
            increment = blocks[-1][-1]
            for stages, h in zip(inputs, lengths, strict=True):
                increment = dynamics.integration_step(increment, start, stages, h)
                steps.append(increment)
            blocks.append(torch.stack(steps))
        return torch.cat(blocks)

    def blocks(
        self, grid: Tensor, signal: Signal, size: int = BLOCK
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield inputs ``(n, stages, *batch, M)`` and lengths ``(n,)`` of up to ``size`` steps."""
        lengths = grid.diff()
        means = signal.means(grid) if self.mean_input else None
        for begin in range(0, grid.shape[0] - 1, size):
            block = slice(begin, begin + size)
            inputs = signal.stages(grid[begin : begin + size + 1], self.nodes)
            if means is not None:
                inputs = inputs + (means[block] - inputs.mean(1)).unsqueeze(1)
            yield inputs, lengths[block]
