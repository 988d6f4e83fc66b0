"""How well the data determine the constants of a known mechanism."""

from __future__ import annotations

import pandas as pd
import torch

from pinn_dyn.mechanics import double_copy
from pinn_dyn.models.known import KnownMechanics
from pinn_dyn.training.least_squares import Fit

_SHARE = 0.5
"""Variance of a direction, as a part of that of the prior, from which the data leave it open."""


def constants_table(model: KnownMechanics, fit: Fit) -> pd.DataFrame:
    """All constants in SI units with their 95 % intervals: name, value, low, high, unit, known.

    The interval is value +- 1.96 sigma, with sigma^2 = g^T C g, C the covariance of the
    standardized parameters and g the slope of the constant in them. ``known`` is the part of the
    variance a priori that the data took away: near 0 the value is that of the prior.
    """
    model = double_copy(model)
    parameters = list(model.parameters())
    rows = []
    for item in model.physical_constants():
        for name, value in zip(item.names, item.values, strict=True):
            slopes = torch.autograd.grad(
                value, parameters, retain_graph=True, materialize_grads=True, allow_unused=True
            )
            slope = torch.cat([part.flatten() for part in slopes])
            sigma = float((slope @ fit.covariance @ slope).clamp(min=0).sqrt())
            prior = float(slope @ slope)
            known = 1 - sigma**2 / prior if prior > 0 else 0.0
            size, margin = float(value.detach()), 1.96 * sigma
            rows.append((name, size, size - margin, size + margin, item.unit, known))
    return pd.DataFrame(rows, columns=["name", "value", "low", "high", "unit", "known"])


def undetermined(model: KnownMechanics, fit: Fit, most: int = 10) -> list[str]:
    """In words, directions of the parameters that the prior decides and not the data.

    They are eigenvectors of the covariance whose variance is more than half of the prior's, the
    least known first; each is named by the parameters that make up most of it.
    """
    variances, directions = torch.linalg.eigh(fit.covariance)
    names = model.parameter_names()
    found: list[str] = []
    for variance, direction in zip(variances.flip(0), directions.T.flip(0), strict=True):
        if variance < _SHARE or len(found) == most:
            break
        order = direction.abs().argsort(descending=True).tolist()
        direction = direction * direction[order[0]].sign()  # the first is named without a sign
        share, chosen = 0.0, []
        for k in order[:4]:
            if share > 0.8:
                break
            share += float(direction[k] ** 2)
            chosen.append(f"{'+' if direction[k] > 0 else '-'} {names[k]}")
        text = " ".join(chosen).removeprefix("+ ")
        found.append(f"{text}: held by the prior ({float(variance):.0%} of its variance is left)")
    return found
