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
    """Engine for the losses ``(E,)`` of an ensemble and their gradients.

    If a window needs few evaluations of the dynamics, a compiled program for the loss and gradient
    of a single model runs for all members in parallel threads. On a GPU one program computes all
    members. Otherwise the dynamics of all members are compiled together.
    """

    def __init__(self, loss: WindowLoss, stack: ContinuousStack, vector: ParameterVector):
        self.loss, self.stack, self.vector = loss, stack, vector
        self._integrator = CompiledDynamics(stack.integrator, stack)
        model = stack if vector.values.is_cuda else stack.template.model
        self._program = LossProgram(loss, model, vector)
        self._evaluations = EvaluationCount(loss, stack.template.member(0))

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        """Return the losses on windows ``(E, B, ...)`` and their gradients."""
        if self._evaluations(next(windows.unbind())) > MOST_EVALUATIONS:
            with integrated_by(self.stack, self._integrator):
                losses = self.loss(self.stack, windows)
            return losses.detach(), self.vector.gradient_of(losses.sum())
        if windows.q.is_cuda:
            return self._program(windows, len(windows))
        batches = list(windows.unbind())
        results = self._program.in_parallel(self.vector.values.detach().unbind(), batches)
        losses, gradients = map(torch.stack, zip(*results, strict=True))
        return losses, gradients
