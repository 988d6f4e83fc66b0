"""External torques along a data frame, in the rows of a log."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data import LogSource
from pinn_dyn.data.logs import Recording
from pinn_dyn.data.logs.pieces import trajectory
from pinn_dyn.evaluation.external_torque import (
    ExternalTorque,
    contact_intervals,
    contact_thresholds,
    link_wrench,
    observed_torques,
    quiet_level,
    settled,
)
from pinn_dyn.mechanics import MechanicalSystem, Trajectory
from pinn_dyn.systems import RigidChain

_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
_DOUBT = 3.0  # ratio of the level of a frame's quiet part to that of quiet motion
_TEXT = (
    "%s: even its quiet part has %.2g times the external torque of quiet motion: the robot carries "
    "a load, or signs, units, order, zero positions or clocks of columns are not those of the "
    "training"
)

log = logging.getLogger(__name__)


def external_torque(
    model: MechanicalSystem,
    source: LogSource,
    frame: pd.DataFrame,
    *,
    quiet: pd.DataFrame | None,
    bandwidth: float,
    false_alarms: float,
    link: str | None,
    urdf: str | None,
    moment: bool,
) -> ExternalTorque:
    """Return the external torques of each run of a frame, see :meth:`Run.external_torque`."""
    chain = None if link is None else _chain(model, urdf, link)
    motions: Sequence[Trajectory] = source.load().validation
    if quiet is not None:
        motions = [_motion(source, clean) for _, _, clean in source.recordings(quiet)]
    step = float(motions[0].t[1] - motions[0].t[0])
    sizes = [settled(observed_torques(model, x, bandwidth)[0], step, bandwidth) for x in motions]
    levels = contact_thresholds(sizes, step, bandwidth, false_alarms)
    usual, doubtful = quiet_level(torch.cat(sizes), levels), []
    threshold = pd.Series(levels, index=source.labels)
    contacts: list[dict[str, object]] = []
    values: dict[str, np.ndarray] = {"time": np.full(len(frame), np.nan)}
    runs = np.full(len(frame), "", dtype=object)
    for rows, raw, clean in source.recordings(frame):
        motion = _motion(source, clean)
        residual, drive = observed_torques(model, motion, bandwidth)
        level = quiet_level(settled(residual, step, bandwidth), levels)
        if level > _DOUBT * usual:
            doubtful.append(clean.run)
            log.warning(_TEXT, clean.run, level / usual)
        parts = {"measured": drive, "model": drive + residual, "external": residual}
        columns: dict[str, Any] = {
            f"{part} {label}": x
            for part, y in parts.items()
            for label, x in zip(source.labels, y.T.numpy(), strict=True)
        }
        contacts += contact_intervals(clean.run, clean.t, residual.numpy(), threshold, bandwidth)
        columns["contact"] = (residual.abs().numpy() > levels).any(axis=1)
        if chain is not None:
            wrench, ambiguous = link_wrench(chain, motion.q, residual, moment=moment)
            columns |= dict(zip(_WRENCH, wrench.T.numpy(), strict=False))
            columns["ambiguous"] = ambiguous.numpy()
        runs[rows], values["time"][rows] = clean.run, raw.t
        for name, column in columns.items():
            whole = values.setdefault(name, np.full(len(frame), np.nan))
            whole[rows] = np.interp(raw.t, clean.t, column, left=np.nan, right=np.nan)
    table = pd.DataFrame(values, index=frame.index)
    table.insert(1, "run", runs)
    for name in {"contact", "ambiguous"} & set(table.columns):
        table[name] = table[name] > 0.5
    names = ["run", "start", "end", "joint", "torque"]
    found = pd.DataFrame(contacts, columns=names)
    return ExternalTorque(table, threshold, found, bandwidth, tuple(doubtful))


def _motion(source: LogSource, clean: Recording) -> Trajectory:
    return trajectory(clean, clean.sample_time("external_torque"), source.interpolation)


def _chain(model: Any, urdf: str | None, link: str) -> RigidChain:
    """Return the robot of the model, or of a URDF with the same joints, whose tip is the link."""
    known = getattr(model, "known", model)
    structure = getattr(known, "structure", None)
    chain = getattr(structure, "chain", structure)
    if urdf is not None:
        chain = RigidChain(urdf, tip=link)
    if not isinstance(chain, RigidChain) or chain.num_coordinates != model.num_coordinates:
        kind = type(model).__name__
        raise ValueError(f"a {kind} has no links: give the URDF of its joints as urdf='robot.urdf'")
    return chain._with("tip", link).to(torch.float64)
