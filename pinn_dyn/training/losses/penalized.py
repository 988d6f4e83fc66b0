"""A loss, and what the model's own freedom costs."""

from __future__ import annotations

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor
from pinn_dyn.training.losses.window_loss import WindowLoss


class Penalized(WindowLoss):
    """loss + penalty of the model at the starts of the windows (:meth:`Predictor.penalty`).

    The acceleration there is the mean over the first step, and so is the input.

    Args:
        loss: of the prediction.
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
        mean_input = model.acting_input(windows.input).means(windows.t)[0].to(q)
        return self.loss(model, windows) + model.penalty(q, v, a, mean_input)
