"""Head for the potential energy and its force."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP


class NetworkPotential(nn.Module):
    """V(q) = scale * (network(q) + z^T K z / 2), z = (q - mean)/std, and G = dV/dq.

    K = S S^T is a learned constant: an elastic or gravity well is mostly quadratic, and the
    network then only has to learn what is left. Angles are left out of z, as V is periodic in them.

    Args:
        size: N.
        scale: typical energy, J; from the data.
        mean, std: normalization of q, ``(N,)``; from the data.
        angles: which coordinates are angles, and enter the network as sine and cosine.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        quadratic: whether the K term is there; false is the paper's plain network.
    """

    scale: Tensor

    def __init__(
        self,
        *,
        size: int,
        scale: float,
        mean: Tensor,
        std: Tensor,
        angles: Sequence[int] = (),
        hidden: Sequence[int],
        activation: str = "softplus",
        quadratic: bool = True,
    ):
        super().__init__()
        self.network = MLP(size, 1, hidden, activation, mean, std, angles)
        self.register_buffer("scale", torch.tensor(float(scale)))
        quadratic = quadratic and len(set(angles)) < size
        self.stiffness_root = nn.Parameter(torch.eye(size)) if quadratic else None

    def forward(self, q: Tensor) -> Tensor:
        """V(q), ``(*batch,)``, J."""
        value = self.network(q).squeeze(-1)
        if self.stiffness_root is not None:
            value = value + 0.5 * (self._lengths(q) @ self.stiffness_root).square().sum(-1)
        return self.scale * value

    def gradient(self, q: Tensor) -> Tensor:
        """G(q) = dV/dq, ``(*batch, N)``, by one reverse pass."""
        y, tape = self.network.linearize(q)
        force = self.network.pullback(tape, torch.ones_like(y))
        if self.stiffness_root is not None:
            stiffness = self.stiffness_root @ self.stiffness_root.T
            well = self._lengths(q) @ stiffness / self.network.std
            force = force + well.masked_fill(self.network.is_angle, 0.0)
        return self.scale * force

    def _lengths(self, q: Tensor) -> Tensor:
        """z, with zero in the place of angles."""
        z = (q - self.network.mean) / self.network.std
        return z.masked_fill(self.network.is_angle, 0.0)
