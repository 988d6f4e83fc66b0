"""Mass, center of mass and inertia of a load, from motions with and without the load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from pinn_dyn.identification.constants import OPEN, constants_covariance
from pinn_dyn.mechanics import Signal, Trajectory, double_copy
from pinn_dyn.models import KnownMechanics, LearnedConstants
from pinn_dyn.models.known import INERTIAL
from pinn_dyn.models.known_constants import Named, RealConstants
from pinn_dyn.systems.inertia import central_parameters, inertial_parameters, pseudo_inertia
from pinn_dyn.training import LeastSquares

_NAMES = ("mass", "center x", "center y", "center z", *INERTIAL[4:])
_UNITS = ("kg", *3 * ["m"], *6 * ["kg m^2"])


def identify_payload(
    model: KnownMechanics,
    without: Sequence[Trajectory],
    loaded: Sequence[Trajectory],
    *,
    cutoff: float,
    samples: int = 4000,
) -> pd.DataFrame:
    """Fit motions with and without a load by shared constants, and by the load alone::

        Y(q, v, a) pi + lambda Y_k(q, v, a) pi_load + drive force(v, a, u) = 0

    lambda is 1 with the load, and k the body that carries it. pi_load has no physical limits, so
    that the interval of a missing load contains zero. The drives must have the same friction with
    and without the load. A number is not determined if the data removed less than half of its prior
    variance, which is that of a load as heavy as the arm. Source: Swevers, Verdonck and De Schutter
    (2007), "Dynamic model identification for industrial robots", IEEE Control Systems 27(5).

    Args:
        model: known mechanics, fitted or not. It is not changed.
        without, loaded: motions without and with the load.
        cutoff: cutoff of the filter, Hz, see :class:`~pinn_dyn.training.LeastSquares`.
        samples: number of samples.

    Returns:
        Table of the mass, the center of mass and the inertia about it, with 95 % intervals, in the
        frame ``attrs["frame"]``.

    Raises:
        ValueError: as :meth:`LeastSquares.fit <pinn_dyn.training.LeastSquares.fit>`, or if the tip
            is fixed to the base.
    """
    joint = _LoadedRobot(double_copy(model)).requires_grad_()
    runs = [_marked(run, 0.0) for run in without] + [_marked(run, 1.0) for run in loaded]
    solver = LeastSquares(cutoff=cutoff, rollouts=False, samples=samples)
    fit = solver.fit(cast(LearnedConstants, joint), runs)
    after, before = constants_covariance(cast(LearnedConstants, joint), fit)
    covariance, prior = after[-10:, -10:], before[-10:, -10:]
    with torch.no_grad():
        parameters = joint.load()
    jacobian = torch.func.jacrev(_central)(parameters)
    variance = (jacobian @ covariance @ jacobian.T).diagonal()
    open_variance = jacobian.diagonal() ** 2 * prior.diagonal()  # without that of the center
    width = 1.96 * variance.sqrt()
    values = _central(parameters)
    determined = variance < OPEN * open_variance
    if not values[0] > width[0]:  # the center of a load without mass is anywhere
        values[1:], determined[1:] = torch.nan, False
    columns = {"value": values, "low": values - width, "high": values + width}
    table = pd.DataFrame({"name": _NAMES} | {k: x.numpy() for k, x in columns.items()})
    table["unit"], table["determined"] = _UNITS, np.where(determined, "yes", "not determined")
    table.attrs["frame"] = joint.frame
    return table


class _LoadedRobot(nn.Module):
    """Known mechanics with a load where the last input is 1."""

    def __init__(self, mechanics: KnownMechanics):
        super().__init__()
        self.known, self.num_inputs = mechanics, mechanics.num_inputs
        self.drive_gain, self.force_ratio = mechanics.drive_gain, mechanics.force_ratio
        structure: Any = getattr(mechanics.structure, "chain", mechanics.structure)
        body, pose = structure._tip_body, torch.eye(4, dtype=torch.float64)
        self.frame = structure.body_names[body]
        if structure.tip is not None:
            self.frame, pose = structure.tip, structure._tip_pose
        if body < 0:
            raise ValueError("the tip is fixed to the base: set structure.tip to a moving link")
        start = mechanics.bodies.start()
        mass = start[:, 3, 3]
        second = start.diagonal(dim1=1, dim2=2)[:, :3].sum(-1)
        length = 2 * float((second / mass).max() ** 0.5)
        powers = torch.tensor([0.0, *3 * [1.0], *6 * [2.0]], dtype=torch.float64)
        units = ["kg", *3 * ["kg m"], *6 * ["kg m^2"]]
        names = [f"{label} of the load" for label in INERTIAL]
        self.load = RealConstants(float(mass.sum()) * length**powers, names, units).double()
        basis = pose @ pseudo_inertia(torch.eye(10, dtype=torch.float64)) @ pose.T
        self.to_body = inertial_parameters(basis).T
        self.columns = slice(10 * body, 10 * body + 10)

    has_passive_joints = False  # the equation of a load has no mass matrix
    parameter_names = LearnedConstants.parameter_names
    absent_parameters = LearnedConstants.absent_parameters

    def physical_constants(self) -> list[Named]:
        return [*self.known.physical_constants(), self.load.named()]

    def force_scale(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        return self.known.force_scale(q, v, a, u[:, :-1])

    def saturated(self, v: Tensor, u: Tensor) -> Tensor:
        return self.known.saturated(v, u[:, :-1])

    def slopes(self) -> _LoadedRobot:
        return self

    def gain(self) -> Tensor:
        return nn.functional.pad(self.known.slopes().gain(), (0, 10))

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> _Samples:
        return _Samples(self, q, v, a, u)


class _Samples:
    def __init__(self, model: _LoadedRobot, q: Tensor, v: Tensor, a: Tensor, u: Tensor):
        self.load, self.known = model.load, model.known.samples(q, v, a, u[:, :-1])
        rows = model.known.structure.regressor(q, v, a)[..., model.columns] @ model.to_body
        self.rows = u[:, -1:, None] * rows * model.load.spread

    def missing_force(self) -> Tensor:
        return self.known.missing_force() + self.rows @ self.load.z

    def by_parameters(self) -> Tensor:
        return torch.cat([self.known.by_parameters(), self.rows], dim=-1)


def _marked(run: Trajectory, load: float) -> Trajectory:
    u = torch.nn.functional.pad(run.u.double(), (0, 1), value=load)
    return replace(run, input=Signal(run.t, u, run.input.interpolation), past=None)


def _central(parameters: Tensor) -> Tensor:
    return central_parameters(pseudo_inertia(parameters))
