"""Uncertainty of the fitted constants of a known system."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from scipy.linalg import qr
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from pinn_dyn.mechanics import double_copy
from pinn_dyn.models.known_constants import Named
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.training.constants_fit import Fit, posterior_covariance

COLUMNS = ["name", "value", "low", "high", "unit", "start", "known"]
"""Columns of the table of constants."""
OPEN = 0.5
"""Part of the prior variance above which a constant or direction is not determined."""
_COMBINED = 1 / 3  # relative width below which a sum or ratio is determined
_WIDE = 0.1  # relative half width above which a constant alone is not determined
_GAIN = "drive gain of "


class _Posterior(NamedTuple):
    """All P physical constants at the fit and at its start, with their covariances.

    ``covariance`` is S of :func:`constants_table`, ``prior`` the covariance without data.
    """

    names: list[str]
    units: list[str]
    values: np.ndarray
    lower: np.ndarray
    start: np.ndarray
    covariance: np.ndarray
    prior: np.ndarray


class Direction(NamedTuple):
    """A direction of P parameters.

    Attributes:
        parameter: index of the parameter that only this direction of a basis contains.
        direction: unit vector, ``(P,)``.
        text: the largest entries with their names.
    """

    parameter: int
    direction: np.ndarray
    text: str


def constants_table(
    model: LearnedConstants, fit: Fit, input_units: Sequence[str] = ()
) -> pd.DataFrame:
    """Return all constants in SI units with their 95 % intervals.

    The columns are name, value, low, high, unit, start (the center of the prior) and known. The
    equation of motion is linear in the constants c, except for widths of friction and drive gains,
    but not in the parameters z. The interval is value +- 1.96 sigma of the linear problem, with
    the information I of the data on z at the fit, and the precision P_0 of the prior at the start::

        S = (G^-T I G^-1 + G_0^-T P_0 G_0^-1)^-1,    G = dc/dz at the fit, G_0 at the start

    A constant that the data do not determine keeps the width of the prior. No interval extends
    below the lower limit of a constant, such as zero for a mass. ``known`` is the part of the
    prior variance that the data removed: the value is that of the prior if it is near 0.

    Args:
        model: the fitted model.
        fit: the result of the fit.
        input_units: units of the inputs, for the drive gains; without, their unit is ``Nm/u``.
    """
    posterior = _posterior(model, fit, input_units)
    variance, before = posterior.covariance.diagonal(), posterior.prior.diagonal()
    width = 1.96 * np.sqrt(variance)
    return pd.DataFrame(
        {
            "name": posterior.names,
            "value": posterior.values,
            "low": np.maximum(posterior.values - width, posterior.lower),
            "high": posterior.values + width,
            "unit": posterior.units,
            "start": posterior.start,
            "known": 1 - variance / before,
        }
    )


def determined_together(
    model: LearnedConstants, fit: Fit, input_units: Sequence[str] = ()
) -> pd.DataFrame:
    """Return sums and ratios that the data determine although they do not determine the parts.

    Candidates are sums of two constants of one unit, such as a sliding mass and the armature of
    its drive, and ratios of the armature or friction of a joint to its drive gain. Both parts have
    intervals wider than 10 % of their values to either side, and the interval of the sum or ratio
    is less than a third of the width that either part alone would give. Arguments and columns are
    those of :func:`constants_table`.
    """
    posterior = _posterior(model, fit, input_units)
    sigma = np.sqrt(posterior.covariance.diagonal())
    wide = np.flatnonzero(1.96 * sigma > _WIDE * np.abs(posterior.values)).tolist()
    rows = []
    for pair in map(list, combinations(wide, 2)):
        first, second = (posterior.names[k] for k in pair)
        units = [posterior.units[k] for k in pair]
        if units[0] == units[1]:
            name, unit, function = f"{first} + {second}", units[0], _sum
        elif second == f"{_GAIN}{first.split(' of ', 1)[1]}" and posterior.lower[pair[0]] >= 0:
            name, unit, function = f"{first} / {second}", f"{units[0]}/({units[1]})", _ratio
        else:
            continue
        value, slopes = function(*posterior.values[pair])
        start, slopes_before = function(*posterior.start[pair])
        block = np.ix_(pair, pair)
        variance = max(slopes @ posterior.covariance[block] @ slopes, 0.0)
        if variance**0.5 < _COMBINED * np.abs(slopes * sigma[pair]).min():
            low = max(value - 1.96 * variance**0.5, posterior.lower[pair].sum())
            before = slopes_before @ posterior.prior[block] @ slopes_before
            high = value + 1.96 * variance**0.5
            rows.append([name, value, low, high, unit, start, 1 - variance / before])
    return pd.DataFrame(rows, columns=COLUMNS)


def _sum(a: float, b: float) -> tuple[float, np.ndarray]:
    """Return a + b and its derivatives."""
    return a + b, np.ones(2)


def _ratio(a: float, b: float) -> tuple[float, np.ndarray]:
    """Return a / b and its derivatives."""
    return a / b, np.array([1 / b, -a / b**2])


def _posterior(model: LearnedConstants, fit: Fit, input_units: Sequence[str]) -> _Posterior:
    model = double_copy(model)
    constants = model.physical_constants()
    jacobian = _jacobian(model)
    vector_to_parameters(fit.prior.mean.double(), model.parameters())
    start = torch.cat([item.values for item in model.physical_constants()])
    first = _jacobian(model)
    change = torch.linalg.lstsq(jacobian, first).solution
    information = change.T @ fit.information @ change
    covariance, prior = (
        first @ posterior_covariance(matrix, fit.prior.root) @ first.T
        for matrix in (information, torch.zeros_like(information))
    )
    values = torch.cat([item.values for item in constants])
    return _Posterior(
        names=[name for item in constants for name in item.names],
        units=[unit for item in constants for unit in _units(item, input_units)],
        values=values.detach().numpy(),
        lower=np.concatenate([np.full(len(item.names), item.lower) for item in constants]),
        start=start.detach().numpy(),
        covariance=covariance.numpy(),
        prior=prior.numpy(),
    )


def _units(item: Named, input_units: Sequence[str]) -> list[str]:
    """Return the units of constants; those of drive gains contain the unit of the input."""
    if not (item.names[0].startswith(_GAIN) and input_units and all(input_units)):
        return item.units
    pairs = zip(item.units, input_units, strict=True)
    return [unit.removesuffix("u") + input_unit for unit, input_unit in pairs]


def _jacobian(model: LearnedConstants) -> Tensor:
    """Return dc/dz of all constants by all parameters, ``(P, P)``."""
    values = torch.cat([item.values for item in model.physical_constants()])
    parameters = list(model.parameters())
    rows = []
    for value in values:
        slopes = torch.autograd.grad(value, parameters, retain_graph=True, materialize_grads=True)
        rows.append(torch.cat([part.flatten() for part in slopes]))
    return torch.stack(rows)


def undetermined(model: LearnedConstants, fit: Fit) -> list[str]:
    """Return descriptions of the directions of the parameters that only the prior determines.

    The directions span the eigenvectors of the covariance whose variance is more than half of the
    prior's, see :func:`named_directions`. Those of drives come first, then bodies.
    """
    variances, vectors = torch.linalg.eigh(fit.covariance)
    space = vectors[:, variances > OPEN].T.numpy()
    lines = []
    for item in reversed(named_directions(space, model.parameter_names())):
        variance = item.direction @ fit.covariance.numpy() @ item.direction
        lines.append(f"{item.text}: held by the prior ({variance:.0%} of its variance is left)")
    return lines


def named_directions(space: np.ndarray, names: Sequence[str]) -> list[Direction]:
    """Return directions that span the orthonormal rows of ``space`` ``(D, P)``, with their names.

    In this basis each direction contains a parameter that no other direction contains, so that a
    single undetermined parameter is named alone. The text names the parameters with the largest
    entries. The directions are in the order of their parameters.
    """
    if not len(space):
        return []
    _, _, order = qr(space, mode="economic", pivoting=True)
    pivots = np.sort(order[: len(space)])
    directions = []
    for k, row in zip(pivots, np.linalg.solve(space[:, pivots], space), strict=True):
        direction = row / np.linalg.norm(row)
        largest = np.argsort(-np.abs(direction))
        direction = direction * np.sign(direction[largest[0]])  # the first has no sign
        share, chosen = 0.0, []
        for j in largest[:4]:
            if share > 0.8:
                break
            share += float(direction[j] ** 2)
            chosen.append(f"{'+' if direction[j] > 0 else '-'} {names[j]}")
        directions.append(Direction(int(k), direction, " ".join(chosen).removeprefix("+ ")))
    return directions
