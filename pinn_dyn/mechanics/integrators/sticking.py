"""A method for dry friction, which lets coordinates stick."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pinn_dyn.mechanics.integrators.integrator import Integrator
from pinn_dyn.mechanics.integrators.rk4 import RK4


class Sticking(Integrator):
    """A step of another method, after :class:`~.sliding.Sliding` has found what sticks.

    The order is that of the inner method while no coordinate stops or starts, otherwise 2, and 1
    for coordinates that start because of the stop of another. A coordinate at rest under a load
    below its friction level does not move at all.

    Args:
        inner: the method while coordinates slide.
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
    """Return an integrator of a system, whose dry friction may be sticking; the default is RK4."""
    integrator = integrator or RK4()
    return Sticking(integrator) if sticking else integrator
