"""Forces along measured motions: the torque error, and the shares of a model's parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import scipy
import torch
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem, Sum, Trajectory, double_copy

_SMOOTHING = 0.05  # s of velocity in the fit of one acceleration, at least 5 samples
_ERROR_SAMPLES, _SHARE_SAMPLES = 5_000, 2_000  # upper limits


@dataclass(frozen=True)
class TorqueError:
    """Inverse-dynamics error of N joints, in the unit of tau = A(q) u, N m or N::

        tau_hat = M a + C v + G + D v + F(v),      all terms of the model, A too

    Attributes:
        mean: mean of |tau_hat - tau|_2 over samples.
        share: sqrt(sum_i mean (tau_hat_i - tau_i)^2 / sum_i var tau_i).
        rms: root mean square of tau_hat_i - tau_i, ``(N,)``.
        spread: standard deviation of tau_i, ``(N,)``; 0 for a joint without a motor.
    """

    mean: float
    share: float
    rms: Tensor
    spread: Tensor

    def to_frame(self, labels: Sequence[str]) -> pd.DataFrame:
        """Return one row per joint: RMS, spread, and their ratio, missing without a motor."""
        share = torch.where(self.spread > 0, self.rms / self.spread, torch.nan)
        columns = {"torque_rms": self.rms, "torque_spread": self.spread, "torque_share": share}
        return pd.DataFrame({"joint": list(labels)} | {k: v.numpy() for k, v in columns.items()})


def torque_error(
    model: MechanicalSystem, truth: Trajectory, *, system: MechanicalSystem | None
) -> TorqueError:
    """Compare the model's inverse dynamics with the force that was applied.

    The acceleration is that of the true system. For measured data it is the slope of the velocity
    by local polynomials of degree 3 (Savitzky and Golay 1964), fitted to 0.05 s or 5 samples,
    whichever is longer.

    ``truth`` is K trajectories stacked, q ``(K, T, N)``; ``system`` is None for measured data.
    """
    learned = double_copy(model)
    with torch.no_grad():
        q, v, u = _samples(learned, truth, _ERROR_SAMPLES)
        if system is None:
            a = _thinned(_acceleration(truth), _ERROR_SAMPLES)
        else:
            a = double_copy(system).forward_dynamics(q, v, u).double()
        # A(q) u, also for a model whose A depends on u.
        tau = learned.inverse_dynamics(q, v, learned.forward_dynamics(q, v, u))
        error = (learned.inverse_dynamics(q, v, a) - tau).nan_to_num(torch.inf)
    spread = tau.std(dim=0, correction=0).nan_to_num(0.0)
    spread = torch.where(spread > 1e-9 * spread.max(), spread, 0.0)
    rms, total = error.square().mean(dim=0).sqrt(), float(spread.norm())
    share = float(rms.norm()) / total if total > 0 else float("inf")
    return TorqueError(float(error.norm(dim=-1).mean()), share, rms, spread)


def residual_share(model: MechanicalSystem, truth: Trajectory) -> float:
    """Return rms |r| / (rms |A u| + rms |r|) along K stacked motions, with the residual force r."""
    q, v, u = _samples(model, truth, _SHARE_SAMPLES)
    with torch.no_grad():
        residual = model.residual_force(q, v, u)
        applied = model.inverse_dynamics(q, v, model.forward_dynamics(q, v, u))  # A u + r
    return _rms(residual) / (_rms(residual) + _rms(applied - residual))


def part_shares(model: Sum, truth: Trajectory) -> pd.DataFrame:
    """Return the contributions of the parts of a sum: columns part, term, rms, share.

    The terms are the forces M a + C v, G and D v + F, with the acceleration of the sum. ``rms`` is
    that of the norm of the force, N m or N, and ``share`` is relative to the rms of all parts.
    """
    q, v, u = _samples(model, truth, _SHARE_SAMPLES)
    rows = []
    with torch.no_grad():
        a = model.forward_dynamics(q, v, u)
        for name, part in model.parts.items():
            assert isinstance(part, MechanicalSystem)
            potential, dissipative = part.potential_force(q), part.dissipative_force(q, v)
            inertial = part.inverse_dynamics(q, v, a) - potential - dissipative
            forces = {"M a + C v": inertial, "G": potential, "D v + F": dissipative}
            rows += [(name, term, _rms(force)) for term, force in forces.items()]
    table = pd.DataFrame(rows, columns=["part", "term", "rms"])
    table["share"] = table["rms"] / table.groupby("term")["rms"].transform("sum")
    return table


def _samples(model: MechanicalSystem, truth: Trajectory, limit: int) -> list[Tensor]:
    """Return S <= limit samples of q, v and the acting u, ``(S, .)``, in the model's precision."""
    like = next(model.parameters(), torch.empty(0, dtype=torch.float64))
    return [_thinned(x, limit).to(like) for x in (truth.q, truth.v, truth.u)]


def _thinned(values: Tensor, limit: int) -> Tensor:
    return values.flatten(0, 1)[:: -(-values.shape[:2].numel() // limit)]


def _rms(force: Tensor) -> float:
    return float(force.square().sum(-1).mean().sqrt())


def _acceleration(truth: Trajectory) -> Tensor:
    steps = truth.t.double().diff()
    step = float(steps.mean())
    if len(truth.t) < 5 or float((steps - step).abs().max()) > 1e-3 * step:
        raise ValueError(
            f"{len(truth.t)} samples: accelerations need at least 5 at a constant step"
        )
    length = min(max(5, 2 * round(_SMOOTHING / step / 2) + 1), 2 * ((len(truth.t) - 1) // 2) + 1)
    slope = scipy.signal.savgol_filter(
        truth.v.double().numpy(), length, 3, deriv=1, delta=step, axis=-2
    )
    return torch.from_numpy(slope)
