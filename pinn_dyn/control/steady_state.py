"""Where the regulated arm comes to rest: a bound around the set point, the point, its poles.

With the closed loop of ``stability.py`` the arm rests where::

    q - q_ref = h(q) = Khat_P^-1 Delta_all,     Khat_P = A A_L^T K_P

docs/stability.md derives it. Shapes: K set points ``(K, N)``; float64 inside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.laws import Gain, diagonal_gain
from pinn_dyn.control.stability import per_configuration, prepare, smallest_eigenvalue, solve
from pinn_dyn.mechanics import MechanicalSystem

DIFFERENCE = 1e-4
"""Step of the central differences, in the units of q."""
SPHERE_POINTS = 16
"""Points on the sphere around a set point at which the slope of h is looked at."""
MARGIN = 2.0
"""The change of that slope over the sphere is multiplied by this, for what lies between them."""
SLACK = 1.05
"""L is taken over a ball this much larger than the bound: one too small has to be done again."""


@dataclass(frozen=True)
class SteadyState:
    """Where the closed loop rests, predicted for K set points. Each is ``(K,)`` unless said.

    Attributes:
        q_ref: set points, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, ``(N,)``.
        slope: L, the largest |dh/dq| over the ball of that radius, estimated from samples.
        radius: radius of the ball around q_ref that L was taken over.
        bound: |h(q_ref)| / (1 - L): the ball of this radius holds exactly one equilibrium.
            Infinite where no ball with L < 1 was found that is large enough.
        condition_1: smallest eigenvalue of the symmetric part of A A_L^T over that ball's samples.
        q_ss: the equilibrium that Newton's method finds from q_ref, ``(K, N)``; NaN if it finds
            none.
        poles: eigenvalues in 1/s of the closed loop linearized there, ``(K, 2 N)``, complex.
    """

    q_ref: Tensor
    position_gain: Tensor
    velocity_gain: Tensor
    slope: Tensor
    radius: Tensor
    bound: Tensor
    condition_1: Tensor
    q_ss: Tensor
    poles: Tensor

    @property
    def error(self) -> Tensor:
        """|q_ss - q_ref|, ``(K,)``: what the equation of the equilibrium gives, not a bound."""
        return torch.linalg.vector_norm(self.q_ss - self.q_ref, dim=-1)

    @property
    def stable(self) -> Tensor:
        """Whether all poles have a negative real part, ``(K,)``."""
        return self.poles.real.amax(-1) < 0

    @property
    def holds(self) -> Tensor:
        """Where the bound is claimed, ``(K,)``: it exists, condition 1 holds, and is stable."""
        return torch.isfinite(self.bound) & (self.condition_1 > 0) & self.stable

    def to_frame(self) -> pd.DataFrame:
        """One row per set point: q1 to qN of the set point, then every number."""
        columns = {
            "slope": self.slope,
            "bound": self.bound,
            "error": self.error,
            "condition_1": self.condition_1,
            "slowest_pole": self.poles.real.amax(-1),
            "fastest_pole": self.poles.abs().amax(-1),
            "holds": self.holds,
        }
        return per_configuration(self.q_ref, columns)


def predict_steady_state(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q_ref: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
) -> SteadyState:
    """Where the regulator brings the true arm to rest: a bound, the point itself, its poles.

    The rest is a fixed point of q -> q_ref + h(q). If |dh/dq| <= L < 1 in a ball around q_ref of
    radius |h(q_ref)| / (1 - L) or more, the map has exactly one fixed point there, and it lies
    within that radius (contraction mapping theorem). L is the slope at q_ref plus MARGIN times
    the largest change of the slope found at SPHERE_POINTS points of the sphere around it.

    The poles are those of M x'' + (D + Khat_D) x' + Khat_P (I - dh/dq) x = 0 at q_ss.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q_ref: set points, ``(K, N)``.
        position_gain: diagonal of K_P, one number or N.
        velocity_gain: diagonal of K_D, one number or N; only the poles depend on it.

    Raises:
        TypeError, ValueError: as for :func:`certify`.
    """
    model, truth, q_ref = prepare(model, truth, q_ref, "q_ref")
    K_P = diagonal_gain("position_gain", position_gain, q_ref.shape[-1]).to(q_ref)
    K_D = diagonal_gain("velocity_gain", velocity_gain, q_ref.shape[-1]).to(q_ref)

    def h(q: Tensor) -> Tensor:
        return _input_error(model, truth, q) / K_P

    with torch.no_grad():
        bound, slope, radius = _contraction(h, q_ref)
        ball = torch.cat([q_ref.unsqueeze(0), q_ref + _sphere(q_ref) * radius[:, None]])
        K_A = truth.input_matrix(ball) @ model.input_matrix(ball).mT
        condition_1 = smallest_eigenvalue(K_A).amin(0)
        q_ss = _equilibrium(h, q_ref)
        poles = _poles(model, truth, q_ss, _jacobian(h, q_ss), K_P, K_D)
    return SteadyState(q_ref, K_P, K_D, slope, radius, bound, condition_1, q_ss, poles)


def required_gain(
    model: MechanicalSystem, truth: MechanicalSystem, q_ref: Tensor, *, error: float
) -> Tensor:
    """The scalar K_P from which on the bound is at most ``error``, for each set point, ``(K,)``::

        kappa = L_w + |w(q_ref)| / error,     w(q) = K_P h(q) = (A A_L^T)^-1 Delta_all

    with L_w the largest |dw/dq| over the ball of radius SLACK * ``error`` around q_ref, as in
    :func:`predict_steady_state`. This is the "kappa high enough" of Proposition 1.

    Raises:
        TypeError, ValueError: as for :func:`certify`, and for an ``error`` that is not positive.
    """
    if not error > 0:
        raise ValueError(f"error is {error}, expected a positive number, in the units of q")
    model, truth, q_ref = prepare(model, truth, q_ref, "q_ref")

    def w(q: Tensor) -> Tensor:
        return _input_error(model, truth, q)

    with torch.no_grad():
        radius = torch.full_like(q_ref[:, 0], SLACK * error)
        slope = _largest_slope(w, _jacobian(w, q_ref), q_ref, radius)
        return slope + torch.linalg.vector_norm(w(q_ref), dim=-1) / error


def _input_error(model: MechanicalSystem, truth: MechanicalSystem, q: Tensor) -> Tensor:
    """w(q) = (A A_L^T)^-1 Delta_all = A_L^-T (A_L^-1 G_L - A^-1 G), ``(*batch, N)``."""
    A, A_L = truth.input_matrix(q), model.input_matrix(q)
    held = solve(A_L, model.potential_force(q)) - solve(A, truth.potential_force(q))
    return solve(A_L.mT, held)


def _contraction(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The bound |h(q_ref)| / (1 - L), L, and the radius of the ball that L was taken over."""
    start = torch.linalg.vector_norm(h(q_ref), dim=-1)
    centre = _jacobian(h, q_ref)
    radius = SLACK * start
    for _ in range(20):
        slope = _largest_slope(h, centre, q_ref, radius)
        bound = torch.where(slope < 1, start / (1 - slope), torch.inf)
        too_small = (bound > radius) & torch.isfinite(bound)
        if not bool(too_small.any()):
            break
        radius = torch.where(too_small, SLACK * bound, radius)
    return torch.where(too_small, torch.inf, bound), slope, radius


