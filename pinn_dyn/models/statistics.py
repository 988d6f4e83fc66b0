"""Scales of the data, from which models and losses take their normalization."""

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
        q_mean, q_std: configuration, ``(N,)``.
        q_low, q_high: smallest and largest configuration, ``(N,)``.
        v_std: velocity, ``(N,)``.
        p_std: momentum, ``(N,)``; ones where the data have none.
        u_mean, u_std: input, ``(M,)``.
        qv_increment_std: of (q, v) over the 1st ... H-th step of a window, ``(H, 2N)``.
        qp_increment_std: the same of (q, p), ``(H, 2N)``; ones where the data have no momenta.
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
        """N."""
        return self.q_mean.shape[0]

    @property
    def num_inputs(self) -> int:
        """M."""
        return self.u_mean.shape[0]

    @property
    def u_rms(self) -> Tensor:
        """Root mean square of each input, ``(M,)``."""
        return (self.u_mean.square() + self.u_std.square()).sqrt()

    def increment_std(self, state: State) -> Tensor:
        """Of (q, v) or (q, p) over the 1st ... H-th step of a window, ``(H, 2N)``."""
        return self.qv_increment_std if state == "qv" else self.qp_increment_std

    @property
    def acceleration(self) -> Tensor:
        """Standard deviation of the mean acceleration over a step, ``(N,)``."""
        return self.qv_increment_std[0, self.num_coordinates :] / self.step

    def network_input(self, repeat_input: int) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of (q, v, u, ... u), for a black box."""
        zero = torch.zeros_like(self.v_std)
        mean = torch.cat([self.q_mean, zero, *[self.u_mean] * repeat_input])
        std = torch.cat([self.q_std, self.v_std, *[self.u_std] * repeat_input])
        return mean, std

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and floats, as a checkpoint stores them."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {k: v.tolist() if isinstance(v, Tensor) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Statistics:
        """The inverse of :meth:`to_dict`."""
        read = {k: torch.tensor(v, dtype=torch.float64) for k, v in values.items() if k != "step"}
        return cls(**read, step=values["step"])
