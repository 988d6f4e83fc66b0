"""Compiled gradients of many members at once."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.ensembles.stack import ContinuousStack
from pinn_dyn.mechanics.compilation import MOST_EVALUATIONS, CompiledDynamics, integrated_by
from pinn_dyn.training.gradients.compiled import EvaluationCount
from pinn_dyn.training.gradients.program import LossProgram
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import ParameterVector


class CompiledMembers:
    """The losses ``(E,)`` of an ensemble, and the gradient of each in its member's parameters.

    Where a window costs few evaluations of the dynamics, one program for the loss and the gradient
    of a single model serves all members, side by side on the threads of torch; on a GPU it is one
    program for all. Elsewhere the dynamics of all members are compiled as one.

    Args:
        loss: of a model, or of stacked members.
        stack: the members.
        vector: their parameters.
    """

    def __init__(self, loss: WindowLoss, stack: ContinuousStack, vector: ParameterVector):
        self.loss = loss
        self.stack = stack
        self.vector = vector
        self._integrator = CompiledDynamics(stack.integrator, stack)
        of_one = stack.template.model
        self._program = LossProgram(loss, stack if vector.values.is_cuda else of_one, vector)
        self._evaluations = EvaluationCount(loss, stack.template.taken_apart(0))

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """The losses on windows ``(E, B, ...)``, and their gradients."""
        if self._evaluations(next(windows.unbind())) > MOST_EVALUATIONS:
            with integrated_by(self.stack, self._integrator):
                losses = self.loss(self.stack, windows)
            return losses.detach(), self.vector.gradient_of(losses.sum())
        if windows.q.is_cuda:
            return self._program(windows, len(windows))
        batches = [windows[index] for index in torch.arange(len(windows))]
        taken = self._program.side_by_side(self.vector.values.detach().unbind(), batches)
        losses, gradients = map(torch.stack, zip(*taken, strict=True))
        return losses, gradients
