"""How well the data determine the constants of a known system."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from pinn_dyn.mechanics import double_copy
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.training.constants_fit import Fit, posterior_covariance

_SHARE = 0.5
"""Variance of a direction, as a part of that of the prior, from which the data leave it open."""


def constants_table(model: LearnedConstants, fit: Fit) -> pd.DataFrame:
    """All constants in SI units with their 95 % intervals: name, value, low, high, unit, known.

    The equation of motion is linear in the constants c (but for widths of friction and drive
    gains), the parameters z are not. So the interval is value +- 1.96 sigma of the linear
    problem, with I what the data say of z where the fit ended and P_0 the prior's precision where
    it began::

        S = (G^-T I G^-1 + G_0^-T P_0 G_0^-1)^-1,    G = dc/dz at the fit, G_0 at the start

    A constant that the data leave open keeps the width of the prior, however small its slope has
    become on the way. ``known`` is the part of the variance a priori that the data took away:
    near 0 the value is that of the prior.
    """
    model = double_copy(model)
    found = model.physical_constants()
    slope = _constant_slopes(model)
    vector_to_parameters(fit.prior.mean.double(), model.parameters())
    first = _constant_slopes(model)
    change = torch.linalg.lstsq(slope, first).solution
    information = change.T @ fit.information @ change
    sigma, prior = (
        (first @ posterior_covariance(known, fit.prior.root) @ first.T).diagonal().sqrt()
        for known in (information, torch.zeros_like(information))
    )
    value = torch.cat([item.values for item in found]).detach()
    return pd.DataFrame(
        {
            "name": [name for item in found for name in item.names],
            "value": value,
            "low": value - 1.96 * sigma,
            "high": value + 1.96 * sigma,
            "unit": [unit for item in found for unit in item.units],
            "known": 1 - (sigma / prior) ** 2,
        }
    )


def _constant_slopes(model: LearnedConstants) -> Tensor:
    """dc/dz, ``(P, P)``, of all constants by all parameters."""
    values = torch.cat([item.values for item in model.physical_constants()])
    parameters = list(model.parameters())
    rows = []
    for value in values:
        slopes = torch.autograd.grad(value, parameters, retain_graph=True, materialize_grads=True)
        rows.append(torch.cat([part.flatten() for part in slopes]))
    return torch.stack(rows)


def undetermined(model: LearnedConstants, fit: Fit, most: int = 10) -> list[str]:
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
