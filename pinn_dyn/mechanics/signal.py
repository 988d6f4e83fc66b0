"""The input between its samples."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

_ROUNDING = 1e-9  # s between shifted times that are the same

Interpolation = Literal["hold", "linear", "cubic"]
"""Interpolation between two samples: the earlier sample, a line, or a cubic."""


@dataclass(frozen=True)
class Signal:
    """A sampled input u(t), constant before the first and after the last sample.

    Between the samples u_k at t_k and u_{k+1} at t_{k+1}, with s = (t - t_k)/h from 0 to 1::

        hold     u = u_k
        linear   u = (1 - s) u_k + s u_{k+1}
        cubic    u = (1 - 3s^2 + 2s^3) u_k + (3s^2 - 2s^3) u_{k+1}
                     + h (s - 2s^2 + s^3) r_k - h (s^2 - s^3) r_{k+1}

    r_k is the rate at a sample, by second-order differences of its two neighbours (a cubic Hermite
    spline). The error for smooth inputs is of order h^3.

    Args:
        t: sample times, ``(K,)``, s, strictly increasing.
        u: samples, ``(*batch, K, M)``.
        interpolation: ``"hold"``, ``"linear"`` or ``"cubic"``.
        rate: r, ``(*batch, K, M)``, for a part of a longer cubic. The default is computed from u.

    Raises:
        ValueError: if shapes do not match, times do not increase, or the interpolation is unknown.
    """

    t: Tensor
    u: Tensor
    interpolation: Interpolation = "linear"
    rate: Tensor | None = None

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.u.ndim < 2 or self.u.shape[-2] != self.t.shape[0]:
            raise ValueError(
                f"u has shape {tuple(self.u.shape)}, expected (*batch, {self.t.shape[0]}, M) for "
                f"{self.t.shape[0]} sample times"
            )
        if self.interpolation not in get_args(Interpolation):
            raise ValueError(
                f"interpolation is {self.interpolation!r}, expected 'hold', 'linear' or 'cubic'"
            )
        backward = ~(self.t[1:] > self.t[:-1])
        if backward.any():
            k = int(backward.nonzero()[0])
            raise ValueError(
                f"t must increase strictly, but t[{k}] = {float(self.t[k])} is followed by "
                f"t[{k + 1}] = {float(self.t[k + 1])}: sort it and drop repeated times"
            )
        if self.interpolation == "cubic" and self.rate is None:
            object.__setattr__(self, "rate", _rates(self.t, self.u))

    @property
    def num_inputs(self) -> int:
        """Number of inputs M."""
        return self.u.shape[-1]

    @property
    def batch(self) -> torch.Size:
        """Batch shape of u."""
        return self.u.shape[:-2]

    def part(self, samples: slice) -> Signal:
        """Return the signal restricted to a slice of its samples."""
        return self._changed(self.t[samples], lambda value: value[..., samples, :])

    def since(self, start: Tensor) -> Signal:
        """Return the signal with times relative to ``start``, ``()``, s."""
        return self._changed(self.t - start, lambda value: value)

    def delayed(self, delays: Tensor) -> Signal:
        """Return u_i(t - d_i) for delays d ``(M,)`` in s, sampled at all shifted times."""
        if not len(delays.unique()) > 1:
            return self.since(-delays[:1].sum())
        t = torch.cat([self.t + d for d in delays.unique().to(self.t)]).sort().values
        t = t[torch.cat([t.diff() > _ROUNDING, t.new_ones(1).bool()])]
        inputs = [self.since(-d).at(t)[..., i] for i, d in enumerate(delays.to(self.t))]
        return Signal(t, torch.stack(inputs, dim=-1).movedim(0, -2), self.interpolation)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Signal:
        """Apply a function such as ``lambda u: u[index]`` to samples and rates."""
        return self._changed(self.t, change)

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Signal:
        """Move times and samples to a device, and convert them to a dtype."""
        return self._changed(self.t.to(device, dtype), lambda value: value.to(device, dtype))

    def with_samples(self, u: Tensor, rate: Tensor | None = None) -> Signal:
        """Return a signal with new samples, and new rates if it is cubic, at the same times."""
        return self._made(self.t, u, rate)

    def _changed(self, t: Tensor, change: Callable[[Tensor], Tensor]) -> Signal:
        return self._made(t, change(self.u), None if self.rate is None else change(self.rate))

    def _made(self, t: Tensor, u: Tensor, rate: Tensor | None) -> Signal:
        made = object.__new__(Signal)
        made.__dict__.update(t=t, u=u, interpolation=self.interpolation, rate=rate)
        return made

    def __call__(self, time: Tensor | float) -> Tensor:
        """Return u at a time, ``(*batch, M)``. At a jump, return the value after it."""
        now, times = float(time), self._times
        last = len(times) - 1
        index = min(max(bisect.bisect_right(times, now) - 1, 0), last)
        if self.interpolation == "hold" or index == last:
            return self._samples[index]
        span = times[index + 1] - times[index]
        share = max((now - times[index]) / span, 0.0)
        if self._rates is None:
            return torch.lerp(self._samples[index], self._samples[index + 1], share)
        # Outside the samples the share is 0, and the rates have no weight.
        weights = torch.tensor(share, dtype=self.u.dtype, device=self.u.device)
        low, high = self._samples[index : index + 2]
        return _combined(_cubic(weights), low, high, *(span * self._rates[index : index + 2]))

    def at(self, times: Tensor) -> Tensor:
        """Return u at times ``(T,)``, ``(T, *batch, M)``. At a jump, return the value after it."""
        return self._at(times, torch.searchsorted(self.t, times, right=True) - 1)

    def stages(self, grid: Tensor, nodes: tuple[float, ...]) -> Tensor:
        """Return u at the stages of each step, ``(T - 1, stages, *batch, M)``.

        ``grid`` ``(T,)`` holds the times of the steps, and ``nodes`` the times of the stages in a
        step, from 0 to 1. At a jump, a stage at the end of a step sees the value before it.
        """
        start, end = grid[:-1], grid[1:]
        inner = [torch.lerp(start, end, node) for node in nodes[:-1]]
        times = torch.stack([*inner, end], dim=-1)
        index = torch.searchsorted(self.t, times, right=True) - 1
        if self.interpolation == "hold":
            index[:, -1] = torch.searchsorted(self.t, end.contiguous()) - 1
        return self._at(times, index)

    def means(self, grid: Tensor) -> Tensor:
        """Return the mean of u over each step of the grid ``(T,)``, ``(T - 1, *batch, M)``."""
        return self._integral(grid).diff(dim=0) / self._beside(grid.diff())

    # Samples are the first dimension, (K, *batch, M), so a row is contiguous.

    @cached_property
    def _times(self) -> list[float]:
        return self.t.to(self.u.dtype).tolist()

    @cached_property
    def _samples(self) -> Tensor:
        return self.u.movedim(-2, 0).contiguous()

    @cached_property
    def _rates(self) -> Tensor | None:
        return None if self.rate is None else self.rate.movedim(-2, 0).contiguous()

    def _beside(self, values: Tensor) -> Tensor:
        return values.reshape(*values.shape, *[1] * (self.u.ndim - 1)).to(self.u)

    def _at(self, times: Tensor, index: Tensor) -> Tensor:
        """Return u at times. ``index`` is the sample before each time, -1 before the first."""
        last = self.t.shape[0] - 1
        if self.interpolation == "hold" or last == 0:
            return self._samples[index.clamp(0, last)]
        index = index.clamp(0, last - 1)
        span = self.t[index + 1] - self.t[index]
        share = self._beside(((times - self.t[index]) / span).clamp(0, 1))
        low, high = self._samples[index], self._samples[index + 1]
        if self._rates is None:
            return torch.lerp(low, high, share)
        rates = (self._beside(span) * self._rates[k] for k in (index, index + 1))
        return _combined(_cubic(share), low, high, *rates)

    def _integral(self, grid: Tensor) -> Tensor:
        """Return the integral of u from t_0 to each time, ``(T, *batch, M)``."""
        samples, rates, last = self._samples, self._rates, self.t.shape[0] - 1
        index = (torch.searchsorted(self.t, grid, right=True) - 1).clamp(min=0)
        elapsed = self._beside(grid - self.t[index])
        span = self._beside(self.t.diff())
        if self.interpolation == "hold":
            areas, height = samples[:-1] * span, samples[index]
        else:
            areas = span * (samples[:-1] + samples[1:]) / 2
            following = (index + 1).clamp(max=last)
            length = self._beside(self.t[following] - self.t[index])
            # Zero beyond the ends, where u is constant.
            inside = length > 0
            share = torch.where(inside, elapsed.clamp(min=0) / torch.where(inside, length, 1), 0)
            if rates is None:
                height = torch.lerp(samples[index], samples[following], share / 2)
            else:
                areas = areas + span.square() * (rates[:-1] - rates[1:]) / 12
                scaled = length * rates[index], length * rates[following]
                height = _combined(_cubic_mean(share), samples[index], samples[following], *scaled)
        total = torch.cat([torch.zeros_like(samples[:1]), areas]).cumsum(0)
        return total[index] + height * elapsed


def stacked(signals: Sequence[Signal], t: Tensor) -> Signal:
    """Stack signals of the same interpolation and length, and replace their times by ``t``."""
    rates = [item.rate for item in signals if item.rate is not None]
    u = torch.stack([item.u for item in signals])
    return signals[0]._made(t, u, torch.stack(rates) if rates else None)


def _rates(t: Tensor, u: Tensor) -> Tensor:
    if t.shape[0] < 2:
        return torch.zeros_like(u)
    order = 1 if t.shape[0] == 2 else 2
    return torch.gradient(u, spacing=(t.to(u),), dim=-2, edge_order=order)[0]


def _cubic(s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return weights of u_k, u_{k+1}, h r_k and h r_{k+1} at s."""
    square, cube = s**2, s**3
    rise = 3 * square - 2 * cube
    return 1 - rise, rise, s - 2 * square + cube, cube - square


def _cubic_mean(s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the means of the weights of :func:`_cubic` over 0 to s."""
    square, cube = s**2, s**3
    rise = square - cube / 2
    return 1 - rise, rise, s / 2 - 2 * square / 3 + cube / 4, cube / 4 - square / 3


def _combined(
    weights: tuple[Tensor, ...], low: Tensor, high: Tensor, low_rate: Tensor, high_rate: Tensor
) -> Tensor:
    a, b, c, d = weights
    return a * low + b * high + c * low_rate + d * high_rate
