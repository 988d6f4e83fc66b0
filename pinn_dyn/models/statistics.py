"""Scales of the data for the normalization of models and losses."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.mechanics import State


@dataclass(frozen=True)
class Statistics:
    """Means, standard deviations and ranges over the training windows, in SI units.

    Attributes:
        q_mean, q_std, q_low, q_high: configuration, with its smallest and largest values, ``(N,)``.
        v_std, p_std: velocity and momentum, ``(N,)``; ones if the data have no momenta.
        u_mean, u_std: input, ``(M,)``.
        qv_increment_std, qp_increment_std: increments of (q, v) and (q, p) over 1 to H steps of a
            window, ``(H, 2N)``.
        step: length of a window's step, s.
    """

    q_mean: Tensor
    q_std: Tensor
    q_low: Tensor
    q_high: Tensor
    v_std: Tensor
    p_std: Tensor
    u_mean: Tensor
    u_std: Tensor
    qv_increment_std: Tensor
    qp_increment_std: Tensor
    step: float

    @property
    def num_coordinates(self) -> int:
        """Number of coordinates N."""
        return self.q_mean.shape[0]

    @property
    def num_inputs(self) -> int:
        """Number of inputs M."""
        return self.u_mean.shape[0]

    @property
    def u_rms(self) -> Tensor:
        """Root mean square of each input, ``(M,)``."""
        return (self.u_mean.square() + self.u_std.square()).sqrt()

    def increment_std(self, state: State) -> Tensor:
        """Return the standard deviations of increments of (q, v) or (q, p), ``(H, 2N)``."""
        return self.qv_increment_std if state == "qv" else self.qp_increment_std

    @property
    def acceleration(self) -> Tensor:
        """Standard deviation of the mean acceleration over a step, ``(N,)``."""
        return self.qv_increment_std[0, self.num_coordinates :] / self.step

    def network_input(self, repeat_input: int) -> tuple[Tensor, Tensor]:
        """Return the mean and standard deviation of (q, v, u, ... u) for a black box."""
        zero = torch.zeros_like(self.v_std)
        mean = torch.cat([self.q_mean, zero, *[self.u_mean] * repeat_input])
        std = torch.cat([self.q_std, self.v_std, *[self.u_std] * repeat_input])
        return mean, std

    def to_dict(self) -> dict[str, Any]:
        """Convert to lists and floats for a checkpoint."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {k: v.tolist() if isinstance(v, Tensor) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Statistics:
        """Build from the result of :meth:`to_dict`; raise ValueError on an invalid number."""
        names = [item.name for item in fields(cls)]
        read = {name: torch.tensor(values[name], dtype=torch.float64) for name in names}
        for name, value in read.items():
            positive = name.endswith("_std") or name == "step"
            if not (value.isfinite() & (value > 0 if positive else True)).all():
                kind = "positive" if positive else "finite"
                raise ValueError(f"statistics.{name} is {value.tolist()}, expected {kind} numbers")
        step = float(read.pop("step"))
        return cls(**read, step=step)
