"""A control law with its limits, guard and memory as one function, for other programs."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from pinn_dyn.control.adaptive import AdaptiveTracking
from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.dead_time import DelayCompensation
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.latent_law import LatentLaw
from pinn_dyn.control.laws import ModelBasedLaw
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.control.region import Guarded

LIMITED, OUTSIDE, NOT_FINITE = 1, 2, 4
"""Bits of the status."""


class SafeLaw:
    """The law between measurement and actuator at a fixed period, with explicit memory::

        u, status, memory_out = safe_law(q, v, q_ref, v_ref, a_ref, memory_in)

    1. The law and its observer give u.
    2. Outside the training data (a :class:`Guarded` law), the fall-back of the guard replaces u.
    3. If u is not finite, the last u replaces it. The observer keeps its memory while v is not, and
       so does an :class:`AdaptiveTracking`.
    4. The actuator limits u.

    A :class:`DelayCompensation` predicts q and v first; references are those at the end of the dead
    time, and the memory holds the last n inputs instead of the last one.

    The status is the sum of 1 (the actuator changed u), 2 (outside the training data) and 4 (not
    finite). The memory is zero before the first call. It holds the last u ``(M,)`` and the memory
    of the observer, see :meth:`DisturbanceObserver.correct`, or of the adaptation. That of a
    :class:`LatentLaw` holds its last inputs, as many as its dead time needs, and its own memory.

    Args:
        controller: a law of a model, also with an observer, a guard or a DelayCompensation, or a
            LatentLaw.
        actuator: limits of the input; None takes those of a LatentLaw.
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
        self.latent: LatentLaw | None = None
        if isinstance(law, LatentLaw):
            if period is None:
                raise ValueError("a LatentLaw needs a fixed period: give a rate")
            law = self.latent = copy.copy(law)
            self.latent.prepare(period)
            actuator = actuator or law.actuator
        elif not isinstance(law, ModelBasedLaw):
            raise TypeError(
                f"{type(law).__name__} cannot be exported, expected a law of a model such as "
                "Tracking, also with a DisturbanceObserver or a guard, or LatentLaw"
            )
        self.law, self.actuator = law, actuator or Actuator()
        if period is None and (self.observer or self.actuator.rate is not None):
            raise ValueError("an observer or a limited rate needs a fixed period: give a rate")
        self.period = period
        self.stored_inputs = law.num_inputs * (self.compensation.size if self.compensation else 1)
        if self.latent:
            self.stored_inputs = self.latent.stored_inputs * law.num_inputs
        self.memory_size = self.stored_inputs + (self.latent.memory_size if self.latent else 0)
        if self.observer:
            self.memory_size += self.observer.memory_size
        self.adaptive = law if isinstance(law, AdaptiveTracking) else None
        if self.adaptive:
            if self.observer or self.compensation or period is None:
                raise ValueError(
                    "AdaptiveTracking is exported with a fixed period, without an observer and "
                    "without a dead time"
                )
            self.memory_size += self.adaptive.memory_size

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
        if self.adaptive:
            u = self.adaptive.law_of(q, v, reference, memory)
            changes = self.adaptive.changes(q, v, reference, memory)
        elif self.latent:
            past = self.latent.past_of(past, memory)
            last = past[-1]
            u, after, _ = self.latent.law_of(q, v, q_ref, v_ref, past, memory)
        else:
            assert isinstance(self.law, ModelBasedLaw)
            u = self.law.law(q, v, *reference, last)
        if self.observer:
            u, finish = self.observer.correct(q, v, u, last, memory, self.period or 0.0)
        status = torch.zeros_like(q[0])
        if self.guard:
            distance = self.guard.region.nearest(q, v)
            u, outside = self.guard.replaced(q, v, reference, u, last, distance)
            status = status + OUTSIDE * outside
        finite = u.abs().sum() < torch.inf  # CasADi takes u - u for zero, also of NaN
        status = status + NOT_FINITE * ~finite
        u = torch.where(finite, u, last)
        applied = self.actuator.limit(u, last, self.period or 0.0)
        status = status + LIMITED * ((applied != u).to(u).sum() > 0)
        if self.observer or self.adaptive or self.latent:
            if self.adaptive:
                after = self.adaptive.adapted(memory, changes, self.period or 0.0)
            elif self.observer:
                after = finish(applied)
            memory = torch.where(finite & (after.abs().sum() < torch.inf), after, memory)
        output, stored = applied, applied
        if self.compensation:
            output, stored = self.compensation.applied(past, applied)
        if self.latent:
            stored = torch.cat([past[1:], applied[None]])
        return output, status, torch.cat([stored.flatten(), memory])
