"""Least squares as a LightningModule: one training step is the whole fit."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import SGD

from pinn_dyn.data.windows import Windows
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.learner import DynamicsLearner, Validator
from pinn_dyn.training.least_squares import Fit, LeastSquares
from pinn_dyn.training.losses import WindowLoss

COVARIANCE = "covariance"
"""Under which a checkpoint has that of the constants."""


class LeastSquaresLearner(DynamicsLearner):
    """Fits a model by least squares where others take many steps of an optimizer.

    So a fit has the run folder, checkpoints, validation and logs of every training. The trainer has
    ``steps: 1`` and ``validations: 1``; one batch holds all windows.

    Args:
        model: what is fitted.
        solver: the fit.
        covariance: of the constants that the model starts from, if an earlier fit found them.
        loss, validator, config, statistics: as of :class:`DynamicsLearner`.

    Attributes:
        result: of the fit, once it is done.

    Raises:
        TypeError: unless the parameters of the model are physical constants.
    """

    result: Fit | None = None

    def __init__(
        self,
        model: LearnedConstants,
        *,
        solver: LeastSquares,
        covariance: Tensor | None = None,
        loss: WindowLoss,
        validator: Validator,
        config: dict[str, Any],
        statistics: Statistics,
    ):
        if not isinstance(model, LearnedConstants):
            raise TypeError(
                "least squares fits physical constants (model=known or known_system), not "
                f"{type(model).__name__}: take optimizer=adamw"
            )
        super().__init__(
            model,
            loss=loss,
            optimizer=SGD,
            scheduler=torch.optim.lr_scheduler.ConstantLR,
            validator=validator,
            config=config,
            statistics=statistics,
            compile=False,
        )
        self.solver = solver
        self.covariance = covariance

    def training_step(self, batch: Windows, batch_idx: int) -> None:  # type: ignore[override]
        """The fit, on all training trajectories and windows, in double precision."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(self.model, LearnedConstants)
        if self.result is None:
            self.result = self.solver.fit(
                self.model, data.splits.train, data.windows, self.covariance
            )
        self.log_losses(torch.tensor(self.result.residual**2))
        self.optimizers().step()  # type: ignore[union-attr]  # no gradients: it only counts

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the covariance of the constants, for a fit that starts from this one."""
        if self.result is not None:
            checkpoint[COVARIANCE] = self.result.covariance

    def configure_optimizers(self) -> Any:
        """One that does nothing, as the trainer counts its steps."""
        return SGD(self.model.parameters(), lr=0.0)
