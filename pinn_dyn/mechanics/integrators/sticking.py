"""Integration method for dry friction, with coordinates that stick."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pinn_dyn.mechanics.integrators.integrator import Integrator
from pinn_dyn.mechanics.integrators.rk4 import RK4


class Sticking(Integrator):
    """Integrator of systems with sticking friction, see :class:`~.sliding.Sliding`.

    The order is that of the inner method while no coordinate stops or starts to move, otherwise
    2. If the stop of a coordinate sets another coordinate in motion, the order is 1. A coordinate
    at rest under a load below its friction level does not move at all.

    Args:
        inner: integration method of the motion in a step.
    """

    def __init__(self, inner: Integrator):
        super().__init__(inner.substeps)
        self.inner = inner
        self.nodes, self.order, self.mean_input = inner.nodes, inner.order, inner.mean_input
        self.implicit = inner.implicit

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
