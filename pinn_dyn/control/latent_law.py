"""Control of a robot by a model in latent coordinates, for soft robots that motors drive."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import scipy.linalg
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.effects import Actuator
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import CoupledOscillators

_PROCESS = 1e-3  # standard deviation of unknown inputs, in those of the data
_BANDWIDTH = 0.2  # smallest bandwidth of q_s times the step of the model
_NEWTON_STEPS = 2  # per call, to z_d
_ROUNDING = 1e-9  # of periods
_RANK = 1e-3  # singular values below this share of the largest are zero


class LatentLaw(Controller):
    r"""Regulation and tracking in the coordinates z of :class:`CoupledOscillators`::

        u = u_d + K_P psi (z_d - z) + K_D psi (z_d' - z'),    psi = S C^+ F^T,    C = F^T H^-1 F
        q(u_d) = q_s - d,    z_d = z(u_d),    z_d' = H^-1 F J^+ v_ref,    J = dq/du
        dq_s/dt = v_ref + max(K_I, 0.2/T) (q_ref - q_s),    q_s = q at the first call

    Inputs are constant over a period, f(u, 0). q(u) and z(u) are the equilibrium of the model under
    a constant input u. F = df/du at u_d and
    the Hessian H of the potential belong to z_d. Inputs are divided by their standard deviations S
    in the data. The feedback is collocated: F^T z' does the work of the inputs, and C^+ is positive
    semi-definite. z and z' are the means of the coming period, which follow from u, so that the
    linearized model loses energy at u_d = const for all gains and periods.

    The latent state and a disturbance d of the output follow from the measured q::

        x_{k+1} = step(x_k, u_k) + L_x r_k,   d_{k+1} = d_k + L_d r_k,   r = q - q(x) - d

    with the gain L of the stationary Kalman filter of the linearized model at the mean input, where
    d is a random walk. Since the linearized model is stable by construction, (x, d) is detectable,
    and the eigenvalues of the error are inside the unit circle (:meth:`observer_poles`). d is the
    integral action: if the loop comes to rest, q = q_ref - d + d = q_ref, whatever the errors of
    the model. K_I is the bandwidth of d. The set point q_s is filtered against overshoot, with the
    step T of the model, and follows smooth references without a lag. d does not wind up while the
    motors are at their limits, since the model knows u.

    A call takes one step of Newton's method to u_d, which starts at the first input, and two steps
    to z_d. With a dead time, the feedback uses the state that the model predicts at its end.

    Assumptions: the robot starts at rest with a known input; the loop is stable, which is not
    proven under sampling, dead time and errors of the model: simulate it.

    Source: Stölzle and Della Santina (2024) for the shaped potential and the collocated damping;
    Pannocchia and Rawlings (2003), "Disturbance models for offset-free model-predictive control".

    Args:
        model: the model, in float64.
        position_gain: K_P, a factor of the stiffness against the inputs, without a unit.
        velocity_gain: K_D, s.
        integral_gain: K_I, 1/s.
        dead_time: time after which an input acts, s.
        noise: standard deviation of measured q, in those of the training data.
        first_input: input before the first call, one number or M.
        actuator: limits of u; an object of its own, since limits of the rate have a memory.

    Raises:
        TypeError: on another model.
    """

    def __init__(
        self,
        model: CoupledOscillators,
        position_gain: NonNegativeFloat = 0.3,
        velocity_gain: NonNegativeFloat = 0.0,
        integral_gain: PositiveFloat = 10.0,
        *,
        dead_time: NonNegativeFloat = 0.0,
        noise: Annotated[float, Field(gt=0)] = 0.01,
        first_input: float | list[float] = 0.0,
        actuator: Actuator | None = None,
    ):
        if not isinstance(model, CoupledOscillators):
            raise TypeError(f"model is a {type(model).__name__}, expected CoupledOscillators")
        super().__init__(model.num_coordinates, model.num_inputs)
        self.model, self.dead_time, self.noise = model, dead_time, noise
        self.position_gain, self.velocity_gain = float(position_gain), float(velocity_gain)
        self.integral_gain = float(integral_gain)
        self.actuator = actuator or Actuator()
        self._first_input = torch.as_tensor(first_input, dtype=torch.float64)
        M, N = self.num_inputs, self.num_coordinates
        self._u_mean, self._u_std = model.mean[-M:], model.std[-M:]
        self._q_std, self._center = model.std[:N], model.linearize(model.mean[-M:])
        self._first_target = model.rest(self._first_input.expand(M))[0]
        n = len(model.bias)
        self._sizes = [1, 2 * n, N, N, M, n]
        self.memory_size = sum(self._sizes)
        self.prepare(model.fixed_step)
        self.reset()

    def reset(self) -> None:
        self._time, self._is_second_call = math.nan, False
        self._memory = self._u_mean.new_zeros(0, 0, 0, 0)
        self._residual: Tensor | None = None
        self._past = self._first_input

    def observer_gain(self, period: PositiveFloat) -> tuple[Tensor, Tensor]:
        """Return L ``(2n + N, N)`` and the matrix of the error of (x, d) for a period in s."""
        A, B = self.model.transition(self._center, period / self.model.fixed_step)
        S, N = len(A), self.num_coordinates
        rate = -math.expm1(-self.integral_gain * period)
        drift = self.noise * rate / math.sqrt(1 - rate)  # gain of a single random walk: rate
        B = B * self._u_std * _PROCESS
        process = torch.block_diag(B @ B.mT, drift**2 * torch.eye(N).double())
        process = process + 1e-12 * torch.eye(S + N).double()
        F = torch.block_diag(A, torch.eye(N).double())
        C = torch.cat([self._center.output / self._q_std[:, None], torch.eye(N).double()], dim=1)
        R = self.noise**2 * torch.eye(N).double()
        P = torch.from_numpy(
            scipy.linalg.solve_discrete_are(*(x.numpy() for x in (F.mT, C.mT, process, R)))
        )
        L = F @ torch.linalg.solve(C @ P @ C.mT + R, C @ P).mT
        return L, F - L @ C

    def observer_poles(self, period: PositiveFloat) -> np.ndarray:
        """Return the eigenvalues of the error of the observer over a period in s."""
        return np.linalg.eigvals(self.observer_gain(period)[1].numpy())

    def prepare(self, period: PositiveFloat) -> None:
        """Compute the constants of a period in s."""
        self._period = period
        self._gain, _ = self.observer_gain(period)
        self._flow = self.model.flow(period / self.model.fixed_step)
        self._wait = self.model.flow(self.dead_time / self.model.fixed_step)
        self.stored_inputs = int(self.dead_time / period + _ROUNDING) + 2
        gains = self.position_gain, self.velocity_gain, self.integral_gain, self.noise
        settings = period, self.dead_time, gains, self.actuator, self._first_input.tolist()
        self._compiled = Compiled(self.model, settings)

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: if the period changes.
        """
        batch, M = q.shape[:-1], self.num_inputs
        with torch.no_grad():
            is_first = self._memory.shape[:-1] != batch
            if is_first:
                self.reset()
                self.prepare(self._period)
                self._memory = q.new_zeros(*batch, self.memory_size)
                self._past = self._first_input.expand(*batch, 1, M)
            else:
                self._require_period(t - self._time)
            lacking = max(self.stored_inputs - self._past.shape[-2], 0)
            older = self._past[..., :1, :].expand(*batch, lacking, M)
            past = torch.cat([older, self._past], dim=-2)[..., -self.stored_inputs :, :]
            motion = (x.expand_as(q) for x in reference[:2])
            rows = torch.cat([q, v, *motion, past.flatten(-2), self._memory], dim=-1)
            result = self._compiled.rows("law", self._row, rows)
            sizes = [M, self.memory_size, 1]
            u, self._memory, residual = result.split(sizes, dim=-1)
            last = None if is_first else past[..., -1, :]
            u = self.actuator.limit(u, last, self._period)
        self._past = torch.cat([past, u.unsqueeze(-2)], dim=-2)
        self._time, self._residual = t, residual[..., 0]
        self._is_second_call = is_first
        return u

    def goal(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return x at the end of the dead time, u_d and z_d of the latest call."""
        _, x, _, _, u_d, z_d = self._memory.split(self._sizes, dim=-1)
        with torch.no_grad():
            return self._predicted(x, self._past[..., :-1, :]), u_d, z_d

    def replace_input(self, u: Tensor) -> None:
        """Store the input u ``(*batch, M)`` that acts instead of that of the latest call."""
        self._past = torch.cat([self._past[..., :-1, :], u.unsqueeze(-2)], dim=-2)

    def _require_period(self, period: float) -> None:
        """Prepare the period at the second call, and refuse another one later."""
        is_same = abs(period - self._period) <= 1e-6 * self._period
        if not is_same and not self._is_second_call:
            time = self._time + period
            raise ValueError(f"the period of the law changed at {time:g} s: reset() the law before")
        if not is_same:
            self.prepare(float(f"{period:.9g}"))

    def _row(self, rows: Tensor) -> Tensor:
        N, M = self.num_coordinates, self.num_inputs
        stored = self.stored_inputs * M
        sizes = [N, N, N, N, stored, self.memory_size]
        q, v, q_ref, v_ref, past, memory = rows.split(sizes, dim=-1)
        past = past.unflatten(-1, (-1, M))
        return torch.cat(self.law_of(q, v, q_ref, v_ref, past, memory), dim=-1)

    def law_of(
        self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, past: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return u without limits, the memory after the call and the residual.

        The operations do not depend on the numbers, so that the law has a file.

        Args:
            q, v, q_ref, v_ref: measurement and reference, ``(*batch, N)``.
            past: last inputs, the latest last, ``(*batch, stored_inputs, M)``.
            memory: ``(*batch, S)``, which is zero before the first call: 1, x, d, q_s, u_d and z_d.
        """
        started, x, d, q_s, u_d, z_d = memory.split(self._sizes, dim=-1)
        is_later = started > 0.5
        past = self.past_of(past, memory)
        first = self._first(q, v, self._first_input.expand(u_d.shape))
        later = (*self._observed(q, x, d, past), u_d, z_d)
        x, d, u_d, z_d = (torch.where(is_later, *y) for y in zip(later, first, strict=True))
        at = self.model.linearize(u_d, z_d, _NEWTON_STEPS)
        F = at.input * self._u_std
        compliant = torch.cholesky_solve(F, torch.linalg.cholesky_ex(at.stiffness).L)
        rate = max(self.integral_gain, _BANDWIDTH / self.model.fixed_step)
        decay = math.exp(-rate * self._period)
        q_s = torch.where(is_later, q_ref + decay * (q_s + self._period * v_ref - q_ref), q)
        error = (q_s - d - at.q) / self._q_std
        J = at.output[..., : at.z.shape[-1]] / self._q_std[:, None] @ compliant
        inverse = torch.linalg.pinv(J, rtol=_RANK)
        change = self._u_std * matvec(inverse, error).clamp(-1.0, 1.0)
        u_d = self.actuator.limit(u_d + change)
        rate_d = matvec(compliant @ inverse, v_ref / self._q_std)
        slopes, wanted = (F, compliant), (at.z, rate_d, u_d)
        u = u_d + self._u_std * self._feedback(self._predicted(x, past), is_later, *slopes, *wanted)
        memory = torch.cat([torch.ones_like(started), x, d, q_s, u_d, at.z], dim=-1)
        return u, memory, error.square().sum(-1, keepdim=True).sqrt()

    def past_of(self, past: Tensor, memory: Tensor) -> Tensor:
        """Return the last inputs, which are the first input before the first call."""
        return torch.where(memory[..., :1, None] > 0.5, past, self._first_input.expand(past.shape))

    def _first(self, q: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """Return x, d, u_d and z_d at rest with a known input."""
        past = (x.repeat(*[1] * (x.ndim - 1), self.model.past_steps) for x in (q, u))
        x = self.model.start(q, v, u, *past)[..., : 2 * len(self.model.bias)]
        z_d = self._first_target.expand(*x.shape[:-1], -1)
        return x, q - self.model.observe(x), u, z_d

    def _observed(self, q: Tensor, x: Tensor, d: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Move the estimate by a period with the inputs that acted, after its correction."""
        whole = self.stored_inputs - 2
        share = self.dead_time / self._period - whole  # of the period, for the older input
        newer, older = past[..., -1 - whole, :], past[..., -2 - whole, :]
        moved = self._moved(x, self._flow, newer.lerp(older, share))
        error = (q - self.model.observe(moved) - d) / self._q_std
        of_x, of_d = (error @ self._gain.mT).tensor_split([x.shape[-1]], dim=-1)
        return moved + of_x, d + self._q_std * of_d

    def _moved(self, x: Tensor, flow: tuple[Tensor, Tensor], u: Tensor) -> Tensor:
        force = self.model.latent_force(u) - self.model.coupling_force(x[..., : x.shape[-1] // 2])
        return x @ flow[0].mT + force @ flow[1].mT

    def _predicted(self, x: Tensor, past: Tensor) -> Tensor:
        """Return the state at the end of the dead time, under the mean input until then."""
        if not self.dead_time:
            return x
        waiting = math.ceil(self.dead_time / self._period - _ROUNDING)
        return self._moved(x, self._wait, past[..., -waiting:, :].mean(-2))

    def _feedback(
        self,
        x: Tensor,
        is_later: Tensor,
        F: Tensor,
        compliant: Tensor,
        z_d: Tensor,
        rate_d: Tensor,
        u_d: Tensor,
    ) -> Tensor:
        """Return (u - u_d) / S from the mean state of the coming period, which it changes.

        At the first call, it takes the present state. ``compliant`` is H^-1 F.
        """
        psi = torch.linalg.pinv(F.mT @ compliant, rtol=_RANK, hermitian=True) @ F.mT
        # Velocities and the velocity gain are those per step of the model.
        step = self.model.fixed_step
        z, rate = x.chunk(2, dim=-1)
        later = self._moved(x, self._flow, u_d)[..., : z.shape[-1]]
        rate = torch.where(is_later, (later - z) * step / self._period, rate)
        ratio = self._period / step * is_later.to(x)  # not of the default dtype
        position, velocity = self.position_gain, self.velocity_gain / step
        wanted = position * (z_d - z - ratio / 2 * rate) + velocity * (step * rate_d - rate)
        effect = self._flow[1][: z.shape[-1]] @ F / (self._period / step)
        change = (ratio.unsqueeze(-1) / 2 * position + velocity) * psi @ effect
        change = is_later.unsqueeze(-1) * change
        one = torch.eye(self.num_inputs).to(change)
        return torch.linalg.solve(one + change, matvec(psi, wanted).unsqueeze(-1))[..., 0]

    def diagnostics(self) -> dict[str, Tensor]:
        """Return ``static_residual``: |q(u_d) - q_s + d| in standard deviations of q."""
        return {} if self._residual is None else {"static_residual": self._residual}
