"""The input between its samples."""

from __future__ import annotations

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
    def _spans(self) -> Tensor:
        """Times between samples, ``(K,)``; 1 after the last sample."""
        return torch.cat([self.t.diff(), torch.ones_like(self.t[:1])])

    @cached_property
    def _coefficients(self) -> list[Tensor]:
        """Coefficients c of u = c_0 + c_1 s + ... after each sample, ``(K, *batch, M)`` each."""
        samples = self.u.movedim(-2, 0).contiguous()
        if self.interpolation == "hold":
            return [samples]
        rise = torch.cat([samples.diff(dim=0), torch.zeros_like(samples[:1])])
        if self.rate is None:
            return [samples, rise]
        scaled = self.rate.movedim(-2, 0)
        span = self._beside(self._spans)
        start = torch.cat([span[:-1] * scaled[:-1], torch.zeros_like(samples[:1])])
        end = torch.cat([span[:-1] * scaled[1:], torch.zeros_like(samples[:1])])
        return [samples, start, 3 * rise - 2 * start - end, start + end - 2 * rise]

    def _beside(self, values: Tensor) -> Tensor:
        return values.reshape(*values.shape, *[1] * (self.u.ndim - 1)).to(self.u)

    def _at(self, times: Tensor, index: Tensor) -> Tensor:
        """Return u at times. ``index`` is the sample before each time, -1 before the first."""
        index = index.clamp(min=0)
        constant, *slopes = (values[index] for values in self._coefficients)
        share = ((times - self.t[index]) / self._spans[index]).clamp(0, 1)
        return constant + _polynomial(self._beside(share), slopes)

    def _integral(self, grid: Tensor) -> Tensor:
        """Return the integral of u from t_0 to each time, ``(T, *batch, M)``."""
        index = (torch.searchsorted(self.t, grid, right=True) - 1).clamp(min=0)
        constant, *slopes = self._coefficients
        slopes = [values / (k + 2) for k, values in enumerate(slopes)]
        span, elapsed = self._beside(self._spans), self._beside(grid - self.t[index])
        share = (elapsed / span[index]).clamp(0, 1)
        areas = span * (constant + sum(slopes))
        total = torch.cat([torch.zeros_like(areas[:1]), areas[:-1]]).cumsum(0)
        mean = constant[index] + _polynomial(share, [values[index] for values in slopes])
        return total[index] + mean * elapsed


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


def _polynomial(s: Tensor, coefficients: Sequence[Tensor]) -> Tensor:
    """Return c_1 s + c_2 s^2 + ..., by Horner's rule."""
    value = torch.zeros_like(s)
    for factor in reversed(coefficients):
        value = s * (factor + value)
    return value
