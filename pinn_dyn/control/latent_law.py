"""Control of motor-driven soft robots by a model in latent coordinates."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import scipy.linalg
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Setting, Stage, Step
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import CoupledOscillators

_PROCESS = 1e-3  # standard deviation of unknown inputs, in those of the data
_BANDWIDTH = 0.2  # smallest bandwidth of q_s times the step of the model
_NEWTON_STEPS = 2  # Newton steps to z_d per call
_ROUNDING = 1e-9  # error of a number of periods
_RANK = 1e-3  # singular values below this share of the largest are zero


class LatentLaw(Stage):
    r"""Regulation and tracking in the coordinates z of :class:`CoupledOscillators`::

        u = u_d + K_P psi (z_d - z) + K_D psi (z_d' - z'),    psi = S C^+ F^T,    C = F^T H^-1 F
        q(u_d) = q_s - d,    z_d = z(u_d),    z_d' = H^-1 F J^+ v_ref,    J = dq/du
        dq_s/dt = v_ref + max(K_I, 0.2/T) (q_ref - q_s),    q_s = q before the first call

    q(u) and z(u) are the equilibrium of the model under a constant input u. The input is held over
    a period, so its force is f(u, 0), with F = df/du at u_d. H is the Hessian of the potential at
    z_d. S are the standard deviations of the inputs in the data, by which inputs are divided. The
    feedback is collocated: F^T z' does the work of the inputs, and C^+ is positive semi-definite.
    z and z' are means over the coming period as functions of u. The linearized model with constant
    u_d then loses energy for all gains and periods.

    The latent state and a disturbance d of the output follow from the measured q::

        x_{k+1} = step(x_k, u_k) + L_x r_k,   d_{k+1} = d_k + L_d r_k,   r = q - q(x) - d

    L is the gain of the stationary Kalman filter of the linearized model at the mean input, with a
    random walk of d. Since the linearized model is stable by construction, (x, d) is detectable,
    and the eigenvalues of the estimation error are inside the unit circle
    (:meth:`observer_poles`). d is the integral action with the bandwidth K_I: if the loop comes to
    rest, q = q_ref - d + d = q_ref for any model error. The filter of the set point q_s, with the
    step T of the model, avoids overshoot and follows smooth references without lag. d does not wind
    up while the motors are at their limits, since the model knows the applied u.

    A call takes one Newton step to u_d, which starts at the first input, and two steps to z_d. With
    a dead time, the feedback uses the state that the model predicts at the end of the dead time.

    Assumptions: the robot starts at rest with a known input, and the loop is stable. Stability is
    not proven under sampling, dead time and model errors: simulate the loop.

    Source: Stölzle and Della Santina (2024) for the shaped potential and the collocated damping;
    Pannocchia and Rawlings (2003), "Disturbance models for offset-free model-predictive control".

    The report has ``static_residual``, |q(u_d) - q_s + d| in standard deviations of q.

    Args:
        model: the model, in float64.
        position_gain: K_P, factor of the model's stiffness as felt at the inputs, without a unit.
        velocity_gain: K_D, s.
        integral_gain: K_I, 1/s.
        dead_time: delay of the inputs, s; None for that of the pipeline.
        noise: standard deviation of the noise of q, relative to that of q in the training data.
        first_input: input before the first call, one number or M.

    Raises:
        TypeError: if the model is not :class:`CoupledOscillators`.
    """

    needs_period, predicts = True, True

    def __init__(
        self,
        model: CoupledOscillators,
        position_gain: NonNegativeFloat = 0.3,
        velocity_gain: NonNegativeFloat = 0.0,
        integral_gain: PositiveFloat = 10.0,
        *,
        dead_time: NonNegativeFloat | None = None,
        noise: Annotated[float, Field(gt=0)] = 0.01,
        first_input: float | list[float] = 0.0,
    ):
        if not isinstance(model, CoupledOscillators):
            raise TypeError(f"model is a {type(model).__name__}, expected CoupledOscillators")
        super().__init__(model.num_coordinates, model.num_inputs)
        self.model, self.dead_time, self.noise = model, dead_time, noise
        self.position_gain, self.velocity_gain = float(position_gain), float(velocity_gain)
        self.integral_gain = float(integral_gain)
        self.first_input = first_input
        M, N = self.num_inputs, self.num_coordinates
        self._u_std, self._q_std = model.std[-M:], model.std[:N]
        self._center = model.linearize(model.mean[-M:])

    def at(self, setting: Setting) -> LatentLaw:
        law: LatentLaw = super().at(setting)
        law._set(setting)
        return law

    def _set(self, setting: Setting) -> None:
        period = setting.period
        self._actuator = setting.actuator
        self._late = setting.dead_time if self.dead_time is None else self.dead_time
        self._first_target = self.model.rest(setting.first_input)[0]
        self._gain, _ = self.observer_gain(period)
        self._flow = self.model.flow(period / self.model.fixed_step)
        self._wait = self.model.flow(self._late / self.model.fixed_step)
        self._stored = int(self._late / period + _ROUNDING) + 1
        n, N, M = len(self.model.bias), self.num_coordinates, self.num_inputs
        self._sizes = [2 * n, N, N, M, n, self._stored * M]
        self.memory_size = sum(self._sizes)

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the memory at rest under the input u: x, d, q_s, u_d, z_d and past inputs."""
        past = (x.repeat(*[1] * (x.ndim - 1), self.model.history_steps) for x in (q, u))
        x = self.model.start(q, v, u, *past)[..., : 2 * len(self.model.bias)]
        z_d = self._first_target.expand(*x.shape[:-1], -1)
        d = q - self.model.observe(x)
        return torch.cat([x, d, q, u, z_d, *[u] * self._stored], dim=-1)

    def observer_gain(self, period: PositiveFloat) -> tuple[Tensor, Tensor]:
        """Return L ``(2n + N, N)`` and the transition matrix of the error of (x, d).

        Both are for a period in s.
        """
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
        """Return the eigenvalues of the estimation error over a period in s."""
        return np.linalg.eigvals(self.observer_gain(period)[1].numpy())

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        x, d, q_s, u_d, z_d, before = memory.split(self._sizes, dim=-1)
        past = before.unflatten(-1, (-1, self.num_inputs))
        past = torch.cat([past, applied.unsqueeze(-2)], dim=-2)
        x, d = self._observed(q, x, d, past)
        at = self.model.linearize(u_d, z_d, _NEWTON_STEPS)
        F = at.input * self._u_std
        compliant = torch.cholesky_solve(F, torch.linalg.cholesky_ex(at.stiffness).L)
        rate = max(self.integral_gain, _BANDWIDTH / self.model.fixed_step)
        decay = math.exp(-rate * self.period)
        target, v_ref, _ = (y.expand_as(q) for y in reference)
        q_s = target + decay * (q_s + self.period * v_ref - target)
        error = (q_s - d - at.q) / self._q_std
        J = at.output[..., : at.z.shape[-1]] / self._q_std[:, None] @ compliant
        inverse = torch.linalg.pinv(J, rtol=_RANK)
        change = self._u_std * matvec(inverse, error).clamp(-1.0, 1.0)
        u_d = self._actuator.limit(u_d + change)
        rate_d = matvec(compliant @ inverse, v_ref / self._q_std)
        predicted = self._predicted(x, past)
        feedback = self._feedback(predicted, F, compliant, at.z, rate_d, u_d)
        memory = torch.cat([x, d, q_s, u_d, at.z, past[..., 1:, :].flatten(-2)], dim=-1)
        residual = error.square().sum(-1).sqrt()
        return Step(u_d + self._u_std * feedback, memory, {"static_residual": residual})

    def _observed(self, q: Tensor, x: Tensor, d: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Predict x and d by a period with the applied inputs, and correct them by q."""
        delay = self._stored - 1  # full periods
        share = self._late / self.period - delay  # part of the period with the older input
        newer, older = past[..., -1 - delay, :], past[..., -2 - delay, :]
        moved = self._moved(x, self._flow, newer.lerp(older, share))
        error = (q - self.model.observe(moved) - d) / self._q_std
        of_x, of_d = (error @ self._gain.mT).tensor_split([x.shape[-1]], dim=-1)
        return moved + of_x, d + self._q_std * of_d

    def _moved(self, x: Tensor, flow: tuple[Tensor, Tensor], u: Tensor) -> Tensor:
        force = self.model.latent_force(u) - self.model.coupling_force(x[..., : x.shape[-1] // 2])
        return x @ flow[0].mT + force @ flow[1].mT

    def _predicted(self, x: Tensor, past: Tensor) -> Tensor:
        """Return the state at the end of the dead time, under the mean of the waiting inputs."""
        if not self._late:
            return x
        waiting = math.ceil(self._late / self.period - _ROUNDING)
        return self._moved(x, self._wait, past[..., -waiting:, :].mean(-2))

    def _feedback(
        self, x: Tensor, F: Tensor, compliant: Tensor, z_d: Tensor, rate_d: Tensor, u_d: Tensor
    ) -> Tensor:
        """Return (u - u_d) / S from the mean state of the coming period.

        This state depends on u, so a linear equation is solved. ``compliant`` is H^-1 F.
        """
        psi = torch.linalg.pinv(F.mT @ compliant, rtol=_RANK, hermitian=True) @ F.mT
        # Velocities and the velocity gain are per step of the model.
        ratio = self.period / self.model.fixed_step
        z, _ = x.chunk(2, dim=-1)
        rate = (self._moved(x, self._flow, u_d)[..., : z.shape[-1]] - z) / ratio
        position, velocity = self.position_gain, self.velocity_gain / self.model.fixed_step
        error = position * (z_d - z - ratio / 2 * rate)
        error = error + velocity * (self.model.fixed_step * rate_d - rate)
        effect = self._flow[1][: z.shape[-1]] @ F / ratio
        change = (ratio / 2 * position + velocity) * psi @ effect
        identity = torch.eye(self.num_inputs).to(change)
        return torch.linalg.solve(identity + change, matvec(psi, error).unsqueeze(-1))[..., 0]
