"""How far the networks of M and D may go beyond what they gave on the training data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.cholesky import NetworkCholesky

_NAME = "output_limits"  # of the buffer
_MOST = 20_000  # configurations that are looked at


def output_limits(model: nn.Module, q: Tensor) -> dict[str, Tensor]:
    """Limits of the heads of a model at training configurations q ``(K, N)``, by their name."""
    q = q[:: -(-len(q) // _MOST)]
    return {f"{name}.{_NAME}": head.limits_at(q) for name, head in _heads(model)}


def given_limits(model: nn.Module) -> dict[str, Tensor]:
    """The limits that the heads of a model have, by their name."""
    return {name: x for name, x in model.named_buffers() if is_limit(name)}


def joint_limits(each: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The limits that hold for all members of an ensemble, which share their buffers."""

    def joint(name: str) -> Tensor:
        low, high, margin = torch.stack([one[name] for one in each]).unbind(1)
        return torch.stack([low.amin(0), high.amax(0), margin.amax(0)])

    return {name: joint(name) for name in set.intersection(*map(set, each))}


def set_output_limits(model: nn.Module, limits: Mapping[str, Tensor]) -> None:
    """Give the heads of a model these limits, by their name, and none to the others."""
    for name, head in _heads(model):
        head.output_limits = limits.get(f"{name}.{_NAME}")


def expect_output_limits(model: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Make room for the limits among the weights of a checkpoint, if it has any."""
    for name, head in _heads(model):
        there = f"{name}.{_NAME}" in weights
        head.output_limits = torch.zeros(3, len(head.order)) if there else None


def free_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a checkpoint without limits."""
    return {name: value for name, value in weights.items() if not is_limit(name)}


def is_limit(name: str) -> bool:
    """Whether a buffer of that name holds the limits of a head."""
    return name.endswith(f".{_NAME}")


def _heads(model: nn.Module) -> list[tuple[str, NetworkCholesky]]:
    return [(n, head) for n, head in model.named_modules() if isinstance(head, NetworkCholesky)]
