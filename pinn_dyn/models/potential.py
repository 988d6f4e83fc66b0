"""Heads for the potential energy and its force."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.models.mlp import Activation, columns, rows
from pinn_dyn.models.scales import Scales


class Potential(nn.Module, abc.ABC):
    """Potential energy V(q) and its gradient."""

    @abc.abstractmethod
    def forward(self, q: Tensor) -> Tensor:
        """Return V(q), ``(*batch,)``, J."""

    @abc.abstractmethod
    def gradient(self, q: Tensor) -> Tensor:
        """Return G(q) = dV/dq, ``(*batch, N)``."""


class NetworkPotential(Potential):
    """V(q) = scale * (network(q) + z^T K z / 2), z = (q - mean)/std, and G = dV/dq.

    K = S S^T is a learned constant matrix. z is zero for angles. The input of the network saturates
    outside the data. V is therefore bounded from below.

    Args:
        scales: scales of the data. The value is a typical energy, J.
        hidden, activation: widths and activation of the hidden layers.
        quadratic: true for the term with K; false is the plain network of the paper.
        initial: factor of the initial weights of the last layer; 0 for a part of a sum.
    """

    scale: Tensor

    def __init__(
        self,
        scales: Scales,
        *,
        hidden: Sequence[PositiveInt],
        activation: Activation = "softplus",
        quadratic: bool = True,
        initial: float = 1.0,
    ):
        super().__init__()
        size = scales.size
        self.network = scales.network(1, hidden, activation)
        with torch.no_grad():
            self.network.linears[-1].weight.mul_(initial)
        self.register_buffer("scale", scales.value.float())
        quadratic = quadratic and len(set(scales.angles)) < size
        self.stiffness_root = nn.Parameter(torch.eye(size)) if quadratic else None

    def forward(self, q: Tensor) -> Tensor:
        value = self.network(q).squeeze(-1)
        if self.stiffness_root is not None:
            value = value + 0.5 * (self._lengths(q) @ self.stiffness_root).square().sum(-1)
        return self.scale * value

    def gradient(self, q: Tensor) -> Tensor:
        y, tape = self.network.linearize(q)
        force = self.network.pullback(tape, torch.ones_like(y))
        if self.stiffness_root is not None:
            stiffness = self.stiffness_root @ self.stiffness_root.T
            well = self._lengths(q) @ stiffness / self.network.std
            force = force + well.masked_fill(self.network.is_angle, 0.0)
        return self.scale * force

    def _lengths(self, q: Tensor) -> Tensor:
        z = (q - self.network.mean) / self.network.std
        return z.masked_fill(self.network.is_angle, 0.0)


class ChainPotential(Potential):
    """Potential of a serial chain of revolute joints, linear in each sine and cosine::

        V = scale * e^T w_1,    w_k = (T_k + S_k sin q_k + C_k cos q_k) w_k+1 + h_k

    with w_N+1 = h_N+1, and learned T, S, C, h and e. Joints are ordered from base to tip. In a
    chain of rigid bodies, w_k is the first moment of mass of the bodies from joint k to the tip, in
    the frame before joint k. Three rows represent w_k exactly; more rows are easier to train.

    Args:
        scales: scales of the data. The value is a typical energy, J.
        rank: number of rows of the vectors w, h and e.

    Raises:
        ValueError: if a coordinate is not an angle.
    """

    scale: Tensor

    def __init__(self, scales: Scales, *, rank: PositiveInt = 8):
        super().__init__()
        size, angles = scales.size, scales.angles
        if set(angles) != set(range(size)):
            raise ValueError(
                f"angles is {list(angles)}, expected all {size} coordinates: a ChainPotential is "
                "for revolute joints"
            )
        self.rank = rank

        def normal(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.randn(shape) / rank**0.5)

        self.turns = nn.ParameterList(normal(3 * rank, rank) for _ in range(size))
        self.offsets = nn.ParameterList(normal(rank, 1) for _ in range(size + 1))
        self.base = normal(rank, 1)
        with torch.no_grad():
            for turn in self.turns:
                turn.mul_(0.7)  # keeps the size of w along the chain
        self.register_buffer("scale", scales.value.float())

    def forward(self, q: Tensor) -> Tensor:
        w, _ = self._moments(columns(q))
        return self.scale * (self.base * w).sum(0).reshape(q.shape[:-1])

    def gradient(self, q: Tensor) -> Tensor:
        x = columns(q)
        sine, cosine = torch.sin(x), torch.cos(x)
        _, turned = self._moments(x)
        left, force = self.base.expand(-1, x.shape[1]), []
        for k, (by_sine, by_cosine) in enumerate(turned):
            force.append((left * (cosine[k] * by_sine - sine[k] * by_cosine)).sum(0))
            left = self.turns[k].T @ torch.cat([left, sine[k] * left, cosine[k] * left])
        return self.scale * rows(torch.stack(force), q)

    def _moments(self, x: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Return w_1, ``(rank, B)``, and S_k w_k+1 and C_k w_k+1 of each joint."""
        sine, cosine = torch.sin(x), torch.cos(x)
        w, turned = self.offsets[-1].expand(-1, x.shape[1]), []
        for k in reversed(range(len(x))):
            fixed, by_sine, by_cosine = (self.turns[k] @ w).split(self.rank)
            w = fixed + sine[k] * by_sine + cosine[k] * by_cosine + self.offsets[k]
            turned.append((by_sine, by_cosine))
        return w, turned[::-1]
