"""Design of a motion that excites the constants of a rigid robot, within its limits."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.identification.designed_motion import DesignedMotion
from pinn_dyn.identification.motion_limits import Envelope, JointValues, MotionLimits
from pinn_dyn.identification.rigid_excitation import (
    base_columns,
    drive_regressor,
    motion_excitation,
)
from pinn_dyn.progress import Progress
from pinn_dyn.systems import RigidChain

log = logging.getLogger(__name__)

_DENSITY = 32  # samples in a period of the fastest sine
_SIZE = 0.3  # weight of the determinant against the condition number
_DRAWS, _STARTS = 32, 3
_BATCH = 8  # motions in memory at once
_UNLIMITED = 100.0  # Nm, scale of a torque without a limit
_PLAYED = 1000.0  # Hz, rate at which the limits hold


def design_excitation(
    urdf: str | RigidChain,
    limits: MotionLimits | Mapping[str, Any] | None = None,
    duration: PositiveFloat = 10.0,
    *,
    frequency: PositiveFloat = 0.8,
    start: JointValues = None,
    steps: PositiveInt = 150,
    seed: NonNegativeInt = 0,
) -> DesignedMotion:
    r"""Design a periodic motion that determines the base parameters of a robot well::

        q_i(t) = start_i + sum_l a_il/(w l) sin(w l t) + b_il/(w l) (1 - cos(w l t))
        minimize  log cond W - 0.3/b log det(W^T W / T)      W: regressor of b base parameters

    with w = 2 pi / duration. The motion starts and ends at rest at ``start``, with zero
    acceleration: sum_l a_il = 0 and sum_l l b_il = 0. W includes armatures and friction, see
    :func:`~pinn_dyn.identification.rigid_excitation.motion_excitation`; the condition number is
    that of columns of unit norm, and in the determinant a torque counts in units of its limit.

    Each joint is scaled to its limits of position, velocity and acceleration. Limits of the torque,
    by the inertias of the URDF without friction, and the height of the tip are penalized. Adam
    starts from the best of 32 random motions. The result is scaled down until all limits hold at
    1 kHz. Ctrl-C ends the search with the best motion so far. Collisions are not checked.

    Sources: Swevers et al. 1997, "Optimal robot excitation and identification"; Park 2006,
    "Fourier-based optimal excitation trajectories for the dynamic identification of robots".

    Args:
        urdf: path or text of the URDF, or a chain with locked joints, payload and so on.
        limits: limits that replace those of the URDF, as :class:`MotionLimits` or its arguments.
        duration: period, s.
        frequency: highest frequency of a sine, Hz.
        start: pose at the start, rad or m; the middle of the ranges by default.
        steps: steps of the search.
        seed: of the random motions.

    Raises:
        ValueError: if the URDF, the limits or the start cannot be used, or the duration is shorter
            than two periods of the highest frequency.
    """
    robot = RigidChain(urdf) if isinstance(urdf, str) else urdf
    if not isinstance(limits, MotionLimits):
        limits = MotionLimits(**(limits or {}))
    search = _Search(Envelope(robot, limits, start), duration, round(frequency * duration))
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randn(_DRAWS, robot.num_coordinates, search.size, generator=generator).double()
    with torch.no_grad():
        draws = torch.cat([search.shrunk(part) for part in draws.split(_BATCH)])
        scores = [search.score(part)[:2] for part in draws.split(_BATCH)]
    costs, conditions = (torch.cat(x) for x in zip(*scores, strict=True))
    order = costs.argsort()[:_STARTS]
    best, lowest = draws[order[0]], float("inf")
    weights = draws[order].requires_grad_()
    optimizer = torch.optim.Adam([weights], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    with Progress("design", steps, "steps") as progress:
        try:
            for step in range(steps):
                costs, numbers, violation = search.score(weights)
                total = costs + 1000 * violation
                k = int(total.argmin())
                if total[k].item() < lowest:
                    best, lowest = weights[k].detach().clone(), total[k].item()
                optimizer.zero_grad()
                total.sum().backward()
                optimizer.step()
                schedule.step()
                progress.update(step + 1, f", condition number {numbers[k].item():.3g}")
        except KeyboardInterrupt:
            log.warning("interrupted: the motion is the best so far")
    times = torch.arange(round(duration * _PLAYED) + 1).double() / _PLAYED
    q, v, a, tau = search.held(best, times)
    stride = max(1, len(times) // 2000)
    return DesignedMotion(
        envelope=search.envelope,
        t=times,
        q=q,
        v=v,
        a=a,
        tau=tau,
        excitation=motion_excitation(robot, q[::stride], v[::stride], a[::stride]),
        random_condition=float(conditions.median()),
    )


class _Search:
    """Fourier motions of P numbers for each joint, and their cost."""

    def __init__(self, envelope: Envelope, duration: float, harmonics: int):
        if harmonics < 2:
            raise ValueError(
                f"{duration:g} s are {harmonics} periods of the highest frequency, expected 2 or "
                "more: raise duration or frequency"
            )
        self.envelope, self.robot = envelope, envelope.robot
        self.base = torch.from_numpy(base_columns(self.robot))
        self.size = 2 * harmonics - 2
        order = torch.arange(1, harmonics + 1).double()
        self.rates = 2 * math.pi / duration * order
        rows = torch.zeros(2, 2 * harmonics).double()
        rows[0, :harmonics], rows[1, harmonics:] = 1, order
        self.rest = torch.linalg.svd(rows)[2][2:].T  # v = a = 0 at the ends
        count = _DENSITY * harmonics
        self.basis = self._basis(torch.arange(count).double() * duration / count)

    def _basis(self, t: Tensor) -> Tensor:
        """Return q, v and a of the P functions at times ``(T,)``, ``(3, T, P)``."""
        w, angle = self.rates, self.rates * t[:, None]
        sin, cos = angle.sin(), angle.cos()
        q, v = torch.cat([sin / w, (1 - cos) / w], 1), torch.cat([cos, sin], 1)
        return torch.stack([q, v, torch.cat([-w * sin, w * cos], 1)]) @ self.rest

    def motion(self, weights: Tensor, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return q, v and a of weights ``(K, N, P)`` within the limits, ``(K, T, N)`` each."""
        velocity = self.envelope.velocity[:, None]
        q, v, a = torch.einsum("otp,knp->oktn", basis, weights * velocity)
        scale = self.envelope.scale(q, v, a).clamp(min=1).unsqueeze(-2)
        return self.envelope.start + q / scale, v / scale, a / scale

    def score(self, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cost, the condition number and the violation of motions, ``(K,)`` each."""
        limits = self.envelope
        q, v, a = self.motion(weights, self.basis)
        sign = torch.tanh(20 * v / limits.velocity)
        rows = drive_regressor(self.robot, q, v, a, sign)[..., self.base]
        unit = rows.flatten(1, 2) / rows.flatten(1, 2).norm(dim=1, keepdim=True).clamp(min=1e-12)
        values = torch.linalg.eigvalsh(unit.mT @ unit)
        condition = (values[:, -1] / values[:, 0].clamp(min=1e-14)).sqrt()
        torque = limits.torque.clamp(max=_UNLIMITED).unsqueeze(-1)
        weighted = (rows / torque).flatten(1, 2)
        information = weighted.mT @ weighted / rows.shape[1]
        trace = information.diagonal(dim1=1, dim2=2).mean(-1)[:, None, None]
        information = information + 1e-12 * trace * torch.eye(len(self.base)).double()
        size = torch.logdet(information) / len(self.base)
        return condition.log() - _SIZE * size, condition, self.violation(q, v, a)

    def violation(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return the mean squared excess of torque and depth of motions, ``(K,)``."""
        limits = self.envelope
        over = (limits.torque_for(q, v, a).abs() / limits.torque - 0.99).clamp(min=0)
        return (over**2).mean((1, 2)) + (limits.depth(q) ** 2).mean(1)

    def shrunk(self, weights: Tensor) -> Tensor:
        """Return motions that are scaled down until no torque or height is violated."""
        velocity = self.envelope.velocity[:, None]
        moves = torch.einsum("otp,knp->oktn", self.basis, weights * velocity)
        weights = weights / self.envelope.scale(*moves).clamp(min=1).unsqueeze(-1)
        for _ in range(60):
            violated = self.violation(*self.motion(weights, self.basis)) > 0
            if not violated.any():
                break
            weights = torch.where(violated[:, None, None], 0.9 * weights, weights)
        return weights

    def held(self, weights: Tensor, t: Tensor) -> list[Tensor]:
        """Return q, v, a and torque at times t, scaled down until all limits hold, ``(T, N)``."""
        limits = self.envelope
        q, v, a = (x[0] for x in self.motion(weights[None], self._basis(t)))
        for _ in range(500):
            tau = limits.torque_for(q, v, a)
            largest = max(float(x.max()) for x in limits.uses(q, v, a, tau).values())
            if largest <= 1 and not limits.depth(q).any():
                break
            q, v, a = limits.start + 0.99 * (q - limits.start), 0.99 * v, 0.99 * a
        return [q, v, a, tau]
