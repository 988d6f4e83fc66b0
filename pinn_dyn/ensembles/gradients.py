"""Compiled gradients of many members at once."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.ensembles.stack import ContinuousStack
from pinn_dyn.mechanics.compilation import MOST_EVALUATIONS, CompiledDynamics, integrated_by
from pinn_dyn.training.gradients.compiled import EvaluationCount
from pinn_dyn.training.gradients.known import Gradients
from pinn_dyn.training.gradients.program import LossProgram
from pinn_dyn.training.losses import WindowLoss


class CompiledMembers:
    """The losses ``(E,)`` of an ensemble, each with the gradient in its own member's parameters.

    Where a window costs few evaluations of the dynamics, one program for the loss and the gradient
    of a single model serves all members, side by side on the threads of torch. Elsewhere the
    dynamics of all members are compiled as one.

    Args:
        loss: of a model, or of stacked members.
        stack: the members.
    """

    def __init__(self, loss: WindowLoss, stack: ContinuousStack):
        self.loss = loss
        self.stack = stack
        self._integrator = CompiledDynamics(stack.integrator, stack)
        self._program = LossProgram(loss, stack.template.model)
        self._evaluations = EvaluationCount(loss, stack.template.taken_apart(0))
        self._parameters = list(stack.parameters())

    def __call__(self, windows: Windows) -> Tensor:
        """The losses on windows ``(E, B, ...)``; their backward pass gives the gradients."""
        batches = [windows[index] for index in torch.arange(len(windows))]
        many = self._evaluations(batches[0]) > MOST_EVALUATIONS
        if many or windows.q.device.type != "cpu":
            with integrated_by(self.stack, self._integrator):
                return self.loss(self.stack, windows)
        values = zip(*(value.detach().unbind() for value in self._parameters), strict=True)
        losses, *gradients = zip(*self._program.side_by_side(values, batches), strict=True)
        stacked = [None if some[0] is None else torch.stack(some) for some in gradients]
        return _MemberGradients.apply(torch.stack(losses), stacked, *self._parameters)


class _MemberGradients(torch.autograd.Function):
    """The losses ``(E,)`` of an ensemble, whose gradients ``(E, ...)`` are known.

    Each loss moves the parameters of its own member alone.
    """

    @staticmethod
    def forward(ctx: Any, losses: Tensor, gradients: Gradients, *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return losses

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        (weights,) = upstream
        scaled = [
            None if gradient is None else gradient * weights.reshape(-1, *[1] * (gradient.ndim - 1))
            for gradient in ctx.gradients
        ]
        return None, None, *scaled
