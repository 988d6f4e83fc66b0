"""Check of a step against the fastest motion in the data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import Trajectory

_SAMPLES = 8  # smallest number of steps in a period


def periods(trajectories: Sequence[Trajectory]) -> Tensor:
    """Return the period at the median of the power of v, ``(N,)``, s; infinite without motion."""
    frequencies, powers = [], []
    for item in trajectories[:: -(-len(trajectories) // 30)]:
        v, sample = item.v.double(), float(item.t[1] - item.t[0])
        frequencies.append(torch.fft.rfftfreq(len(v), sample, dtype=v.dtype)[1:])
        power = torch.fft.rfft(v - v.mean(0), dim=0).abs().square()[1:]
        powers.append(power / frequencies[-1][:, None])
    frequency, order = torch.cat(frequencies).sort()
    below = torch.cat(powers)[order].cumsum(0)
    half = torch.searchsorted(below.T.contiguous(), below[-1, :, None] / 2)[:, 0]
    return torch.where(below[-1] > 0, 1 / frequency[half], torch.inf)


def too_long_for(
    trajectories: Sequence[Trajectory], step: float, labels: Sequence[str]
) -> str | None:
    """Return a message if a step in s is too long for the fastest labeled coordinate, else None."""
    period, k = periods(trajectories).min(0)
    if not period < _SAMPLES * step:
        return None
    return (
        f"a step of {step:g} s is too long for the fastest motion in the data, that of "
        f"{labels[int(k)]}, which has a period of about {period:.2g} s: expected at least "
        f"{_SAMPLES} steps in it, of {period / _SAMPLES:.2g} s or less"
    )
