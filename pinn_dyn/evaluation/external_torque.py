"""External torques and contacts in a log, from the momentum observer and an identified model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import scipy
import torch
from torch import Tensor

from pinn_dyn.control.observer import MomentumObserver, rest_speeds
from pinn_dyn.evaluation.tables import units
from pinn_dyn.mechanics import MechanicalSystem, Trajectory
from pinn_dyn.plots import COLORS, TRUTH, legend_below, panels, save
from pinn_dyn.systems import RigidChain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BLOCK = 10.0  # time constants of the observer in a block of independent maxima
_FEWEST_BLOCKS = 10
_STARTING = 3.0  # time constants after which the observer has forgotten its start
_SINGULAR = 0.05  # smallest over largest singular value of the Jacobian of an ambiguous wrench
_DAMPING = 0.01  # in units of the largest singular value
_SMALLEST = 1e-6  # largest singular value of a Jacobian of zero, in mean link lengths
_QUIET = 0.25  # share of the samples in motion that are quiet in any frame


@dataclass(frozen=True, repr=False)
class ExternalTorque:
    """External torques of a log, see :func:`observed_torques`.

    Attributes:
        table: a row per sample: the time in s, ``run``, for each joint the torque of the drive
            (``measured``), of the motion (``model``), and their difference (``external``), all
            after the low-pass filter of the observer, N or Nm; and ``contact``. With a link, its
            force ``fx fy fz`` in N and moment ``mx my mz`` in Nm in the frame of the base, and
            ``ambiguous``, true where the joints cannot tell a part of the force.
        threshold: largest external torque of each joint without a contact, N or Nm.
        contacts: a row per contact: run, start and end in s, the joint that exceeds its threshold
            most, and the largest external torque of this joint.
        bandwidth: K_O of the observer, 1/s.
        doubtful: runs whose quiet part does not fit the model, see :func:`quiet_level`.
    """

    table: pd.DataFrame
    threshold: pd.Series
    contacts: pd.DataFrame
    bandwidth: float
    doubtful: tuple[str, ...] = ()

    def __repr__(self) -> str:
        levels = ", ".join(f"{joint}: {value:.3g}" for joint, value in self.threshold.items())
        doubt = f", doubtful: {', '.join(self.doubtful)}" if self.doubtful else ""
        return f"ExternalTorque({len(self.contacts)} contacts, thresholds {levels}{doubt})"

    def figure(self, run: str | None = None) -> Figure:
        """Draw the torques of a run, the first by default, with thresholds and contacts."""
        run = self.table["run"].iloc[0] if run is None else run
        rows = self.table[self.table["run"] == run]
        t, joints = rows["time"].to_numpy(), list(self.threshold.index)
        names = [
            f"{joint.split(' [')[0]}\n[{'N' if units([joint]) == 'm' else 'Nm'}]"
            for joint in joints
        ]
        title = f"{run}: external torque, observer of {self.bandwidth:g} 1/s"
        figure, (torques, external) = panels([names, names], t, title=title)
        for joint, first, second in zip(joints, torques, external, strict=True):
            for part, color in (("measured", TRUTH), ("model", COLORS[0])):
                first.plot(t, rows[f"{part} {joint}"], color=color, label=part, linewidth=1.0)
            values = rows[f"external {joint}"]
            second.plot(t, values, color=COLORS[1], label="external", linewidth=1.0)
            for level in (-self.threshold[joint], self.threshold[joint]):
                second.axhline(level, color="k", linestyle="--", linewidth=0.8, label="threshold")
            for contact in self.contacts[self.contacts["run"] == run].itertuples():
                for ax in (first, second):
                    span = {"color": COLORS[3], "alpha": 0.2, "label": "contact"}
                    ax.axvspan(contact.start, contact.end, **span)  # type: ignore[arg-type]
        legend_below(figure, columns=5)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the figure of the first run as PNG."""
        save(self.figure(), Path(path).expanduser())


def observed_torques(
    model: MechanicalSystem, motion: Trajectory, bandwidth: float
) -> tuple[Tensor, Tensor]:
    """Return the external torque r and the drive torque after the same low-pass, ``(T, N)`` each.

    r is the residual of :class:`~pinn_dyn.control.observer.MomentumObserver`: the part of the
    momentum's rate that neither the drives nor the model explain, through a low-pass of 1 / K_O s.
    """
    observer = MomentumObserver(model, bandwidth, rest=rest_speeds(model))
    q, v, u = (x.double() for x in (motion.q, motion.v, motion.u))
    period = float(motion.t[1] - motion.t[0])
    with torch.no_grad():
        residual = observer.observe(q, v, u, period, hold=motion.input.interpolation == "hold")
        drive = observer.driven(q, v, u)
    gain = -math.expm1(-bandwidth * period)
    filtered = scipy.signal.lfilter([gain], [1, gain - 1], (drive - drive[0]).numpy(), axis=0)
    return residual, drive[0] + torch.from_numpy(filtered)


