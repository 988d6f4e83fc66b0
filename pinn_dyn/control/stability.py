"""Proposition 1 of the paper in numbers: its conditions, its deltas and the error they allow.

Plant and law, paper eqs. (armdynamics) and (controller_PD), with N = M, and their closed loop::

    M(q) dv/dt + C(q, v) v + G(q) + D(q) v = A(q) u
    u = A_L^-1 G_L + A_L^T (K_P (q_ref - q) - K_D v)
    M dv/dt + C v + (D + Khat_D) v = Delta_all + Khat_P (q_ref - q)
    Delta_all = A A_L^-1 G_L - G,     Khat_P = A A_L^T K_P,     Khat_D = A A_L^T K_D

The arm rests where q - q_ref = h(q) = Khat_P^-1 Delta_all. docs/stability.md derives the numbers.
"""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.laws import Gain, diagonal_gain
from pinn_dyn.mechanics import MechanicalSystem, Terms, double_copy
from pinn_dyn.mechanics.arrays import matvec, require_last_dim


def certify(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
) -> pd.DataFrame:
    """Evaluate Proposition 1 at configurations q ``(K, N)``, one row each.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q: configurations, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.

    Returns:
        The columns ``q1`` to ``qN``, those of :func:`factor_bounds` with the P of
        :func:`fit_factor`, and

        - ``condition_1``: smallest eigenvalue of the symmetric part of A A_L^T, eq. (PD_transpose),
          which must be positive;
        - ``position_eigenvalue``, ``velocity_eigenvalue``: the same of Khat_P and Khat_D;
        - ``delta_all``: |A A_L^-1 G_L - G|, to compare with ``potential_force``, |G|;
        - ``rest_error``: |Khat_P^-1 Delta_all|, the distance from q_ref of an arm that rests at q.

    Raises:
        ValueError: on sizes that do not match, or N != M.
    """
    model, truth, q = float64_pair(model, truth, q)
    K_P = diagonal_gain("position_gain", position_gain, q.shape[-1]).to(q)
    K_D = diagonal_gain("velocity_gain", velocity_gain, q.shape[-1]).to(q)
    with torch.no_grad():
        true, learned = truth.terms(q), model.terms(q)
        K_A = true.A @ learned.A.mT
        delta_all = matvec(true.A, solve(learned.A, learned.G)) - true.G
        columns = {
            "condition_1": smallest_eigenvalue(K_A),
            "position_eigenvalue": smallest_eigenvalue(K_A * K_P),
            "velocity_eigenvalue": smallest_eigenvalue(K_A * K_D),
            "delta_all": torch.linalg.vector_norm(delta_all, dim=-1),
            "potential_force": torch.linalg.vector_norm(true.G, dim=-1),
            "rest_error": torch.linalg.vector_norm(solve(K_A, delta_all) / K_P, dim=-1),
            **factor_bounds(fit_factor(true, learned), true, learned),
        }
    return per_configuration(q, columns)


def fit_factor(true: Terms, learned: Terms) -> Tensor:
    """Fit the factor P(q), ``(*batch, N, N)``, between learned and true terms::

        P = argmin  sum_X |P X - X_L|^2 / |X|^2,     X in {M, D, A, G}

    with Frobenius norms. A true term that vanishes is left out; where P is not unique, the P of
    smallest norm is returned. Motion determines the terms only up to such a P.

    Source: paper, section PINN-based controllers, X_L = P X. The column P(q) of the paper's table
    holds the inverse.
    """
    true, learned = (x._replace(G=x.G.unsqueeze(-1)) for x in (true, learned))
    norms = [torch.linalg.matrix_norm(X)[..., None, None] for X in true]
    weights = [torch.where(norm > 0, 1 / norm, 0.0) for norm in norms]
    X, X_L = (
        torch.cat([weight * x for weight, x in zip(weights, terms, strict=True)], -1)
        for terms in (true, learned)
    )
    return X_L @ torch.linalg.pinv(X)


