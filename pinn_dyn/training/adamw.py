"""Steps of AdamW as part of a compiled program."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.optim import AdamW, Optimizer

from pinn_dyn.training.parameter_vector import ParameterVector

MOVED = 5
"""Number of arguments of :meth:`CompiledAdamW.step` after the gradient."""


def clipped(gradient: Tensor, largest: float | None, by_value: bool = False) -> Tensor:
    """Clip a gradient ``(*members, P)`` to the largest norm of each member, or value, if any."""
    if largest is None:
        return gradient
    if by_value:
        return gradient.clamp(-largest, largest)
    norm = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
    return gradient * (largest / (norm + 1e-6)).clamp(max=1.0)


class CompiledAdamW:
    """Steps of an AdamW optimizer on a parameter vector, for the compiled program of a batch.

    Parameters and moments are those of the optimizer, and change in place::

        m <- b1 m + (1 - b1) g      s <- b2 s + (1 - b2) g^2      g: the clipped gradient
        w <- (1 - lr d) w - lr / (1 - b1^k) m / (sqrt(s / (1 - b2^k)) + eps)

    Args:
        optimizer: the optimizer of the vector. A step of length zero creates its state.
        vector: the parameters.
        largest, by_value: arguments of :func:`clipped`.
    """

    def __init__(
        self, optimizer: Optimizer, vector: ParameterVector, largest: float | None, by_value: bool
    ):
        self._optimizer, self._vector = optimizer, vector
        self._largest, self._by_value = largest, by_value
        (group,) = optimizer.param_groups
        rate, group["lr"] = group["lr"], 0.0
        optimizer.step()  # the gradient is zero
        group["lr"] = rate
        optimizer.state[vector.values]["step"].zero_()

    @staticmethod
    def supports(optimizer: Optimizer) -> bool:
        """Tell whether an optimizer has the formula of this class."""
        options = optimizer.defaults
        return type(optimizer) is AdamW and not (options["amsgrad"] or options["maximize"])

    def next_arguments(self) -> tuple[Tensor, ...]:
        """Count a step and return the arguments of :meth:`step` after the gradient."""
        (group,), state = self._optimizer.param_groups, self._optimizer.state[self._vector.values]
        beta1, beta2 = group["betas"]
        state["step"] += 1
        number, rate = float(state["step"]), group["lr"]
        root = math.sqrt(1 - beta2**number)
        factors = (1 - rate * group["weight_decay"], -rate / (1 - beta1**number), root)
        values = self._vector.values.detach()
        moments = state["exp_avg"], state["exp_avg_sq"]
        return values, self._vector.gradient, *moments, torch.tensor(factors, dtype=values.dtype)

    def step(self, gradient: Tensor, *arguments: Tensor) -> None:
        """Move the parameters by operations that can be traced."""
        values, shown, mean, square, (decay, rate, root) = arguments
        (group,) = self._optimizer.param_groups
        beta1, beta2 = group["betas"]
        gradient = clipped(gradient, self._largest, self._by_value)
        mean.lerp_(gradient, 1 - beta1)
        square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
        update = rate * mean / (square.sqrt() / root + group["eps"])
        values.mul_(decay).add_(update)
        shown.copy_(gradient)
