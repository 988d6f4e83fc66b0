"""The input between its samples."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import torch
from torch import Tensor

Interpolation = Literal["hold", "linear", "cubic"]
"""How a signal moves between two samples: held at the earlier one, on a line, or on a cubic."""
Side = Literal["left", "right"]


@dataclass(frozen=True)
class Signal:
    """An input u(t), known at sample times; before the first and after the last it holds those.

    Between the samples u_k at t_k and u_{k+1} at t_{k+1}, with s = (t - t_k)/h from 0 to 1::

        hold     u = u_k
        linear   u = (1 - s) u_k + s u_{k+1}
        cubic    u = (1 - 3s^2 + 2s^3) u_k + (3s^2 - 2s^3) u_{k+1}
                     + h (s - 2s^2 + s^3) r_k - h (s^2 - s^3) r_{k+1}

    r_k is the rate at a sample, from its two neighbours by second-order differences (a cubic
    Hermite spline): smooth inputs of a low rate are followed with an error of order h^3, and a
    sample moves the curve no farther than two samples away.

    Args:
        t: sample times, ``(K,)``, s, strictly increasing.
        u: samples, ``(*batch, K, M)``.
        interpolation: ``"hold"``, ``"linear"`` or ``"cubic"``.
        rate: r, ``(*batch, K, M)``, for a cubic that is part of a longer one; None: from u.

    Raises:
        ValueError: on shapes that do not match, times that do not increase, or another
            interpolation.
    """

    t: Tensor
    u: Tensor
    interpolation: Interpolation = "linear"
    rate: Tensor | None = None

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.u.ndim < 2 or self.u.shape[-2] != self.t.shape[0]:
            raise ValueError(
                f"u has shape {tuple(self.u.shape)}, expected (*batch, {self.t.shape[0]}, M): "
                f"one input for each of the {self.t.shape[0]} sample times"
            )
        if self.interpolation not in get_args(Interpolation):
            raise ValueError(
                f"interpolation is {self.interpolation!r}, expected 'hold', 'linear' or 'cubic'"
            )
        backward = ~(self.t[1:] > self.t[:-1])
        if backward.any():
            k = int(backward.nonzero()[0])
            raise ValueError(
                f"t must increase strictly, but t[{k}] = {float(self.t[k])} "
                f"is followed by t[{k + 1}] = {float(self.t[k + 1])}: sort it and drop repeated "
                "times"
            )
        if self.interpolation == "cubic" and self.rate is None:
            object.__setattr__(self, "rate", _rates(self.t, self.u))

    @property
    def num_inputs(self) -> int:
        """M."""
        return self.u.shape[-1]

    @property
    def batch(self) -> torch.Size:
        """Batch shape of u."""
        return self.u.shape[:-2]

    # Other signals made of this one.

    def part(self, samples: slice) -> Signal:
        """The signal at some of its samples alone."""
        return self._changed(self.t[samples], lambda value: value[..., samples, :])

    def since(self, start: Tensor) -> Signal:
        """The same signal, its times counted from ``start``, ``()``, s."""
        return self._changed(self.t - start, lambda value: value)

    def delayed(self, delay: Tensor) -> Signal:
        """u(t - d), for d ``()`` in s; its gradient in d is -du/dt.

        Raises:
            ValueError: if u is held, and so has no slope between its jumps.
        """
        if self.interpolation == "hold":
            raise ValueError(
                "interpolation is 'hold', expected 'linear' or 'cubic': a held input has no slope "
                "by which its delay could be learned; set dataset.interpolation=linear, or find "
                "the delay before the training (check.py) and shift the input (InputDelay)"
            )
        return self._changed(self.t + delay.to(self.t), lambda value: value)

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Signal:
        """A change of the batch, such as ``lambda u: u[index]``, in all that has one."""
        return self._changed(self.t, change)

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Signal:
        """Times and samples on a device and, where given, in a dtype."""
        return self._changed(self.t.to(device, dtype), lambda value: value.to(device, dtype))

    def with_samples(self, u: Tensor, rate: Tensor | None = None) -> Signal:
        """Other samples, and rates where it is cubic, at the same times."""
        return self._made(self.t, u, rate)

    def _changed(self, t: Tensor, change: Callable[[Tensor], Tensor]) -> Signal:
        return self._made(t, change(self.u), None if self.rate is None else change(self.rate))

    def _made(self, t: Tensor, u: Tensor, rate: Tensor | None) -> Signal:
        """Without the checks, which have been made, and by operations that can be traced."""
        made = object.__new__(Signal)
        values = {"t": t, "u": u, "interpolation": self.interpolation, "rate": rate}
        made.__dict__.update(values)
        return made

    # Values.

    def __call__(self, time: Tensor | float, side: Side = "right") -> Tensor:
        """u at one time, ``(*batch, M)``; a held input jumps at its samples, seen from a side."""
        now, times = float(time), self._times
        last = len(times) - 1
        find = bisect.bisect_right if side == "right" else bisect.bisect_left
        index = min(max(find(times, now) - 1, 0), last)
        if self.interpolation == "hold" or index == last:
            return self._samples[index]
        span = times[index + 1] - times[index]
        share = max((now - times[index]) / span, 0.0)
        if self._rates is None:
            return torch.lerp(self._samples[index], self._samples[index + 1], share)
        # Outside the samples share is 0, where the rates do not count.
        weights = torch.tensor(share, dtype=self.u.dtype, device=self.u.device)
        values = self._samples[index : index + 2], span * self._rates[index : index + 2]
        return _combined(_cubic(weights), values[0][0], values[0][1], values[1][0], values[1][1])

    def at(self, times: Tensor) -> Tensor:
        """u at times ``(T,)``, seen from the right, ``(T, *batch, M)``."""
        return self._at(times, torch.searchsorted(self.t, times, right=True) - 1)

    def stages(self, grid: Tensor, nodes: tuple[float, ...]) -> Tensor:
        """u at the stages of each step, ``(T - 1, stages, *batch, M)``.

        A stage at the end of a step sees the input from the left: the held one of the step, not the
        one that begins there.

        Args:
            grid: times of the steps, ``(T,)``, s.
            nodes: times of the stages in a step, from 0 to 1; the last is 1.
        """
        start, end = grid[:-1], grid[1:]
        inner = [torch.lerp(start, end, node) for node in nodes[:-1]]
        times = torch.stack([*inner, end], dim=-1)
        index = torch.searchsorted(self.t, times, right=True) - 1
        if self.interpolation == "hold":
            index[:, -1] = torch.searchsorted(self.t, end) - 1
        return self._at(times, index)

    def means(self, grid: Tensor) -> Tensor:
        """The mean of u over each step, ``(T - 1, *batch, M)``, for steps at ``grid`` ``(T,)``."""
        integral = self._integral(grid)
        return integral.diff(dim=0) / self._beside(grid.diff())

    # How they come about. Samples lie in front, (K, *batch, M): one row is one block.

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
        """Numbers for samples, shaped to be multiplied with those."""
        return values.reshape(*values.shape, *[1] * (self.u.ndim - 1)).to(self.u)

    def _at(self, times: Tensor, index: Tensor) -> Tensor:
        """u at times that follow the samples ``index``, which may lie before the first."""
        last = self.t.shape[0] - 1
        if self.interpolation == "hold" or last == 0:
            return self._samples[index.clamp(0, last)]
        index = index.clamp(0, last - 1)
        span = self.t[index + 1] - self.t[index]
        share = self._beside(((times - self.t[index]) / span).clamp(0, 1))
        low, high = self._samples[index], self._samples[index + 1]
        if self._rates is None:
            return torch.lerp(low, high, share)
        rates = self._beside(span) * self._rates[index], self._beside(span) * self._rates[index + 1]
        return _combined(_cubic(share), low, high, *rates)

    def _integral(self, grid: Tensor) -> Tensor:
        """The integral of u from t_0 to each time, ``(T, *batch, M)``."""
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
            # Zero beyond the ends, where u holds.
            inside = length > 0
            share = torch.where(inside, elapsed.clamp(min=0) / torch.where(inside, length, 1), 0)
            if rates is None:
                height = torch.lerp(samples[index], samples[following], share / 2)
            else:
                areas = areas + span.square() * (rates[:-1] - rates[1:]) / 12
                scaled = length * rates[index], length * rates[following]
                height = _combined(_cubic_mean(share), samples[index], samples[following], *scaled)
        whole = torch.cat([torch.zeros_like(samples[:1]), areas]).cumsum(0)
        return whole[index] + height * elapsed


def stacked(signals: Sequence[Signal], t: Tensor) -> Signal:
    """Signals of one interpolation and as many samples as one, ``(len(signals), *batch, K, M)``.

    Each counts its time from a start of its own; all samples are taken to lie at ``t`` ``(K,)``.
    """
    first = signals[0]
    together = Signal(t, torch.stack([item.u for item in signals]), "hold")
    rates = [item.rate for item in signals if item.rate is not None]
    return replace(
        together,
        interpolation=first.interpolation,
        rate=torch.stack(rates) if rates else None,
    )


def _rates(t: Tensor, u: Tensor) -> Tensor:
    """du/dt at the samples, by differences of second order where there are three of them."""
    if t.shape[0] < 2:
        return torch.zeros_like(u)
    order = 1 if t.shape[0] == 2 else 2
    return torch.gradient(u, spacing=(t.to(u),), dim=-2, edge_order=order)[0]


def _cubic(s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights of u_k, u_{k+1}, h r_k and h r_{k+1} at s."""
    square, cube = s**2, s**3
    rise = 3 * square - 2 * cube
    return 1 - rise, rise, s - 2 * square + cube, cube - square


def _cubic_mean(s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means of these weights from 0 to s."""
    square, cube = s**2, s**3
    rise = square - cube / 2
    return 1 - rise, rise, s / 2 - 2 * square / 3 + cube / 4, cube / 4 - square / 3


def _combined(
    weights: tuple[Tensor, ...], low: Tensor, high: Tensor, low_rate: Tensor, high_rate: Tensor
) -> Tensor:
    a, b, c, d = weights
    return a * low + b * high + c * low_rate + d * high_rate