def factor_bounds(P: Tensor, true: Terms, learned: Terms) -> dict[str, Tensor]:
    """Return the deltas of Proposition 1 for a factor P ``(K, N, N)``, with N = M.

    With Delta_A = A_L - P A, Delta_G = G_L - P G, Delta_I = A_L^-1 - X and X = (P A)^-1, the
    spectral norms, ``(K,)`` each:

    - ``condition_2``: |X Delta_A|, which must be below 1, eq. (smallenss_A_2);
    - ``delta_A``, ``delta_G``, ``delta_I``: |Delta_A|, |Delta_G|, |Delta_I|;
    - ``delta_I_bound``: |X Delta_A X| / (1 - |X Delta_A|), infinite where condition 2 fails;
    - ``delta_all_bound``: |P^-1| delta_G + |A| delta_I_bound (|P G| + delta_G).
    """
    PA, PG = P @ true.A, matvec(P, true.G)
    X = torch.linalg.inv(PA)
    delta_A = learned.A - PA
    delta_G = torch.linalg.vector_norm(learned.G - PG, dim=-1)
    condition_2 = _norm(X @ delta_A)
    neumann = _norm(X @ delta_A @ X) / (1 - condition_2)
    delta_I = torch.where(condition_2 < 1, neumann, torch.inf)
    size = torch.linalg.vector_norm(PG, dim=-1) + delta_G
    return {
        "condition_2": condition_2,
        "delta_A": _norm(delta_A),
        "delta_G": delta_G,
        "delta_I": _norm(torch.linalg.inv(learned.A) - X),
        "delta_I_bound": delta_I,
        "delta_all_bound": _norm(torch.linalg.inv(P)) * delta_G + _norm(true.A) * delta_I * size,
    }


def term_conditions(model: MechanicalSystem, q: Tensor) -> pd.DataFrame:
    """Return the conditioning of the terms of a model at configurations q ``(K, N)``, a row each.

    Next to ``q1`` to ``qN`` there are ``mass_min`` and ``damping_min``, the smallest eigenvalues of
    M and D, and ``mass_condition`` and ``input_condition``, condition numbers in the 2-norm.
    """
    with torch.no_grad():
        terms = double_copy(model, q.device).terms(q.double())
    columns = {
        "mass_min": smallest_eigenvalue(terms.M),
        "damping_min": smallest_eigenvalue(terms.D),
        "mass_condition": torch.linalg.cond(terms.M),
        "input_condition": torch.linalg.cond(terms.A),
    }
    return per_configuration(q, columns)


def float64_pair(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor
) -> tuple[MechanicalSystem, MechanicalSystem, Tensor]:
    """Return float64 copies of two systems and of configurations, after checking them."""
    sizes = [(system.num_coordinates, system.num_inputs) for system in (model, truth)]
    if sizes[0] != sizes[1]:
        raise ValueError(f"model has (N, M) = {sizes[0]}, truth {sizes[1]}: expected the same")
    require_last_dim("q", q, truth.num_coordinates, "N")
    if truth.num_coordinates != truth.num_inputs:
        raise ValueError(f"Proposition 1 needs N = M inputs, the robot has M = {truth.num_inputs}")
    if not (model.input_affine and truth.input_affine):
        raise ValueError("Proposition 1 needs a force A(q) u, linear in the input: stability=null")
    return double_copy(model, q.device), double_copy(truth, q.device), q.double()


def per_configuration(q: Tensor, columns: dict[str, Tensor]) -> pd.DataFrame:
    """Return a table with one row per configuration: q1 to qN, then the columns, ``(K,)`` each."""
    coordinates = {f"q{i + 1}": value for i, value in enumerate(q.unbind(-1))}
    return pd.DataFrame({k: v.cpu().numpy() for k, v in (coordinates | columns).items()})


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrix^-1 vector, batched; not finite where the matrix is singular."""
    return torch.linalg.solve_ex(matrix, vector.unsqueeze(-1))[0].squeeze(-1)


def smallest_eigenvalue(matrix: Tensor) -> Tensor:
    """Return the smallest eigenvalue of the symmetric part."""
    return torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT))[..., 0]


def _norm(matrix: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(matrix, 2)
