"""The parameters of a model as one vector, and AdamW on it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import (
    SGD,
    Adadelta,
    Adagrad,
    Adam,
    Adamax,
    AdamW,
    NAdam,
    Optimizer,
    RAdam,
    RMSprop,
)

ELEMENTWISE = (Adam, AdamW, NAdam, RAdam, Adamax, Adagrad, Adadelta, RMSprop, SGD)
"""Optimizers that treat every number separately, so that all parameters can be one vector."""


class ParameterVector:
    """The parameters of a model and their gradients as views of two vectors.

    Args:
        parameters: the parameters.

    Attributes:
        parameters: the parameters.
        values: all numbers of the parameters, ``(P,)``, with all gradients.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]):
        self.parameters = list(parameters)
        self._shapes = [p.shape for p in self.parameters]
        self._sizes = [shape.numel() for shape in self._shapes]
        self.values = nn.Parameter(torch.cat([p.detach().flatten() for p in self.parameters]))
        self.gradient = torch.zeros_like(self.values)
        self.values.grad = self.gradient
        for parameter, value in zip(self.parameters, self.split(self.values.detach()), strict=True):
            parameter.data = value
        self._gradients = self.split(self.gradient)
        self.show_gradients()

    def show_gradients(self) -> None:
        """Set the gradients of the parameters, which an optimizer or trainer may have removed."""
        for parameter, gradient in zip(self.parameters, self._gradients, strict=True):
            parameter.grad = gradient

    def split(self, vector: Tensor) -> list[Tensor]:
        """Split a vector ``(P,)`` into views of the shapes of the parameters."""
        parts = zip(vector.split(self._sizes), self._shapes, strict=True)
        return [part.view(shape) for part, shape in parts]

    def joined(self, gradients: Sequence[Tensor | None]) -> Tensor:
        """Join gradients of the shapes of the parameters, with None for zero, to ``(P,)``."""
        pairs = zip(gradients, self._sizes, strict=True)
        return torch.cat([self.values.new_zeros(n) if x is None else x.flatten() for x, n in pairs])

    def gradient_of(self, loss: Tensor) -> Tensor:
        """Return the gradient of a loss by autograd, ``(P,)``."""
        return self.joined(torch.autograd.grad(loss, self.parameters, allow_unused=True))


MOVED = 6
"""Number of arguments of :meth:`CompiledAdamW.step` after the gradient."""


def clipped(gradient: Tensor, largest: float | None, by_value: bool = False) -> Tensor:
    """Clip a gradient ``(P,)`` to the largest norm, or value, if any."""
    if largest is None:
        return gradient
    if by_value:
        return gradient.clamp(-largest, largest)
    norm = torch.linalg.vector_norm(gradient)
    return gradient * (largest / (norm + 1e-6)).clamp(max=1.0)


class CompiledAdamW:
    """Steps of an AdamW optimizer on a parameter vector, for the compiled program of a batch.

    Parameters and moments are those of the optimizer, and change in place::

        m <- b1 m + (1 - b1) g      s <- b2 s + (1 - b2) g^2
        w <- (1 - lr d) w - lr / (1 - b1^k) m / (sqrt(s / (1 - b2^k)) + eps)

    w: parameters, g: clipped gradient, m and s: moments, ``(P,)`` each; k: number of the
    step, b1 and b2: decay of the moments, d: weight decay. Source: Loshchilov and Hutter (2019),
    "Decoupled weight decay regularization".

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

    def arguments(self) -> tuple[Tensor, ...]:
        """Return the arguments of :meth:`step` after the gradient, MOVED in number."""
        (group,), state = self._optimizer.param_groups, self._optimizer.state[self._vector.values]
        moved = self._vector.values.detach(), self._vector.gradient
        moments = state["exp_avg"], state["exp_avg_sq"], state["step"]
        # A schedule changes the rate, and possibly the decay of the moments.
        numbers = group["lr"], *group["betas"], group["weight_decay"], group["eps"]
        return *moved, *moments, torch.from_numpy(np.array(numbers))

    def step(self, gradient: Tensor, *arguments: Tensor) -> None:
        """Move the parameters and count the step by operations that can be traced."""
        values, shown, mean, square, count, numbers = arguments
        rate, beta1, beta2, decay, eps = numbers.unbind()
        gradient = clipped(gradient, self._largest, self._by_value)
        count += 1
        size = rate / (1 - beta1**count)  # in double precision, since 1 - b^k cancels
        root = torch.sqrt(1 - beta2**count)
        scalars = (1 - rate * decay, size, root, eps, 1 - beta1, beta2, 1 - beta2)
        shrink, size, root, eps, weight, beta2, weight2 = (x.to(values) for x in scalars)
        mean += weight * (gradient - mean)
        square.copy_(beta2 * square + weight2 * gradient * gradient)
        values.copy_(shrink * values - size * mean / (torch.sqrt(square) / root + eps))
        shown.copy_(gradient)
