"""A simulator's function of q, such as M(q), for automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

_Batched = Callable[[Tensor], Tensor]


class KnownSlope(torch.autograd.Function):
    """A function of q whose first derivative is known: y ``(*batch, ...)``, dy/dq one axis more."""

    @staticmethod
    def forward(value: _Batched, slope: _Batched, q: Tensor) -> Tensor:
        return value(q)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, ctx.slope, q = inputs
        ctx.save_for_backward(q)
        ctx.save_for_forward(q)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None, Tensor]:
        (q,) = ctx.saved_tensors
        slope = KnownSlope.apply(ctx.slope, _no_slope, q)
        batch, size = q.shape[:-1], q.shape[-1]
        flat = slope.reshape(*batch, -1, size)
        return None, None, (gradients[0].reshape(*batch, 1, -1) @ flat).squeeze(-2)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        (q,) = ctx.saved_tensors
        slope = KnownSlope.apply(ctx.slope, _no_slope, q)
        ones = (1,) * (slope.ndim - q.ndim)
        return (slope * tangents[2].reshape(*q.shape[:-1], *ones, -1)).sum(-1)


def _no_slope(q: Tensor) -> Tensor:
    raise RuntimeError("BulletArm: M and V have first derivatives only")
