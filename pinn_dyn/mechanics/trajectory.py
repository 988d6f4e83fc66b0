"""Trajectories: simulated, measured or predicted motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from pinn_dyn.mechanics.signal import Signal, stacked

State = Literal["qv", "qp"]
"""Name of a state x: (q, v), or (q, p) with p = M(q) v."""


@dataclass(frozen=True)
class Trajectory:
    """A sampled motion under a sampled input.

    Attributes:
        q, v: configuration and velocity, ``(*batch, T, N)``.
        input: u at T times, ``(*batch, T, M)``, and its interpolation.
        momentum: function from (q, v) to p = M(q) v on the CPU, ``(*batch, N)``, for simulated
            data; None for measured data.
        past, past_q: the K samples of u, ``(*batch, K, M)``, and of q, ``(*batch, K, N)``, before
            the first sample; None if unknown.

    Raises:
        ValueError: if there are fewer than two samples, or shapes do not match.
    """

    q: Tensor
    v: Tensor
    input: Signal
    momentum: Callable[[Tensor, Tensor], Tensor] | None = None
    past: Tensor | None = None
    past_q: Tensor | None = None

    def __post_init__(self) -> None:
        samples = self.t.shape[0]
        if samples < 2:
            raise ValueError(f"t has shape ({samples},), expected (T,) with at least 2 samples")
        shape = (*self.u.shape[:-1], self.q.shape[-1])
        for name, value in (("q", self.q), ("v", self.v)):
            if value.shape != shape:
                raise ValueError(
                    f"{name} has shape {tuple(value.shape)}, expected {shape} to match u"
                )

    @property
    def t(self) -> Tensor:
        """Sample times, ``(T,)``, s."""
        return self.input.t

    @property
    def u(self) -> Tensor:
        """Samples of the input, ``(*batch, T, M)``."""
        return self.input.u

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t[-1] - self.t[0])

    def since(self, history: float) -> Trajectory:
        """Return the motion extended by ``history`` seconds before its start.

        Unknown samples of q and u repeat the earliest known sample, as of a robot at rest. v before
        the start repeats its first sample and has no meaning.
        """
        step = self.t[1] - self.t[0]
        count = math.ceil(history / float(step) - 1e-6)
        if count < 1:
            return self
        before = self.t[0] - step * torch.arange(count, 0, -1).to(self.t)
        q = torch.cat([_extended(self.past_q, self.q, count), self.q], dim=-2)
        v = torch.cat([_extended(None, self.v, count), self.v], dim=-2)
        u = torch.cat([_extended(self.past, self.u, count), self.u], dim=-2)
        input = Signal(torch.cat([before, self.t]), u, self.input.interpolation)
        return Trajectory(q, v, input, self.momentum)

    def states(
        self, state: State, samples: slice = slice(None), past: int = 0, stride: int = 1
    ) -> Tensor:
        """Return states (q, v) or (q, p) at the chosen samples, ``(*batch, T, 2N)``.

        With ``past`` = n, each state is followed by n earlier q that are ``stride`` samples apart,
        the latest first, ``(*batch, T, 2N + nN)``.

        Raises:
            ValueError: if momenta are needed and M is unknown.
        """
        if past:
            step = float(self.t[1] - self.t[0])
            q = self.since(past * stride * step).q
            start = torch.arange(self.t.shape[0])[samples, None]
            earlier = q[..., start + stride * torch.arange(past - 1, -1, -1), :].flatten(-2)
            return torch.cat([self.states(state, samples), earlier], dim=-1)
        q, v = self.q[..., samples, :], self.v[..., samples, :]
        if state == "qv":
            return torch.cat([q, v], dim=-1)
        if self.momentum is None:
            raise ValueError(
                "this trajectory has no momentum p: use simulated data or a Lagrangian model"
            )
        return torch.cat([q, self.momentum(q.cpu(), v.cpu()).to(q)], dim=-1)

    def to(self, device: torch.device | str) -> Trajectory:
        """Move the trajectory to a device."""
        names = ("q", "v", "input", "past", "past_q")
        values = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, **{name: value.to(device) for name, value in values.items()})

    def until(self, horizon: float) -> Trajectory:
        """Return the part up to ``horizon`` seconds after the start.

        Raises:
            ValueError: if the horizon is longer than the trajectory, or shorter than a step.
        """
        step = float(self.t[1] - self.t[0])
        count = int(torch.searchsorted(self.t, self.t[0] + horizon + 0.5 * step))
        if self.duration < horizon - 0.5 * step or count < 2:
            raise ValueError(
                f"horizon is {horizon} s, but the trajectory lasts only {self.duration:g} s, with "
                f"steps of {step:g} s"
            )
        q, v = (x[..., :count, :] for x in (self.q, self.v))
        return replace(self, q=q, v=v, input=self.input.part(slice(count)))


def stack(trajectories: list[Trajectory]) -> Trajectory:
    """Stack trajectories that share their sample times into one batched trajectory.

    Raises:
        ValueError: if sample times or interpolations differ.
    """
    first = trajectories[0]
    for index, item in enumerate(trajectories):
        kind, expected = item.input.interpolation, first.input.interpolation
        if kind != expected:
            raise ValueError(
                f"trajectory {index} has interpolation {kind!r}, trajectory 0 {expected!r}"
            )
        # Compare sample times relative to the start of each trajectory.
        resolution = 4 * torch.finfo(item.t.dtype).eps * float(item.t.abs().max())
        same = item.t.shape == first.t.shape and torch.allclose(
            item.t - item.t[0], first.t - first.t[0], rtol=0, atol=max(1e-9, resolution)
        )
        if not same:
            raise ValueError(
                f"trajectory {index} has other sample times than trajectory 0 "
                f"({item.t.shape[0]} and {first.t.shape[0]} samples): resample them first"
            )
    return replace(
        first,
        q=torch.stack([item.q for item in trajectories]),
        v=torch.stack([item.v for item in trajectories]),
        input=stacked([item.input for item in trajectories], first.t - first.t[0]),
        past=_stacked([(item.past, item.u) for item in trajectories]),
        past_q=_stacked([(item.past_q, item.q) for item in trajectories]),
    )


def stack_until(trajectories: Sequence[Trajectory], duration: float | None = None) -> Trajectory:
    """Cut trajectories to a duration in s and stack them; leave out shorter trajectories.

    All must have the same sample time. The default is the duration of the shortest trajectory.

    Raises:
        ValueError: if no trajectory is long enough, or they cannot be stacked, see :func:`stack`.
    """
    if duration is None:
        duration = min(item.duration for item in trajectories)
    longest = max(trajectories, key=lambda item: item.duration)
    step = float(longest.t[1] - longest.t[0])
    long_enough = [item for item in trajectories if item.duration >= duration - 0.5 * step]
    return stack([item.until(duration) for item in long_enough or [longest]])


def _stacked(pasts: list[tuple[Tensor | None, Tensor]]) -> Tensor | None:
    count = max((past.shape[-2] for past, _ in pasts if past is not None), default=0)
    return torch.stack([_extended(*item, count) for item in pasts]) if count else None


def _extended(past: Tensor | None, values: Tensor, count: int) -> Tensor:
    """Return ``count`` samples before values; repeat the earliest known sample where needed."""
    if past is None:
        past = values[..., :0, :]
    past = past[..., max(past.shape[-2] - count, 0) :, :]
    first = torch.cat([past, values], dim=-2)[..., :1, :]
    missing = count - past.shape[-2]
    return torch.cat([first.expand(*values.shape[:-2], missing, values.shape[-1]), past], dim=-2)


def samples_of(name: str, duration: float, t: Tensor) -> int:
    """Convert a duration in s to a number of sample times of t ``(T,)``."""
    steps = t.double().diff()
    sample_time = float(steps.mean())
    if float((steps - sample_time).abs().max()) > 1e-3 * sample_time:
        raise ValueError(
            f"{name} is {duration} s, but the sample time varies between {float(steps.min()):g} "
            f"and {float(steps.max()):g} s: resample the data first"
        )
    count = round(duration / sample_time)
    if count < 1 or abs(duration / sample_time - count) > 1e-3:
        raise ValueError(
            f"{name} is {duration} s and the sample time of the data is {sample_time:g} s: "
            f"{name} must be a positive integer multiple of the sample time"
        )
    return count
