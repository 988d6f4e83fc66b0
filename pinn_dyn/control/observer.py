"""A disturbance observer that measures and compensates the error of a model-based law."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import ModelBasedLaw
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec, pseudo_inverse_times
from pinn_dyn.models import CoulombFriction

_CHUNK = 4096  # samples whose terms are computed at once


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

    :meth:`estimate` and :meth:`observe` give r alone, without a law. With ``rest``, the law is that
    of sticking rollouts (:class:`~pinn_dyn.mechanics.sliding.Sliding`): dry friction is sliding
    friction, and anything between both directions for joints slower than ``rest`` or that reverse.
    In d_k, it is the value in this range that brings r_k+1 closest to zero.

    Stability for a square A: with a = 1 - exp(-K_O T) and mu the largest eigenvalue of M_L M^-1
    (model M_L, plant M), the loop is stable for a mu < 2. An unknown dead time of n periods reduces
    this for M_L = M to a < 2 sin(pi / (4 n + 2)). Beyond, r alternates within max_rate T.

    Assumptions: d changes little within 1 / K_O, u reaches the plant at once, and A has full rank.

    Source: De Luca and Mattone 2005, Sensorless robot collision detection and hybrid force/motion
    control; Haddadin, De Luca, Albu-Schaeffer 2017, Robot collisions: a survey. Not in the paper.

    Args:
        law: the law to correct; the observer uses its model and its A^+. A model alone gives an
            observer that has no law to correct.
        bandwidth: K_O, 1/s.
        max_rate: largest rate of change of each entry of r, N/s or Nm/s; None for no limit.
        actuator: limits of the plant's input, so that r does not wind up in saturation. Give an
            object of its own, since limits of the rate have a memory. u itself is not limited.
        rest: speed below which a joint counts as at rest, ``(N,)``, rad/s or m/s; None for none.

    Raises:
        ValueError: on a law of a model whose force is not linear in the input.

    Attributes:
        residual: r of the latest call, ``(*batch, N)``, N or Nm; None before the first call.
        bandwidth, max_rate: as above; the rate is infinite without a limit.
    """

    law: ModelBasedLaw
    _finish: Callable[[Tensor], Tensor]
    _u: Tensor

    def __init__(
        self,
        law: ModelBasedLaw | MechanicalSystem,
        bandwidth: PositiveFloat | Tensor,
        *,
        max_rate: PositiveFloat | None = None,
        actuator: Actuator | None = None,
        rest: Tensor | None = None,
    ):
        super().__init__(law.num_coordinates, law.num_inputs)
        if isinstance(law, MechanicalSystem):
            self.model = law
        else:
            self.law, self.model = law, law.model
            if not law.model.input_affine:
                raise ValueError(
                    "the observer needs a force A(q) u: remove controllers.<law>.observer"
                )
        self.bandwidth = bandwidth
        self.rest = rest
        self.max_rate = math.inf if max_rate is None else float(max_rate)
        self._actuator = actuator
        self.memory_size = 1 + (3 if rest is None else 5) * law.num_coordinates
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
        A = self.model.input_matrix(q)
        residual, finish = self.estimate(q, v, last, memory, period, A)
        return u - pseudo_inverse_times(A, residual), finish

    def estimate(
        self,
        q: Tensor,
        v: Tensor,
        last: Tensor,
        memory: Tensor,
        period: float | Tensor,
        A: Tensor | None = None,
    ) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Return r and a function from the applied input to the memory for the next call.

        Arguments as for :meth:`correct`. A ``(*batch, N, M)`` saves its computation.
        """
        n = q.shape[-1]
        sizes = [1] + [n] * (self.memory_size // n)
        started, residual, last_momentum, last_force, *last_band = memory.split(sizes, dim=-1)
        momentum, force = self._momentum_and_force(q, v)
        modeled = last_force + 0.5 * (force + self._driven(q, v, last, A))
        disturbance = (momentum - last_momentum) / period - modeled
        band = self._friction_band(v)
        change = self._change(disturbance, residual, period, *_joined(band, last_band))
        residual = residual + started * change

        def finish(applied: Tensor) -> Tensor:
            half = 0.5 * (force + self._driven(q, v, applied, A))
            return torch.cat([torch.ones_like(started), residual, momentum, half, *band], dim=-1)

        return residual, finish

    def observe(
        self, q: Tensor, v: Tensor, u: Tensor, period: float, *, hold: bool = False
    ) -> Tensor:
        """Return r at all samples of a motion, ``(T, N)``.

        Args:
            q, v: states at the times k T, ``(T, N)``.
            u: inputs at these times, ``(T, M)``.
            period: T, s.
            hold: true for inputs that are held until the next sample, instead of lines between.
        """
        before = torch.cat([u[:1], u[:-1]]) if hold else u
        rows = zip(*(x.split(_CHUNK) for x in (q, v)), strict=True)
        parts = [self._momentum_and_force(*row) for row in rows]
        momentum, force = (torch.cat(x) for x in zip(*parts, strict=True))
        ending, starting = (force + self._driven(q, v, x) for x in (before, u))
        disturbance = momentum.diff(dim=0) / period - 0.5 * (ending[1:] + starting[:-1])
        band = self._friction_band(v)
        ranges = _joined([x[1:] for x in band], [x[:-1] for x in band])
        residuals = [torch.zeros_like(q[0])]
        for value, *friction in zip(disturbance, *ranges, strict=True):
            change = self._change(value, residuals[-1], period, *friction)
            residuals.append(residuals[-1] + change)
        return torch.stack(residuals)

    def _momentum_and_force(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return p = M v and f, the part of dp/dt without the input: C^T v - G - D v - F.

        With ``rest``, f is without the dry friction F.
        """
        momentum = self.model.momentum(q, v)
        state = torch.cat([q, momentum], dim=-1)
        no_input = q.new_zeros(*q.shape[:-1], self.num_inputs)
        force = self.model.momentum_derivative(state, no_input)[..., q.shape[-1] :]
        return momentum, force if self.rest is None else force + self.model._friction_force(v)

    def _driven(self, q: Tensor, v: Tensor, u: Tensor, A: Tensor | None = None) -> Tensor:
        """Return the force that the input adds, ``(*batch, N)``."""
        if A is not None:
            return matvec(A, u)
        no_input = self.model._applied_force(q, v, torch.zeros_like(u))
        return self.model._applied_force(q, v, u) - no_input

    def _friction_band(self, v: Tensor) -> list[Tensor]:
        """Return the least and the largest dry friction at v, ``(*batch, N)``; [] without rest."""
        if self.rest is None:
            return []
        forward, resting = (v > 0).to(v), v.abs() < self.rest
        shares = (torch.where(resting, end, forward) for end in (0.0, 1.0))
        return [self.model._sliding_force(v, share) for share in shares]

    def _change(
        self, disturbance: Tensor, residual: Tensor, period: float | Tensor, *friction: Tensor
    ) -> Tensor:
        """Return r_k+1 - r_k, with the least and largest friction that d does not contain yet."""
        exponent = -self.bandwidth * period
        gain = -(exponent.expm1() if isinstance(exponent, Tensor) else math.expm1(exponent))
        if friction:
            holding = residual - residual / gain - disturbance  # r_k+1 would be zero
            disturbance = disturbance + torch.clamp(holding, *friction)
        change = gain * (disturbance - residual)
        limit: Any = self.max_rate * period
        return change.clamp(-limit, limit) if math.isfinite(self.max_rate) else change

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


def _joined(band: list[Tensor], last_band: list[Tensor]) -> tuple[Tensor, ...]:
    """Return the least and the largest friction between two instants; () without bands."""
    if not band:
        return ()
    return torch.minimum(band[0], last_band[0]), torch.maximum(band[1], last_band[1])


def rest_speeds(model: MechanicalSystem) -> Tensor | None:
    """Return the speeds ``(N,)`` below which joints of a model with stiction count as at rest.

    These are the widths of its Coulomb law. None for a model whose joints do not stick.
    """
    laws = [x for x in model.modules() if isinstance(x, CoulombFriction) and x.sticking]
    return torch.stack([law.width().detach() for law in laws]).amax(0) if laws else None
