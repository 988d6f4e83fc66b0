"""Limits of the outputs of the networks of M and D outside the training data."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from pinn_dyn.models.cholesky import NetworkCholesky

_NAME = "output_limits"  # name of the buffer
_CONFIGURATIONS = 20_000  # largest number of evaluated configurations


def output_limits(model: nn.Module, q: Tensor) -> dict[str, Tensor]:
    """Compute the limits of the heads at training configurations q ``(K, N)``, by name."""
    q = q[:: -(-len(q) // _CONFIGURATIONS)]
    return {f"{name}.{_NAME}": head.limits_at(q) for name, head in _heads(model)}


def set_output_limits(model: nn.Module, limits: Mapping[str, Tensor]) -> None:
    """Set the limits of the heads of a model by name, and remove all other limits."""
    for name, head in _heads(model):
        head.output_limits = limits.get(f"{name}.{_NAME}")


def free_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a checkpoint without limits."""
    return {name: value for name, value in weights.items() if not name.endswith(f".{_NAME}")}


def _heads(model: nn.Module) -> list[tuple[str, NetworkCholesky]]:
    return [(n, head) for n, head in model.named_modules() if isinstance(head, NetworkCholesky)]
