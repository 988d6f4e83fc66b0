"""The factor P(q) between learned and true terms, and what Proposition 1 says of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pinn_dyn.mechanics import Terms


def fit_factor(true: Terms, learned: Terms) -> Tensor:
    """The factor P(q), ``(*batch, N, N)``, that fits the learned terms best::

        P = argmin  sum_X |P X - X_L|^2 / |X|^2,     X in {M, D, A, G}

    with Frobenius norms, so that no term outweighs the others by its units. A true term that
    vanishes is left out; where P is not unique it is the one of smallest norm. Motion determines
    the terms only up to such a P, as P on both sides of the equation of motion cancels.

    Source: paper, section PINN-based controllers, X_L = P X. The column P(q) of the paper's table
    holds the inverse of this one: its numbers satisfy P X_L = X.
    """
    true_blocks, learned_blocks = [], []
    for X, X_L in zip(_with_columns(true), _with_columns(learned), strict=True):
        norm = torch.linalg.matrix_norm(X)[..., None, None]
        weight = torch.where(norm > 0, 1 / norm, 0.0)
        true_blocks.append(weight * X)
        learned_blocks.append(weight * X_L)
    return torch.cat(learned_blocks, -1) @ torch.linalg.pinv(torch.cat(true_blocks, -1))


@dataclass(frozen=True)
class FactorBounds:
    """What Proposition 1 says of one choice of the factor P, at K configurations.

    With Delta_A = A_L - P A, Delta_G = G_L - P G, Delta_I = A_L^-1 - (P A)^-1 and X = (P A)^-1;
    spectral norms, ``(K,)`` each.

    Attributes:
        P: the factor, ``(K, N, N)``.
        condition_2: |X Delta_A|, which eq. (smallenss_A_2) wants below 1.
        delta_A, delta_G, delta_I: |Delta_A|, |Delta_G|, |Delta_I|.
        delta_I_bound: |X Delta_A X| / (1 - |X Delta_A|), the paper's bound on delta_I; infinite
            where condition 2 fails.
        delta_all_bound: |P^-1| delta_G + |A| delta_I_bound (|P G| + delta_G), the triangle
            inequality on the three terms of the paper's Delta_all.
    """

    P: Tensor
    condition_2: Tensor
    delta_A: Tensor
    delta_G: Tensor
    delta_I: Tensor
    delta_I_bound: Tensor
    delta_all_bound: Tensor


def factor_bounds(P: Tensor, true: Terms, learned: Terms) -> FactorBounds:
    """The deltas of Proposition 1 for a factor P ``(K, N, N)``, with N = M.

    Source: paper, Proposition 1 and its proof.
    """
    PA, PG = P @ true.A, (P @ true.G.unsqueeze(-1)).squeeze(-1)
    X = torch.linalg.inv(PA)
    delta_A = learned.A - PA
    delta_G = torch.linalg.vector_norm(learned.G - PG, dim=-1)
    condition_2 = _norm(X @ delta_A)
    neumann = _norm(X @ delta_A @ X) / (1 - condition_2)
    delta_I = torch.where(condition_2 < 1, neumann, torch.inf)
    size = torch.linalg.vector_norm(PG, dim=-1) + delta_G
    return FactorBounds(
        P=P,
        condition_2=condition_2,
        delta_A=_norm(delta_A),
        delta_G=delta_G,
        delta_I=_norm(torch.linalg.inv(learned.A) - X),
        delta_I_bound=delta_I,
        delta_all_bound=_norm(torch.linalg.inv(P)) * delta_G + _norm(true.A) * delta_I * size,
    )


def _norm(matrix: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(matrix, 2)


def _with_columns(terms: Terms) -> Terms:
    return terms._replace(G=terms.G.unsqueeze(-1))
