"""How well the data determine the constants of a known system."""

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
"""Of the table of constants."""
OPEN = 0.5
"""Variance of a constant or direction, as a part of the prior's, from which it is left open."""
_TOGETHER = 1 / 3
"""Width of a sum or ratio, as a part of what either part gives it, below which it is named."""
_WIDE = 0.1
"""Half of a 95 % interval, as a part of the value, above which a constant is not known alone."""
_GAIN = "drive gain of "


class _Posterior(NamedTuple):
    """All physical constants, ``(P,)`` each: at the fit and at the start, and covariances of both.

    ``covariance`` is S of :func:`constants_table`, ``prior`` that without data.
    """

    names: list[str]
    units: list[str]
    values: np.ndarray
    lower: np.ndarray
    start: np.ndarray
    covariance: np.ndarray
    prior: np.ndarray


class Direction(NamedTuple):
    """A direction of P parameters: the number of its own one, its entries ``(P,)``, in words."""

    own: int
    direction: np.ndarray
    text: str


def constants_table(
    model: LearnedConstants, fit: Fit, input_units: Sequence[str] = ()
) -> pd.DataFrame:
    """All constants in SI units with their 95 % intervals.

    Columns: name, value, low, high, unit, start (the value that the prior is around), known.

    The equation of motion is linear in the constants c (but for widths of friction and drive
    gains), the parameters z are not. So the interval is value +- 1.96 sigma of the linear
    problem, with I what the data say of z where the fit ended and P_0 the prior's precision where
    it began::

        S = (G^-T I G^-1 + G_0^-T P_0 G_0^-1)^-1,    G = dc/dz at the fit, G_0 at the start

    A constant that the data leave open keeps the width of the prior, however small its slope has
    become on the way. No interval goes below what a constant can be: zero for a mass. ``known`` is
    the part of the variance a priori that the data took away: near 0 the value is that of the
    prior.

    Args:
        model: where the fit left it.
        fit: what it found.
        input_units: of the inputs, for the drive gains, which are in ``Nm/u`` without.
    """
    of = _posterior(model, fit, input_units)
    variance, before = of.covariance.diagonal(), of.prior.diagonal()
    width = 1.96 * np.sqrt(variance)
    return pd.DataFrame(
        {
            "name": of.names,
            "value": of.values,
            "low": np.maximum(of.values - width, of.lower),
            "high": of.values + width,
            "unit": of.units,
            "start": of.start,
            "known": 1 - variance / before,
        }
    )


def determined_together(
    model: LearnedConstants, fit: Fit, input_units: Sequence[str] = ()
) -> pd.DataFrame:
    """Sums and ratios that the data determine where they do not determine the parts.

    Sums of two constants of one unit, as of a sliding mass and the armature of its drive; armature
    and friction of a joint over its drive gain. Both parts have intervals of more than 10 % of
    their values to either side, and the interval of the sum or ratio is less than a third of what
    either part alone would give it. Arguments and columns as of :func:`constants_table`.
    """
    of = _posterior(model, fit, input_units)
    sigma = np.sqrt(of.covariance.diagonal())
    unknown = np.flatnonzero(1.96 * sigma > _WIDE * np.abs(of.values)).tolist()
    rows = []
    for pair in map(list, combinations(unknown, 2)):
        (one, other), units = (of.names[k] for k in pair), [of.units[k] for k in pair]
        if units[0] == units[1]:
            name, unit, function = f"{one} + {other}", units[0], _sum
        elif other == f"{_GAIN}{one.split(' of ', 1)[1]}" and of.lower[pair[0]] >= 0:
            name, unit, function = f"{one} / {other}", f"{units[0]}/({units[1]})", _ratio
        else:
            continue
        value, slopes = function(*of.values[pair])
        start, slopes_before = function(*of.start[pair])
        block = np.ix_(pair, pair)
        variance = max(slopes @ of.covariance[block] @ slopes, 0.0)
        if variance**0.5 < _TOGETHER * np.abs(slopes * sigma[pair]).min():
            low = max(value - 1.96 * variance**0.5, of.lower[pair].sum())
            known = 1 - variance / (slopes_before @ of.prior[block] @ slopes_before)
            rows.append([name, value, low, value + 1.96 * variance**0.5, unit, start, known])
    return pd.DataFrame(rows, columns=COLUMNS)


