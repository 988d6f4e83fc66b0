"""Trajectories: what is simulated, measured, predicted and compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

Coordinates = Literal["velocity", "momentum"]
"""Which variable completes the state x: (q, v) or (q, p) with p = M(q) v."""

Interpolation = Literal["linear", "hold"]
"""How the input moves between two samples: on a straight line, or held at the earlier one."""


@dataclass(frozen=True)
class Trajectory:
    """A sampled motion under a sampled input.

    Attributes:
        t: sample times in s, ``(T,)``, strictly increasing.
        q: configuration, ``(*batch, T, N)``.
        v: velocity dq/dt, ``(*batch, T, N)``.
        u: input, ``(*batch, T, M)``.
        interpolation: how ``u`` moves between samples.
        momentum: p = M(q) v where the truth is known, ``(*batch, N), (*batch, N) -> (*batch, N)``
            on the CPU; None for measured data.

    Raises:
        ValueError: on shapes that do not match or times that do not increase.
    """

    t: Tensor
    q: Tensor
    v: Tensor
    u: Tensor
    interpolation: Interpolation = "linear"
    momentum: Callable[[Tensor, Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        samples = self.t.shape[0] if self.t.ndim == 1 else -1
        if samples < 2:
            raise ValueError(
                f"t has shape {tuple(self.t.shape)}, expected (T,) with at least 2 samples"
            )
        backward = ~(self.t[1:] > self.t[:-1])
        if backward.any():
            k = int(backward.nonzero()[0])
            raise ValueError(
                f"t must increase strictly, but t[{k}] = {float(self.t[k])} "
                f"is followed by t[{k + 1}] = {float(self.t[k + 1])}"
            )
        for name in ("q", "v", "u"):
            value = getattr(self, name)
            width = (value if name == "u" else self.q).shape[-1:]
            batch = self.q.shape[:-2]
            if value.ndim < 2 or value.shape != (*batch, samples, *width):
                sizes = ", ".join(str(size) for size in (samples, *width))
                raise ValueError(
                    f"{name} has shape {tuple(value.shape)}, expected (*batch, {sizes}) with the "
                    f"batch {tuple(batch)} of q"
                )
        if self.interpolation not in ("linear", "hold"):
            raise ValueError(
                f"interpolation is {self.interpolation!r}, expected 'linear' or 'hold'"
            )

    @property
    def duration(self) -> float:
        """Time from the first to the last sample in s."""
        return float(self.t[-1] - self.t[0])

    def state(self, coordinates: Coordinates, samples: slice = slice(None)) -> Tensor:
        """Stacked state ``(*batch, T, 2N)`` at the chosen samples: (q, v) or (q, p).

        Raises:
            ValueError: if momenta are asked for and M is not known.
        """
        q, v = self.q[..., samples, :], self.v[..., samples, :]
        if coordinates == "velocity":
            return torch.cat([q, v], dim=-1)
        if self.momentum is None:
            raise ValueError(
                "this trajectory has no momentum p, which a Hamiltonian model needs: use "
                "simulated data, which have it, or a Lagrangian model"
            )
        return torch.cat([q, self.momentum(q.cpu(), v.cpu()).to(q)], dim=-1)

    def to(self, device: torch.device | str) -> Trajectory:
        """The trajectory on another device."""
        moved = {name: getattr(self, name).to(device) for name in ("t", "q", "v", "u")}
        return replace(self, **moved)

    def until(self, horizon: float) -> Trajectory:
        """The part of the trajectory up to ``horizon`` seconds after its start.

        Raises:
            ValueError: if the trajectory is shorter than the horizon.
        """
        step = float(self.t[1] - self.t[0])
        if self.duration < horizon - 0.5 * step:
            raise ValueError(
                f"horizon is {horizon} s, but the trajectory lasts only {self.duration:g} s"
            )
        count = int(torch.searchsorted(self.t, self.t[0] + horizon + 0.5 * step))
        return replace(
            self,
            t=self.t[:count],
            q=self.q[..., :count, :],
            v=self.v[..., :count, :],
            u=self.u[..., :count, :],
        )


def stack(trajectories: list[Trajectory]) -> Trajectory:
    """Stack trajectories that share their sample times into one batched trajectory.

    Raises:
        ValueError: on an empty list, or on trajectories whose sample times differ.
    """
    if not trajectories:
        raise ValueError("trajectories is empty: expected at least one")
    first = trajectories[0]
    for index, other in enumerate(trajectories):
        if other.interpolation != first.interpolation:
            raise ValueError(
                f"trajectory {index} has interpolation {other.interpolation!r}, trajectory 0 "
                f"{first.interpolation!r}: expected the same"
            )
        # Sample times are compared from each trajectory's own start.
        resolution = 4 * torch.finfo(other.t.dtype).eps * float(other.t.abs().max())
        same = other.t.shape == first.t.shape and torch.allclose(
            other.t - other.t[0], first.t - first.t[0], rtol=0, atol=max(1e-9, resolution)
        )
        if not same:
            raise ValueError(
                f"trajectory {index} has other sample times than trajectory 0 "
                f"({other.t.shape[0]} and {first.t.shape[0]} samples): resample them first"
            )
    return replace(
        first,
        t=first.t - first.t[0],
        q=torch.stack([item.q for item in trajectories]),
        v=torch.stack([item.v for item in trajectories]),
        u=torch.stack([item.u for item in trajectories]),
    )
