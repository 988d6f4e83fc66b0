"""A linearly implicit method that stays stable where damping outweighs inertia."""

from __future__ import annotations

import math

from torch import Tensor

from pinn_dyn.mechanics.integrators.integrator import Dynamics, Integrator

_GAMMA = 1 - 1 / math.sqrt(2)


class Rosenbrock(Integrator):
    """The linearly implicit, second-order method ROS2 with g = 1 - 1/sqrt(2)::

        (1 - g h J) k1 = f(x, u(t))
        (1 - g h J) k2 = f(x + h k1, u(t + h)) - 2 k1
        x(t + h) = x + h (3 k1 + k2)/2

    It has its order for any J, and with J = df/dx it is L-stable: what decays far faster than a
    step lasts is damped, where an explicit method would blow up. J only has to hold what is
    stiff. Two evaluations of f and two linear solves a step. Verwer, Spee, Blom and Hundsdorfer
    (1999), "A second-order Rosenbrock method applied to photochemical dispersion problems".

    A step may span many samples of u. With m the mean of u over the step, both stages take
    ``u + m - (u(t) + u(t + h))/2``, so that no impulse of the input is lost between them: a motion
    that follows the rates of motors adds up to where the motors went. The shift is of order h^2,
    and zero where u is linear over the step.
    """

    nodes = (0.0, 1.0)
    order = 2
    mean_input = True

    def step(
        self, dynamics: Dynamics, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        x = start + increment
        solve = dynamics.implicit_solver(x, _GAMMA * h)
        first = solve(dynamics.state_derivative(x, inputs[0]))
        ahead = dynamics.state_derivative(start + (increment + h * first), inputs[1])
        second = solve(ahead - 2 * first)
        return increment + h * (1.5 * first + 0.5 * second)
