"""Excitation signals: random inputs that move a robot during data collection."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat, PositiveInt


def _increasing(bounds: Sequence[float]) -> Sequence[float]:
    if bounds[0] > bounds[1]:
        raise ValueError("expected [low, high] with low <= high")
    return bounds


Bounds = Annotated[
    Sequence[PositiveFloat], Field(min_length=2, max_length=2), AfterValidator(_increasing)
]
"""A range [low, high] with 0 < low <= high."""

InputSignal = Callable[[np.ndarray], np.ndarray]
"""Function from times ``(T,)`` in s to inputs ``(count, T, M)`` of ``count`` drawn signals."""


def picked_signals(
    signals: Sequence[InputSignal], which: np.ndarray, row: np.ndarray
) -> InputSignal:
    """Select signals from several draws: signal k is number ``row[k]`` of ``signals[which[k]]``."""

    def signal(t: np.ndarray) -> np.ndarray:
        values = [part(t) for part in signals]
        starts = np.cumsum([0, *map(len, values[:-1])])
        return np.concatenate(values)[starts[which] + row]

    return signal


class Excitation(abc.ABC):
    """A family of random input signals.

    A signal moves about ``offset`` with a peak drawn uniformly from ``[amplitude/3, amplitude]``.
    """

    @abc.abstractmethod
    def draw(self, count: int, duration: float, rng: np.random.Generator) -> InputSignal:
        """Draw ``count`` signals for times from 0 to ``duration`` s."""


@dataclass(frozen=True)
class _Bounded(Excitation):
    offset: Sequence[float]
    amplitude: Sequence[NonNegativeFloat]

    def _scaled(self, shape: np.ndarray, peak: np.ndarray) -> np.ndarray:
        """Return offset + peak * shape for a shape ``(count, T, M)`` within [-1, 1]."""
        return np.asarray(self.offset) + peak[:, None, :] * shape

    def _peaks(self, count: int, rng: np.random.Generator) -> np.ndarray:
        return np.array(self.amplitude) * rng.uniform(1 / 3, 1.0, (count, len(self.amplitude)))


@dataclass(frozen=True)
class MultiSine(_Bounded):
    """u_i(t) = offset_i + peak_i sum_h w_ih sin(2 pi f_ih t + phi_ih), with sum_h w_ih = 1.

    Args:
        offset: mean of each input, ``(M,)``.
        amplitude: largest peak of each input, ``(M,)``.
        frequency: [low, high] in Hz; f_ih is uniform in its logarithm.
        harmonics: number of sines; 1 gives a plain sine.
    """

    frequency: Bounds = (0.1, 1.0)
    harmonics: PositiveInt = 4

    def draw(self, count: int, duration: float, rng: np.random.Generator) -> InputSignal:
        """Draw ``count`` multi-sines, which do not depend on the duration."""
        peak = self._peaks(count, rng)
        shape = (*peak.shape, self.harmonics)
        low, high = np.log(self.frequency)
        frequency = np.exp(rng.uniform(low, high, shape))
        phase = rng.uniform(0, 2 * np.pi, shape)
        weight = rng.dirichlet(np.ones(self.harmonics), peak.shape)

        def signal(t: np.ndarray) -> np.ndarray:
            angle = 2 * np.pi * frequency[:, None] * t[:, None, None] + phase[:, None]
            return self._scaled((weight[:, None] * np.sin(angle)).sum(-1), peak)

        return signal


@dataclass(frozen=True)
class Chirp(_Bounded):
    """u_i(t) = offset_i + peak_i sin(phi_i + 2 pi (f_0 t + (f_1 - f_0) t^2 / (2 T))).

    Args:
        offset: mean of each input, ``(M,)``.
        amplitude: largest peak of each input, ``(M,)``.
        frequency: [f_0, f_1] in Hz, swept over the duration T; half of the inputs sweep down.
    """

    frequency: Bounds = (0.1, 2.0)

    def draw(self, count: int, duration: float, rng: np.random.Generator) -> InputSignal:
        """Draw ``count`` chirps that sweep the whole band within ``duration`` s."""
        peak = self._peaks(count, rng)
        phase = rng.uniform(0, 2 * np.pi, peak.shape)
        down = rng.random(peak.shape) < 0.5
        start = np.where(down, self.frequency[1], self.frequency[0])
        rate = np.where(down, -1, 1) * (self.frequency[1] - self.frequency[0]) / duration

        def signal(t: np.ndarray) -> np.ndarray:
            cycles = start[:, None] * t[:, None] + 0.5 * rate[:, None] * t[:, None] ** 2
            return self._scaled(np.sin(phase[:, None] + 2 * np.pi * cycles), peak)

        return signal


@dataclass(frozen=True)
class Steps(_Bounded):
    """Levels held for random times, joined by minimum-jerk ramps of ``rise_time``.

    Args:
        offset: mean of each input, ``(M,)``.
        amplitude: largest peak of each input, ``(M,)``.
        hold: [low, high] in s of the duration of a level, including its ramp.
        rise_time: length of a ramp in s, at most ``hold[0]``.
    """

    hold: Bounds = (0.5, 2.0)
    rise_time: PositiveFloat = 0.1

    def __post_init__(self) -> None:
        if self.rise_time > self.hold[0]:
            raise ValueError(
                f"Steps: rise_time is {self.rise_time} s, expected at most hold[0] = {self.hold[0]}"
            )

    def draw(self, count: int, duration: float, rng: np.random.Generator) -> InputSignal:
        """Draw ``count`` sequences of levels that cover ``duration`` s."""
        peak = self._peaks(count, rng)
        shape = (*peak.shape, int(np.ceil(duration / self.hold[0])) + 1)
        level = rng.uniform(-1, 1, shape)
        start = np.cumsum(rng.uniform(self.hold[0], self.hold[1], shape), axis=-1)
        rows, _, columns = np.ix_(range(count), range(1), range(peak.shape[1]))

        def signal(t: np.ndarray) -> np.ndarray:
            # A ramp ends before the next ramp begins, so at most the latest ramp is active.
            begun = (t[:, None, None] >= start[:, None, :, :-1]).sum(-1)
            last = np.maximum(begun - 1, 0)
            before = level[rows, columns, last]
            ramp = np.clip((t[:, None] - start[rows, columns, last]) / self.rise_time, 0.0, 1.0)
            smooth = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
            return self._scaled(before + (level[rows, columns, last + 1] - before) * smooth, peak)

        return signal


@dataclass(frozen=True)
class Mixture(Excitation):
    """Signals of several kinds: signal k is drawn from ``parts[k % len(parts)]``."""

    parts: Annotated[Sequence[Excitation], Field(min_length=1)]

    def draw(self, count: int, duration: float, rng: np.random.Generator) -> InputSignal:
        """Draw ``count`` signals from the parts in turn."""
        kinds, index = len(self.parts), np.arange(count)
        signals = [
            part.draw(len(index[k::kinds]), duration, rng) for k, part in enumerate(self.parts)
        ]
        return picked_signals(signals, index % kinds, index // kinds)
