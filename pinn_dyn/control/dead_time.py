"""A law that compensates the dead time of its inputs by predicting the state."""

from __future__ import annotations

import copy
import math

import numpy as np
import torch
from numpy.typing import ArrayLike
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.closed_loop import motion_of_copies
from pinn_dyn.control.contracts import Controller, Motion, Reference
from pinn_dyn.control.effects import Actuator
from pinn_dyn.exports.model_functions import held_step
from pinn_dyn.mechanics import MechanicalSystem


class DelayCompensation(Controller):
    """A law whose inputs act after a dead time d, at the state that the model predicts::

        x(t_k + d) = x(t_k) + integral from t_k to t_k + d of f(x, u(s - d)) ds
        u_k = law(t_k + d, x(t_k + d), reference(t_k + d))

    The inputs since t_k - d are the memory of the law, zero before the first call. In the predicted
    state, the plant has no dead time: gains, an observer, a guard and predictive control are those
    for the plant without it. The reference is followed without lag if it is known ahead
    (:meth:`follow`). A disturbance acts for d before the law can react, and shifts the predicted
    state by d^2 / 2 of the acceleration that it causes.

    If inputs have different dead times, d is the longest, and the other inputs are held back by the
    difference, interpolated between two periods.

    Source: Smith 1957, Closer control of loops with dead time; Manitius and Olbrot 1979, Finite
    spectrum assignment problem for systems with delays.

    Args:
        law: the law for the plant without dead time, also with an observer or a guard.
        model: the model that predicts, in float64.
        delay: d, s, one or M.
        period: time between two calls, s.
        actuator: limits of the input; an object of its own, since limits of the rate have a memory.

    Attributes:
        ahead: time between a call and the reference that a caller gives, s: the longest d.
        size: number n of inputs in the memory.
    """

    def __init__(
        self,
        law: Controller,
        model: MechanicalSystem,
        delay: ArrayLike,
        period: PositiveFloat,
        actuator: Actuator | None = None,
    ):
        super().__init__(law.num_coordinates, law.num_inputs)
        self.law, self.model = law, model
        self._actuator = actuator or Actuator()
        self.period = period
        delays = np.resize(np.asarray(delay, dtype=float), self.num_inputs)
        self.ahead = float(delays.max())
        self.size = n = math.ceil(self.ahead / period - 1e-6)
        self._position = torch.from_numpy(n - (self.ahead - delays) / period)
        # Input k of the memory acts between the ends k and k + 1, from now on.
        ends = np.maximum(self.ahead + period * np.arange(-n, 1), 0.0)
        self._lengths = torch.from_numpy(np.diff(ends))
        self.reset()

    def reset(self) -> None:
        self.law.reset()
        self._actuator.reset()
        self._reference: Reference | None = None
        self._past: Tensor | None = None
        self._time = -math.inf

    def follow(self, reference: Reference) -> None:
        self._reference = reference
        self.law.follow(reference)

    def predict(self, q: Tensor, v: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Return q and v after the dead time, from the last n inputs ``(*batch, n, M)``."""
        substeps = self.model.integrator.substeps
        for u, length in zip(past.unbind(-2), self._lengths, strict=True):
            for _ in range(substeps):
                q, v = held_step(self.model, q, v, u, length / substeps)
        return q, v

    def applied(self, past: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the input to apply ``(*batch, M)`` and the last n inputs, with u the latest."""
        inputs = torch.cat([past, u.unsqueeze(-2)], dim=-2)
        number = torch.arange(self.num_inputs)
        before, after = self._position.floor().long(), self._position.ceil().long()
        held_back = inputs[..., before, number].lerp(
            inputs[..., after, number], self._position - before
        )
        return held_back, inputs[..., 1:, :]

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``.

        The reference is that at t + d, if the law does not follow one.

        Raises:
            ValueError: if the time since the previous call is not the period.
        """
        if math.isfinite(self._time) and abs(t - self._time - self.period) > 1e-6 * self.period:
            raise ValueError(
                f"t is {t:g} s after {self._time:g} s, expected steps of the period {self.period:g}"
                " s: give the law the period of the loop, and reset() it before a new run"
            )
        self._time = t
        past = self._past
        if past is None or past.shape[:-2] != q.shape[:-1]:
            past = q.new_zeros(*q.shape[:-1], self.size, self.num_inputs)
        with torch.no_grad():
            q, v = self.predict(q, v, past)
        if self._reference is not None:
            reference = motion_of_copies(self._reference, t + self.ahead, q)
        u = self.law(t + self.ahead, q, v, reference)
        limited, _ = self._actuator(u, self.period)
        held_back, self._past = self.applied(past, limited)
        return torch.where(self._position == self.size, u, held_back)

    def diagnostics(self) -> dict[str, Tensor]:
        return self.law.diagnostics()

    def faults(self) -> dict[str, Tensor]:
        return self.law.faults()


def compensated(
    law: Controller,
    model: MechanicalSystem,
    delay: ArrayLike,
    rate: float | None,
    actuator: Actuator | None = None,
) -> Controller:
    """Return the law at a rate in 1/s with a :class:`DelayCompensation` if inputs act late."""
    if not np.any(delay):
        return law
    if rate is None:
        raise ValueError(
            f"inputs act up to {np.max(delay):g} s late, which a law in continuous time cannot "
            "compensate: give a rate"
        )
    return DelayCompensation(law, model, delay, 1 / rate, copy.deepcopy(actuator))
