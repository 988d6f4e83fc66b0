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
    """
    z = parameters_to_vector(model.parameters()).detach().double()
    root = torch.linalg.cholesky(covariance.double())
    noise = torch.randn(size, len(z), generator=torch.Generator().manual_seed(0)).double()
    members = [copy.deepcopy(model) for _ in range(size)]
    for member, shift in zip(members, noise @ root.T, strict=True):
        vector_to_parameters((z + shift).to(next(model.parameters()).dtype), member.parameters())
    return Ensemble(members)
