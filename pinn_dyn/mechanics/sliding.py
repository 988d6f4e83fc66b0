"""The motion of a mechanical system with sticking dry friction within a step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import matvec, spd_solve
from pinn_dyn.mechanics.mechanical_terms import MechanicalTerms

_PASSES = 4
"""Number of passes of the active-set method."""


class Sliding:
    """Dynamics of a step of h seconds, in which coordinates slide or come to rest::

        M a + C v + G + D v + F(v, s) = A u + r        rows of coordinates that slide
        v_i(t) = v_i(0) (1 - t/h)                      of coordinates that come to rest

    F(v, s) is the sliding friction, and s is the mean direction over the step, from 0 (backward)
    to 1 (forward). A coordinate at rest sticks as long as a force between F(0, 0) and F(0, 1)
    holds it (Coulomb's law). A coordinate in motion stops at most once in a step, at the time tau.
    After the stops, the accelerations minimize::

        (a - a_free)^T M (a - a_free)/2 + sum over coordinates at rest of F_i(0, a_i > 0) a_i

    where a_free is the acceleration without friction at rest. For an ``implicit`` method, M is
    replaced by M + h D + h^2 K, with the stiffness K of drives and elastic joints. An active-set
    method with a fixed number of passes finds the coordinates that stick. Gradients hold this set
    fixed.

    Source: Moreau (1988), "Unilateral contact and dry friction in finite freedom dynamics";
    Hintermueller, Ito and Kunisch (2002), "The primal-dual active set strategy as a semismooth
    Newton method".

    Args:
        system: the system, with the state (q, v).
        x: state at the start of the step, ``(*batch, 2N)``.
        inputs: input at the nodes of the step, ``(stages, *batch, M)``. The mean input determines
            the stops.
        h: length of the step, ``()``, s.
        implicit: true for a method that is stable where damping outweighs inertia.

    Attributes:
        rate: acceleration before the stops, ``(*batch, N)``.
        stops: true for coordinates that stop, ``(*batch, N)``.
        forward, ahead: true for coordinates that slide forward before and after the stops.
        stop: tau, ``(*batch, N)``, s; 0 at rest, and h for coordinates that do not stop.
        stuck: true for coordinates that are at rest at the end of the step, ``(*batch, N)``.
        share: s, ``(*batch, N)``.
    """

    def __init__(
        self, system: MechanicalTerms, x: Tensor, inputs: Tensor, h: Tensor, implicit: bool = False
    ):
        self.system, self.h = system, h
        q, v = x.chunk(2, dim=-1)
        self._v = v
        inertia, force = self._mass_and_force(q, v, inputs[0])
        self._first: tuple[Tensor, Tensor] | None = (inertia, force)
        mean, first = (system.applied_force(q, v, u) for u in (inputs.mean(0), inputs[0]))
        force = force + mean - first
        resistance = torch.zeros_like(inertia)
        if implicit:
            resistance = system.resistance_matrix(q, h)
            inertia = inertia + h * resistance
            force = force + system.damping_force(q, v) - matvec(resistance, v)
        at_rest, self.forward = v == 0, v > 0
        friction = system.sliding_force(v, self.forward.to(v))
        self.rate = _solve(inertia, force - friction, at_rest, 0 * v)
        self.stops = (v * self.rate < 0) & (v.abs() < h * self.rate.abs())
        time = -v / torch.where(self.stops, self.rate, 1.0)
        self.stop = torch.where(at_rest, 0.0, torch.where(self.stops, time, h))
        with torch.no_grad():
            can_stick = at_rest | self.stops
            moving = torch.where(can_stick, 0.0, v)
            force = force + matvec(resistance, v - moving)
            upper = system.sliding_force(moving, torch.ones_like(v))
            lower = system.sliding_force(moving, torch.zeros_like(v))
            scale = inertia.diagonal(dim1=-2, dim2=-1)
            stuck, ahead = can_stick, self.forward
            for _ in range(_PASSES):
                friction = torch.where(ahead, upper, lower)
                rate = _solve(inertia, force - friction, stuck, 0 * v)
                reaction = torch.where(stuck, force - matvec(inertia, rate), friction)
                tendency = reaction + scale * rate
                stuck = can_stick & (tendency > lower) & (tendency < upper)
                ahead = (can_stick & (tendency >= upper)) | (~can_stick & self.forward)
        self.stuck, self.ahead = stuck, ahead
        before = self.stop / h
        self.share = before * self.forward + (1 - before) * ahead

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return dx/dt, ``(*batch, 2N)``. The first call must be at the start of the step."""
        q, v = x.chunk(2, dim=-1)
        mass, force = self._first or self._mass_and_force(q, v, u)
        self._first = None
        force = force - self.system.sliding_force(v, self.share)
        return torch.cat([v, _solve(mass, force, self.stuck, -self._v / self.h)], dim=-1)

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Return :meth:`MechanicalSystem.implicit_solver` with the stuck coordinates fixed."""
        q, _ = x.chunk(2, dim=-1)
        mass = self.system.mass_matrix(q)
        inertia = mass + step * self.system.resistance_matrix(q, step)
        stiffness = self.system.stiffness_matrix(q)

        def solve(rate: Tensor) -> Tensor:
            rate_q, rate_v = rate.chunk(2, dim=-1)
            force = matvec(mass, rate_v)
            if stiffness is not None:
                force = force - step * matvec(stiffness, rate_q)
            rate_v = _solve(inertia, force, self.stuck, rate_v)
            return torch.cat([rate_q + step * rate_v, rate_v], dim=-1)

        return solve

    def ended(self, start: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Return the increment after a step, with corrections for coordinates that stopped.

        A coordinate that stopped moves by v(0) tau/2 before its stop and by v(h) (h - tau)/2
        after it. The velocity of a coordinate at rest is exactly zero.
        """
        position, velocity = after.chunk(2, dim=-1)
        origin = start.chunk(2, dim=-1)[1]
        velocity = torch.where(self.stuck, -origin, velocity)
        moved = self._v * self.stop + (origin + velocity) * (self.h - self.stop)
        moved = before.chunk(2, dim=-1)[0] + 0.5 * moved
        return torch.cat([torch.where(self.stops, moved, position), velocity], dim=-1)

    def _mass_and_force(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return M and the force without dry friction."""
        mass, bias = self.system.mass_and_bias(q, v)
        applied = self.system.applied_force(q, v, u)
        return mass, applied - bias - self.system.damping_force(q, v)


def hold(matrix: Tensor, fixed: Tensor) -> Tensor:
    """Replace the rows and columns of fixed coordinates by those of the identity matrix."""
    free = ~(fixed.unsqueeze(-1) | fixed.unsqueeze(-2))
    unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.where(free, matrix, unit)


def _solve(matrix: Tensor, force: Tensor, fixed: Tensor, values: Tensor) -> Tensor:
    """Solve ``matrix x = force`` in the coordinates that are not fixed at their values."""
    values = torch.where(fixed, values, 0.0)
    force = torch.where(fixed, values, force - matvec(matrix, values))
    return spd_solve(hold(matrix, fixed), force)
