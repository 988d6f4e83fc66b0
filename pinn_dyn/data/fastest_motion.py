"""Check of a step against the fastest motion in the data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import Trajectory

_SAMPLES = 8  # of a period, at least
_MOST = 30  # trajectories that are looked at


def periods(trajectories: Sequence[Trajectory]) -> Tensor:
    """Return the typical period of each coordinate, ``(N,)``, s: the median of its spectrum.

    The spectrum is that of q v, the power of the velocity over the frequency. That of v itself is
    mostly noise where v is derived from a measured q, and that of q mostly drift. The mean
    velocity of a trajectory is no oscillation; infinite where nothing moves.
    """
    frequencies, powers = [], []
    for item in trajectories[:: -(-len(trajectories) // _MOST)]:
        v, sample = item.v.double(), float(item.t[1] - item.t[0])
        frequency = torch.fft.rfftfreq(len(v), sample, dtype=v.dtype)[1:]
        power = torch.fft.rfft(v - v.mean(0), dim=0).abs().square()[1:]
        frequencies.append(frequency)
        powers.append(power / frequency[:, None])
    frequency, order = torch.cat(frequencies).sort()
    below = torch.cat(powers)[order].cumsum(0)
    half = torch.searchsorted(below.T.contiguous(), below[-1, :, None] / 2)[:, 0]
    return torch.where(below[-1] > 0, 1 / frequency[half], torch.inf)


def too_long_for(
    trajectories: Sequence[Trajectory], step: float, labels: Sequence[str]
) -> str | None:
    """Return a message if a step is too long, else None.

    Args:
        trajectories: of the data, each with samples of one distance.
        step: of a roll-out or a training window, s.
        labels: names of the coordinates.
    """
    shortest = periods(trajectories)
    k = int(shortest.argmin())
    if not shortest[k] < _SAMPLES * step:
        return None
    period = float(shortest[k])
    return (
        f"a step of {step:g} s is too long for the fastest motion in the data, that of "
        f"{labels[k]}, which has a period of about {period:.2g} s: expected at least {_SAMPLES} "
        f"steps in it, of {period / _SAMPLES:.2g} s or less"
    )
