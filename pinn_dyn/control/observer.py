"""A disturbance observer that measures and compensates the error of a model-based law."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import ModelBasedLaw
from pinn_dyn.mechanics.arrays import matvec, pseudo_inverse_times


class DisturbanceObserver(Controller):
    """A law with a generalized-momentum observer that corrects the law's model.

    The disturbance d is the force that the model's terms do not explain: errors of M, G, D, F and
    A, a payload, a contact. The observer's residual r estimates d and corrects the input::

        dp/dt = f(q, v) + A(q) u + d,   p = M(q) v,   f = d(v^T M v / 2)/dq - G - D v - F(v)
        r(t) = K_O (p(t) - p(0) - integral from 0 to t of (f + A u + r) ds),   u = u_law - A^+(q) r

    so dr/dt = K_O (d - r): r is d through a first-order low-pass. With u_k held over a period T::

        r_k+1 = r_k + limited((1 - exp(-K_O T)) (d_k - r_k)),   r_0 = 0
        d_k = (p_k+1 - p_k) / T - (f_k + f_k+1 + (A_k + A_k+1) u_k) / 2

    where each entry is limited to max_rate T, and T is the time between two calls.

    Stability for a square A: with a = 1 - exp(-K_O T) and mu the largest eigenvalue of M_L M^-1
    (model M_L, plant M), the loop is stable for a mu < 2. An unknown dead time of n periods reduces
    this for M_L = M to a < 2 sin(pi / (4 n + 2)). Beyond, r alternates within max_rate T.

    Assumptions: d changes little within 1 / K_O, u reaches the plant at once, and A has full rank.

    Source: De Luca and Mattone 2005, Sensorless robot collision detection and hybrid force/motion
    control; Haddadin, De Luca, Albu-Schaeffer 2017, Robot collisions: a survey. Not in the paper.

    Args:
        law: the law to correct; the observer uses its model and its A^+.
        bandwidth: K_O, 1/s.
        max_rate: largest rate of change of each entry of r, N/s or Nm/s; None for no limit.
        actuator: limits of the plant's input, so that r does not wind up in saturation. Give an
            object of its own, since limits of the rate have a memory. u itself is not limited.

    Raises:
        ValueError: on a model whose force is not linear in the input.

    Attributes:
        residual: r of the latest call, ``(*batch, N)``, N or Nm; None before the first call.
        bandwidth, max_rate: as above; the rate is infinite without a limit.
    """

    _finish: Callable[[Tensor], Tensor]
    _u: Tensor

    def __init__(
        self,
        law: ModelBasedLaw,
        bandwidth: PositiveFloat,
        *,
        max_rate: PositiveFloat | None = None,
        actuator: Actuator | None = None,
    ):
        super().__init__(law.num_coordinates, law.num_inputs)
        if not law.model.input_affine:
            raise ValueError("the observer needs a force A(q) u: remove controllers.<law>.observer")
        self.law = law
        self.bandwidth = float(bandwidth)
        self.max_rate = math.inf if max_rate is None else float(max_rate)
        self._actuator = actuator
        self.memory_size = 1 + 3 * law.num_coordinates
        self._forget()

    def reset(self) -> None:
        self.law.reset()
        self._forget()

    def _forget(self) -> None:
        self.residual: Tensor | None = None
        self._time, self._period = -math.inf, 1.0
        if self._actuator is not None:
            self._actuator.reset()

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: on a time before the previous call.
        """
        u_law = self.law(t, q, v, reference)
        if t < self._time:
            raise ValueError(
                f"t is {t:g} s, before the previous call at {self._time:g} s: reset() the observer "
                "before a new run, and give a rate, since it cannot act in continuous time"
            )
        with torch.no_grad():
            if self.residual is None or self.residual.shape != q.shape:
                self._forget()
                self._memory = q.new_zeros(*q.shape[:-1], self.memory_size)
                self._applied = torch.zeros_like(u_law)
            elif t > self._time:
                self._period, self._applied = t - self._time, self._u
                if self._actuator is not None:
                    self._applied, _ = self._actuator(self._u, self._period)
                self._memory = self._finish(self._applied)
            u, self._finish = self.correct(q, v, u_law, self._applied, self._memory, self._period)
            self.residual = self._finish(u)[..., 1 : q.shape[-1] + 1]
        self._time, self._u = t, u
        self._size = torch.linalg.vector_norm(u_law - u, dim=-1)
        return u

    def correct(
        self, q: Tensor, v: Tensor, u: Tensor, last: Tensor, memory: Tensor, period: float
    ) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Correct the law's u ``(*batch, M)``, without side effects.

        Args:
            q, v: state, ``(*batch, N)``.
            u: input of the law, ``(*batch, M)``.
            last: input that was applied since the previous call, ``(*batch, M)``.
            memory: zero before the first call; then 1, r, M v and (f + A u) / 2, side by side.
            period: T, s.

        Returns:
            u - A^+ r, and a function from the applied input to the memory for the next call.
        """
        model, n = self.law.model, q.shape[-1]
        started, residual, last_momentum, last_force = memory.split([1, n, n, n], dim=-1)
        momentum, A = model.momentum(q, v), model.input_matrix(q)
        # The part of dp/dt without the input: C^T v - G - D v.
        state = torch.cat([q, momentum], dim=-1)
        force = model.momentum_derivative(state, torch.zeros_like(u))[..., n:]
        modeled = last_force + 0.5 * (force + matvec(A, last))
        disturbance = (momentum - last_momentum) / period - modeled
        change = -math.expm1(-self.bandwidth * period) * (disturbance - residual)
        limit = self.max_rate * period
        if math.isfinite(limit):
            change = change.clamp(-limit, limit)
        residual = residual + started * change

        def finish(applied: Tensor) -> Tensor:
            half = 0.5 * (force + matvec(A, applied))
            return torch.cat([torch.ones_like(started), residual, momentum, half], dim=-1)

        return u - pseudo_inverse_times(A, residual), finish

    def replace_input(self, u: Tensor) -> None:
        """Set the input that acts in place of that of the latest call, ``(*batch, M)``."""
        self._u = u

    def diagnostics(self) -> dict[str, Tensor]:
        """Return the law's diagnostics and ``compensation``, |A^+ r| in the units of u."""
        if self.residual is None:
            return {}
        return self.law.diagnostics() | {"compensation": self._size}

    def faults(self) -> dict[str, Tensor]:
        return self.law.faults()
