"""Uncertainty of the fitted constants of a known system, and joints that a fit cannot predict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy
import torch
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from pinn_dyn.atomic_files import read_regular
from pinn_dyn.mechanics import Trajectory, double_copy
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.known import KnownMechanics
from pinn_dyn.models.known_constants import Named, PositiveConstants
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.training.constants_fit import Fit, posterior_covariance
from pinn_dyn.training.filtered_motion import filtered_motion

_SAMPLES = 2000
_DIFFERENCE = 6**0.5  # standard deviation of the second difference of white noise of one


@torch.no_grad()
def weak_joints(
    model: LearnedConstants, runs: Sequence[Trajectory], cutoff: float, labels: Sequence[str]
) -> list[str]:
    """Describe joints whose accelerating force is smaller than the unexplained force of the fit.

    The cause is noise of the torques if it makes up more than half of the power of the unexplained
    force in the band of the filter, or else motion that is too slow.

    Args:
        model: the fitted model.
        runs: training motions.
        cutoff: cutoff of the filter of the motions, Hz.
        labels: names of the coordinates.
    """
    model = double_copy(model)
    q, v, a, u = filtered_motion(runs, cutoff, _SAMPLES)
    inertial = matvec(model.mass_matrix(q), a).std(0)
    missing = model.missing_force(q, v, a, u).std(0)
    changes = [model.motor_force(*(x.double() for x in (run.q, run.v, run.u))) for run in runs]
    noise = torch.cat([force.diff(n=2, dim=0) for force in changes]).std(0) / _DIFFERENCE
    step = float(runs[0].t[1] - runs[0].t[0])
    noise = noise * (2 * cutoff * step) ** 0.5
    lines = []
    for k in (missing > inertial).nonzero().flatten().tolist():
        noisy = bool(2 * noise[k].square() > missing[k].square())
        cause = "the noise of its torque" if noisy else "the motion is too slow"
        lines.append(
            f"{labels[k]}: forces of {inertial[k]:.2g} accelerate it, and {missing[k]:.2g} are "
            f"unexplained, probable cause: {cause}"
        )
    return lines


CONSTANTS = "constants.csv"
"""File of the table of constants in a run folder."""
COLUMNS = ["name", "value", "low", "high", "unit", "start", "known"]
"""Columns of the table of constants."""
OPEN = 0.5
"""Part of the prior variance above which a constant or direction is not determined."""
_CONFLICT = 3.0  # prior standard deviations
_FAR = 3.0  # factor between a mass and that of the URDF


class Direction(NamedTuple):
    """A unit vector of P parameters, in words; ``parameter`` is in no other of its basis."""

    parameter: int
    direction: np.ndarray
    text: str


def read_constants(folders: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """Read the constants of runs by their names; earlier versions wrote fewer columns."""
    return {
        name: pd.read_csv(StringIO(read_regular(path))).reindex(columns=COLUMNS)
        for name, folder in folders.items()
        if (path := folder / CONSTANTS).is_file()
    }


def constants_table(
    model: LearnedConstants, fit: Fit, input_units: Sequence[str] = ()
) -> pd.DataFrame:
    """Return all constants in SI units with their 95 % intervals.

    The equation of motion is linear in the constants c, except for widths of friction and drive
    gains, but not in the parameters z. The interval is value +- 1.96 sigma from the information of
    the data on c = c(z) at the fit and the prior of c, with G = dc/dz at the fit or at the start,
    whichever is wider in a direction.

    No interval extends below the lower limit of a constant, such as zero for a mass. Data give only
    upper limits of widths of friction. ``start`` is the center of the prior, and ``known`` the part
    of the prior variance that the data removed. With ``input_units`` the units of drive gains are
    complete; without, they are ``Nm/u``.
    """
    model = double_copy(model)
    constants = model.physical_constants()
    values = torch.cat([item.values for item in constants]).detach().numpy()
    covariance, prior = constants_covariance(model, fit)
    vector_to_parameters(fit.prior.mean.double(), model.parameters())
    start = torch.cat([item.values for item in model.physical_constants()]).detach().numpy()
    variance, before = covariance.diagonal().numpy(), prior.diagonal().numpy()
    lower = np.concatenate([np.full(len(item.names), item.lower) for item in constants])
    limits = np.concatenate([np.full(len(item.names), item.upper_limit) for item in constants])
    width = 1.96 * np.sqrt(variance)
    columns = {
        "name": [name for item in constants for name in item.names],
        "value": values,
        "low": np.where(limits, lower, np.maximum(values - width, lower)),
        "high": values + width,
        "unit": [unit for item in constants for unit in _units(item, input_units)],
        "start": start,
        "known": 1 - variance / before,
    }
    return pd.DataFrame(columns)


def constants_covariance(model: LearnedConstants, fit: Fit) -> tuple[Tensor, Tensor]:
    """Return the covariances of the physical constants after the fit and a priori, ``(P, P)``."""
    model = double_copy(model)
    jacobian = _jacobian(model)
    vector_to_parameters(fit.prior.mean.double(), model.parameters())
    change = torch.linalg.lstsq(jacobian, _jacobian(model)).solution
    back = torch.linalg.inv(fit.prior.root)
    vectors, scale, _ = torch.linalg.svd(fit.prior.root @ change @ back)
    root = (vectors / scale.clamp(min=1)).T @ fit.prior.root
    before = posterior_covariance(torch.zeros_like(root), root)
    after = posterior_covariance(fit.information, root, fit.scores)
    return jacobian @ after @ jacobian.T, jacobian @ before @ jacobian.T


def _units(item: Named, input_units: Sequence[str]) -> list[str]:
    """Return the units of constants; the unit of a drive gain contains the unit of its input."""
    if not (input_units and all(input_units) and item.names[0].startswith("drive gain of ")):
        return item.units
    pairs = zip(item.units, input_units, strict=True)
    return [unit.removesuffix("u") + input_unit for unit, input_unit in pairs]


def _jacobian(model: LearnedConstants) -> Tensor:
    """Return dc/dz of all constants by all parameters, ``(P, P)``."""
    values = torch.cat([item.values for item in model.physical_constants()])
    unit = torch.eye(len(values)).to(values)
    slopes = torch.autograd.grad(
        values, list(model.parameters()), unit, is_grads_batched=True, materialize_grads=True
    )
    return torch.cat([part.flatten(1) for part in slopes], dim=1)


def undetermined(model: LearnedConstants, fit: Fit) -> list[str]:
    """Describe the directions of the parameters that only the prior determines.

    They span the eigenvectors of the covariance whose variance is more than half of the prior's.
    Widths of friction that a fit with sticking does not use are left out.
    """
    widths = {x for item in model.physical_constants() if item.upper_limit for x in item.names}
    unused = {
        name
        for name, row in zip(model.parameter_names(), fit.information, strict=True)
        if name in widths and not row.any()
    }
    variances, vectors = torch.linalg.eigh(fit.covariance)
    space = vectors[:, variances > OPEN].T.numpy()
    lines = []
    for item in reversed(named_directions(space, model.parameter_names())):
        if item.text in unused:
            continue
        variance = item.direction @ fit.covariance.numpy() @ item.direction
        lines.append(f"{item.text}: held by the prior ({variance:.0%} of its variance is left)")
    return lines


def contradicted(model: LearnedConstants, fit: Fit) -> list[str]:
    """Describe the bodies and gains that a first fit moves by over 3 prior standard deviations."""
    if not isinstance(model, KnownMechanics) or fit.prior.mean.any():
        return []
    default = float(model.bodies.spread.min())
    wider = f"correct its <inertial>, or set 'model.spread={{{{default: {default:g}, {{0}}: 3}}}}'"
    remedies = {model.bodies: wider, model.gain: "correct model.drive_gain, or raise gain_spread"}
    lines = []
    for part, remedy in remedies.items():
        far: dict[str, list[str]] = {}
        for name, z in zip(part.names, part.z.flatten().tolist(), strict=True) if part else ():
            label, owner = name.split(" of ", 1)
            if abs(z) > _CONFLICT:
                far.setdefault(owner, []).append(f"{label} by {abs(z):.1f}")
        for owner, texts in far.items():
            moved = (
                f"the data move {owner} far from its prior, {', '.join(texts)} standard deviations"
            )
            lines.append(f"{moved}: {remedy.format(owner)}")
    return lines


def far_masses(table: pd.DataFrame) -> list[str]:
    """Describe masses whose 95 % interval lies more than a factor of 3 from the start of the fit.

    Args:
        table: constants of a first fit, which starts from the masses of the URDF.
    """
    masses = table[table["name"].str.startswith("mass of ")]
    far = masses[
        (masses["low"] > _FAR * masses["start"]) | (masses["high"] * _FAR < masses["start"])
    ]
    parts = [
        f"the {row.name} is {row.value:.3g} kg ({row.low:.3g} to {row.high:.3g}), in the URDF "
        f"{row.start:.3g} kg"
        for row in far.itertuples(index=False, name="Mass")
    ]
    if not parts:
        return []
    cause = "is an input reversed or in another unit, or does the URDF describe another robot?"
    return [f"{'; '.join(parts)}: {cause} Check the log with the URDF"]


def common_factor(model: KnownMechanics, fit: Fit) -> float:
    """Return the ratio of the upper end of the 95 % interval of all drive gains to their value."""
    assert isinstance(model.gain, PositiveConstants)
    index = [model.parameter_names().index(name) for name in model.gain.names]
    deviation = model.gain.spread * float(fit.covariance[index][:, index].mean()) ** 0.5
    return math.exp(1.96 * deviation)


def named_directions(space: np.ndarray, names: Sequence[str]) -> list[Direction]:
    """Return directions that span the orthonormal rows of ``space`` ``(D, P)``, with their names.

    Each direction contains a parameter that no other direction contains, so that a single
    undetermined parameter is named alone.
    """
    if not len(space):
        return []
    _, _, order = scipy.linalg.qr(space, mode="economic", pivoting=True)
    pivots = np.sort(order[: len(space)])
    directions = []
    for k, row in zip(pivots, np.linalg.solve(space[:, pivots], space), strict=True):
        direction = row / np.linalg.norm(row)
        largest = np.argsort(-np.abs(direction))
        direction = direction * np.sign(direction[largest[0]])  # the first has no sign
        before = np.cumsum(direction[largest] ** 2) - direction[largest] ** 2
        chosen = [
            f"{'+' if direction[j] > 0 else '-'} {names[j]}" for j in largest[:4][before[:4] <= 0.8]
        ]
        directions.append(Direction(int(k), direction, " ".join(chosen).removeprefix("+ ")))
    return directions
