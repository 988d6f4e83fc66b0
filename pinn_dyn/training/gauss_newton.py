"""Gauss-Newton steps in a trust region, with a robust loss and an estimated noise."""

from __future__ import annotations

from collections.abc import Callable

import scipy
import torch
from torch import Tensor

from pinn_dyn.training.constants_fit import Prior

_FIRST_NOISE = 0.1  # largest assumed noise of the normalized residuals before the first step
_SMALLEST_NOISE = 1e-15
_GOOD, _POOR = 0.75, 0.25  # actual over predicted decrease of the cost
_SCALE_STEPS = 20


class GaussNewton:
    """Minimization of a robust cost of residuals r(z), with a normal prior of z::

        cost = w^2 sum over k of rho(r_k) + |R (z - m)|^2
        rho(r) = 2 s^2 (sqrt(1 + (r/s)^2) - 1)                soft L1, or r^2 for s = inf
        s^2 = mean(r psi),   psi = rho'/2
        w^2 = mean(psi') / (n mean(psi^2))                    if n residuals count as one

    s and w follow the residuals of each step, but w never decreases: a later step does not raise
    the weight of the prior. Sources: Huber and Ronchetti (2009), "Robust Statistics", chapter 7;
    Nocedal and Wright (2006), "Numerical Optimization", chapter 4.

    Args:
        evaluate: function from z to r ``(K,)``, or with ``True`` to its derivatives ``(K, P)``.
        z: start, ``(P,)``.
        prior: m and R.
        group: n.
        robust: true for soft L1, false for squares.

    Attributes:
        z: best z so far.
        noise, scale: root mean square of its residuals, and s.
        evaluations, steps: number of evaluations of r, and of steps.
        slopes, data: weighted derivatives J ``(K, P)`` and residuals d ``(K,)`` at the last z: the
            information about z is J^T J, and half the gradient of the cost without prior J^T d.
    """

    slopes: Tensor
    data: Tensor

    def __init__(
        self,
        evaluate: Callable[[Tensor, bool], Tensor],
        z: Tensor,
        prior: Prior,
        group: float,
        robust: bool,
    ):
        self.z, self.evaluations, self.steps = z, 0, 0
        self._evaluate, self._prior, self._group, self._robust = evaluate, prior, group, robust
        self._radius, self._weight = 1.0, 0.0
        self._move(z, self._residuals(z), _FIRST_NOISE)

    def minimize(self, limit: int, tolerance: float, report: Callable[[], None]) -> bool:
        """Step until a step decreases the cost by less than a tolerance, or is expected to.

        Return whether the minimum was reached before ``limit`` evaluations.

        The cost is minus twice the logarithm of a probability: at the true z, it exceeds the
        minimum by chi^2 with P degrees of freedom, whose standard deviation is sqrt(2 P). No more
        than ``limit`` evaluations are used, and ``report`` is called after each.
        """
        decrease = torch.inf
        while True:
            predicted = self._linearize()
            if min(decrease, predicted) < tolerance:
                return True
            decrease = 0.0
            while not decrease > 0:
                if predicted < tolerance:
                    return True
                if self.evaluations >= limit:
                    return False
                decrease, predicted = self._step()
                report()

    def _linearize(self) -> float:
        """Return the decrease of the cost by the full step from z."""
        shares = self._shares(self._errors)
        weights = self._weight * shares.pow(1.5)
        self.slopes = weights[:, None] * self._evaluate(self.z, True)
        self.data = self._weight * self._errors * shares.rsqrt()
        self._back = torch.linalg.inv(self._prior.root)
        side = self.slopes @ self._back
        values, self._axes = torch.linalg.eigh(side.T @ side)
        gradient = side.T @ self.data + self._prior.root @ (self.z - self._prior.mean)
        self._gradient = self._axes.T @ gradient
        self._curvature = 1 + values.clamp(min=0)
        return float((self._gradient**2 / self._curvature).sum())

    def _step(self) -> tuple[float, float]:
        """Move z by at most the radius if that decreases the cost.

        Return the decrease of the cost, and the predicted decrease.
        """
        change, largest = self._change(0.0), float(self._gradient.norm()) / self._radius
        if change.norm() > self._radius:
            damping = scipy.optimize.brentq(
                lambda x: float(self._change(x).norm()) - self._radius, 0.0, largest, rtol=1e-3
            )
            change = self._change(damping)
        z = self.z + self._back @ (self._axes @ change)
        errors = self._residuals(z)
        predicted = float(-((2 * self._gradient + self._curvature * change) * change).sum())
        decrease, length = self._cost - self._cost_at(z, errors), float(change.norm())
        if decrease > _GOOD * predicted:
            self._radius = max(self._radius, 2 * length)
        if decrease < _POOR * predicted:
            self._radius = _POOR * length
        if decrease > 0:
            self.steps += 1
            self._move(z, errors, torch.inf)
        return decrease, predicted

    def _change(self, damping: float) -> Tensor:
        return -self._gradient / (self._curvature + damping)

    def _residuals(self, z: Tensor) -> Tensor:
        self.evaluations += 1
        return self._evaluate(z, False)

    def _move(self, z: Tensor, errors: Tensor, largest_noise: float) -> None:
        self.z, self._errors = z, errors
        square = errors.square()
        self.noise, self.scale = float(square.mean().sqrt()), torch.inf
        if self._robust:
            self.scale = self.noise
            for _ in range(_SCALE_STEPS):
                scale = float((square * self._shares(errors)).mean().sqrt())
                self.scale = max(scale, _SMALLEST_NOISE)
        shares = self._shares(errors)
        noise = float(((shares * errors).square().mean() / shares.pow(3).mean()).sqrt())
        noise = min(max(noise, _SMALLEST_NOISE), largest_noise)
        self._weight = max(self._weight, 1 / (noise * self._group**0.5))
        self._cost = self._cost_at(z, errors)

    def _shares(self, errors: Tensor) -> Tensor:
        """Return psi(r) / r, ``(K,)``."""
        return (1 + (errors / max(self.scale, _SMALLEST_NOISE)).square()).rsqrt()

    def _cost_at(self, z: Tensor, errors: Tensor) -> float:
        losses = errors.square() * 2 / (1 + 1 / self._shares(errors))
        distance = self._prior.root @ (z - self._prior.mean)
        return float(self._weight**2 * losses.sum() + distance.square().sum())
