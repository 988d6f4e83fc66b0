"""Draws from what a least-squares fit left open, as an ensemble."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.mechanics import Predictor

DRAWS = 20


def posterior_draws(model: Predictor, covariance: Tensor, size: int = DRAWS) -> Ensemble:
    """E models whose parameters are drawn from N(z, C), the same draws every time.

    The spread of their predictions is what the fitted constants leave open; it has no part of the
    noise of the measured start, nor of forces that the model does not have.

    Args:
        model: at the z that a fit found.
        covariance: C of the z, ``(P, P)``.
        size: E.

    Raises:
        ValueError: if C is no covariance of the P parameters.
    """
    z = parameters_to_vector(model.parameters()).detach().double()
    if covariance.shape != (len(z), len(z)):
        raise ValueError(
            f"the covariance is of {len(covariance)} constants, expected of the {len(z)} of the "
            "model: its checkpoint is damaged, fit it again"
        )
    root, failed = torch.linalg.cholesky_ex(covariance.double())
    if failed or not root.isfinite().all():
        raise ValueError(
            "the covariance of the constants is no positive definite matrix of finite numbers: its "
            "checkpoint is damaged, fit it again"
        )
    noise = torch.randn(size, len(z), generator=torch.Generator().manual_seed(0)).double()
    members = [copy.deepcopy(model) for _ in range(size)]
    for member, shift in zip(members, noise @ root.T, strict=True):
        vector_to_parameters((z + shift).to(next(model.parameters()).dtype), member.parameters())
    return Ensemble(members)
