"""Gradient engines: eager autograd, or programs that are compiled."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.mechanics.compilation import (
    CHUNK,
    MOST_EVALUATIONS,
    STEPS_FOR_PROGRAM,
    CompiledDynamics,
    integrated_by,
)
from pinn_dyn.training.loss_program import LossProgram, StateWindows, weighted_sum
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import CompiledAdamW, ParameterVector

Engine = Callable[[Windows], tuple[Tensor, Tensor]]
"""Function from windows to the loss ``()`` and its gradient ``(P,)``."""


class Eager:
    """Engine for loss and gradient by eager autograd."""

    def __init__(self, loss: WindowLoss, model: Predictor, vector: ParameterVector):
        self.loss, self.model, self.vector = loss, model, vector

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        loss = self.loss(self.model, windows)
        return loss.detach(), self.vector.gradient_of(loss)


class Compiled:
    """Engine for loss and gradient by compiled dynamics, or by one compiled program.

    A program for loss and gradient is fastest and takes longest to compile. It is used if the
    training of ``steps`` steps is long and a window needs few evaluations of the dynamics.
    Otherwise only the dynamics are compiled. On a CPU large batches are split into parts.
    """

    def __init__(
        self, loss: WindowLoss, model: ContinuousPredictor, vector: ParameterVector, steps: int
    ):
        self.loss, self.model, self.vector, self.steps = loss, model, vector, steps
        self._integrator = CompiledDynamics(model.integrator, model)
        self._program = LossProgram(loss, model, vector)

    def step(self, windows: Windows, optimizer: CompiledAdamW) -> Callable[[], list[Tensor]] | None:
        """Return a function that takes a step on a batch, or None if a program does not pay off."""
        part = self._part(windows)
        if part is None or len(windows) >= 2 * part or windows.q.is_cuda:
            return None
        return self._program.step(windows, optimizer)

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        if (part := self._part(windows)) is not None:
            return self._program(windows, part)
        on_cpu = windows.q.device.type == "cpu"
        if not on_cpu or len(windows) < 2 * CHUNK:
            return self._loss_and_gradient(windows)
        parts = windows.split(CHUNK)
        shares = [len(part) / len(windows) for part in parts]
        return weighted_sum(shares, map(self._loss_and_gradient, parts))

    def _part(self, windows: Windows) -> int | None:
        """Return the windows that a program computes at once, or None without a program."""
        evaluations = self.loss.evaluations(self.model, len(windows.t) - 1)
        on_cpu = windows.q.device.type == "cpu"
        # On a GPU a program replaces thousands of launches.
        long = not on_cpu or self.steps >= STEPS_FOR_PROGRAM
        if evaluations == 0:  # of a rollout with joints that stick, which has no derivative
            return None
        if evaluations > 1 and (evaluations > MOST_EVALUATIONS or not long):
            return None
        return CHUNK * MOST_EVALUATIONS // evaluations if on_cpu else len(windows)

    def _loss_and_gradient(self, windows: Windows) -> tuple[Tensor, Tensor]:
        laid_out = StateWindows.of(windows, self.model.state)
        laid_out.x0.requires_grad_()  # so that all stages share a compiled function
        with integrated_by(self.model, self._integrator):
            loss = self.loss(self.model, laid_out)
        return loss.detach(), self.vector.gradient_of(loss)
