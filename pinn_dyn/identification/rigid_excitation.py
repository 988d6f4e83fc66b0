"""Constants of a rigid robot that the motions of a log determine, before any fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.identification.constants import named_directions
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.known import INERTIAL
from pinn_dyn.models.structure import Structure
from pinn_dyn.training.filtered_motion import filtered_motion
from pinn_dyn.training.least_squares import REST

MOST = 100.0
"""Condition number up to which a motion is well conditioned, as Gautier and Khalil take it."""
_DEPENDENT = 3e-3  # remainder of a dependent column, as a share of its length: URDFs round pi / 2
_DRIVE = ("armature", "viscous friction", "dry friction", "offset")


@dataclass(frozen=True)
class RigidExcitation:
    """Excitation of the base parameters of a rigid robot.

    Attributes:
        condition: condition number of the regressor; infinite if a column is zero.
        count: number of base parameters, drives included.
        joints: table of each joint: number of base parameters, and of undetermined ones.
        undetermined: directions that the motions do not determine.
    """

    condition: float
    count: int
    joints: pd.DataFrame
    undetermined: str

    @property
    def open_joints(self) -> list[str]:
        """Joints with constants of body or drive that are not determined."""
        return self.joints.loc[self.joints["not determined"] > 0, "joint"].tolist()


def base_parameters(regressor: np.ndarray) -> np.ndarray:
    """Return the columns of a regressor ``(R, P)`` that earlier columns do not determine, ``(b,)``.

    Source: Gautier 1991, "Numerical calculation of the base inertial parameters of robots".
    """
    norms = np.linalg.norm(regressor, axis=0)
    scaled = regressor / np.where(norms > _DEPENDENT * norms.max(), norms, np.inf)
    return np.flatnonzero(np.abs(np.diag(np.linalg.qr(scaled, mode="r"))) > _DEPENDENT)


def base_columns(structure: Structure) -> np.ndarray:
    """Return the columns of :func:`drive_regressor` that are independent at random states."""
    generator = torch.Generator().manual_seed(0)
    size = structure.num_coordinates
    q, v, a = 3 * torch.rand(3, 600, size, generator=generator).double() - 1.5
    return base_parameters(drive_regressor(structure, q, v, a, v.sign()).flatten(0, 1).numpy())


def rigid_excitation(
    structure: Structure,
    trajectories: Sequence[Trajectory],
    *,
    cutoff: float,
    still: Sequence[bool] = (),
) -> RigidExcitation:
    """Return the :func:`motion_excitation` of filtered motions.

    Args:
        structure, trajectories: kinematics and motions.
        cutoff: frequency of the filter, Hz: above the motion, below the noise.
        still: true for joints that move by no more than their noise.

    Raises:
        ValueError: if all trajectories are too short for the filter.
    """
    q, v, a, _ = filtered_motion(trajectories, cutoff, 2000)
    return motion_excitation(structure, q, v, a, still)


def motion_excitation(
    structure: Structure, q: Tensor, v: Tensor, a: Tensor, still: Sequence[bool] = ()
) -> RigidExcitation:
    """Return the condition number of the regressor of base parameters on a motion ``(K, N)``.

    The equation of motion of rigid bodies on drives is linear in their constants::

        Y(q, v, a) pi + r a + d v + c sign(v) - o = tau

    with inertial parameters pi, armatures r, viscous and dry friction d and c, and offsets o. The
    columns that are independent at random states are scaled to unit norm on the motion.
    Directions with less than a hundredth of the largest singular value are not determined. Sources:
    Gautier and Khalil 1992, "Exciting trajectories for the identification of base inertial
    parameters of robots"; Swevers et al. 1997, "Optimal robot excitation and identification".
    """
    size = structure.num_coordinates
    rests = torch.tensor(list(still) or [False] * size)
    moves = (v.abs() > REST * v.std(0)) & ~rests
    q, v, a = torch.where(rests, q.mean(0), q), v * ~rests, a * ~rests
    base = base_columns(structure)
    rows = drive_regressor(structure, q, v, a, v.sign())[moves].numpy()[:, base]
    rows = np.vstack([rows, np.zeros((len(base), len(base)))])  # short motions have fewer rows
    scaled = rows / np.linalg.norm(rows, axis=0).clip(min=1e-300)
    _, sizes, directions = np.linalg.svd(scaled, full_matrices=False)
    rounding = max(float(sizes[0]), 1.0) * np.finfo(float).eps * len(base)
    bodies = [f"{label} of {body}" for body in structure.body_names for label in INERTIAL]
    drives = [f"{label} of {joint}" for label in _DRIVE for joint in structure.joint_names]
    names = [[*bodies, *drives][k] for k in base]
    lost = named_directions(directions[sizes < max(sizes[0], 1e-300) / MOST], names)
    # Joint of each column: ten constants of each body, then a constant of each drive in turn.
    joint = np.r_[np.repeat(structure.body_joints, 10), np.tile(np.arange(size), len(_DRIVE))][base]
    table = {
        "joint": structure.joint_names,
        "base parameters": np.bincount(joint, minlength=size),
        "not determined": np.bincount(joint[[x.parameter for x in lost]], minlength=size),
    }
    return RigidExcitation(
        condition=float(sizes[0] / sizes[-1]) if sizes[-1] > rounding else float("inf"),
        count=len(base),
        joints=pd.DataFrame(table),
        undetermined="; ".join(x.text for x in lost) or "none",
    )


def drive_regressor(structure: Structure, q: Tensor, v: Tensor, a: Tensor, sign: Tensor) -> Tensor:
    """Return W ``(*batch, N, 14 N)`` of bodies, then armatures, frictions and offsets.

    ``sign`` of v may be a smooth approximation.
    """
    drives = [torch.diag_embed(x) for x in (a, v, sign, -torch.ones_like(v))]
    return torch.cat([structure.regressor(q, v, a), *drives], dim=-1)
