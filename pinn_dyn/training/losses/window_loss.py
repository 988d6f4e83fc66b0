"""The contract of a loss."""

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
