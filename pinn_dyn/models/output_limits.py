"""Limits of the outputs of the networks of M and D outside the training data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.cholesky import NetworkCholesky

_NAME = "output_limits"  # name of the buffer
_CONFIGURATIONS = 20_000  # largest number of evaluated configurations


def output_limits(model: nn.Module, q: Tensor) -> dict[str, Tensor]:
    """Compute the limits of the heads at training configurations q ``(K, N)``, by name."""
    q = q[:: -(-len(q) // _CONFIGURATIONS)]
    return {f"{name}.{_NAME}": head.limits_at(q) for name, head in _heads(model)}


def given_limits(model: nn.Module) -> dict[str, Tensor]:
    """Return the limits that the heads of a model have, by name."""
    return {name: x for name, x in model.named_buffers() if name.endswith(f".{_NAME}")}


def joint_limits(members: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Combine the limits of all members of an ensemble, which share their buffers."""

    def joint(name: str) -> Tensor:
        low, high, margin = torch.stack([limits[name] for limits in members]).unbind(1)
        return torch.stack([low.amin(0), high.amax(0), margin.amax(0)])

    return {name: joint(name) for name in set.intersection(*map(set, members))}


def set_output_limits(model: nn.Module, limits: Mapping[str, Tensor]) -> None:
    """Set the limits of the heads of a model by name, and remove all other limits."""
    for name, head in _heads(model):
        head.output_limits = limits.get(f"{name}.{_NAME}")


def free_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a checkpoint without limits."""
    return {name: value for name, value in weights.items() if not name.endswith(f".{_NAME}")}


def _heads(model: nn.Module) -> list[tuple[str, NetworkCholesky]]:
    return [(n, head) for n, head in model.named_modules() if isinstance(head, NetworkCholesky)]
