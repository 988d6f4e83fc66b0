"""A disturbance observer that measures and compensates the error of a model-based law."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import ModelBasedLaw, pseudo_inverse_times
from pinn_dyn.mechanics.arrays import matvec


class _Memory(NamedTuple):
    """Quantities of a call that the next call needs."""

    t: float
    momentum: Tensor
    force: Tensor
    A: Tensor
    u: Tensor


class DisturbanceObserver(Controller):
    """A law with a generalized-momentum observer that corrects the law's model.

    The disturbance d is the force that the model's terms do not explain::

        dp/dt = f(q, v) + A(q) u + d,   p = M(q) v,   f = d(v^T M v / 2)/dq - G - D v - F(v)

    so d holds the errors of M, G, D, F and A, a payload, and contacts. The observer's residual r,
    and what is done about it::

        r(t) = K_O (p(t) - p(0) - integral from 0 to t of (f + A u + r) ds),   u = u_law - A^+(q) r

    With it dr/dt = K_O (d - r): r is d through a first-order low-pass, and needs no acceleration.
    The control instants t_k hold u_k, and over a period T a held d gives exactly::

        r_k+1 = r_k + limited((1 - exp(-K_O T)) (d_k - r_k)),   r_0 = 0
        d_k = (p_k+1 - p_k) / T - (f_k + f_k+1 + (A_k + A_k+1) u_k) / 2

    with the integral by the trapezoidal rule, and each entry limited to max_rate T, if there is
    one. T is the time between two calls. The first call, and one with another batch, has r = 0 and
    leaves the law as it is; a second one at the same time leaves r as it is. The paper's laws have
    no observer, it is an addition to them.

    Stability without the limit: with M the plant's mass matrix, M_L the model's, A square and the
    same for both, r_k+1 = (1 - a M_L M^-1) r_k + ..., a = 1 - exp(-K_O T). This is stable for
    a mu < 2, with mu the largest eigenvalue of M_L M^-1: any bandwidth serves where M_L < 2 M, and
    K_O T < 2 / mu is needed where the plant is far lighter. A dead time of n periods that the
    observer does not know of takes M_L = M to a < 2 sin(pi / (4 n + 2)). Beyond either, r
    alternates and grows until the input saturates; the limit keeps it alternating by max_rate T,
    about a useful mean. Noise of standard deviation s on v comes into r as about K_O M s, and less
    with the limit, which then makes r slower too.

    Assumptions: d changes little within 1 / K_O; u reaches the plant at once, or is clipped by
    limits that are given here; A has full rank, and of d only the part in its range can be undone
    where there are fewer inputs than coordinates. A contact is a disturbance too, and is pushed
    against.

    Source: De Luca and Mattone 2005, Sensorless robot collision detection and hybrid force/motion
    control; Haddadin, De Luca, Albu-Schaeffer 2017, Robot collisions: a survey.

    Args:
        law: the law to correct; the observer uses its model and its A^+.
        bandwidth: K_O, 1/s, one for all coordinates: those of a learned force may be mixed by P(q).
        max_rate: largest rate of change of each entry of r, N/s or Nm/s up to the same factor: how
            fast a force that the model misses is expected to change. None for no limit.
        actuator: limits of the plant's input, so that what they cut off is not taken for a
            disturbance (r does not wind up). An object of its own, not the loop's, since limits of
            the rate have a memory. The input that is returned is not limited. None if there are
            none.

    Attributes:
        residual: r of the latest call, ``(*batch, N)``, N or Nm up to the factor P(q) of a learned
            model; None before the first.

    Raises:
        TypeError: on a law that has no model.
    """

    def __init__(
        self,
        law: ModelBasedLaw,
        bandwidth: PositiveFloat,
        *,
        max_rate: PositiveFloat | None = None,
        actuator: Actuator | None = None,
    ):
        if not isinstance(law, ModelBasedLaw):
            raise TypeError(
                f"law is a {type(law).__name__}, expected a law on the terms of a model, such as "
                "Tracking: the observer needs M, G, D and A; put a guard around the observer, "
                "not inside"
            )
        super().__init__(law.num_coordinates, law.num_inputs)
        self.law = law
        self.bandwidth = float(bandwidth)
        self._max_rate = math.inf if max_rate is None else float(max_rate)
        self._actuator = actuator
        self.residual: Tensor | None = None
        self._size: Tensor | None = None
        self._memory: _Memory | None = None

    def reset(self) -> None:
        self.law.reset()
        self._forget()

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """The input u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: on a last dimension that is not N, or a time before that of the last call.
        """
        u = self.law(t, q, v, reference)
        last = self._memory
        if last is not None and t < last.t:
            raise ValueError(
                f"t is {t:g} s, but the call before was at {last.t:g} s: an observer is for "
                "control instants, one after the other; give a rate instead of continuous time, "
                "or call reset() before a new run"
            )
        model = self.law.model
        with torch.no_grad():
            momentum, A = model.momentum(q, v), model.input_matrix(q)
            # The part of dp/dt without the input: C^T v - G - D v.
            state = torch.cat([q, momentum], dim=-1)
            force = model.momentum_derivative(state, torch.zeros_like(u))[..., q.shape[-1] :]
            if last is None or self.residual is None or last.momentum.shape != q.shape:
                self._forget()
                self.residual = torch.zeros_like(q)
            elif t > last.t:
                period = t - last.t
                applied = last.u
                if self._actuator is not None:
                    applied, _ = self._actuator(applied, period)
                known = 0.5 * (last.force + force + matvec(last.A + A, applied))
                disturbance = (momentum - last.momentum) / period - known
                gain = -math.expm1(-self.bandwidth * period)
                change = gain * (disturbance - self.residual)
                limit = self._max_rate * period
                self.residual = self.residual + change.clamp(-limit, limit)
            compensation = pseudo_inverse_times(A, self.residual, self.law.inverse_damping)
            u = u - compensation
        self._size = torch.linalg.vector_norm(compensation, dim=-1)
        self._memory = _Memory(t, momentum, force, A, u)
        return u

    def diagnostics(self) -> dict[str, Tensor]:
        """Those of the law, and ``compensation``: |A^+ r|, ``(*batch,)``, in the units of u."""
        if self._size is None:
            return {}
        return self.law.diagnostics() | {"compensation": self._size}

    def faults(self) -> dict[str, Tensor]:
        return self.law.faults()

    def _forget(self) -> None:
        self.residual = self._size = self._memory = None
        if self._actuator is not None:
            self._actuator.reset()
