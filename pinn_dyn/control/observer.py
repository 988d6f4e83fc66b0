"""A disturbance observer that estimates and compensates the model error of a law."""

from __future__ import annotations

import math
from typing import Any

import torch
from pydantic import PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Stage, Step, Wrapper
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec, pseudo_inverse_times
from pinn_dyn.models import CoulombFriction

_CHUNK = 4096  # samples whose terms are computed at once


class MomentumObserver:
    """Generalized-momentum observer of the force d that a model does not explain::

        dp/dt = f(q, v) + A(q) u + d,   p = M(q) v,   f = d(v^T M v / 2)/dq - G - D v - F(v)
        r(t) = K_O (p(t) - p(0) - integral from 0 to t of (f + A u + r) ds)

    so dr/dt = K_O (d - r): r is the low-pass filtered d. In discrete time with the period T::

        r_k+1 = r_k + limited((1 - exp(-K_O T)) (d_k - r_k)),   r_0 = 0
        d_k = (p_k+1 - p_k) / T - (f_k + f_k+1 + A_k u_k + A_k+1 u_k+1) / 2

    where each entry is limited to max_rate T. The force of the inputs need not be linear in u.

    With ``rest``, dry friction is that of rollouts with sticking friction, see
    :class:`~pinn_dyn.mechanics.sliding.Sliding`. A moving joint has its sliding friction. The
    friction of a joint that reverses, or is slower than ``rest``, lies between the sliding friction
    of both directions; d_k uses the value in this range that brings r_k+1 closest to zero.

    Source: De Luca and Mattone 2005, Sensorless robot collision detection and hybrid force/motion
    control; Haddadin, De Luca, Albu-Schaeffer 2017, Robot collisions: a survey. Not in the paper.

    Args:
        model: the model.
        bandwidth: K_O, 1/s.
        max_rate: largest rate of change of each entry of r, N/s or Nm/s; None for no limit.
        rest: speeds below which joints count as at rest, ``(N,)``, rad/s or m/s; None for a model
            without sticking friction.

    Attributes:
        memory_size: length of the memory of :meth:`estimate`.
    """

    def __init__(
        self,
        model: MechanicalSystem,
        bandwidth: float | Tensor,
        *,
        max_rate: float | None = None,
        rest: Tensor | None = None,
    ):
        self.model, self.bandwidth, self.rest = model, bandwidth, rest
        self.max_rate = math.inf if max_rate is None else float(max_rate)
        self.memory_size = 1 + (3 if rest is None else 5) * model.num_coordinates

    def estimate(
        self,
        q: Tensor,
        v: Tensor,
        begin: Tensor,
        end: Tensor,
        memory: Tensor,
        period: float | Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return r and the memory for the next call.

        Args:
            q, v: state, ``(*batch, N)``.
            begin, end: force of the inputs at the start and the end of the period, ``(*batch, N)``.
            memory: zero before the first call; later 1, r, M v, f and the bounds of dry friction.
            period: T, s.
        """
        n = q.shape[-1]
        started, residual, last = memory.split([1, n, self.memory_size - 1 - n], dim=-1)
        terms = self._terms(q, v)
        disturbance = self._disturbance(terms, last, begin + end, period)
        change = self._change(residual, period, *disturbance)
        residual = residual + torch.where(started > 0.5, change, 0.0)
        return residual, torch.cat([torch.ones_like(started), residual, terms], dim=-1)

    def observe(
        self, q: Tensor, v: Tensor, u: Tensor, period: float, *, hold: bool = False
    ) -> Tensor:
        """Return r at all samples of a motion, ``(T, N)``.

        Args:
            q, v: states at the times k T, ``(T, N)``.
            u: inputs at these times, ``(T, M)``.
            period: T, s.
            hold: true if inputs are held until the next sample, false if they are interpolated.
        """
        before = torch.cat([u[:1], u[:-1]]) if hold else u
        driven = self.driven(q, v, u)[:-1] + self.driven(q, v, before)[1:]
        chunks = zip(q.split(_CHUNK), v.split(_CHUNK), strict=True)
        terms = torch.cat([self._terms(*chunk) for chunk in chunks])
        disturbance = self._disturbance(terms[1:], terms[:-1], driven, period)
        residuals = [torch.zeros_like(q[0])]
        for values in zip(*disturbance, strict=True):
            residuals.append(residuals[-1] + self._change(residuals[-1], period, *values))
        return torch.stack(residuals)

    def _terms(self, q: Tensor, v: Tensor) -> Tensor:
        """Return M v and f = C^T v - G - D v - F, ``(*batch, 2N)``.

        With ``rest``, f does not include the dry friction F, whose smallest and largest value
        follow, ``(*batch, 4N)``.
        """
        momentum = self.model.momentum(q, v)
        state = torch.cat([q, momentum], dim=-1)
        no_input = q.new_zeros(*q.shape[:-1], self.model.num_inputs)
        force = self.model.momentum_derivative(state, no_input)[..., q.shape[-1] :]
        if self.rest is None:
            return torch.cat([momentum, force], dim=-1)
        force = force + self.model.friction_force(v)
        forward, resting = (v > 0).to(v), v.abs() < self.rest
        shares = (torch.where(resting, end, forward) for end in (0.0, 1.0))
        band = [self.model.sliding_force(v, share) for share in shares]
        return torch.cat([momentum, force, *band], dim=-1)

    def driven(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force that the input adds, ``(*batch, N)``."""
        no_input = self.model.applied_force(q, v, torch.zeros_like(u))
        return self.model.applied_force(q, v, u) - no_input

    def _disturbance(
        self, terms: Tensor, last: Tensor, driven: Tensor, period: float | Tensor
    ) -> tuple[Tensor, ...]:
        """Return d_k without dry friction, and with ``rest`` the bounds of the dry friction.

        Args:
            terms, last: :meth:`_terms` at the end and at the start of the period.
            driven: sum of the forces of the inputs at both times.
            period: T, s.
        """
        n = driven.shape[-1]
        (momentum, force, *band), (last_momentum, last_force, *last_band) = (
            x.split(n, dim=-1) for x in (terms, last)
        )
        modeled = 0.5 * (last_force + force + driven)
        disturbance = (momentum - last_momentum) / period - modeled
        if not band:
            return (disturbance,)
        low, high = torch.minimum(band[0], last_band[0]), torch.maximum(band[1], last_band[1])
        return disturbance, low, high

    def _change(
        self, residual: Tensor, period: float | Tensor, disturbance: Tensor, *friction: Tensor
    ) -> Tensor:
        """Return r_k+1 - r_k for the results of :meth:`_disturbance`."""
        exponent = -self.bandwidth * period
        gain = -(exponent.expm1() if isinstance(exponent, Tensor) else math.expm1(exponent))
        if friction:
            balance = residual - residual / gain - disturbance  # friction for which r_k+1 = 0
            disturbance = disturbance + torch.clamp(balance, *friction)
        change = gain * (disturbance - residual)
        limit: Any = self.max_rate * period
        return change.clamp(-limit, limit) if math.isfinite(self.max_rate) else change


class DisturbanceObserver(Wrapper):
    """A law corrected by a :class:`MomentumObserver`::

        u = u_law - A^+(q) r

    The disturbance is the force that the model does not explain: errors of M, G, D, F and A, a
    payload, a contact. The observer uses the applied input; limits of the actuator therefore do
    not count as a disturbance.

    Stability for a square A: with a = 1 - exp(-K_O T) and mu the largest eigenvalue of M_L M^-1
    (model M_L, plant M), the loop is stable for a mu < 2. An unknown dead time of n periods reduces
    this for M_L = M to a < 2 sin(pi / (4 n + 2)). In an unstable loop, r alternates within
    max_rate T.

    Assumptions: d changes little within 1 / K_O, u acts without a dead time, and A has full rank.

    The report has ``compensation``, |A^+ r| in the units of u.

    Args:
        law: the law to correct; the observer uses its model and its A^+.
        bandwidth: K_O, 1/s.
        max_rate: largest rate of change of each entry of r, N/s or Nm/s; None for no limit.

    Raises:
        TypeError: if the law has no mechanical system.
        ValueError: if the force of the model is not linear in the input.
    """

    def __init__(
        self,
        law: Stage,
        bandwidth: PositiveFloat,
        *,
        max_rate: PositiveFloat | None = None,
    ):
        model = law.model
        if not isinstance(model, MechanicalSystem):
            kind = "none" if model is None else f"a {type(model).__name__}"
            raise TypeError(
                f"the observer needs a model with terms M, G and A, and {type(law).__name__} has "
                f"{kind}: remove the observer"
            )
        if not model.input_affine:
            raise ValueError(
                "the observer needs a force A(q) u, but the force of this model is not linear in "
                "u: remove controllers.<law>.observer"
            )
        self.observer = MomentumObserver(model, bandwidth, max_rate=max_rate)
        n, m = model.num_coordinates, model.num_inputs
        self._sizes = [self.observer.memory_size, n * m, m]
        super().__init__(law, sum(self._sizes))

    def about(self) -> dict[str, Any]:
        return {**self.law.about(), "observer": {"bandwidth": self.observer.bandwidth}}

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        observed, last, change, inner = memory.split([*self._sizes, self.law.memory_size], dim=-1)
        u, after, report = Step(*self.law.step(q, v, reference, applied + change, inner))
        A = self.model.input_matrix(q)
        begin = matvec(last.unflatten(-1, A.shape[-2:]), applied)
        end = matvec(A, applied)
        residual, observed = self.observer.estimate(q, v, begin, end, observed, self.period)
        compensation = pseudo_inverse_times(A, residual)
        size = compensation.square().sum(-1).sqrt()
        A = A.flatten(-2).expand(*q.shape[:-1], -1)
        memory = torch.cat([observed, A, compensation, after], dim=-1)
        return Step(u - compensation, memory, {**report, "compensation": size})


def rest_speeds(model: MechanicalSystem) -> Tensor | None:
    """Return the speeds ``(N,)`` below which joints count as at rest.

    These are the widths of the model's Coulomb law. None for a model whose joints do not stick.
    """
    laws = [x for x in model.modules() if isinstance(x, CoulombFriction) and x.sticking]
    return torch.stack([law.width().detach() for law in laws]).amax(0) if laws else None
