"""The contract of a loss, and a loss with what the model's own freedom costs."""

from __future__ import annotations

import abc

from torch import Tensor, nn

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor


class WindowLoss(nn.Module, abc.ABC):
    """A loss of a model on a batch of windows, a number near one before anything is learned.

    It is mathematics alone: how its gradient is taken, eagerly or compiled, is no matter of the
    loss (:mod:`pinn_dyn.training.gradients`).
    """

    @abc.abstractmethod
    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        """The loss, a scalar, by operations that can be traced.

        Of the stacked members of an ensemble, on windows ``(E, B, ...)``, it has one entry for
        each, ``(E,)``.
        """

    def selected(self, windows: Windows, progress: float) -> Windows:
        """What of the windows counts when the part ``progress``, 0 to 1, of the training is over.

        Here it is all of them.
        """
        return windows


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
