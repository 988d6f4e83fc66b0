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
from pinn_dyn.mechanics import InputSolver
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.models.oscillators import Linearization

_PROCESS = 1e-3  # standard deviation of unknown inputs, in those of the data
_TOLERANCE = 1e-5  # of q(u_d) at the first call
_RANK = 1e-3  # singular values below this share of the largest are zero


class LatentLaw(Controller):
    r"""Regulation and tracking in the coordinates z of :class:`CoupledOscillators`::

        u = u_d + K_P psi (z_d - z) + K_D psi (z_d' - z'),    psi = S C^+ F^T,    C = F^T H^-1 F
        q(u_d) = q_ref - d,    z_d = z(u_d),    z_d' = H^-1 F J^+ v_ref,    J = dq/du

    q(u) and z(u) are the equilibrium of the model under a constant input u. F = df/du at u_d and
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
    the model. d does not wind up while the motors are at their limits, since the model knows u.

    u_d takes one step of Newton's method per call, after all steps at the first call. With a dead
    time, the feedback uses the state that the model predicts at its end.

    Assumptions: the robot starts at rest with a known input; the loop is stable, which is not
    proven under sampling, dead time and errors of the model: simulate it.

    Source: Stölzle and Della Santina (2024) for the shaped potential and the collocated damping;
    Pannocchia and Rawlings (2003), "Disturbance models for offset-free model-predictive control".

    Args:
        model: the model, in float64.
        position_gain: K_P, a factor of the stiffness against the inputs, without a unit.
        velocity_gain: K_D, s.
        integral_gain: bandwidth of d, 1/s.
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
        limits = self.actuator.low, self.actuator.high
        self._solver = InputSolver(tolerance=_TOLERANCE, low=limits[0], high=limits[1])
        self._first_input = torch.as_tensor(first_input, dtype=torch.float64)
        M, N = self.num_inputs, self.num_coordinates
        self._u_mean, self._u_std = model.mean[-M:], model.std[-M:]
        self._q_std, self._center = model.std[:N], model.linearize(model.mean[-M:])
        self.reset()

    def reset(self) -> None:
        self._time, self._period = math.nan, 0.0
        self._past: list[Tensor] = []  # inputs, the latest last
        self._residual: Tensor | None = None

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

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch.

        Raises:
            ValueError: if the period changes.
        """
        q_ref, v_ref = (x.expand_as(q) for x in reference[:2])
        with torch.no_grad():
            if not self._past or self._past[-1].shape[:-1] != q.shape[:-1]:
                self._start(q, v, q_ref)
            else:
                self._observe(t, q)
            at = self._target(q_ref)
            x = self._predicted()
            u = self._u_d + self._u_std * self._feedback(at, x, v_ref)
            u = self.actuator.limit(u, self._past[-1] if self._period else None, self._period)
        self._time = t
        self._past.append(u)
        return u

    def _start(self, q: Tensor, v: Tensor, q_ref: Tensor) -> None:
        """Encode the first state, and find the input that holds the reference."""
        model, n = self.model, self.model.past_steps
        self.reset()
        u = self._first_input.expand(*q.shape[:-1], self.num_inputs)
        past = [x.repeat(*[1] * (x.ndim - 1), n) for x in (q, u)]
        self._x = model.start(q, v, u, *past)[..., : 2 * len(model.bias)]
        self._d = q - model.observe(self._x)
        self._past = [u]
        typical = self._u_mean.expand_as(u)
        self._z_d: Tensor | None = None
        self._u_d = self._solver(lambda u: model.rest(u)[1], q_ref - self._d, typical).u

    def _observe(self, t: float, q: Tensor) -> None:
        """Move the estimate by a period with the inputs that acted, after its correction."""
        if not self._period:
            self._period = t - self._time
            self._gain, _ = self.observer_gain(self._period)
            self._flow = self.model.flow(self._period / self.model.fixed_step)
        if abs(t - self._time - self._period) > 1e-6 * self._period:
            raise ValueError(f"the period of the law changed at {t:g} s: reset() the law before")
        wait = self.dead_time / self._period
        whole = int(wait + 1e-9)
        share = wait - whole  # of the period, in which the older input acts
        newer, older = (self._past[max(len(self._past) - 1 - k, 0)] for k in (whole, whole + 1))
        del self._past[: -whole - 2]
        self._x = self._moved(self._x, self._flow, newer.lerp(older, share))
        error = (q - self.model.observe(self._x) - self._d) / self._q_std
        change = error @ self._gain.mT
        states = self._x.shape[-1]
        self._x = self._x + change[..., :states]
        self._d = self._d + self._q_std * change[..., states:]

    def _moved(self, x: Tensor, flow: tuple[Tensor, Tensor], u: Tensor) -> Tensor:
        force = self.model.latent_force(u) - self.model.coupling_force(x[..., : x.shape[-1] // 2])
        return x @ flow[0].mT + force @ flow[1].mT

    def _predicted(self) -> Tensor:
        """Return the state at the end of the dead time, under the mean input until then."""
        if not self.dead_time or not self._period:
            return self._x
        waiting = math.ceil(self.dead_time / self._period - 1e-9)
        u = torch.stack(self._past[-waiting:]).mean(0)
        flow = self.model.flow(self.dead_time / self.model.fixed_step)
        return self._moved(self._x, flow, u)

    def _target(self, q_ref: Tensor) -> Linearization:
        """Take a step of Newton's method to the input that holds q_ref - d."""
        at = self.model.linearize(self._u_d, self._z_d)
        self._z_d = at.z
        self._residual = torch.linalg.vector_norm((q_ref - self._d - at.q) / self._q_std, dim=-1)
        step = matvec(self._inverse_gain(at), (q_ref - self._d - at.q) / self._q_std)
        self._u_d = self.actuator.limit(self._u_d + self._u_std * step.clamp(-1.0, 1.0))
        return at

    def _inverse_gain(self, at: Linearization) -> Tensor:
        """Return J^+ of the normalized q and u, ``(*batch, M, N)``."""
        output = at.output[..., : at.z.shape[-1]] / self._q_std[:, None]
        J = output @ torch.linalg.solve(at.stiffness, at.input * self._u_std)
        return torch.linalg.pinv(J, rtol=_RANK)

    def _feedback(self, at: Linearization, x: Tensor, v_ref: Tensor) -> Tensor:
        """Return (u - u_d) / S from the mean state of the coming period, which it changes."""
        F = at.input * self._u_std
        compliant = torch.linalg.solve(at.stiffness, F)
        psi = torch.linalg.pinv(F.mT @ compliant, rtol=_RANK, hermitian=True) @ F.mT
        # Velocities and the velocity gain are those per step of the model.
        step = self.model.fixed_step
        rate_d = step * matvec(compliant @ self._inverse_gain(at), v_ref / self._q_std)
        (z, rate), ratio, effect = x.chunk(2, dim=-1), self._period / step, torch.zeros_like(F)
        if ratio:
            later = self._moved(x, self._flow, self._u_d)
            rate = (later[..., : z.shape[-1]] - z) / ratio
            effect = self._flow[1][: z.shape[-1]] @ F / ratio
        position, velocity = self.position_gain, self.velocity_gain / step
        wanted = position * (at.z - z - ratio / 2 * rate) + velocity * (rate_d - rate)
        change = (ratio / 2 * position + velocity) * psi @ effect
        one = torch.eye(self.num_inputs).to(change)
        return torch.linalg.solve(one + change, matvec(psi, wanted).unsqueeze(-1))[..., 0]

    def diagnostics(self) -> dict[str, Tensor]:
        """Return ``static_residual``: |q(u_d) - q_ref + d| in standard deviations of q."""
        return {} if self._residual is None else {"static_residual": self._residual}
