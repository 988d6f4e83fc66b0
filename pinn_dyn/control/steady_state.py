"""The steady state of the regulated arm of ``stability.py``, where q - q_ref = h(q)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.laws import Gain, diagonal_gain
from pinn_dyn.control.stability import float64_pair, per_configuration, smallest_eigenvalue, solve
from pinn_dyn.mechanics import MechanicalSystem

_DIFFERENCE = 1e-4  # step of the central differences, in the units of q
_SPHERE_POINTS = 16  # points on the sphere around a set point at which dh/dq is evaluated
_MARGIN = 2.0  # factor of the change of dh/dq over the sphere, for the points in between
_SLACK = 1.05  # radius of the ball over the bound


def predict_steady_state(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q_ref: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
) -> pd.DataFrame:
    """Predict the steady states of the true arm under the learned regulator, a row per set point.

    If |dh/dq| <= L < 1 in a ball around q_ref of radius |h(q_ref)| / (1 - L) or more, the map
    q -> q_ref + h(q) has exactly one fixed point q_ss there, and it lies within that radius. L is
    the slope at q_ref plus twice the largest change of the slope at 16 points of the sphere around
    it. The poles are those of M x'' + (D + Khat_D) x' + Khat_P (I - dh/dq) x = 0 at q_ss.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q_ref: set points, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.

    Returns:
        The columns ``q1`` to ``qN`` of q_ref, ``rest1`` to ``restN`` of q_ss (NaN where Newton's
        method does not converge), and

        - ``slope``: L;
        - ``bound``: |h(q_ref)| / (1 - L), infinite where no ball with L < 1 is large enough;
        - ``error``: |q_ss - q_ref|, a prediction and no bound;
        - ``condition_1``: smallest eigenvalue of the symmetric part of A A_L^T over the ball;
        - ``slowest_pole``: largest real part of the poles, 1/s, negative where stable;
        - ``fastest_pole``: largest absolute value of the poles, 1/s;
        - ``holds``: true where the bound is finite, condition 1 holds, and the loop is stable.
    """
    model, truth, q_ref = float64_pair(model, truth, q_ref)
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
    slowest = poles.real.amax(-1)
    columns = {f"rest{i + 1}": value for i, value in enumerate(q_ss.unbind(-1))} | {
        "slope": slope,
        "bound": bound,
        "error": torch.linalg.vector_norm(q_ss - q_ref, dim=-1),
        "condition_1": condition_1,
        "slowest_pole": slowest,
        "fastest_pole": poles.abs().amax(-1),
        "holds": bound.isfinite() & (condition_1 > 0) & (slowest < 0),
    }
    return per_configuration(q_ref, columns)


def required_gain(
    model: MechanicalSystem, truth: MechanicalSystem, q_ref: Tensor, *, error: float
) -> Tensor:
    """Return the smallest scalar K_P with a bound of at most ``error``, ``(K,)``::

        kappa = L_w + |w(q_ref)| / error,     w(q) = K_P h(q) = (A A_L^T)^-1 Delta_all

    with L_w the largest |dw/dq| over the ball of radius 1.05 ``error`` around q_ref.
    """
    model, truth, q_ref = float64_pair(model, truth, q_ref)
    w = partial(_input_error, model, truth)
    with torch.no_grad():
        radius = torch.full_like(q_ref[:, 0], _SLACK * error)
        slope = _largest_slope(w, _jacobian(w, q_ref), q_ref, radius)
        return slope + torch.linalg.vector_norm(w(q_ref), dim=-1) / error


def _input_error(model: MechanicalSystem, truth: MechanicalSystem, q: Tensor) -> Tensor:
    """Return w(q) = (A A_L^T)^-1 Delta_all = A_L^-T (A_L^-1 G_L - A^-1 G), ``(*batch, N)``."""
    A, A_L = truth.input_matrix(q), model.input_matrix(q)
    held = solve(A_L, model.potential_force(q)) - solve(A, truth.potential_force(q))
    return solve(A_L.mT, held)


def _contraction(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the bound |h(q_ref)| / (1 - L), L, and the radius of the ball of L."""
    start = torch.linalg.vector_norm(h(q_ref), dim=-1)
    centre = _jacobian(h, q_ref)
    radius = _SLACK * start
    for _ in range(20):
        slope = _largest_slope(h, centre, q_ref, radius)
        bound = torch.where(slope < 1, start / (1 - slope), torch.inf)
        too_small = (bound > radius) & torch.isfinite(bound)
        if not bool(too_small.any()):
            break
        radius = torch.where(too_small, _SLACK * bound, radius)
    return torch.where(too_small, torch.inf, bound), slope, radius


def _largest_slope(
    h: Callable[[Tensor], Tensor], centre: Tensor, q: Tensor, radius: Tensor
) -> Tensor:
    """Estimate the largest |dh/dq| over balls around q from dh/dq at their centers."""
    change = torch.zeros_like(radius)
    for point in _sphere(q):
        jacobian = _jacobian(h, q + point * radius[:, None])
        change = torch.maximum(change, _spectral_norm(jacobian - centre))
    return _spectral_norm(centre) + _MARGIN * change


def _sphere(q: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(_SPHERE_POINTS, 1, q.shape[-1], generator=generator, dtype=q.dtype)
    return (points / torch.linalg.vector_norm(points, dim=-1, keepdim=True)).to(q.device)


def _equilibrium(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> Tensor:
    """Solve q = q_ref + h(q) by Newton's method from q_ref; NaN where it does not converge."""
    q, eye = q_ref, torch.eye(q_ref.shape[-1], dtype=q_ref.dtype, device=q_ref.device)
    for _ in range(30):
        step = solve(eye - _jacobian(h, q), q - q_ref - h(q))
        q = q - step
        if bool((step.abs().amax(-1) < 1e-13).all()):
            break
    converged = torch.linalg.vector_norm(q - q_ref - h(q), dim=-1) < 1e-9
    return torch.where(converged[:, None], q, torch.nan)


def _poles(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor, slope: Tensor, *gains: Tensor
) -> Tensor:
    finite = torch.isfinite(q).all(-1)
    terms, zero = truth.terms(q.nan_to_num()), torch.zeros_like(slope)
    K_P, K_D = (terms.A @ model.input_matrix(q.nan_to_num()).mT * gain for gain in gains)
    eye = torch.eye(q.shape[-1]).to(slope)
    stiffness = K_P @ (eye - slope.nan_to_num())
    lower = -torch.linalg.solve(terms.M, torch.cat([stiffness, terms.D + K_D], -1))
    upper = torch.cat([zero, eye.expand_as(zero)], -1)
    poles = torch.linalg.eigvals(torch.cat([upper, lower], -2))
    return torch.where(finite[:, None], poles, torch.nan)


def _jacobian(function: Callable[[Tensor], Tensor], q: Tensor) -> Tensor:
    steps = _DIFFERENCE * torch.eye(q.shape[-1], dtype=q.dtype, device=q.device)
    ahead, behind = function(q.unsqueeze(-2) + steps), function(q.unsqueeze(-2) - steps)
    return (ahead - behind).mT / (2 * _DIFFERENCE)


def _spectral_norm(matrix: Tensor) -> Tensor:
    finite = torch.isfinite(matrix).all(-1).all(-1)
    return torch.where(finite, torch.linalg.matrix_norm(matrix.nan_to_num(), 2), torch.inf)
