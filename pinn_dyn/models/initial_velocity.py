"""Heads for the velocity at which a roll-out starts: the measured one, or a learned correction."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.scales import Scales


class InitialVelocity(nn.Module, abc.ABC):
    """The velocity v_0 ``(*batch, N)`` at which a roll-out from a measured state starts.

    Attributes:
        learned: whether v_0 is other than the measured velocity.
    """

    learned: bool

    @abc.abstractmethod
    def forward(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """v_0 at the measured q, v ``(*batch, N)`` and the input u ``(*batch, M)`` there."""

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """(q, v_0), ``(*batch, 2N)``, at the measured x0 = (q, v) and the input u0 there."""
        q, v = x0.chunk(2, dim=-1)
        return torch.cat([q, self(q, v, u0)], dim=-1)


InitialVelocityHead = Callable[[Scales], InitialVelocity]
"""Builds a head for the velocity at which roll-outs start."""


class MeasuredVelocity(InitialVelocity):
    """v_0 = v.

    Args:
        scales: of the data.
    """

    learned = False

    def __init__(self, scales: Scales):
        super().__init__()

    def forward(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return v


class LearnedVelocity(InitialVelocity):
    """v_0 = v + s_v * network(q, v, u): where the state is estimated, not measured.

    A velocity derived from the last few samples of q carries noise, and damped motion forgets it
    within a step or two, so that the dynamics cannot average over it. The network knows where
    noise is likely, as where the motors rest. What follows obeys the equation of motion as before.
    It starts at v_0 = v, and is trained with the dynamics (an encoder of the initial state, as in
    Beintema, Schoukens and Toth 2023, "Deep subspace encoders for nonlinear system
    identification").

    Args:
        scales: of the data; the value is s_v, ``(N,)``.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
    """

    learned = True
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
        last = self.network.linears[-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.register_buffer("scale", scales.value.float().clone())

    def forward(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return v + self.scale * self.network(torch.cat([q, v, u], dim=-1))
