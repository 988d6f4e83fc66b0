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
