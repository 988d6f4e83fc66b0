"""Mass, center of mass and inertia of a load, from motions with and without the load."""

from __future__ import annotations

import logging
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
from pinn_dyn.training.filtered_motion import filtered_motion
from pinn_dyn.training.least_squares import REST

_NAMES = ("mass", "center x", "center y", "center z", *INERTIAL[4:])
_UNITS = ("kg", *3 * ["m"], *6 * ["kg m^2"])
_DOUBT = 2.5  # RMS ratio of the unexplained shares of the torques, with the load over without it

log = logging.getLogger(__name__)


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
    variance, which is that of a load as heavy as the arm. All numbers are contradicted if the mass
    is clearly negative, or if the fitted model with any load leaves more than 2.5 times the share
    of the torques of the loaded motions unexplained than of the others. Source: Swevers, Verdonck
    and De Schutter (2007), "Dynamic model identification for industrial robots", IEEE Control
    Systems 27(5).

    Args:
        model: known mechanics, fitted to the motions without the load. It is not changed.
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
    if doubt := _doubt(model, without, loaded, table.high[0], cutoff, samples):
        table["determined"] = "contradicted"
        log.warning("the load is contradicted: %s", doubt)
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


def _doubt(
    model: KnownMechanics,
    without: Sequence[Trajectory],
    loaded: Sequence[Trajectory],
    heaviest: float,
    cutoff: float,
    samples: int,
) -> str:
    """Return the contradiction to a load of at most ``heaviest`` kg, or "" without one."""
    robot = _LoadedRobot(double_copy(model))
    before, after = (_unexplained(robot, x, cutoff, samples) for x in (without, loaded))
    ratios = (after / before).nan_to_num(0.0)  # a passive joint has no torque
    name, ratio = (
        model.structure.joint_names[int(ratios.argmax())],
        float(ratios.square().mean().sqrt()),
    )
    if ratio > _DOUBT:
        return (
            f"no load explains {ratio:.2g} times the share of the torques that is unexplained "
            f"without a load, most at {name}; compare signs, units, order, zero positions and "
            "clocks of the columns with those of the training"
        )
    text = "its mass is at most {:.3g} kg: are the motions with and without the load exchanged?"
    return text.format(heaviest) if heaviest < 0 else ""


def _unexplained(
    robot: _LoadedRobot, runs: Sequence[Trajectory], cutoff: float, samples: int
) -> Tensor:
    """Return the unexplained share of each torque with the best load, ``(N,)``."""
    q, v, a, u = filtered_motion([_marked(run, 1.0) for run in runs], cutoff, samples)
    at = robot.samples(q, v, a, u)
    moves = v.abs() > REST * v.std(0)
    with torch.no_grad():
        force, rows = at.missing_force() * moves, at.rows * moves[..., None]
        drive = robot.known.motor_force(q, v, u[:, :-1]) * moves
    flat = rows.flatten(0, 1)
    load = torch.linalg.lstsq(flat, -force.flatten()[:, None], driver="gelsd").solution
    return (force + (rows @ load)[..., 0]).norm(dim=0) / drive.norm(dim=0)


def _marked(run: Trajectory, load: float) -> Trajectory:
    u = torch.nn.functional.pad(run.u.double(), (0, 1), value=load)
    return replace(run, input=Signal(run.t, u, run.input.interpolation), past=None)


def _central(parameters: Tensor) -> Tensor:
    return central_parameters(pseudo_inertia(parameters))