def settled(residual: Tensor, step: float, bandwidth: float) -> Tensor:
    """Return |r| after the start of the observer, ``(T, N)``."""
    return residual[math.ceil(_STARTING / (bandwidth * step)) :].abs()


def quiet_level(sizes: Tensor, threshold: np.ndarray) -> float:
    """Return the lower quartile of max_i |r_i| / threshold_i over the samples in motion.

    The quartile belongs to motion without contact if contacts last less than three quarters of the
    frame.
    """
    ratios = (sizes / torch.from_numpy(threshold)).amax(dim=1)
    return float(np.quantile(ratios[ratios > 0], _QUIET)) if ratios.any() else 0.0


def contact_thresholds(
    quiet: Sequence[Tensor], step: float, bandwidth: float, false_alarms: float
) -> np.ndarray:
    """Return the contact threshold of each joint from motion without contact, ``(N,)``.

    The largest |r| of blocks of 10 / K_O s follows a Gumbel distribution with the measured mean m
    and standard deviation s. With the Euler constant g and p, the share of blocks with a false
    alarm of one joint::

        threshold = m + s (sqrt(6) / pi) (-log(-log(1 - p)) - g)

    Source: Gumbel 1958, Statistics of Extremes.

    Args:
        quiet: |r| of motions without a contact that the model was not fitted to, :func:`settled`.
        step: sample time, s.
        bandwidth: K_O, 1/s.
        false_alarms: expected false alarms of all joints in an hour of such motion.

    Raises:
        ValueError: if the motions are too short for ten blocks.
    """
    length = math.ceil(_BLOCK / (bandwidth * step))
    parts = [part for sizes in quiet for part in sizes.split(length)]
    blocks = [part.amax(0) for part in parts if len(part) == length]
    if len(blocks) < _FEWEST_BLOCKS:
        raise ValueError(
            f"the quiet motions have {len(blocks)} stretches of {_BLOCK / bandwidth:.2g} s, "
            f"expected {_FEWEST_BLOCKS} for a threshold: give "
            f"{_FEWEST_BLOCKS * _BLOCK / bandwidth:.2g} s without a contact as quiet, or a larger "
            "bandwidth"
        )
    values = torch.stack(blocks)
    share = -math.expm1(-false_alarms * _BLOCK / (3600 * bandwidth) / values.shape[1])
    level = math.sqrt(6) / math.pi * (-math.log(-math.log1p(-share)) - np.euler_gamma)
    return (values.mean(0) + level * values.std(0)).numpy()


def contact_intervals(
    run: str, t: np.ndarray, residual: np.ndarray, threshold: pd.Series, bandwidth: float
) -> list[dict[str, object]]:
    """Return the contacts of a run: where |r| of a joint exceeds its threshold.

    Contacts that are less than two time constants apart are one.
    """
    ratio = np.abs(residual) / threshold.to_numpy()
    samples = np.flatnonzero((ratio > 1).any(axis=1))
    apart = np.flatnonzero(np.diff(t[samples]) > 2 / bandwidth) + 1
    contacts: list[dict[str, object]] = []
    for part in np.split(samples, apart) if len(samples) else []:
        part = np.arange(part[0], part[-1] + 1)
        k = int(ratio[part].max(axis=0).argmax())
        largest = part[np.abs(residual[part, k]).argmax()]
        contacts.append(
            {
                "run": run,
                "start": t[part[0]],
                "end": t[part[-1]],
                "joint": threshold.index[k],
                "torque": residual[largest, k],
            }
        )
    return contacts


def link_wrench(
    chain: RigidChain, q: Tensor, torque: Tensor, *, moment: bool
) -> tuple[Tensor, Tensor]:
    """Return force and moment at the tip of a chain, and where they are ambiguous::

        w = (J J^T + (0.01 s_1)^2)^-1 J tau        so that J^T w is close to tau

    s_1 is the largest singular value of J. Moments count per mean link length. The wrench is
    ambiguous where the smallest singular value is below s_1 / 20, such as for fewer joints than
    numbers.

    Args:
        chain: the robot, whose ``tip`` is the link.
        q, torque: configuration and external torques, ``(T, N)``.
        moment: false for a force at the origin of the link, without a moment.

    Returns:
        w ``(T, 3)`` in N, or ``(T, 6)`` with the moments in Nm, in the frame of the base; and a
        mask ``(T,)``.
    """
    size = 6 if moment else 3
    scale = torch.tensor([1.0] * 3 + [chain._usual_length()] * 3).to(q)[:size]
    J = chain.tip_jacobian(q)[..., :size, :] * scale[:, None]
    U, S, V = torch.linalg.svd(J, full_matrices=False)
    largest = S[..., :1].clamp(min=_SMALLEST * chain._usual_length())
    damped = S / (S**2 + (_DAMPING * largest) ** 2)
    wrench = U @ (damped * (V @ torque[..., None])[..., 0])[..., None]
    ambiguous = S[..., -1] < _SINGULAR * largest[..., 0]
    if J.shape[-1] < size:
        ambiguous = torch.ones_like(ambiguous)
    return wrench[..., 0] * scale, ambiguous
