"""The input that gives a force which is not linear in the input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.mechanics.arrays import jacobians, matvec, spd_solve

_SMALLEST, _FIRST = 1e-10, 1e-2  # damping mu, at the start and after the first failed step
_SMALLER, _LARGER = 0.1, 10.0  # factors of mu after an accepted and a rejected step
_SETTLED = 1e-4  # largest final step relative to u, if M > N


class Solution(NamedTuple):
    """Input u ``(*batch, M)``, J = dF/du at u, residual |F(u) - tau| and its convergence test."""

    u: Tensor
    J: Tensor
    residual: Tensor
    converged: Tensor


@dataclass(frozen=True)
class InputSolver:
    """Damped Newton method for an input u with F(u) = tau, in batches and without branches::

        u <- clamp(u + d),    d = d_0 + W J^T (J W J^T + mu |J W^(1/2)|^2 / N)^-1 (tau - F - J d_0)

    with J = dF/du. Rows of F, J and tau are divided by the norm of the row of J at the start. A
    solution starts with W = 1 and mu = 1e-10. A step that increases |tau - F| is rejected. Then mu
    grows, and W = 1/|J_j|^2 moves inputs with little effect, such as slack tendons. For M > N,
    d_0 = u_0 - u leads to the solution closest to a typical input u_0; otherwise d_0 = 0. For
    M < N, u minimizes |F - tau|.

    Source: Marquardt 1963, "An algorithm for least-squares estimation of nonlinear parameters".

    Args:
        tolerance: largest |F(u) - tau| relative to |tau| + |J| |u|.
        steps: largest number of steps from each of two starts.
        low, high: limits of u in its units, one number or M; None for no limit.
    """

    tolerance: PositiveFloat = 1e-8
    steps: PositiveInt = 30
    low: float | Sequence[float] | None = None
    high: float | Sequence[float] | None = None

    def __call__(
        self,
        force: Callable[[Tensor], Tensor],
        tau: Tensor,
        typical: Tensor,
        previous: Tensor | None = None,
        *,
        all_steps: bool = False,
    ) -> Solution:
        """Solve F(u) = tau ``(*batch, N)`` from the start with the shorter first Newton step.

        Rows that do not converge are solved again from the second start.

        Args:
            force: F, maps ``(*batch, M)`` to ``(*batch, N)`` row by row.
            tau: the force.
            typical: first start u_0, ``(*batch, M)``.
            previous: second start, the input of the previous instant, ``(*batch, M)``.
            all_steps: take all steps; the operations then do not depend on the numbers.
        """
        if previous is None:
            return self._solve(force, tau, typical, typical, all_steps)
        mu = torch.full_like(tau[..., :1], _SMALLEST)
        points = [_linear(force, torch.ones_like(tau), u) for u in (previous, typical)]
        lengths = [_norm(_damped_step(x.J, tau - x.F, mu)) for x in points]
        nearer = lengths[0] < lengths[1]
        near, far = previous.where(nearer, typical), typical.where(nearer, previous)
        first = self._solve(force, tau, typical, near, all_steps)
        if not all_steps and bool(first.converged.all()):
            return first
        second = self._solve(force, tau, typical, far, all_steps)
        done = first.converged
        return Solution(
            first.u.where(done.unsqueeze(-1), second.u),
            first.J.where(done[..., None, None], second.J),
            first.residual.where(done, second.residual),
            done | second.converged,
        )

    def _solve(
        self,
        force: Callable[[Tensor], Tensor],
        tau: Tensor,
        typical: Tensor,
        start: Tensor,
        all_steps: bool,
    ) -> Solution:
        mu = torch.full_like(tau[..., :1], _SMALLEST)
        unit = torch.ones_like(tau)
        wide, tall = typical.shape[-1] > tau.shape[-1], typical.shape[-1] < tau.shape[-1]
        if not tall:
            rows = _linear(force, unit, start).J.square().sum(-1).sqrt()
            unit = torch.where(rows > 0, 1 / rows, 1.0)
        point, tau = _linear(force, unit, start), unit * tau
        settled = torch.zeros_like(mu, dtype=torch.bool)
        for _ in range(self.steps):
            step = self._limited_step(point, tau, mu, typical)
            trial = _linear(force, unit, self._clamped(point.u + step))
            enough = self.tolerance * _size(trial, tau)
            better = _error(trial, tau) <= torch.maximum(_error(point, tau), enough)
            point = _chosen(better & ~settled, trial, point)
            mu = torch.where(better, _SMALLER * mu, (_LARGER * mu).clamp(min=_FIRST))
            mu = mu.clamp(min=_SMALLEST)
            settled = settled | (_error(point, tau) <= enough)
            if wide:
                settled = settled & (_norm(step) <= _SETTLED * _norm(point.u))
            if not all_steps and bool(settled.all()):
                break
        converged = _error(point, tau) <= self.tolerance * _size(point, tau)
        residual = _norm((tau - point.F) / unit)
        J = point.J / unit.unsqueeze(-1)
        return Solution(point.u, J, residual.squeeze(-1), converged.squeeze(-1))

    def _limited_step(self, point: _Point, tau: Tensor, mu: Tensor, typical: Tensor) -> Tensor:
        J, r, u = point.J, tau - point.F, point.u
        wide = J.shape[-1] > J.shape[-2]
        pull = _SMALLEST / mu * (typical - u) if wide else torch.zeros_like(u)
        step = pull + _damped_step(J, r - matvec(J, pull), mu)
        if self.low is None and self.high is None:
            return step
        free = self._clamped(u + step.sign()) != u
        pull = pull * free
        return pull + _damped_step(J * free.unsqueeze(-2), r - matvec(J, pull), mu)

    def _clamped(self, u: Tensor) -> Tensor:
        low = -torch.inf if self.low is None else self.low
        high = torch.inf if self.high is None else self.high
        lowest = torch.as_tensor(low, dtype=u.dtype, device=u.device)
        return u.clamp(lowest, torch.as_tensor(high, dtype=u.dtype, device=u.device))


class _Point(NamedTuple):
    u: Tensor
    F: Tensor
    J: Tensor


def _linear(force: Callable[[Tensor], Tensor], unit: Tensor, u: Tensor) -> _Point:
    F, (J,) = jacobians(lambda x: unit * force(x), u)
    return _Point(u, F, J)


def _chosen(mask: Tensor, first: _Point, second: _Point) -> _Point:
    u, F = first.u.where(mask, second.u), first.F.where(mask, second.F)
    return _Point(u, F, first.J.where(mask.unsqueeze(-1), second.J))


def _damped_step(J: Tensor, r: Tensor, mu: Tensor) -> Tensor:
    """Return W J^T (J W J^T + mu |J W^(1/2)|^2 / N)^-1 r, with W = 1 for small mu.

    For M < N, return (J^T J + mu |J|^2 / M)^-1 J^T r, whose matrix is not singular.
    """
    if J.shape[-1] < J.shape[-2]:
        gram = J.mT @ J
        size = gram.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        damping = torch.diag_embed(mu * size.expand(gram.shape[:-1]))
        return spd_solve(gram + damping, matvec(J.mT, r))
    columns = J.square().sum(-2)
    columns = columns.clamp(min=1e-2 * columns.amax(-1, keepdim=True))
    W = torch.where(mu < _FIRST, 1.0, 1 / columns)
    K = J * W.unsqueeze(-2)
    gram = K @ J.mT
    size = gram.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    return matvec(K.mT, spd_solve(gram + torch.diag_embed(mu * size.expand(r.shape)), r))


def _error(point: _Point, tau: Tensor) -> Tensor:
    """Return |tau - F|, ``(*batch, 1)``; for M < N, the part in the range of J."""
    r, J = tau - point.F, point.J
    if J.shape[-1] < J.shape[-2]:
        r = matvec(J.mT, r) / J.square().sum((-2, -1)).sqrt().unsqueeze(-1)
    return _norm(r)


def _size(point: _Point, tau: Tensor) -> Tensor:
    return _norm(tau) + point.J.square().sum((-2, -1)).sqrt().unsqueeze(-1) * _norm(point.u)


def _norm(x: Tensor) -> Tensor:
    return x.square().sum(-1, keepdim=True).sqrt()
