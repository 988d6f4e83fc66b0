"""The factor P(q) between learned and true terms."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.mechanics import Terms


def fit_factor(true: Terms, learned: Terms) -> Tensor:
    """Fit the factor P(q), ``(*batch, N, N)``, between learned and true terms::

        P = argmin  sum_X |P X - X_L|^2 / |X|^2,     X in {M, D, A, G}

    with Frobenius norms, so that no term outweighs the others by its units. A true term that
    vanishes is left out; where P is not unique, the P of smallest norm is returned. Motion
    determines the terms only up to such a P, because P on both sides of the equation of motion
    cancels.

    Source: paper, section PINN-based controllers, X_L = P X. The column P(q) of the paper's table
    holds the inverse: its numbers satisfy P X_L = X.
    """
    true_blocks, learned_blocks = [], []
    for X, X_L in zip(_with_columns(true), _with_columns(learned), strict=True):
        norm = torch.linalg.matrix_norm(X)[..., None, None]
        weight = torch.where(norm > 0, 1 / norm, 0.0)
        true_blocks.append(weight * X)
        learned_blocks.append(weight * X_L)
    return torch.cat(learned_blocks, -1) @ torch.linalg.pinv(torch.cat(true_blocks, -1))


def _with_columns(terms: Terms) -> Terms:
    return terms._replace(G=terms.G.unsqueeze(-1))
