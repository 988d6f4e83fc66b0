"""Who does what: the shares of the parts of a sum, and of a residual force."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem, Sum, Trajectory

_SAMPLES = 2_000  # at which the forces are taken, at most


def residual_share(model: MechanicalSystem, truth: Trajectory) -> float:
    """rms |r| / (rms |A u| + rms |r|) along measured motions: 0 is a mechanical robot, 1 is none.

    Args:
        model: a model with a residual force.
        truth: K trajectories stacked, q ``(K, T, N)``.
    """
    q, v, u = _samples(model, truth)
    with torch.no_grad():
        residual = model.residual_force(q, v, u)
        applied = model.inverse_dynamics(q, v, model.forward_dynamics(q, v, u))  # A u + r
        taken, driven = _rms(residual), _rms(applied - residual)
    return taken / (taken + driven)


def part_shares(model: Sum, truth: Trajectory) -> pd.DataFrame:
    """What each part of a sum contributes along measured motions: part, term, rms, share.

    The terms are the forces M a + C v, G and D v + F, with the acceleration that the sum gives; the
    rms is that of its norm, N m or N, and the share is of the rms of all parts.
    """
    q, v, u = _samples(model, truth)
    rows = []
    with torch.no_grad():
        a = model.forward_dynamics(q, v, u)
        for name, part in model.parts.items():
            assert isinstance(part, MechanicalSystem)
            rest, lost = part.potential_force(q), part.dissipative_force(q, v)
            moving = part.inverse_dynamics(q, v, a) - rest - lost
            for term, force in (("M a + C v", moving), ("G", rest), ("D v + F", lost)):
                rows.append((name, term, _rms(force)))
    table = pd.DataFrame(rows, columns=["part", "term", "rms"])
    table["share"] = table["rms"] / table.groupby("term")["rms"].transform("sum")
    return table


def _samples(model: MechanicalSystem, truth: Trajectory) -> list[Tensor]:
    chosen = slice(None, None, -(-truth.q.shape[:2].numel() // _SAMPLES))
    like = next(model.parameters())
    u = model.acting_samples(truth).detach()
    return [x.flatten(0, 1)[chosen].to(like) for x in (truth.q, truth.v, u)]


def _rms(force: Tensor) -> float:
    return float(force.square().sum(-1).mean().sqrt())
