"""Diagonal control gains."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

Gain = float | Sequence[float] | Tensor
"""One positive number for all coordinates, or N of them."""


def diagonal_gain(name: str, value: Gain, size: int) -> Tensor:
    """The diagonal of a gain matrix K = diag(k_1 ... k_N), ``(N,)``, float64.

    Paper, Propositions on regulation and tracking: K_P and K_D must be positive definite.

    Args:
        name: what to call the gain in an error.
        value: one number for all coordinates, or N of them.
        size: N.

    Raises:
        ValueError: on a gain that is no number, not finite, not positive, or not 1 or N of them.
    """
    expected = f"expected one positive number or {size} of them, one for each coordinate"
    try:
        gain = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} is {value!r}: {expected}") from error
    if gain.ndim > 1 or (gain.ndim == 1 and gain.shape[0] != size):
        raise ValueError(f"{name} has shape {tuple(gain.shape)}: {expected}")
    if not bool((torch.isfinite(gain) & (gain > 0)).all()):
        raise ValueError(
            f"{name} is {gain.tolist()}: {expected}; the closed loop is only proven stable for "
            "positive definite gains"
        )
    return gain.expand(size).clone()
