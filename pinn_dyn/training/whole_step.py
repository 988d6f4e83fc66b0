"""Loss and gradient of a batch as one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor
from pinn_dyn.mechanics.compilation import compile_graph
from pinn_dyn.mechanics.integration import step_grid
from pinn_dyn.mechanics.steps import take_steps

Gradients = list[Tensor | None]
"""One entry for each parameter of the model, None where the loss does not depend on it."""
MOST_STAGES = 4
"""Evaluations of the dynamics in a window up to which it is compiled as a whole: the time to
compile grows with them."""


def stages(model: ContinuousPredictor, windows: Windows) -> int:
    """Evaluations of the dynamics in a window."""
    return len(model.scheme().nodes) * model.substeps * (len(windows.t) - 1)


class WholeStep:
    """The loss of windows and its gradient in the parameters, by one call of a C++ program.

    A compiled derivative still leaves some hundred operations around it to Python and autograd,
    which is half of the time of a small batch. Here the roll-out, the loss and the gradient are
    traced as one graph and compiled for the batch sizes that come.

    Args:
        model: the model that is trained.
        error: the loss of increments, as :meth:`IncrementLoss.error`.

    Attributes:
        parameters: those of the model, in the order of the gradients.
    """

    def __init__(self, model: ContinuousPredictor, error: Callable[[Tensor, Tensor], Tensor]):
        self._window = _Window(model, error)
        self.parameters = list(model.parameters())  # walking through the modules takes its time
        self._programs: dict[tuple[Any, ...], Callable[..., list[Any]]] = {}

    def __call__(self, windows: Windows) -> tuple[Tensor, Gradients]:
        """The loss and its gradients."""
        model = self._window.model
        x0 = windows.start(model.coordinates).mT.contiguous().mT  # the batch along memory
        arguments = (
            [value.detach() for value in self.parameters],
            x0,
            windows.u,
            windows.increments(model.coordinates),
        )
        key = (windows.dq.shape, x0.dtype)
        with torch.no_grad():
            if key not in self._programs:
                self._programs[key] = compile_graph(self._traced(windows), arguments)
            loss, *gradients = self._programs[key](*arguments)
        return loss, gradients

    def _traced(self, windows: Windows) -> Callable[..., list[Any]]:
        names = [f"model.{name}" for name, _ in self._window.model.named_parameters()]

        def loss_and_gradients(
            values: list[Tensor], x0: Tensor, u: Tensor, measured: Tensor
        ) -> list[Any]:
            with torch.enable_grad():
                values = [value.detach().requires_grad_() for value in values]
                loss = functional_call(
                    self._window,
                    dict(zip(names, values, strict=True)),
                    (windows, x0, u, measured),
                )
                gradients = torch.autograd.grad(loss, values, allow_unused=True)
            return [loss.detach(), *gradients]

        return loss_and_gradients


class _Window(nn.Module):
    """The loss of a batch as a function of the parameters and of the data."""

    def __init__(self, model: ContinuousPredictor, error: Callable[[Tensor, Tensor], Tensor]):
        super().__init__()
        self.model = model
        self.error = error

    def forward(self, windows: Windows, x0: Tensor, u: Tensor, measured: Tensor) -> Tensor:
        t, t_input = windows.t - windows.t[0], windows.t_input - windows.t[0]
        grid = step_grid(t, t_input, self.model.substeps)
        path = take_steps(
            self.model.scheme(), x0, grid.to(x0), t_input.to(x0), u, windows.interpolation
        )
        return self.error(path[self.model.substeps :: self.model.substeps].movedim(0, -2), measured)
