"""Joints whose acceleration a fit cannot predict, because other torques are larger."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pinn_dyn.mechanics import Trajectory, double_copy
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import LearnedConstants
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
