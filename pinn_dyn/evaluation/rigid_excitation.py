"""Which constants of a rigid robot the motions of a log can tell, before any fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.evaluation.identification import named_directions
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.known import INERTIAL, Structure
from pinn_dyn.training.filtered_motion import Motion, filtered_motion
from pinn_dyn.training.least_squares import REST

MOST = 100.0
"""Condition number up to which a motion is well conditioned, as Gautier and Khalil take it."""
_SAMPLES = 2000
_STATES = 600
_DEPENDENT = 1e-6
"""Of its length, what other columns leave of one that they determine, but for rounding."""
_DRIVE = ("armature", "viscous friction", "dry friction", "offset")


@dataclass(frozen=True)
class RigidExcitation:
    """What motions tell of the base parameters of a rigid robot.

    Attributes:
        condition: number of the regressor, infinite where a column is none of the others' but zero.
        count: of base parameters, those of drives among them.
        joints: one row per joint: base parameters of its body and drive, how many of them are not
            determined, and the weakest with the share of its column that the others leave.
        undetermined: directions that are not determined, in words.
    """

    condition: float
    count: int
    joints: pd.DataFrame
    undetermined: list[str]

    @property
    def open_joints(self) -> list[str]:
        """The joints with constants of body or drive that are not determined."""
        return self.joints.loc[self.joints["not determined"] > 0, "joint"].tolist()

    def summary(self, most: int) -> str:
        """The first ``most`` directions that are not determined, and how many more there are."""
        shown = "; ".join(self.undetermined[:most]) or "none"
        more = len(self.undetermined) - most
        return f"{shown}; and {more} more" if more > 0 else shown


def base_parameters(regressor: np.ndarray) -> np.ndarray:
    """The columns of a regressor ``(R, P)`` that no earlier ones determine, ``(b,)``.

    Of bodies in the order of the chain these are the usual ones: what a link shares with the one
    before it is counted there. Source: Gautier 1991, "Numerical calculation of the base inertial
    parameters of robots".
    """
    norms = np.linalg.norm(regressor, axis=0)
    # The rounded angles of a URDF leave next to nothing of a column that would be zero.
    scale = np.where(norms > _DEPENDENT * norms.max(), norms, 1.0)
    _, triangle = np.linalg.qr(regressor / scale)
    basis, kept = np.zeros((len(triangle), 0)), []
    for k, column in enumerate(triangle.T):
        rest = column
        for _ in range(2):  # twice is as good as orthogonal
            rest = rest - basis @ (basis.T @ rest)
        if (length := np.linalg.norm(rest)) > _DEPENDENT:
            kept.append(k)
            basis = np.column_stack([basis, rest / length])
    return np.array(kept)


def rigid_excitation(
    structure: Structure,
    trajectories: Sequence[Trajectory],
    *,
    cutoff: float,
    still: Sequence[bool] = (),
) -> RigidExcitation:
    """The condition number of the base parameters' regressor on motions, and what stays open.

    The equation of motion of rigid bodies on drives is linear in their constants::

        Y(q, v, a) pi + r a + d v + c sign(v) - o = tau

    with the inertial parameters pi of the bodies, armatures r, viscous and dry friction d and c,
    and offsets o. Base parameters are those of its columns that are independent at random states;
    the condition number is that of these columns, each of unit norm, at samples of the filtered
    motion. A joint at rest has no row, as dry friction may then have any value up to its level.
    Directions whose singular value is less than a hundredth of the largest are not determined.
    Drive gains, where they are unknown, are not among the constants. Sources: Gautier and Khalil
    1992, "Exciting trajectories for the identification of base inertial parameters of robots";
    Swevers et al. 1997, "Optimal robot excitation and identification".

    Args:
        structure: the kinematics.
        trajectories: the motions.
        cutoff: of the filter, Hz: above the motion, below the noise.
        still: of each joint whether it moves by no more than its noise, and so counts as at rest.

    Raises:
        ValueError: if all trajectories are too short for the filter.
    """
    motion = filtered_motion(trajectories, cutoff, _SAMPLES)
    moves = motion.v.abs() > REST * motion.v.std(0)
    if any(still):
        rests = torch.tensor(list(still))
        moves &= ~rests
        motion = _held(motion, rests)
    size = structure.num_coordinates
    generator = torch.Generator().manual_seed(0)
    states = 3 * torch.rand(3, _STATES, size, generator=generator).to(motion.q) - 1.5
    base = base_parameters(_regressor(structure, *states).flatten(0, 1).numpy())
    rows = _regressor(structure, motion.q, motion.v, motion.a)[moves].numpy()[:, base]
    rows = np.vstack([rows, np.zeros((len(base), len(base)))])  # of a short motion there are fewer
    scaled = rows / np.linalg.norm(rows, axis=0).clip(min=1e-300)
    _, sizes, directions = np.linalg.svd(scaled, full_matrices=False)
    least = max(float(sizes[0]), 1.0) * np.finfo(float).eps * len(base)
    shares = 1 / ((directions / sizes.clip(min=least)[:, None]) ** 2).sum(axis=0)
    names = [_names(structure)[k] for k in base]
    found = named_directions(directions[sizes < max(sizes[0], 1e-300) / MOST], names)
    owners = np.concatenate([np.repeat(np.arange(size), 10), np.tile(np.arange(size), len(_DRIVE))])
    return RigidExcitation(
        condition=float(sizes[0] / sizes[-1]) if sizes[-1] > least else float("inf"),
        count=len(base),
        joints=_joints(structure, owners[base], shares, names, [one.parameter for one in found]),
        undetermined=[one.text for one in found],
    )


def _held(motion: Motion, still: Tensor) -> Motion:
    """The same with these joints at rest in their middle."""
    q = torch.where(still, motion.q.mean(0), motion.q)
    v, a = (torch.where(still, 0.0, x) for x in (motion.v, motion.a))
    return Motion(q, v, a, motion.u)


def _regressor(structure: Structure, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
    """W ``(K, N, 14 N)`` of bodies, body after body, then armatures, frictions and offsets."""
    drives = [torch.diag_embed(x) for x in (a, v, v.sign(), -torch.ones_like(v))]
    return torch.cat([structure.regressor(q, v, a), *drives], dim=-1)


def _names(structure: Structure) -> list[str]:
    """Of the columns of the regressor."""
    bodies = [f"{label} of {body}" for body in structure.body_names for label in INERTIAL]
    return bodies + [f"{label} of {joint}" for label in _DRIVE for joint in structure.joint_names]


def _joints(
    structure: Structure,
    owners: np.ndarray,
    shares: np.ndarray,
    names: list[str],
    undetermined: list[int],
) -> pd.DataFrame:
    """One row per joint; every body and drive has a base parameter, its friction."""
    rows = []
    for k, joint in enumerate(structure.joint_names):
        own = np.flatnonzero(owners == k)
        weakest = own[np.argmin(shares[own])]
        rows.append(
            {
                "joint": joint,
                "base parameters": len(own),
                "not determined": sum(owners[j] == k for j in undetermined),
                "weakest": names[weakest],
                "its own share": shares[weakest],
            }
        )
    return pd.DataFrame(rows)
