"""The contract of a one-step method, and the loop over its steps."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterator
from typing import Protocol

import torch
from pydantic import PositiveInt
from torch import Tensor

from pinn_dyn.mechanics.signal import Signal

# Steps whose inputs are laid out at once: bounds the memory of large batches.
BLOCK = 64


class Dynamics(Protocol):
    """What is integrated: dx/dt = f(x, u), with x ``(*batch, S)`` and u ``(*batch, M)``."""

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """f(x, u), ``(*batch, S)``."""

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Maps r to the k with (1 - step J) k = r, where J holds what is stiff of df/dx at x."""

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """One step of the method that it is integrated by; arguments of :meth:`Integrator.step`."""


class Integrator(abc.ABC):
    """A one-step method. It integrates the increment x(t) - x(t_0), not the state::

        d_{k+1} = step(d_k),    x(t_k) = x(t_0) + d_k

    With a small step in float32 an increment is far below the resolution of the state that it is
    added to.

    Args:
        substeps: steps in a step of the data. One is enough while the data resolve the fastest
            motion; data of a low rate need more.

    Attributes:
        nodes: times of the stages in a step, from 0 to 1.
        order: of the error, O(h^order).
        mean_input: shift the inputs at the nodes so that their mean is that of the input over the
            step, for a method whose steps are longer than a sample.
    """

    nodes: tuple[float, ...]
    order: int
    mean_input: bool = False

    def __init__(self, substeps: PositiveInt = 1):
        self.substeps = substeps

    @abc.abstractmethod
    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """The increment after a step, ``(*batch, S)``.

        Args:
            dynamics: f, and what is stiff of it.
            increment: the one before, ``(*batch, S)``.
            start: x(t_0), ``(*batch, S)``.
            inputs: u at the nodes, ``(stages, *batch, M)``.
            h: length of the step, ``()``, s.
        """

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        """Increments ``(T, *batch, S)`` at the times of the grid ``(T,)``, a step between two."""
        blocks = [torch.zeros_like(start)[None]]
        for inputs, lengths in self.blocks(grid, signal):
            steps = []
            increment = blocks[-1][-1]
            for stages, h in zip(inputs, lengths, strict=True):
                increment = dynamics.integration_step(increment, start, stages, h)
                steps.append(increment)
            blocks.append(torch.stack(steps))
        return torch.cat(blocks)

    def blocks(self, grid: Tensor, signal: Signal) -> Iterator[tuple[Tensor, Tensor]]:
        """Inputs ``(n, stages, *batch, M)`` and lengths ``(n,)`` of n steps at a time."""
        lengths = grid.diff()
        means = signal.means(grid) if self.mean_input else None
        for begin in range(0, grid.shape[0] - 1, BLOCK):
            taken = slice(begin, begin + BLOCK)
            inputs = signal.stages(grid[begin : begin + BLOCK + 1], self.nodes)
            if means is not None:
                inputs = inputs + (means[taken] - inputs.mean(1)).unsqueeze(1)
            yield inputs, lengths[taken]
