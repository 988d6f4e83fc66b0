"""Figures of validation rollouts in the training log."""

from __future__ import annotations

from typing import Any

import lightning as L
from lightning.pytorch.loggers import TensorBoardLogger
from pydantic import PositiveInt


class RolloutFigures(L.Callback):
    """Figures of a validation rollout, its error and the learned terms in the training log."""

    def __init__(self, *, every_n_validations: PositiveInt = 4):
        self.every_n_validations = every_n_validations
        self._validations = 0

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw at every n-th validation."""
        self._validations += 1
        if self._validations % self.every_n_validations == 0:
            self._draw(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw the final model, unless the last validation did."""
        if self._validations % self.every_n_validations:
            self._draw(trainer, pl_module)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        datamodule = trainer.datamodule  # type: ignore[attr-defined]
        (truth,) = list(datamodule.val_dataloader())
        validator: Any = pl_module.validator
        figures = validator.figures(pl_module.model, datamodule.data.source, truth)
        # The step at which Lightning logs the errors of the same validation.
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                for name, figure in figures.items():
                    logger.experiment.add_figure(name, figure, trainer.global_step - 1)
