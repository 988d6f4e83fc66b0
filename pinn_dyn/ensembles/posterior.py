"""Draws from the posterior of a least-squares fit, as an ensemble."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.mechanics import Predictor

DRAWS = 20


def posterior_draws(model: Predictor, covariance: Tensor, size: int = DRAWS) -> Ensemble:
    """Draw E models with parameters from N(z, C). The draws are the same every time.

    The spread of their predictions shows the uncertainty of the fitted constants. It includes
    neither the noise of the measured initial state nor forces that the model lacks.

    Args:
        model: model with the fitted z.
        covariance: C, ``(P, P)``.
        size: E.

    Raises:
        ValueError: if C is not a covariance of the P parameters.
    """
    z = parameters_to_vector(model.parameters()).detach().double()
    if covariance.shape != (len(z), len(z)):
        raise ValueError(
            f"the covariance has {len(covariance)} rows, but the model has {len(z)} constants: "
            "the checkpoint is damaged, fit the model again"
        )
    root, failed = torch.linalg.cholesky_ex(covariance.double())
    if failed or not root.isfinite().all():
        raise ValueError(
            "the covariance of the constants is not positive definite: the checkpoint is damaged, "
            "fit the model again"
        )
    noise = torch.randn(size, len(z), generator=torch.Generator().manual_seed(0)).double()
    members = [copy.deepcopy(model) for _ in range(size)]
    for member, shift in zip(members, noise @ root.T, strict=True):
        vector_to_parameters((z + shift).to(next(model.parameters()).dtype), member.parameters())
    return Ensemble(members)
