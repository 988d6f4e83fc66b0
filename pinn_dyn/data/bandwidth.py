"""Bandwidth of sampled signals, and the step that follows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

_ROUND = [x * 10.0**k for k in (-3, -2, -1) for x in (1, 2, 5)]  # s
_SLOWEST = 0.1  # Hz, of an input that sets the step
_COARSER = 2.5  # round time over a tenth of the period, at most


def bandwidth(signals: Sequence[np.ndarray], step: float, noise: np.ndarray) -> float:
    """Return the frequency in Hz below which 99 % of the power of the rates of signals is.

    Args:
        signals: signals of each run, ``(T, K)``.
        step: sample time, s.
        noise: standard deviation of their noise, ``(K,)``, which does not count.
    """
    size = min(round(8 / step), min(map(len, signals)))
    spectra = [scipy.signal.welch(x, 1 / step, nperseg=size, axis=0) for x in signals]
    f, density = spectra[0][0], np.mean([power for _, power in spectra], axis=0)
    # White noise has 2 s² h per Hz. Power up to four times this level counts as noise.
    level = np.maximum(2 * noise**2 * step, np.median(density[len(f) // 2 :], axis=0))
    power = np.where(density > 4 * level, density, 0.0) * f[:, None] ** 2
    share = np.cumsum(power, axis=0) / power.sum(axis=0).clip(min=1e-300)
    return max((float(f[np.searchsorted(x, 0.99)]) for x in share.T if x[-1] > 0), default=0.0)


def samples_in_step(signals: Sequence[list[np.ndarray]], step: float) -> int:
    """Return the samples in about a tenth of a period of the slower kind of signal, a round time.

    Measured coordinates have noise and inputs may jump, so the slower of both tells how fast the
    motion is.

    Args:
        signals: inputs and coordinates of each run, ``(T, K)``.
        step: sample time, s.
    """
    fastest = [bandwidth(x, step, np.zeros(x[0].shape[1])) for x in signals]
    # White signals have no bandwidth above their noise.
    longest = 0.1 / max(min([x for x in fastest if x > 0], default=0.5 / step), _SLOWEST)
    usual = [x for x in _ROUND if 0.99 <= x / longest <= _COARSER]
    fitting = [x for x in usual if abs(x / step % 1 - 0.5) > 0.49]
    return max(round((fitting[0] if fitting else longest) / step), 1)
