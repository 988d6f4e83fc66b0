"""One-step methods, and the loop over their steps."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol

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


class RK4(Integrator):
    """The four-stage, fourth-order 3/8 rule::

        k1 = f(x, u(t))                       k2 = f(x + h k1/3, u(t + h/3))
        k3 = f(x + h (k2 - k1/3), u(t + 2h/3))   k4 = f(x + h (k1 - k2 + k3), u(t + h))
        x(t + h) = x + h (k1 + 3 k2 + 3 k3 + k4)/8

    Paths are computed by torchdiffeq. :meth:`step` gives the same numbers up to rounding, by
    operations that can be traced.
    """

    nodes = (0.0, 1 / 3, 2 / 3, 1.0)
    order = 4

    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        f = dynamics.state_derivative
        first = f(start + increment, inputs[0])
        second = f(start + (increment + h * first / 3), inputs[1])
        third = f(start + (increment + h * (second - first / 3)), inputs[2])
        fourth = f(start + (increment + h * (first - second + third)), inputs[3])
        return increment + h * (first + 3 * (second + third) + fourth) / 8

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        from torchdiffeq import odeint  # imports scipy.integrate, which takes a second

        def rate(time: Tensor, increment: Tensor) -> Tensor:
            return dynamics.state_derivative(start + increment, signal.at(time[None])[0])

        # For a held input torchdiffeq moves the stages at both ends of a step inwards.
        held = signal.interpolation == "hold"
        zero = torch.zeros_like(start)
        return odeint(rate, zero, grid, method="rk4", options={"perturb": held})


_GAMMA = 1 - 1 / math.sqrt(2)


class Rosenbrock(Integrator):
    """The linearly implicit, second-order method ROS2 with g = 1 - 1/sqrt(2)::

        (1 - g h J) k1 = f(x, u(t))
        (1 - g h J) k2 = f(x + h k1, u(t + h)) - 2 k1
        x(t + h) = x + h (3 k1 + k2)/2

    The order is 2 for any J. With J = df/dx the method is L-stable: motions that decay within a
    fraction of a step are damped. J only needs the stiff part. Source: Verwer, Spee, Blom and
    Hundsdorfer (1999), "A second-order Rosenbrock method applied to photochemical dispersion
    problems".

    With the mean m of u over the step, both stages use ``u + m - (u(t) + u(t + h))/2``. This keeps
    impulses of the input between the stages.
    """

    nodes = (0.0, 1.0)
    order = 2
    mean_input = True
    implicit = True

    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        x = start + increment
        solve = dynamics.implicit_solver(x, _GAMMA * h)
        first = solve(dynamics.state_derivative(x, inputs[0]))
        ahead = dynamics.state_derivative(start + (increment + h * first), inputs[1])
        second = solve(ahead - 2 * first)
        return increment + h * (1.5 * first + 0.5 * second)


class Wrapped(Integrator):
    """Integrator that takes the steps of an inner integrator, in a loop that can be traced."""

    def __init__(self, inner: Integrator):
        super().__init__(inner.substeps)
        self.inner = inner
        self.nodes, self.order, self.mean_input = inner.nodes, inner.order, inner.mean_input
        self.implicit = inner.implicit

    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        return self.inner.step(dynamics, increment, start, inputs, h)


class Sticking(Wrapped):
    """Integrator of systems with sticking friction, see :class:`~.sliding.Sliding`.

    The order is that of the inner method while no coordinate stops or starts to move, otherwise
    2. If the stop of a coordinate sets another coordinate in motion, the order is 1. A coordinate
    at rest under a load below its friction level does not move at all.

    Args:
        inner: integration method of the motion in a step.
    """

    def step(
        self, dynamics: Any, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        sliding = dynamics.sliding(start + increment, inputs, h, self.implicit)
        after = self.inner.step(sliding, increment, start, inputs, h)
        return sliding.ended(start, increment, after)


def with_friction(integrator: Integrator | None, sticking: bool) -> Integrator:
    """Return the integrator of a system with or without sticking friction; the default is RK4."""
    integrator = integrator or RK4()
    return Sticking(integrator) if sticking else integrator
