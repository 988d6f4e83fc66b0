"""Bandwidth of sampled signals, and a step that resolves them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy
import torch
from torch import Tensor

from pinn_dyn.mechanics import Trajectory

_SEGMENT = 100  # samples of a spectrum, at least
_FALSE = 0.01  # chance that white noise counts as a signal
_ROUND = [x * 10.0**k for k in (-3, -2, -1) for x in (1, 2, 5)]  # s
_SLOWEST = 0.1  # Hz, of an input that sets the step
_COARSER = 2.5  # round time over a tenth of the period, at most


def bandwidth(signals: Sequence[np.ndarray], step: float, noise: np.ndarray) -> float:
    """Return the frequency (Hz) below which 99 % of the power of the signals' derivatives lies.

    Args:
        signals: signals of each run, ``(T, K)``.
        step: sample time, s.
        noise: standard deviation of the noise of each signal, ``(K,)``. The power of the noise is
            subtracted.
    """
    size = min(max(round(8 / step), _SEGMENT), min(map(len, signals)))
    spectra = [scipy.signal.welch(x, 1 / step, nperseg=size, axis=0) for x in signals]
    f, density = spectra[0][0], np.mean([power for _, power in spectra], axis=0)
    # White noise has 2 s² h per Hz. Its estimate is the mean of squares of independent pieces.
    pieces = max(sum(len(x) // size for x in signals), 1)
    chances = np.array([0.5, 1 - _FALSE / len(f)])
    middle, highest = scipy.stats.chi2.ppf(chances, 2 * pieces) / (2 * pieces)
    level = np.median(density[len(f) // 2 :], axis=0) / middle
    level = np.maximum(2 * noise**2 * step, level)
    above = np.where(density > highest * level, density - level, 0.0)
    power = above * f[:, None] ** 2
    share = np.cumsum(power, axis=0) / power.sum(axis=0).clip(min=1e-300)
    return max((float(f[np.searchsorted(x, 0.99)]) for x in share.T if x[-1] > 0), default=0.0)


def hold_of(signals: Sequence[np.ndarray]) -> int:
    """Return the median number of samples for which signals ``(T, K)`` hold their values."""
    changes = [np.flatnonzero((np.diff(x, axis=0) != 0).any(axis=1)) for x in signals]
    lengths = np.concatenate([np.diff(x) for x in changes])
    return int(np.median(lengths)) if len(lengths) else 1


def samples_in_step(signals: Sequence[list[np.ndarray]], step: float) -> int:
    """Return the number of samples in about a tenth of a period of the motion.

    The period is that of the slower kind of signal, inputs or coordinates, since measured
    coordinates have noise, and inputs may jump. The time is round if possible. For signals that
    are held over several samples, only one sample per hold counts.

    Args:
        signals: inputs and coordinates of each run, ``(T, K)``.
        step: sample time, s.
    """
    fastest = []
    for kind in signals:
        hold = hold_of(kind)
        updates = [x[::hold] for x in kind]
        fastest.append(bandwidth(updates, hold * step, np.zeros(updates[0].shape[1])))
    # The bandwidth of white signals is zero.
    longest = 0.1 / max(min([x for x in fastest if x > 0], default=0.5 / step), _SLOWEST)
    usual = [x for x in _ROUND if 0.99 <= x / longest <= _COARSER]
    fitting = [x for x in usual if abs(x / step % 1 - 0.5) > 0.49]
    return max(round((fitting[0] if fitting else longest) / step), 1)


_SAMPLES = 8  # smallest number of steps in a period


def periods(trajectories: Sequence[Trajectory]) -> Tensor:
    """Return the period at the median of the power of v, ``(N,)``, s; infinity without motion."""
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
    """Return a message if a step in s is too long for the fastest coordinate, otherwise None."""
    period, k = periods(trajectories).min(0)
    if not period < _SAMPLES * step:
        return None
    return (
        f"a step of {step:g} s is too long for the fastest motion in the data, that of "
        f"{labels[int(k)]}, which has a period of about {period:.2g} s: expected at least "
        f"{_SAMPLES} steps per period, of {period / _SAMPLES:.2g} s or less"
    )
