"""Steps that smooth the signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import polynomial
from scipy.signal import butter, savgol_coeffs, savgol_filter, sosfiltfilt

from pinn_dyn.data.lengths import Length
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import (
    SIGNALS,
    Step,
    change,
    check_signals,
    check_window,
    sample_time,
    window_samples,
)


@dataclass(frozen=True)
class MovingAverage(Step):
    """The centred mean of ``window`` samples, of fewer at the ends, as MATLAB's ``movmean``.

        x̄_k = mean(x_{k-b}, ..., x_{k+f}),   b = ⌊w/2⌋,   f = ⌈w/2⌉ - 1

    An even window looks one sample further back than ahead.

    Args:
        window: number of samples w, or a time, such as ``"0.1 s"``.
        signals: which of q, v and u.
    """

    window: Length = 50
    signals: Sequence[str] = SIGNALS

    def __post_init__(self) -> None:
        check_signals(self.signals)
        check_window("MovingAverage", self.window, 1)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        step = sample_time(recording, "MovingAverage")
        window = window_samples(self.window, recording, 1)
        smooth = change(
            recording,
            self.signals,
            lambda x: pd.DataFrame(x).rolling(window, center=True, min_periods=1).mean().to_numpy(),
        )
        names = ", ".join(self.signals)
        return [smooth], f"mean of {window} samples ({window * step:.4g} s) of {names}"


@dataclass(frozen=True)
class PolynomialFit(Step):
    """Least-squares polynomials, centred and scaled as MATLAB's ``[p, S, mu] = polyfit(t, x, n)``.

        x(t) ≈ Σ_i p_i z^i,   z = (t - μ)/σ,   μ = mean(t), σ = std(t) (over T - 1)

    Each segment is fitted alone and becomes a recording of its own, as polynomials of neighbouring
    segments do not meet. A missing velocity is the derivative of the polynomial of q.

    Args:
        degree: degree n.
        segment: length of a segment, s; a rest shorter than that is dropped.
        signals: which of q, v and u.
    """

    degree: int
    segment: float
    signals: Sequence[str] = SIGNALS

    def __post_init__(self) -> None:
        check_signals(self.signals)
        if self.degree < 1 or not self.segment > 0:
            raise LogError(
                f"PolynomialFit: degree is {self.degree} and segment {self.segment} s, expected a "
                "degree of at least 1 and a segment longer than 0"
            )

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        step = sample_time(recording, "PolynomialFit")
        samples = round(self.segment / step) + 1
        if samples <= self.degree:
            raise LogError(
                f"{recording.run}: PolynomialFit has segments of {samples} samples for degree "
                f"{self.degree}, expected more samples than the degree: use a longer segment"
            )
        parts = [
            self._fit(recording.rows(slice(first, first + samples)))
            for first in range(0, len(recording) - samples + 1, samples)
        ]
        text = (
            f"degree {self.degree} in {len(parts)} segments of {self.segment:g} s; dropped the "
            f"last {len(recording) - len(parts) * samples} samples"
        )
        return parts, text

    def _fit(self, part: Recording) -> Recording:
        centre, scale = part.t.mean(), part.t.std(ddof=1)
        z = (part.t - centre) / scale
        fits = {
            name: polynomial.polyfit(z, getattr(part, name), self.degree)
            for name in self.signals
            if getattr(part, name) is not None
        }
        # polyval returns one row per column of the coefficients.
        changed = {name: polynomial.polyval(z, fit).T for name, fit in fits.items()}
        if part.v is None and "q" in fits:
            changed["v"] = polynomial.polyval(z, polynomial.polyder(fits["q"])).T / scale
        return replace(part, **changed)


@dataclass(frozen=True)
class Butterworth(Step):
    """A Butterworth low-pass run forwards and backwards, so that nothing is delayed.

        |H(f)|² = 1 / (1 + (tan(π f/f_s)/tan(π f_c/f_s))^{2n}),   squared by the second pass

    The same filter on q, v and u keeps linear equations of motion between them true.

    Args:
        cutoff: cut-off frequency f_c, Hz; there the two passes halve the amplitude.
        order: order n of one pass.
        signals: which of q, v and u.
    """

    cutoff: float
    order: int = 4
    signals: Sequence[str] = SIGNALS

    def __post_init__(self) -> None:
        check_signals(self.signals)
        if not self.cutoff > 0 or self.order < 1:
            raise LogError(
                f"Butterworth: cutoff is {self.cutoff} Hz and order {self.order}, expected a "
                "cut-off above 0 and an order of at least 1"
            )

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        rate = 1 / sample_time(recording, "Butterworth")
        if self.cutoff >= rate / 2:
            raise LogError(
                f"{recording.run}: Butterworth has a cut-off of {self.cutoff} Hz, expected less "
                f"than half the sample rate, {rate / 2:.4g} Hz"
            )
        sections = butter(self.order, self.cutoff, fs=rate, output="sos")
        # A period of the cut-off at either end lets the start-up of the filter die out.
        padding = max(3 * (2 * len(sections) + 1), round(rate / self.cutoff))
        if len(recording) <= padding:
            raise LogError(
                f"{recording.place}: {len(recording)} samples are too few for Butterworth, "
                f"expected more than {padding}: raise the cut-off, or drop the run"
            )
        smooth = change(
            recording,
            self.signals,
            lambda x: sosfiltfilt(sections, x, axis=0, padlen=padding),
        )
        return [smooth], f"low-pass of {self.cutoff:g} Hz on {', '.join(self.signals)}"


@dataclass(frozen=True)
class _SavitzkyGolaySlope(Step):
    """What needs the slope of a polynomial through ``window`` samples around each sample."""

    window: Length = 11
    order: int = 3

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.order < 1:
            raise LogError(f"{name}: order is {self.order}, expected at least 1")
        check_window(name, self.window, self.order + 1, odd=True)

    def _slope(self, recording: Recording, values: np.ndarray) -> tuple[np.ndarray, int, float]:
        """The slope of each column of ``values``, the samples of a window, and the sample time."""
        name = type(self).__name__
        step = sample_time(recording, name)
        # The shortest odd window that has the order.
        window = window_samples(self.window, recording, self.order + 1 + self.order % 2, odd=True)
        if len(recording) < window:
            raise LogError(
                f"{recording.place}: {len(recording)} samples are too few for {name}, expected at "
                f"least {window}"
            )
        slope = savgol_filter(values, window, self.order, deriv=1, delta=step, axis=0)
        return slope, window, step


@dataclass(frozen=True)
class SavitzkyGolayVelocity(_SavitzkyGolaySlope):
    """Velocity as the slope of a polynomial through ``window`` samples of q around each sample.

    Within half a window of an end the polynomial of the outermost full window is used.

    The velocity of a sample then knows what q does half a window later, and a prediction that
    starts there knows it too: a model can read the first half window of its errors from v. With
    ``causal`` the polynomial goes through the sample and the ``window`` - 1 before it, as a
    controller has them; only the first ``window`` - 1 samples of a run still share one polynomial.
    It carries more noise, so a shorter window and a lower order suit it.

    Args:
        window: number of samples, odd, or a time, such as ``"50 ms"``.
        order: order of the polynomial.
        causal: whether only the past counts.
    """

    causal: bool = False

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        if recording.v is not None:
            raise LogError(
                f"{recording.run}: the log has a velocity already, expected none: leave out "
                "SavitzkyGolayVelocity, or v"
            )
        v, window, step = self._slope(recording, recording.q)
        if self.causal:
            v = self._causal_slope(recording.q, window, step)
        past = ", from the past alone" if self.causal else ""
        return [replace(recording, v=v)], f"v from q in windows of {window * step:.3g} s{past}"

    def _causal_slope(self, values: np.ndarray, window: int, step: float) -> np.ndarray:
        def weights(position: int) -> np.ndarray:
            return savgol_coeffs(window, self.order, deriv=1, delta=step, pos=position, use="dot")

        last = window - 1
        start = [weights(k) @ values[:window] for k in range(last)]
        windows = sliding_window_view(values, window, axis=0)
        return np.vstack([*start, windows @ weights(last)])


@dataclass(frozen=True)
class InputRates(_SavitzkyGolaySlope):
    """The rates of the inputs as further inputs: u becomes (u, du/dt), 2 M columns.

    For inputs that are positions, such as motor angles of tendons. A tendon that pulls like a
    spring and a damper side by side has the force k (u - q) + c (du/dt - dq/dt), so it needs
    A(q) (u, du/dt), and a drive that holds its place by friction moves with du/dt alone. The rate
    is the slope of the polynomial through ``window`` samples of u around each sample, as in
    :class:`SavitzkyGolayVelocity`, so it looks half a window ahead.

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