def _sum(a: float, b: float) -> tuple[float, np.ndarray]:
    """a + b and its slopes."""
    return a + b, np.ones(2)


def _ratio(a: float, b: float) -> tuple[float, np.ndarray]:
    """a / b and its slopes."""
    return a / b, np.array([1 / b, -a / b**2])


def _posterior(model: LearnedConstants, fit: Fit, input_units: Sequence[str]) -> _Posterior:
    model = double_copy(model)
    found = model.physical_constants()
    slope = _constant_slopes(model)
    vector_to_parameters(fit.prior.mean.double(), model.parameters())
    start = torch.cat([item.values for item in model.physical_constants()])
    first = _constant_slopes(model)
    change = torch.linalg.lstsq(slope, first).solution
    information = change.T @ fit.information @ change
    covariance, prior = (
        first @ posterior_covariance(known, fit.prior.root) @ first.T
        for known in (information, torch.zeros_like(information))
    )
    values = torch.cat([item.values for item in found])
    return _Posterior(
        names=[name for item in found for name in item.names],
        units=[unit for item in found for unit in _units(item, input_units)],
        values=values.detach().numpy(),
        lower=np.concatenate([np.full(len(item.names), item.lower) for item in found]),
        start=start.detach().numpy(),
        covariance=covariance.numpy(),
        prior=prior.numpy(),
    )


def _units(item: Named, input_units: Sequence[str]) -> list[str]:
    """The units of constants, with that of the input in those of drive gains."""
    if not (item.names[0].startswith(_GAIN) and input_units and all(input_units)):
        return item.units
    pairs = zip(item.units, input_units, strict=True)
    return [unit.removesuffix("u") + input_unit for unit, input_unit in pairs]


def _constant_slopes(model: LearnedConstants) -> Tensor:
    """dc/dz, ``(P, P)``, of all constants by all parameters."""
    values = torch.cat([item.values for item in model.physical_constants()])
    parameters = list(model.parameters())
    rows = []
    for value in values:
        slopes = torch.autograd.grad(value, parameters, retain_graph=True, materialize_grads=True)
        rows.append(torch.cat([part.flatten() for part in slopes]))
    return torch.stack(rows)


def undetermined(model: LearnedConstants, fit: Fit) -> list[str]:
    """In words, directions of the parameters that the prior decides and not the data.

    They span the eigenvectors of the covariance whose variance is more than half of the prior's
    (:func:`named_directions`); those of drives come first, then bodies.
    """
    variances, vectors = torch.linalg.eigh(fit.covariance)
    space = vectors[:, variances > OPEN].T.numpy()
    found = []
    for one in reversed(named_directions(space, model.parameter_names())):
        variance = one.direction @ fit.covariance.numpy() @ one.direction
        found.append(f"{one.text}: held by the prior ({variance:.0%} of its variance is left)")
    return found


def named_directions(space: np.ndarray, names: Sequence[str]) -> list[Direction]:
    """Directions that span the rows of ``space`` ``(D, P)``, orthonormal, in words.

    Of all bases of that space this one has a parameter of its own in each direction, so that what
    is open by itself is named by itself. Each is named by the parameters that make up most of it;
    they come in the order of their own parameters.
    """
    if not len(space):
        return []
    _, _, order = qr(space, mode="economic", pivoting=True)
    own = np.sort(order[: len(space)])
    found = []
    for k, row in zip(own, np.linalg.solve(space[:, own], space), strict=True):
        direction = row / np.linalg.norm(row)
        largest = np.argsort(-np.abs(direction))
        direction = direction * np.sign(direction[largest[0]])  # the first has no sign
        share, chosen = 0.0, []
        for j in largest[:4]:
            if share > 0.8:
                break
            share += float(direction[j] ** 2)
            chosen.append(f"{'+' if direction[j] > 0 else '-'} {names[j]}")
        found.append(Direction(int(k), direction, " ".join(chosen).removeprefix("+ ")))
    return found
