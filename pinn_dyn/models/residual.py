"""Head for a residual force: a network of q, v and u."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.scales import Scales


class NetworkResidual(nn.Module):
    """Residual force r_i = f_i network_i(q, v, u) of effects that are not mechanical::

        penalty = w mean over the batch and i of (r_i / f_i)^2

    f is a typical generalized force. r is initially zero. r is not passive, but bounded: the input
    of the network saturates outside the range of q, and beyond three standard deviations of v and
    u.

    Args:
        scales: scales of the data. The value is a typical generalized force, ``(N,)``.
        hidden, activation: widths and activation of the hidden layers.
        weight: w, in relation to the loss of the prediction, which is near one at the start.
    """

    scale: Tensor

    def __init__(
        self,
        scales: Scales,
        *,
        hidden: Sequence[PositiveInt],
        activation: Activation = "tanh",
        weight: NonNegativeFloat = 0.01,
    ):
        super().__init__()
        self.weight = weight
        data, size = scales.statistics, scales.size
        mean, std = data.network_input(repeat_input=1)
        low, high = mean - 3 * std, mean + 3 * std
        low[:size], high[:size] = data.q_low, data.q_high
        sizes = len(mean), size
        limits = low, high
        self.network = MLP(*sizes, hidden, activation, mean, std, scales.angles, limits=limits)
        nn.init.zeros_(self.network.linears[-1].weight)
        self.register_buffer("scale", scales.value.float())

    def forward(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return r, ``(*batch, N)``, at q, v ``(*batch, N)`` and u ``(*batch, M)``."""
        return self.scale * self.network.linearize(torch.cat([q, v, u], dim=-1))[0]

    def penalty(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the penalty of r, a scalar, at states ``(B, N)`` and inputs ``(B, M)``."""
        return self.weight * (self(q, v, u) / self.scale).square().mean()


ResidualHead = Callable[[Scales], NetworkResidual]
"""Builder of a residual head. The value of its scales is a force."""
