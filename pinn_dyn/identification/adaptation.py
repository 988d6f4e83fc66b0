"""Constants of drives over the time of a log, by recursive least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import KnownMechanics
from pinn_dyn.plots import COLORS, legend_below, panels, save
from pinn_dyn.training.filtered_motion import filtered_motion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PER_PERIOD = 2.0  # samples in a period of the cutoff, which are all but independent
_REST = 0.03  # speed in units of its spread, below which dry friction is unknown

Constant = Literal["friction", "offset"]


@dataclass(frozen=True, repr=False)
class Adaptation:
    """Constants over time, see :func:`adapted_constants`.

    Attributes:
        table: a row per run, time and constant: ``run``, ``time`` in s, ``name``, ``unit``,
            ``value``, the ends ``low`` and ``high`` of its 95 % interval, and ``start``, the value
            of the fit.
    """

    table: pd.DataFrame

    def figure(self, run: str | None = None) -> Figure:
        """Draw the constants of a run over time, the first run by default."""
        table = self.table
        run = table["run"].iloc[0] if run is None else run
        parts = dict(iter(table[table["run"] == run].groupby("name", sort=False)))
        labels = [
            f"{name.replace(' of ', chr(10), 1)}\n[{x['unit'].iloc[0]}]"
            for name, x in parts.items()
        ]
        t = next(iter(parts.values()))["time"].to_numpy()
        figure, (axes,) = panels([labels], t, title=f"{run}: constants over time")
        figure.set_figwidth(8.0)
        for ax, rows in zip(axes, parts.values(), strict=True):
            time = rows["time"]
            ends = rows["low"], rows["high"]
            ax.fill_between(time, *ends, color=COLORS[0], alpha=0.2, linewidth=0, label="95 %")
            ax.plot(time, rows["value"], color=COLORS[0], label="adapted")
            ax.plot(time, rows["start"], color="k", linestyle="--", linewidth=0.8, label="fit")
        legend_below(figure)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the figure of the first run as PNG."""
        save(self.figure(), Path(path).expanduser())


def adapted_constants(
    model: KnownMechanics,
    motion: Trajectory,
    *,
    cutoff: float,
    time_constant: float,
    constants: Sequence[Constant] = ("friction",),
) -> pd.DataFrame:
    """Follow constants of the drives along a motion, with all other constants as fitted::

        y_k = e(q, v, a, u) + H_k theta_k-1 = H_k theta_k + noise,   theta_k = theta_k-1 + drift

    e is the force that the model lacks, with the sign of the friction. theta are the viscous and
    the dry friction of each joint, H = (v, sign of v after the filter), and the constant torque,
    H = -1. A Kalman filter estimates theta, whose drift has half of theta as its standard deviation
    in a time constant. Samples are half a period of the cutoff apart. The noise is what constants
    that change linearly leave of y, as errors of neighbors that are correlated. Joints at rest do
    not count. The intervals hold if the other constants are right. Source: Ljung 1999, System
    Identification, ch. 11.

    Args:
        model: identified mechanics in float64.
        motion: the motion.
        cutoff: cutoff of the low-pass filter of the identification, Hz.
        time_constant: time in which friction may change by a half, s.
        constants: constants to follow, ``"friction"`` and ``"offset"``.

    Returns:
        Table with the columns of :attr:`Adaptation.table` except for the run.
    """
    with_signs = Signal(motion.t, torch.cat([motion.u.double(), motion.v.double().sign()], dim=1))
    q, v, a, u = filtered_motion([replace(motion, input=with_signs, past=None)], cutoff, 10**9)
    rate = 1 / float(motion.t[1] - motion.t[0])
    stride = max(round(rate / (_PER_PERIOD * cutoff)), 1)
    edge = (len(motion.t) - len(q)) / 2 / rate
    q, v, a, u = (x[::stride] for x in (q, v, a, u))
    u, sign = u.split([model.num_inputs, v.shape[1]], dim=1)
    times = (edge + stride / rate * np.arange(len(q))) + float(motion.t[0])
    fast = torch.full_like(v[0], torch.inf)
    level = (model.friction(fast) - model.friction(-fast)) / 2
    columns: list[tuple[str, Tensor, Tensor]] = []
    if "friction" in constants:
        columns += [("viscous friction", v, model.viscous()), ("dry friction", sign, level)]
    if "offset" in constants:
        columns.append(("torque offset", -torch.ones_like(v), model.constant_force()))
    with torch.no_grad():
        error = -model.samples(q, v, a, u).missing_force()
        if "friction" in constants:  # the filtered sign replaces the law at the filtered speed
            error = error + model.friction(v) - level * sign
    start = torch.stack([x for _, _, x in columns], dim=1).detach().numpy()  # (N, C)
    rows = torch.stack([x.detach() for _, x, _ in columns], dim=2).numpy()  # (K, N, C)
    y = error.numpy() + (rows * start).sum(-1)
    moving = (v.abs() > _REST * v.std(0)).numpy()
    scale = 0.5 * np.maximum(np.abs(start), 0.1 * level.detach().numpy()[:, None])
    drift = scale**2 * (stride / rate / time_constant)
    tables = []
    for k, joint in enumerate(model.structure.joint_names):
        valid = moving[:, k]
        noise = _noise(rows[valid, k], y[valid, k])
        values, deviations = _followed(
            rows[:, k], y[:, k], valid, start[k], scale[k], drift[k], noise
        )
        force, damping = ("Nm", "Nms/rad") if model.structure.turning[k] else ("N", "Ns/m")
        for c, (name, _, _) in enumerate(columns):
            width = 1.96 * deviations[:, c]
            unit = damping if name == "viscous friction" else force
            item: dict[str, Any] = {"time": times, "name": f"{name} of {joint}", "unit": unit}
            item |= {"value": values[:, c], "low": values[:, c] - width}
            item |= {"high": values[:, c] + width, "start": start[k, c]}
            tables.append(pd.DataFrame(item))
    return pd.concat(tables, ignore_index=True)


def _noise(rows: np.ndarray, y: np.ndarray) -> float:
    """Return the standard deviation of the residual of y for linearly changing constants.

    It is enlarged for errors of neighbors with the correlation r, by (1 + r) / (1 - r).
    """
    growing = np.linspace(0, 1, len(rows))[:, None] * rows
    columns = np.hstack([rows, growing])
    left = y - columns @ np.linalg.lstsq(columns, y)[0]
    r = float(np.clip(np.mean(left[1:] * left[:-1]) / np.mean(left**2), 0.0, 0.95))
    return float(left.std()) * ((1 + r) / (1 - r)) ** 0.5


def _followed(
    rows: np.ndarray,
    y: np.ndarray,
    moving: np.ndarray,
    start: np.ndarray,
    scale: np.ndarray,
    drift: np.ndarray,
    noise: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates of a Kalman filter and their standard deviations, ``(K, C)``."""
    theta, P = start.copy(), np.diag(scale**2)
    values, deviations = [], []
    for h, target, valid in zip(rows, y, moving, strict=True):
        P = P + np.diag(drift)
        if valid:
            gain = P @ h / (h @ P @ h + noise**2)
            theta = theta + gain * (target - h @ theta)
            P = P - np.outer(gain, h @ P)
        values.append(theta)
        deviations.append(np.sqrt(np.diag(P)))
    return np.array(values), np.array(deviations)
