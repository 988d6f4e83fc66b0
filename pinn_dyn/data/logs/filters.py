"""Steps that smooth or differentiate the signals."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import PositiveFloat, PositiveInt

from pinn_dyn.data.lengths import Length
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.recording import SIGNALS, Recording
from pinn_dyn.data.logs.step import Signals, Step, window_samples


@dataclass(frozen=True)
class MovingAverage(Step):
    """Average ``window`` samples around each sample, fewer at the ends, like MATLAB's ``movmean``.

        x̄_k = mean(x_{k-b}, ..., x_{k+f}),   b = ⌊w/2⌋,   f = ⌈w/2⌉ - 1

    Args:
        window: number of samples w, or a time, such as ``"0.1 s"``.
        signals: averaged signals.
    """

    window: Length = 50
    signals: Signals = SIGNALS

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        step = recording.sample_time("MovingAverage")
        window = window_samples(self.window, recording, 1)

        def average(x: np.ndarray) -> np.ndarray:
            return pd.DataFrame(x).rolling(window, center=True, min_periods=1).mean().to_numpy()

        text = f"mean of {window} samples ({window * step:.4g} s) of {', '.join(self.signals)}"
        return [recording.change(self.signals, average)], text


@dataclass(frozen=True)
class Butterworth(Step):
    """Filter by a Butterworth low-pass, forwards and backwards, without a delay.

        |H(f)|² = 1 / (1 + (tan(π f/f_s)/tan(π f_c/f_s))^{2n}),   squared by the second pass

    If q, v and u pass the same filter, they still satisfy a linear equation of motion.

    Args:
        cutoff: cut-off frequency f_c, Hz. The two passes together halve the amplitude at f_c.
        order: order n of a single pass.
        signals: filtered signals.
    """

    cutoff: PositiveFloat
    order: PositiveInt = 4
    signals: Signals = SIGNALS

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        rate = 1 / recording.sample_time("Butterworth")
        sections = scipy.signal.butter(self.order, self.cutoff, fs=rate, output="sos")
        # The transient of the filter decays in a padding of a cut-off period at each end.
        padding = max(3 * (2 * len(sections) + 1), round(rate / self.cutoff))
        smooth = partial(scipy.signal.sosfiltfilt, sections, axis=0, padlen=padding)
        filtered = recording.change(self.signals, smooth)
        return [filtered], f"low-pass of {self.cutoff:g} Hz on {', '.join(self.signals)}"


@dataclass(frozen=True)
class RemoveJumps(Step):
    """Replace samples far from the median of their neighbors, such as jumps of a marker.

    A sample is a jump if |x_k - median(x_{k-h}, ..., x_{k+h})| > threshold, h = (window - 1)/2.
    Jumps are replaced by linear interpolation. A jump of more than h samples is not detected. The
    first and last h samples are not checked.

    Args:
        threshold: largest distance without a jump, SI units, one number, or one per column.
        window: number of samples, odd, or a time, such as ``"0.25 s"``.
        signals: repaired signals.
    """

    threshold: PositiveFloat | Sequence[PositiveFloat]
    window: Length = 25
    signals: Signals = ("q",)

    @property
    def repairs(self) -> Collection[str]:  # type: ignore[override]
        return [f"jumps of {signal}" for signal in self.signals]

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        window = window_samples(self.window, recording, 3, odd=True)

        def repair(x: np.ndarray) -> np.ndarray:
            frame = pd.DataFrame(x)
            distance = (frame - frame.rolling(window, center=True).median()).abs()
            bad = distance > np.asarray(self.threshold)
            return frame.mask(bad).interpolate(limit_direction="both").to_numpy()

        repaired = recording.change(self.signals, repair)
        changed = recording.t[(repaired.values() != recording.values()).any(axis=1)]
        text = f"{len(changed)} of {len(recording)} samples replaced"
        return [repaired], text + (f", at {listed(changed)} s" if len(changed) else "")


@dataclass(frozen=True)
class _SavitzkyGolaySlope(Step):
    window: Length = 11
    order: PositiveInt = 3

    def _slope(self, recording: Recording, values: np.ndarray) -> tuple[np.ndarray, int, float]:
        step = recording.sample_time(type(self).__name__)
        # The minimum is the shortest odd window that determines the polynomial.
        window = window_samples(self.window, recording, self.order + 1 + self.order % 2, odd=True)
        slope = scipy.signal.savgol_filter(values, window, self.order, deriv=1, delta=step, axis=0)
        return slope, window, step


@dataclass(frozen=True)
class SavitzkyGolayVelocity(_SavitzkyGolaySlope):
    """Derive the velocity as the slope of a polynomial through ``window`` samples of q.

    v_k, and a prediction that starts at v_k, depends on q up to half a window later. With
    ``causal``, the polynomial is fitted to the sample and the ``window`` - 1 samples before it.
    This velocity has more noise. The first ``window`` - 1 samples use the first window.

    Args:
        window: number of samples, odd, or a time, such as ``"50 ms"``.
        order: order of the polynomial.
        causal: true to use only the past of each sample.
    """

    causal: bool = False

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        if recording.v is not None:
            raise LogError("the log already has a velocity: leave out SavitzkyGolayVelocity, or v")
        q = recording.q
        v, window, step = self._slope(recording, q)
        text = f"v from q in windows of {window * step:.3g} s"
        if self.causal:
            weights = [
                scipy.signal.savgol_coeffs(
                    window, self.order, deriv=1, delta=step, pos=k, use="dot"
                )
                for k in range(window)
            ]
            start = [w @ q[:window] for w in weights[:-1]]
            v = np.vstack([*start, sliding_window_view(q, window, axis=0) @ weights[-1]])
            text += ", from past samples only"
        return [replace(recording, v=v)], text


@dataclass(frozen=True)
class InputRates(_SavitzkyGolaySlope):
    """Append the rates of the inputs: u becomes (u, du/dt), 2 M columns.

    This step is for inputs that are positions. A tendon that acts like a spring and a damper has
    the force k (u - q) + c (du/dt - dq/dt). The rate is the slope of a polynomial through
    ``window`` samples of u around each sample, up to half a window later.

    Args:
        window: number of samples, odd, or a time, such as ``"50 ms"``.
        order: order of the polynomial.
    """

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        rates, window, step = self._slope(recording, recording.u)
        text = f"du/dt, in windows of {window * step:.3g} s, follows u"
        return [replace(recording, u=np.hstack([recording.u, rates]))], text

    def input_labels(self, labels: list[str]) -> list[str]:
        return [*labels, *(f"d/dt {label.replace(']', '/s]')}" for label in labels)]