def _largest_slope(
    h: Callable[[Tensor], Tensor], centre: Tensor, q: Tensor, radius: Tensor
) -> Tensor:
    """Estimate of the largest |dh/dq| over balls around q, given dh/dq at their centres."""
    change = torch.zeros_like(radius)
    for point in _sphere(q):
        jacobian = _jacobian(h, q + point * radius[:, None])
        change = torch.maximum(change, _spectral_norm(jacobian - centre))
    return _spectral_norm(centre) + MARGIN * change


def _sphere(q: Tensor) -> Tensor:
    """Points of the unit sphere, ``(SPHERE_POINTS, 1, N)``, the same in every call."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(SPHERE_POINTS, 1, q.shape[-1], generator=generator, dtype=q.dtype)
    return (points / torch.linalg.vector_norm(points, dim=-1, keepdim=True)).to(q.device)


def _equilibrium(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> Tensor:
    """The q = q_ref + h(q) that Newton's method finds from q_ref; NaN where it finds none."""
    q, eye = q_ref, torch.eye(q_ref.shape[-1], dtype=q_ref.dtype, device=q_ref.device)
    for _ in range(30):
        step = solve(eye - _jacobian(h, q), q - q_ref - h(q))
        q = q - step
        if bool((step.abs().amax(-1) < 1e-13).all()):
            break
    found = torch.linalg.vector_norm(q - q_ref - h(q), dim=-1) < 1e-9
    return torch.where(found[:, None], q, torch.nan)


def _poles(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q_ss: Tensor,
    slope: Tensor,
    K_P: Tensor,
    K_D: Tensor,
) -> Tensor:
    found = torch.isfinite(q_ss).all(-1)
    q = torch.where(found[:, None], q_ss, 0.0)
    terms = truth.terms(q)
    K_A = terms.A @ model.input_matrix(q).mT
    eye = torch.eye(q.shape[-1], dtype=q.dtype, device=q.device)
    stiffness = (K_A * K_P) @ (eye - torch.where(found[:, None, None], slope, 0.0))
    lower = -torch.linalg.solve(terms.M, torch.cat([stiffness, terms.D + K_A * K_D], -1))
    upper = torch.cat([torch.zeros_like(eye), eye], -1).expand_as(lower)
    poles = torch.linalg.eigvals(torch.cat([upper, lower], -2))
    return torch.where(found[:, None], poles, torch.nan)


def _jacobian(function: Callable[[Tensor], Tensor], q: Tensor) -> Tensor:
    """df/dq ``(K, N, N)`` by central differences: a simulator's terms have no other slope."""
    steps = DIFFERENCE * torch.eye(q.shape[-1], dtype=q.dtype, device=q.device)
    ahead, behind = function(q.unsqueeze(-2) + steps), function(q.unsqueeze(-2) - steps)
    return (ahead - behind).mT / (2 * DIFFERENCE)


def _spectral_norm(matrix: Tensor) -> Tensor:
    """Largest singular value, infinite where an entry is not finite, which an SVD refuses."""
    finite = torch.isfinite(matrix).all(-1).all(-1)
    norm = torch.linalg.matrix_norm(torch.where(finite[..., None, None], matrix, 0.0), 2)
    return torch.where(finite, norm, torch.inf)
