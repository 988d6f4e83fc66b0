"""Whether a step is short enough for the fastest motion in the data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import Trajectory

_SAMPLES = 8  # of a period, at least


def periods(trajectories: Sequence[Trajectory]) -> Tensor:
    """The period of each velocity, ``(N,)``, s: half of its power has a shorter one.

    Half of the power, as measured velocities are noisy, and noise has any period down to two
    samples. The mean velocity of a trajectory is no oscillation; infinite where nothing moves.
    """
    frequencies, powers = [], []
    for item in trajectories:
        v, sample = item.v.double(), float(item.t[1] - item.t[0])
        powers.append(torch.fft.rfft(v - v.mean(0), dim=0).abs().square()[1:])
        frequencies.append(torch.fft.rfftfreq(len(v), sample, dtype=v.dtype)[1:])
    frequency, order = torch.cat(frequencies).sort()
    below = torch.cat(powers)[order].cumsum(0)
    half = torch.searchsorted(below.T.contiguous(), below[-1, :, None] / 2)[:, 0]
    return torch.where(below[-1] > 0, 1 / frequency[half], torch.inf)


def too_long_for(
    trajectories: Sequence[Trajectory], step: float, labels: Sequence[str]
) -> str | None:
    """What is wrong with a step, in a sentence; None where nothing is.

    Args:
        trajectories: of the data, each with samples of one distance.
        step: of a roll-out or a training window, s.
        labels: names of the coordinates.
    """
    found = periods(trajectories)
    k = int(found.argmin())
    if not found[k] < _SAMPLES * step:
        return None
    return (
        f"a step of {step:g} s is too long for the fastest motion in the data, that of "
        f"{labels[k]}: half of the power of its velocity has periods below {float(found[k]):.3g} s,"
        f" expected at least {_SAMPLES} steps a period: take one of at most "
        f"{float(found[k]) / _SAMPLES:.2g} s"
    )
