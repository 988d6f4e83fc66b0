"""The classical explicit method of fourth order, by torchdiffeq."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.mechanics.integrators.integrator import Dynamics, Integrator
from pinn_dyn.mechanics.signal import Signal


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

        f = dynamics.state_derivative

        def rate(time: Tensor, increment: Tensor) -> Tensor:
            return f(start + increment, signal(time))

        # For a held input torchdiffeq moves the stages at both ends of a step inwards.
        held = signal.interpolation == "hold"
        zero = torch.zeros_like(start)
        return odeint(rate, zero, grid, method="rk4", options={"perturb": held})
