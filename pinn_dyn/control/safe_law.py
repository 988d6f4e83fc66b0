"""A control law with its limits, guard and memory as one function, for other programs."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.dead_time import DelayCompensation
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import ModelBasedLaw
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.control.region import Guarded
from pinn_dyn.mechanics.arrays import matvec, pseudo_inverse_times

LIMITED, OUTSIDE, NOT_FINITE = 1, 2, 4
"""Bits of the status."""


class SafeLaw:
    """The law between measurement and actuator at a fixed period, with explicit memory::

        u, status, memory_out = safe_law(q, v, q_ref, v_ref, a_ref, memory_in)

    1. The law and its observer give u.
    2. Outside the training data (a :class:`Guarded` law), the fall-back of the guard replaces u.
    3. If u is not finite, the last u replaces it. The observer keeps its memory while v is not.
    4. The actuator limits u.

    A :class:`DelayCompensation` predicts q and v first; references are those at the end of the dead
    time, and the memory holds the last n inputs instead of the last one.

    The status is the sum of 1 (the actuator changed u), 2 (outside the training data) and 4 (not
    finite). The memory is zero before the first call. It holds the last u ``(M,)``. An observer
    adds 1 after the first call, and r, M v and (f + A u) / 2, ``(N,)`` each. The observer
    computes as :class:`DisturbanceObserver` with the limits of the actuator.

    Args:
        controller: a law of a model, also with an observer, a guard or a DelayCompensation.
        actuator: limits of the input.
        period: time between two calls, s; limits of the rate and observers need it.

    Raises:
        TypeError: on another controller.
        ValueError: if the period is missing.
    """

    def __init__(
        self,
        controller: Controller,
        actuator: Actuator | None = None,
        period: float | None = None,
    ):
        self.compensation: DelayCompensation | None = None
        if isinstance(controller, DelayCompensation):
            self.compensation, period = controller, controller.period
            controller = controller.law
        self.guard = controller if isinstance(controller, Guarded) else None
        law = self.guard.law if self.guard else controller
        self.observer = law if isinstance(law, DisturbanceObserver) else None
        law = self.observer.law if self.observer else law
        if not isinstance(law, ModelBasedLaw):
            raise TypeError(
                f"{type(law).__name__} cannot be exported, expected a law of a model such as "
                "Tracking, also with a DisturbanceObserver or a guard"
            )
        self.law, self.actuator = law, actuator or Actuator()
        if period is None and (self.observer or self.actuator.rate is not None):
            raise ValueError("an observer or a limited rate needs a fixed period: give a rate")
        self.period = period
        self.stored_inputs = law.num_inputs * (self.compensation.size if self.compensation else 1)
        self.memory_size = self.stored_inputs + (1 + 3 * law.num_coordinates) * bool(self.observer)

    def __call__(
        self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, a_ref: Tensor, memory_in: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return u ``(M,)``, the status ``()`` and the memory after the call."""
        reference = Motion(q_ref, v_ref, a_ref)
        past, memory = memory_in.tensor_split([self.stored_inputs])
        past = past.reshape(-1, self.law.num_inputs)
        last = past[-1]
        if self.compensation:
            q, v = self.compensation.predict(q, v, past)
        u = self.law.law(q, v, *reference, last)
        if self.observer:
            u, finish = self._observed(self.observer, q, v, u, last, memory)
        status = torch.zeros_like(q[0])
        if self.guard:
            outside = self.guard.region.nearest(q, v) > self.guard.threshold
            status = status + OUTSIDE * outside
            u = torch.where(outside, self.guard.fall_back(q, v, reference, u, last), u)
        finite = u.abs().sum() < torch.inf  # CasADi takes u - u for zero, also of NaN
        status = status + NOT_FINITE * ~finite
        u = torch.where(finite, u, last)
        applied = self.actuator.limit(u, last, self.period or 0.0)
        status = status + LIMITED * ((applied != u).to(u).sum() > 0)
        if self.observer:
            after = finish(applied)
            memory = torch.where(finite & (after.abs().sum() < torch.inf), after, memory)
        output, stored = applied, applied
        if self.compensation:
            output, stored = self.compensation.applied(past, applied)
        return output, status, torch.cat([stored.flatten(), memory])

    def _observed(
        self,
        observer: DisturbanceObserver,
        q: Tensor,
        v: Tensor,
        u: Tensor,
        last: Tensor,
        memory: Tensor,
    ) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return the corrected u, and a function from the applied u to the observer's memory."""
        model, n, period = self.law.model, len(q), self.period or 0.0
        started, residual, last_momentum, last_force = memory.split([1, n, n, n])
        momentum, A = model.momentum(q, v), model.input_matrix(q)
        state = torch.cat([q, momentum])
        force = model.momentum_derivative(state, torch.zeros_like(u))[n:]
        modeled = last_force + 0.5 * (force + matvec(A, last))
        disturbance = (momentum - last_momentum) / period - modeled
        change = -math.expm1(-observer.bandwidth * period) * (disturbance - residual)
        limit = observer.max_rate * period
        if math.isfinite(limit):
            change = change.clamp(-limit, limit)
        residual = residual + started * change

        def finish(applied: Tensor) -> Tensor:
            half = 0.5 * (force + matvec(A, applied))
            return torch.cat([torch.ones_like(started), residual, momentum, half])

        return u - pseudo_inverse_times(A, residual), finish
