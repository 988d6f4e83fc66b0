"""The contract of a loss, and a loss with the penalty of the model."""

from __future__ import annotations

import abc

from torch import Tensor, nn

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor


class WindowLoss(nn.Module, abc.ABC):
    """Loss of a model on a batch of windows. The initial value is near one."""

    @abc.abstractmethod
    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        """Return the loss, a scalar, by operations that can be traced."""

    def selected(self, windows: Windows, progress: float) -> Windows:
        """Return the part of the windows that the loss uses at ``progress`` from 0 to 1."""
        return windows


class Penalized(WindowLoss):
    """Sum of a loss and the penalty of the model (:meth:`Predictor.penalty`).

    The penalty is evaluated at the start of each window, with the mean acceleration and the mean
    input of the first step.
    """

    def __init__(self, loss: WindowLoss):
        super().__init__()
        self.loss = loss

    def selected(self, windows: Windows, progress: float) -> Windows:
        return self.loss.selected(windows, progress)

    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        q, v = windows.start("qv").chunk(2, dim=-1)
        step = (windows.t[1] - windows.t[0]).to(q)
        a = windows.increments("qv")[..., 0, model.num_coordinates :] / step
        mean_input = windows.input.means(windows.t)[0].to(q)
        return self.loss(model, windows) + model.penalty(q, v, a, mean_input)
