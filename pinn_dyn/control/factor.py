"""The factor P(q) between learned and true terms."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.mechanics import Terms


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
