"""Head for a learned initial velocity of a rollout."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.scales import Scales


class LearnedVelocity(nn.Module):
    """v_0 = v + s_v * network(q, v, u), for velocities that are not measured but estimated.

    Before the training, v_0 = v. The head is trained together with the dynamics. Source: Beintema,
    Schoukens and Toth (2023), "Deep subspace encoders for nonlinear system identification".

    Args:
        scales: scales of the data. The value is s_v, ``(N,)``.
        hidden, activation: widths and activation of the hidden layers.
    """

    scale: Tensor

    def __init__(
        self,
        scales: Scales,
        *,
        hidden: Sequence[PositiveInt] = (64,),
        activation: Activation = "tanh",
    ):
        super().__init__()
        mean, std = scales.statistics.network_input(repeat_input=1)
        self.network = MLP(len(mean), scales.size, hidden, activation, mean, std, scales.angles)
        for parameter in self.network.linears[-1].parameters():
            nn.init.zeros_(parameter)
        self.register_buffer("scale", scales.value.float().clone())

    def forward(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return v_0, ``(*batch, N)``, at the measured q and v and the input u ``(*batch, M)``."""
        return v + self.scale * self.network(torch.cat([q, v, u], dim=-1))


InitialVelocityHead = Callable[[Scales], LearnedVelocity]
"""Builder of a head for the initial velocity."""


def start_of(head: LearnedVelocity | None, x0: Tensor, u0: Tensor) -> Tensor:
    """Return (q, v_0), ``(*batch, 2N)``, at the measured x0 = (q, v) and the input u0."""
    q, v = x0.chunk(2, dim=-1)
    return torch.cat([q, v if head is None else head(q, v, u0)], dim=-1)
