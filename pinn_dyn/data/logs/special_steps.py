"""Cleaning steps for rare faults of logs; templates for user-defined steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial
from pydantic import PositiveFloat, PositiveInt

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import Step, window_samples


@dataclass(frozen=True)
class SubtractStart(Step):
    """Subtract the mean of q over the first samples of a run, for sensors that drift.

    All runs must start at rest in the same pose.

    Args:
        samples: number of samples at rest, or their time, such as ``"0.5 s"``.
    """

    samples: int | str

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        start = recording.q[: window_samples(self.samples, recording, 1)].mean(axis=0)
        text = ", ".join(f"{value:.4g}" for value in start)
        return [replace(recording, q=recording.q - start)], f"subtracted ({text}) from q"


@dataclass(frozen=True)
class InterpolateHeld(Step):
    """Interpolate linearly between the updates of a sensor that is slower than the log.

    Up to ``longest`` repeats of a value in a row are replaced. Longer standstills are not changed.
    Each column is processed separately.

    Args:
        longest: largest number of repeats in a row, or their time, such as ``"80 ms"``.
        signals: signals that are interpolated.
    """

    longest: int | str
    signals: Sequence[str] = ("u",)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        shares: list[float] = []
        longest = window_samples(self.longest, recording, 1)

        def interpolate(x: np.ndarray) -> np.ndarray:
            columns = []
            for column in x.T:
                held = np.r_[False, column[1:] == column[:-1]]
                edges = np.flatnonzero(np.diff(np.r_[False, held, False])).reshape(-1, 2)
                for first, end in edges:
                    # No update follows at the end of the log.
                    if end - first > longest or end == len(column):
                        held[first:end] = False
                shares.append(float(held.mean()))
                columns.append(np.interp(recording.t, recording.t[~held], column[~held]))
            return np.column_stack(columns)

        interpolated = recording.change(self.signals, interpolate)
        text = (
            f"{100 * min(shares):.0f} to {100 * max(shares):.0f} % of the values of "
            f"{', '.join(self.signals)} were held and are interpolated"
        )
        return [interpolated], text


@dataclass(frozen=True)
class PolynomialFit(Step):
    """Fit polynomials, centered and scaled like MATLAB's ``[p, S, mu] = polyfit(t, x, n)``.

        x(t) ≈ Σ_i p_i z^i,   z = (t - μ)/σ,   μ = mean(t), σ = std(t) (over T - 1)

    Each segment is fitted separately and becomes a separate recording, since the polynomials of
    neighboring segments do not meet. A missing velocity is the derivative of the polynomial of q.

    Args:
        degree: degree n.
        segment: length of a segment, s; a shorter remainder is dropped.
        signals: signals that are fitted.
    """

    degree: PositiveInt
    segment: PositiveFloat
    signals: Sequence[str] = ("q", "v", "u")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        samples = round(self.segment / recording.sample_time("PolynomialFit")) + 1
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
        center, scale = part.t.mean(), part.t.std(ddof=1)
        z = (part.t - center) / scale
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
class RowClock(Step):
    """Replace stamps that come in bursts by times from the row numbers::

        t_k = a + k / rate

    A logger with a buffer stamps its rows when it writes them, not when they were sampled. Many
    rows then have the same stamp or follow within microseconds, before a pause. a is fitted to the
    stamps by least squares. No rows may be missing.

    Args:
        longest: largest distance of a stamp from the line, s: the length of some bursts. A larger
            distance indicates missing rows.
        rate: samples per second, Hz.
    """

    longest: PositiveFloat
    rate: PositiveFloat
    repairs = ("bursts", "gaps", "repeated times")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        rows, t, step = np.arange(len(recording)), recording.t - recording.t[0], 1 / self.rate
        line = step * rows + (t - step * rows).mean()
        distance = np.abs(t - line)
        k = int(distance.argmax())
        if distance[k] > self.longest:
            raise LogError(
                f"{recording.place}: RowClock found the stamp {recording.t[k]:.6g} s "
                f"{distance[k]:.4g} s off a clock of {step:.6g} s, more than longest, "
                f"{self.longest} s: rows are missing, or the rate changes: put SplitGaps before "
                "it, or raise longest to the length of some bursts"
            )
        text = (
            f"t from the row number, {step:.6g} s a row; stamps were up to {distance[k]:.4g} s off"
        )
        return [replace(recording, t=recording.t[0] + line)], text
